// Kernels of blend and blend_vjp.
//
// A tile's 16x16 pixels are eight subtiles of 8x4, a warp of lanes each: subtile b at column b % 2 and
// row b / 2, lane l at column l % 8 and row l / 8 of it. A splat is tested against the subtiles once
// per tile; warps skip those that do not reach them.
//
// Lists are cut into chunks. blend_front goes through a tile's first chunks in order and knows when all
// pixels have stopped. Where pairs are left, the other chunks are done all at once: rest_through finds
// how much light each lets through, rest_scan from that the transmittance in front of each, with which
// rest_blend composites each exactly as if the chunks before had just been, and rest_sum adds up. So
// few tiles with long lists, as in small images of large scenes, still fill the device, and the last
// bits depend on nothing but the lists.
#pragma once

#include <type_traits>

#include "core/bin.h"
#include "core/blend.h"
#include "core/footprint/registry.h"
#include "cuda/side_streams.h"
#include "cuda/tasks.h"
#include "cuda/warp.cuh"

namespace ar::cuda {

inline constexpr int kTilePixels = kTile * kTile;
inline constexpr int kSubtiles = 8;
inline constexpr int kBlendThreads = 32 * kSubtiles;

/// A lane's pixel of subtile b, relative to the tile's first.
__device__ inline Vec2<float> pixel_of(int b, int lane) {
  return {float((b & 1) * 8 + (lane & 7)), float((b >> 1) * 4 + (lane >> 3))};
}

/// A tile and its list of splats, front to back.
struct TileList {
  int x0, y0;
  const int32_t* pairs;
  int stride, count;
  bool overflow;  ///< the list is all splats

  __device__ int32_t splat(int k) const { return pairs[int64_t(k) * stride]; }
  __device__ int32_t slot(int k) const { return pairs[int64_t(k) * stride + 1]; }
};

__device__ inline TileList list_of(const TileLists& lists, TileGrid grid, int tile) {
  TileList list;
  list.x0 = tile % grid.columns() * kTile;
  list.y0 = tile / grid.columns() * kTile;
  list.overflow = lists.counts->pairs > lists.capacity;
  list.stride = list.overflow ? 1 : lists.stride;
  const int64_t first = list.overflow ? 0 : lists.tile_offsets[tile];
  list.pairs = list.overflow ? lists.order : lists.pairs + first * lists.stride;
  list.count = int(list.overflow ? lists.counts->splats : lists.tile_offsets[tile + 1] - first);
  return list;
}

/// Bit b: the support reaches subtile b.
__device__ inline uint32_t subtile_reach(const Support<float>& support, int x0, int y0) {
  uint32_t reach = 0;
#pragma unroll
  for (int band = 0; band < 4; ++band) {
    const Span<float> span = columns_of(support, float(y0 + 4 * band), float(y0 + 4 * band + 3));
    reach |= uint32_t(span.lo <= float(x0 + 7) && span.hi >= float(x0)) << (2 * band);
    reach |= uint32_t(span.lo <= float(x0 + 15) && span.hi >= float(x0 + 8)) << (2 * band + 1);
  }
  return reach;
}

/// What the pixels of a tile need of a splat.
template <class F> struct alignas(16) TileSplat {
  typename F::template Terms<float> terms;
  Vec3<float> color;
};

/// A splat while pixels are at it: copied to registers, unless it has too many numbers.
template <class F>
using Held = std::conditional_t<sizeof(TileSplat<F>) <= 112, const TileSplat<F>, const TileSplat<F>&>;

template <class F> __device__ TileSplat<F> tile_splat(const Splat<F, float>& splat, const TileList& list) {
  return {F::terms(splat.shape, splat.opacity, {float(list.x0) - splat.mean.x, float(list.y0) - splat.mean.y}),
          splat.color};
}

/// What compositing carries from splat to splat. kColors: 1, or one per sample where checkpoints need it.
template <int S, int kColors> struct PixelState {
  float transmittance[S];
  Vec3<float> color[kColors];
  int last[S];

  __device__ void start(bool open) {
#pragma unroll
    for (int s = 0; s < S; ++s) transmittance[s] = open ? 1.0f : -1.0f, last[s] = 0;
    clear_color();
  }
  __device__ void clear_color() {
#pragma unroll
    for (int c = 0; c < kColors; ++c) color[c] = {0, 0, 0};
  }
  __device__ Vec3<float> total_color() const {
    Vec3<float> total = color[0];
#pragma unroll
    for (int c = 1; c < kColors; ++c) total += color[c];
    return total;
  }
  __device__ bool open() const {
    bool any = false;
#pragma unroll
    for (int s = 0; s < S; ++s) any |= transmittance[s] > 0;
    return any;
  }
};

/// Composites the splats in `mask` of a group of 32; `index` = place of the first in the tile's list.
template <class F, int kColors>
__device__ __forceinline__ void composite(const TileSplat<F>* splats, uint32_t mask, int index, Vec2<float> p,
                                          PixelState<F::kSamples, kColors>& state) {
  for (; mask != 0; mask &= mask - 1) {
    const int j = __ffs(mask) - 1;
    Held<F> splat = splats[j];
    float contribution = 0;
#pragma unroll
    for (int s = 0; s < F::kSamples; ++s) {
      const Blended<float> b = blend_sample(F::alpha(splat.terms, p, s), state.transmittance[s]);
      if (kColors > 1) {
        state.color[s % kColors] = {madd(b.contribution, splat.color.x, state.color[s % kColors].x),
                                    madd(b.contribution, splat.color.y, state.color[s % kColors].y),
                                    madd(b.contribution, splat.color.z, state.color[s % kColors].z)};
      } else {
        contribution = s == 0 ? b.contribution : contribution + b.contribution;
      }
      state.last[s] = b.mask ? index + j + 1 : state.last[s];
    }
    if (kColors == 1) {
      state.color[0] = {madd(contribution, splat.color.x, state.color[0].x),
                        madd(contribution, splat.color.y, state.color[0].y),
                        madd(contribution, splat.color.z, state.color[0].z)};
    }
  }
}

/// The splats of a tile that a block looks at together.
template <class F> struct Stage {
  TileSplat<F> splats[kBlendThreads];
  uint8_t reach[kBlendThreads];

  /// Loads splats [k, k + kBlendThreads) of the list; returns how many there are before `end`.
  __device__ int load(const Splat<F, float>* splats_in, const TileList& list, int k, int end) {
    const int t = threadIdx.x;
    uint32_t bits = 0;
    if (k + t < end) {
      const Splat<F, float> splat = splats_in[list.splat(k + t)];
      bits = subtile_reach(support_of(splat), list.x0, list.y0);
      if (bits) splats[t] = tile_splat(splat, list);
    }
    reach[t] = uint8_t(bits);
    return min(end - k, kBlendThreads);
  }

  /// Multiplies the transmittance by what the splats let through.
  __device__ void pass_all(int count, Vec2<float> p, float (&transmittance)[F::kSamples]) const {
    const int warp = threadIdx.x / 32;
    for (int k = 0; k < count; k += 32) {
      for (uint32_t mask = __ballot_sync(kAllLanes, reach[k + lane_id()] >> warp & 1); mask != 0; mask &= mask - 1) {
        Held<F> splat = splats[k + __ffs(mask) - 1];
#pragma unroll
        for (int s = 0; s < F::kSamples; ++s)
          transmittance[s] -= transmittance[s] * effective_alpha(F::alpha(splat.terms, p, s));
      }
    }
  }

  template <int kColors>
  __device__ void composite_all(int count, int index, Vec2<float> p, PixelState<F::kSamples, kColors>& state) const {
    const int warp = threadIdx.x / 32;
    for (int k = 0; k < count; k += 32) {
      if (!__any_sync(kAllLanes, state.open())) return;
      const uint32_t mask = __ballot_sync(kAllLanes, reach[k + lane_id()] >> warp & 1);
      composite<F>(splats + k, mask, index + k, p, state);
    }
  }
};

/// Whether a tile is blended with S samples.
template <int S> __device__ bool has_samples(const TileLists& lists, int tile) {
  return !lists.tile_samples || lists.tile_samples[tile] == S;
}

/// Those of S samples that the front chunks left open.
template <int S> __device__ int32_t* open_tiles(const BlendTask& task) {
  return task.open_tiles + sample_class(S) * task.grid.tiles();
}

/// Checkpoints of a thread's pixel.
template <int S> struct PixelCheckpoints {
  Checkpoint* base;  // of the tile's first

  __device__ PixelCheckpoints(const BlendTask& task, int tile, int pixel)
      : base(task.checkpoints + int64_t(task.plan.tile_planes[tile]) * kTilePixels + pixel) {}
  __device__ Checkpoint& at(int chunk, int s) const { return base[(int64_t(chunk) * S + s) * kTilePixels]; }
};

/// Writes a pixel whose samples are done. `total` is the sum of their colours.
template <int S>
__device__ void store_color(const BlendTask& task, int x, int y, Vec3<float> total, const float (&transmittance)[S]) {
  if (x >= task.grid.width || y >= task.grid.height) return;
  const int64_t plane = int64_t(task.grid.width) * task.grid.height, i = int64_t(y) * task.grid.width + x;
  float through = 0;
#pragma unroll
  for (int s = 0; s < S; ++s) {
    through += abs(transmittance[s]);
    if (task.transmittance) task.transmittance[s * plane + i] = abs(transmittance[s]);
  }
  const float scale = 1.0f / S;
  task.image[i] = scale * total.x + scale * through * task.background[0];
  task.image[plane + i] = scale * total.y + scale * through * task.background[1];
  task.image[2 * plane + i] = scale * total.z + scale * through * task.background[2];
  if (task.alpha) task.alpha[i] = 1 - scale * through;
}
template <int S> __device__ void store_last(const BlendTask& task, int x, int y, const int (&last)[S]) {
  if (x >= task.grid.width || y >= task.grid.height) return;
  const int64_t plane = int64_t(task.grid.width) * task.grid.height, i = int64_t(y) * task.grid.width + x;
#pragma unroll
  for (int s = 0; s < S; ++s) task.last[s * plane + i] = last[s];
}

/// Turns the colours of a sample's first `n` chunks into the colour of everything behind each: what
/// blend_vjp starts from. `behind`: of what is behind them all. Sums of positive terms do not cancel.
template <int S>
__device__ void accumulate_behind(const PixelCheckpoints<S>& checkpoints, int n, int s, Vec3<float> behind) {
  constexpr int kBatch = 8;  // loads before stores, so that they wait together
  for (int last = n - 1; last >= 0; last -= kBatch) {
    Vec3<float> own[kBatch];
#pragma unroll
    for (int k = 0; k < kBatch; ++k) {
      if (last >= k) own[k] = checkpoints.at(last - k, s).color;
    }
#pragma unroll
    for (int k = 0; k < kBatch; ++k) {
      if (last < k) continue;
      checkpoints.at(last - k, s).color = behind;
      behind += own[k];
    }
  }
}

/// A block per tile.
template <class F, bool kKeep>
__global__ void __launch_bounds__(kBlendThreads, F::kSamples > 1             ? 1
                                                 : sizeof(TileSplat<F>) > 96 ? 4
                                                                             : 5)
    blend_front_kernel(const BlendTask task) {
  constexpr int S = F::kSamples, kLength = chunk_length(S), kColors = kKeep ? S : 1;
  __shared__ Stage<F> stage;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(task.lists.splats);
  int place = int(blockIdx.x);
  if (task.lists.tile_samples) {
    const SampleParts& tiles = task.lists.counts->tiles;
    place += tiles.first[sample_class(S)];
    if (place >= tiles.first[sample_class(S) + 1]) return;
  }
  const int tile = task.plan.tile_order[place], warp = threadIdx.x / 32, front_length = front_chunks(task.grid, S);
  const TileList list = list_of(task.lists, task.grid, tile);
  const Vec2<float> p = pixel_of(warp, lane_id());
  const int x = list.x0 + int(p.x), y = list.y0 + int(p.y);
  const int front = list.overflow ? list.count : min(list.count, front_length * kLength);
  const bool several = !list.overflow && list.count > kLength;
  const PixelCheckpoints<S> checkpoints(task, tile, threadIdx.x);
  PixelState<S, kColors> state;
  state.start(x < task.grid.width && y < task.grid.height);
  Vec3<float> total = {0, 0, 0};
  int k = 0, written = 0;
  while (k < front && __syncthreads_or(state.open())) {
    const int count = stage.load(splats, list, k, front);
    __syncthreads();
    stage.composite_all(count, k, p, state);
    k += count;
    if (several && k % kLength == 0 && k < list.count) {
#pragma unroll
      for (int s = 0; kKeep && s < S; ++s)
        checkpoints.at(written, s) = {state.color[s % kColors], state.transmittance[s]};
      total += state.total_color();
      state.clear_color();
      ++written;
    }
  }
  const bool more = k == front && front < list.count && __syncthreads_or(state.open());
  if (threadIdx.x == 0) {
    task.tile_open[tile] = more;
    if (more) open_tiles<S>(task)[atomicAdd(&task.lists.counts->open_tiles[sample_class(S)], 1)] = tile;
  }
  if (kKeep) store_last(task, x, y, state.last);
  if (!more) {
    store_color(task, x, y, total + state.total_color(), state.transmittance);
    if constexpr (kKeep) {
      const Vec3<float> bg = {task.background[0], task.background[1], task.background[2]};
#pragma unroll
      for (int s = 0; s < S; ++s)
        accumulate_behind(checkpoints, written, s, abs(state.transmittance[s]) * bg + state.color[s]);
    }
    return;
  }
  // The rest goes on from the last front chunk's checkpoint.
  if (!kKeep) {
#pragma unroll
    for (int s = 0; s < S; ++s) {
      checkpoints.at(front_length - 1, s) = {s == 0 ? total : Vec3<float>{0, 0, 0}, state.transmittance[s]};
    }
  }
}

/// Blocks share the chunks. Writes the transmittance of each chunk alone.
template <class F> __global__ void __launch_bounds__(kBlendThreads) rest_through_kernel(const BlendTask task) {
  constexpr int S = F::kSamples, kLength = chunk_length(S);
  __shared__ Stage<F> stage;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(task.lists.splats);
  const Vec2<float> p = pixel_of(threadIdx.x / 32, lane_id());
  const int items = task.lists.counts->rest;
  for (int item = blockIdx.x; item < items; item += gridDim.x) {
    const TileChunk rest = task.plan.rest[item];
    if (!has_samples<S>(task.lists, rest.tile) || !task.tile_open[rest.tile]) continue;
    const TileList list = list_of(task.lists, task.grid, rest.tile);
    const int end = min(list.count, (rest.chunk + 1) * kLength);
    float transmittance[S];
#pragma unroll
    for (int s = 0; s < S; ++s) transmittance[s] = 1;
    for (int k = rest.chunk * kLength; k < end; k += kBlendThreads) {
      __syncthreads();
      const int count = stage.load(splats, list, k, end);
      __syncthreads();
      stage.pass_all(count, p, transmittance);
    }
    const PixelCheckpoints<S> checkpoints(task, rest.tile, threadIdx.x);
#pragma unroll
    for (int s = 0; s < S; ++s) checkpoints.at(rest.chunk, s).transmittance = transmittance[s];
  }
}

/// A sample with less transmittance than this would be stopped by any splat it meets: it may count as
/// stopped before. The reserve over the minimum absorbs that products of chunks round differently.
inline constexpr float kNearlyStopped = float(kTransmittanceMin * (1 + kAlphaMin / 2));

__device__ inline int chunks_of(const BlendTask& task, int tile, int length) {
  return int((task.lists.tile_offsets[tile + 1] - task.lists.tile_offsets[tile] + length - 1) / length);
}

/// Turns the transmittance of each chunk into the one in front of it, negative where a sample has
/// stopped before. Blocks share the open tiles.
template <int S> __global__ void __launch_bounds__(kTilePixels) rest_scan_kernel(const BlendTask task) {
  constexpr int kBatch = 16;
  const int items = task.lists.counts->open_tiles[sample_class(S)] * S;
  for (int item = blockIdx.x; item < items; item += gridDim.x) {
    const int tile = open_tiles<S>(task)[item / S], s = item % S, chunks = chunks_of(task, tile, chunk_length(S));
    const PixelCheckpoints<S> checkpoints(task, tile, threadIdx.x);
    const int front = front_chunks(task.grid, S);
    float transmittance = checkpoints.at(front - 1, s).transmittance;
    for (int first = front; first < chunks; first += kBatch) {
      float through[kBatch];
#pragma unroll
      for (int k = 0; k < kBatch; ++k) {
        if (first + k < chunks) through[k] = checkpoints.at(first + k, s).transmittance;
      }
#pragma unroll
      for (int k = 0; k < kBatch; ++k) {
        if (first + k >= chunks) break;
        checkpoints.at(first + k, s).transmittance = transmittance;
        if (transmittance > 0) transmittance *= through[k];
        if (transmittance < kNearlyStopped) transmittance = -abs(transmittance);
      }
    }
  }
}

/// Blocks share the chunks. Writes the colour of each, and the transmittance at its end; zero where
/// the sample had stopped before.
template <class F, bool kKeep>
__global__ void __launch_bounds__(kBlendThreads) rest_blend_kernel(const BlendTask task) {
  constexpr int S = F::kSamples, kLength = chunk_length(S), kColors = kKeep ? S : 1;
  __shared__ Stage<F> stage;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(task.lists.splats);
  const Vec2<float> p = pixel_of(threadIdx.x / 32, lane_id());
  const int items = task.lists.counts->rest;
  for (int item = blockIdx.x; item < items; item += gridDim.x) {
    const TileChunk rest = task.plan.rest[item];
    if (!has_samples<S>(task.lists, rest.tile) || !task.tile_open[rest.tile]) continue;
    const TileList list = list_of(task.lists, task.grid, rest.tile);
    const int end = min(list.count, (rest.chunk + 1) * kLength);
    const PixelCheckpoints<S> checkpoints(task, rest.tile, threadIdx.x);
    PixelState<S, kColors> state;
    state.start(false);
    bool started[S];
#pragma unroll
    for (int s = 0; s < S; ++s) {
      const float transmittance = checkpoints.at(rest.chunk, s).transmittance;
      started[s] = transmittance > 0;
      if (started[s]) state.transmittance[s] = transmittance;
    }
    int k = rest.chunk * kLength;
    while (k < end && __syncthreads_or(state.open())) {
      const int count = stage.load(splats, list, k, end);
      __syncthreads();
      stage.composite_all(count, k, p, state);
      k += count;
    }
    const int x = list.x0 + int(p.x), y = list.y0 + int(p.y);
    const bool inside = x < task.grid.width && y < task.grid.height;
    const int64_t plane = int64_t(task.grid.width) * task.grid.height, i = int64_t(y) * task.grid.width + x;
#pragma unroll
    for (int s = 0; s < S; ++s) {
      const Vec3<float> color = s < kColors ? state.color[s % kColors] : Vec3<float>{0, 0, 0};
      checkpoints.at(rest.chunk, s) = {color, started[s] ? state.transmittance[s] : 0};
      if (kKeep && inside && state.last[s] > 0) atomicMax(&task.last[s * plane + i], state.last[s]);
    }
    __syncthreads();
  }
}

/// Adds the chunks of the open tiles. Blocks share the tiles.
template <int S, bool kKeep> __global__ void __launch_bounds__(kTilePixels) rest_sum_kernel(const BlendTask task) {
  const Vec3<float> bg = {task.background[0], task.background[1], task.background[2]};
  const Vec2<float> p = pixel_of(threadIdx.x / 32, lane_id());
  const int items = task.lists.counts->open_tiles[sample_class(S)];
  for (int item = blockIdx.x; item < items; item += gridDim.x) {
    const int tile = open_tiles<S>(task)[item], chunks = chunks_of(task, tile, chunk_length(S));
    const PixelCheckpoints<S> checkpoints(task, tile, threadIdx.x);
    Vec3<float> color = {0, 0, 0};
    float transmittance[S];
#pragma unroll
    for (int s = 0; s < S; ++s) {
      float last = -1;
#pragma unroll 16
      for (int c = kKeep ? 0 : front_chunks(task.grid, S) - 1; c < chunks; ++c) {
        const Checkpoint checkpoint = checkpoints.at(c, s);
        color += checkpoint.color;
        if (checkpoint.transmittance != 0) last = checkpoint.transmittance;
      }
      transmittance[s] = last;
      if (kKeep) accumulate_behind(checkpoints, chunks, s, abs(last) * bg);
    }
    const int x = tile % task.grid.columns() * kTile + int(p.x), y = tile / task.grid.columns() * kTile + int(p.y);
    store_color(task, x, y, color, transmittance);
  }
}

/// Blocks that fill any device.
inline constexpr int kRestBlocks = 132 * 8;

template <class F, bool kKeep> void blend_kernels(const BlendTask& task, cudaStream_t stream) {
  constexpr int S = F::kSamples;
  const unsigned tiles = unsigned(task.grid.tiles());
  blend_front_kernel<F, kKeep><<<tiles, kBlendThreads, 0, stream>>>(task);
  rest_through_kernel<F><<<kRestBlocks, kBlendThreads, 0, stream>>>(task);
  rest_scan_kernel<S><<<kRestBlocks, kTilePixels, 0, stream>>>(task);
  rest_blend_kernel<F, kKeep><<<kRestBlocks, kBlendThreads, 0, stream>>>(task);
  rest_sum_kernel<S, kKeep><<<kRestBlocks, kTilePixels, 0, stream>>>(task);
}
template <class F> void blend_tiles(const BlendTask& task, cudaStream_t stream) {
  if (task.transmittance) {
    blend_kernels<F, true>(task, stream);
  } else {
    blend_kernels<F, false>(task, stream);
  }
}

/// Calls f(F{}, stream) for every footprint that tiles of F are blended with: those of `adaptive`, Boxes, side
/// by side, as a few tiles of many samples would else keep the device waiting.
template <class F, class Boxes, class Function> void for_each_tile_footprint(cudaStream_t stream, Function&& f) {
  if constexpr (std::is_same_v<F, Adaptive>) {
    SideStreams sides(stream);
    int k = 0;
    for_each_footprint(Boxes{}, [&](auto tile_footprint) { f(tile_footprint, sides.stream(k++)); });
    sides.join();
  } else {
    f(F{}, stream);
  }
}

template <class F> void blend(const BlendTask& task, cudaStream_t stream) {
  for_each_tile_footprint<F, AdaptiveBoxes>(stream,
                                            [&](auto f, cudaStream_t side) { blend_tiles<decltype(f)>(task, side); });
}

/// What a kernel of blend_vjp sums: gradients, |dL/dmean| of each pixel, or both at once.
enum class Sums { kGrads, kAbs, kBoth };

/// Samples of a pixel that a warp of blend_vjp takes. More are shared out to the warps of a block: one warp
/// would be busy for long with their chunk. Only the absolute values need a pixel's sum at once.
template <class F, Sums kSums>
inline constexpr int kVjpSamples = F::kSamples <= 4 || kSums == Sums::kAbs ? F::kSamples : 4;

/// Splats in blend_vjp, and what each of the warps that share them sums.
template <class F, int kGroup> struct VjpGroup {
  TileSplat<F> splats[32];
  int32_t rows[kGroup > 1 ? 32 : 1];
  float sums[kGroup > 1 ? kGroup : 1][kGroup > 1 ? 32 : 1][9];
};

/// A warp's pixels in blend_vjp, S samples of each.
template <int S> struct VjpPixels {
  struct Sample {
    float transmittance, behind;
  };
  float4 g[kTilePixels];  // dL/d(one sample's colour), and sample 0's last as bits
  Sample samples[S][kTilePixels];
  int last[S > 1 ? S - 1 : 1][S > 1 ? kTilePixels : 1];

  __device__ int last_of(int s, int pixel, const float4& g_pixel) const {
    return s == 0 ? __float_as_int(g_pixel.w) : last[s > 0 ? s - 1 : 0][pixel];
  }
};

/// Blocks of blend_vjp that an SM should hold: bounds the registers.
template <class F> inline constexpr int kVjpBlocks = F::kSamples > 1 ? 1 : sizeof(TileSplat<F>) <= 48 ? 7 : 5;

/// Warps of a block of blend_vjp: as many as leave room for a few blocks in shared memory.
template <class F, Sums kSums>
inline constexpr int kVjpWarps = F::kSamples > kVjpSamples<F, kSums> ? F::kSamples / kVjpSamples<F, kSums>
                                 : F::kSamples <= 2                  ? 4
                                 : F::kSamples <= 8                  ? 2
                                                                     : 1;

/// A warp per chunk, for many samples a block, back to front, over all pixels of the tile: every pair is
/// summed in one place, so the sums need no atomics, whose order would change from run to run.
template <class F, Sums kSums>
__global__ void __launch_bounds__(32 * kVjpWarps<F, kSums>, kVjpBlocks<F>) blend_vjp_kernel(const BlendVjpTask task) {
  constexpr int S = F::kSamples, kLength = chunk_length(S), kWarps = kVjpWarps<F, kSums>;
  constexpr int kOwn = kVjpSamples<F, kSums>, kGroup = S / kOwn;  // samples of a warp, warps of a chunk
  constexpr bool kGrads = kSums != Sums::kAbs, kAbs = kSums != Sums::kGrads;
  // A shared-out sample's number is not known when the code is compiled: keep its node indexable.
  using VjpSplat = std::conditional_t<kGroup == 1, Held<F>, const TileSplat<F>&>;
  using Pixels = VjpPixels<kOwn>;
  using Group = VjpGroup<F, kGroup>;
  extern __shared__ float4 shared[];
  const int lane = lane_id(), warp = threadIdx.x / 32, first = warp % kGroup * kOwn;
  Pixels& stage = reinterpret_cast<Pixels*>(shared)[warp];
  Group& group = reinterpret_cast<Group*>(reinterpret_cast<Pixels*>(shared) + kWarps)[warp / kGroup];
  const auto group_sync = [] {
    if constexpr (kGroup > 1) {
      __syncthreads();
    } else {
      __syncwarp();
    }
  };
  const SampleParts& chunks = task.lists.counts->chunks;
  const int64_t item = chunks.first[sample_class(S)] + (int64_t(blockIdx.x) * kWarps + warp) / kGroup;
  if (item >= chunks.first[sample_class(S) + 1]) return;
  const auto [tile, chunk, plane] = task.chunk_order[item];
  const TileList list = list_of(task.lists, task.grid, tile);
  const int begin = chunk * kLength, end = list.overflow ? list.count : min(list.count, begin + kLength);
  const int64_t image = int64_t(task.grid.width) * task.grid.height;
  const auto pixel_index = [&](int b) {  // in the image; -1 outside
    const Vec2<float> p = pixel_of(b, lane);
    const int x = list.x0 + int(p.x), y = list.y0 + int(p.y);
    return x < task.grid.width && y < task.grid.height ? int64_t(y) * task.grid.width + x : int64_t(-1);
  };

  int subtile_last[kSubtiles], tile_last = 0;
#pragma unroll
  for (int b = 0; b < kSubtiles; ++b) {
    const int64_t i = pixel_index(b);
    int last = 0;
#pragma unroll
    for (int s = 0; s < S; ++s) last = max(last, i < 0 ? 0 : task.last[s * image + i]);
    subtile_last[b] = warp_max(last);
    tile_last = max(tile_last, subtile_last[b]);
  }
  if (kGrads && !list.overflow) {
    for (int k = max(begin, min(tile_last, end)) + lane; k < end; k += 32) {  // pairs that nothing reached
      auto* row = reinterpret_cast<float4*>(task.pair_grads + int64_t(list.slot(k)) * kPairGradWidth);
#pragma unroll
      for (int q = 0; q < kPairGradWidth / 4; ++q) row[q] = {0, 0, 0, 0};
    }
  }
  if (begin >= tile_last) return;

  const bool final = tile_last <= end;
  const Checkpoint* checkpoints = task.checkpoints + int64_t(plane) * kTilePixels;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(task.lists.splats);
  const Vec2<float> p0 = pixel_of(0, lane);
  constexpr int kTwo23 = 0x4b000000;
  const int value = lane % 4 == 0 ? lane / 4 : lane == 2 ? 8 : -1;  // that sum_nine leaves here
#pragma unroll
  for (int b = 0; b < kSubtiles; ++b) {
    const int64_t i = pixel_index(b);
    const int q = b * 32 + lane;
    const float scale = i < 0 ? 0 : 1.0f / S;
    const int64_t j = max(i, int64_t(0));
    const Vec3<float> g = {scale * task.dL_dimage[j], scale * task.dL_dimage[image + j],
                           scale * task.dL_dimage[2 * image + j]};
#pragma unroll
    for (int s = 0; s < kOwn; ++s) {
      const int last = i < 0 ? 0 : task.last[(first + s) * image + i];
      float transmittance = 1, behind = 0;
      if (final) {
        transmittance = i < 0 ? 1.0f : task.transmittance[(first + s) * image + i];
        behind = g.x * task.background[0] + g.y * task.background[1] + g.z * task.background[2];
      } else {
        const Checkpoint c = checkpoints[(first + s) * kTilePixels + q];
        transmittance = abs(c.transmittance);
        behind = dot(g, c.color) / transmittance;
      }
      // What is covered does not let the background through: a background of its own.
      if (task.dL_dalpha && i >= 0) {
        const float open = final ? 1 : task.transmittance[(first + s) * image + i] / transmittance;
        behind -= scale * task.dL_dalpha[i] * open;
      }
      stage.samples[s][q] = {transmittance, behind};
      if (s == 0) stage.g[q] = {g.x, g.y, g.z, __int_as_float(last)};
      if (s > 0) stage.last[s > 0 ? s - 1 : 0][q] = last;
    }
  }

  const auto put = [&](int32_t row, int v, float x) {
    float* place = task.pair_grads + int64_t(row) * kPairGradWidth + v;
    if (list.overflow) {
      atomicAdd(place, x);
    } else {
      *place = x;
    }
  };
  for (int k1 = min(end, tile_last); k1 > begin; k1 -= 32) {
    const int k0 = max(k1 - 32, begin), k = k0 + lane;
    uint32_t reach = 0;
    int32_t row_index = 0;
    Mat2<float> mean_map = {0, 0, 0, 0};
    group_sync();
    if (k < k1) {
      const int32_t id = list.splat(k);
      row_index = list.overflow ? id : list.slot(k);
      const Splat<F, float> splat = splats[id];
      reach = subtile_reach(support_of(splat), list.x0, list.y0);
#pragma unroll
      for (int b = 0; b < kSubtiles; ++b) reach &= ~(uint32_t(k >= subtile_last[b]) << b);
      if (reach && first == 0) group.splats[lane] = tile_splat(splat, list);
      if (kAbs) mean_map = F::mean_map(splat.shape);
      if (kGroup > 1 && first == 0) group.rows[lane] = row_index;
    }
    group_sync();
    for (int j = k1 - k0 - 1; j >= 0; --j) {
      const uint32_t reached = __shfl_sync(kAllLanes, reach, j);
      VjpSplat splat = group.splats[j];
      const Mat2<float> m =
          !kAbs ? mean_map
                : Mat2<float>{__shfl_sync(kAllLanes, mean_map.xx, j), __shfl_sync(kAllLanes, mean_map.xy, j),
                              __shfl_sync(kAllLanes, mean_map.yx, j), __shfl_sync(kAllLanes, mean_map.yy, j)};
      ShapeGrad<float> shape = {{0, 0}, {0, 0, 0}};
      float weighted = 0;
      Vec3<float> color = {0, 0, 0};
      Vec2<float> abs2d = {0, 0};
      for (uint32_t hit = reached; hit != 0; hit &= hit - 1) {
        const int b = __ffs(hit) - 1, q = b * 32 + lane;
        // pixel_of(b, lane); an integer below 2^23 set into the mantissa of 2^23 is a float to be
        const float column = __int_as_float(kTwo23 | (b & 1)) - 8388608.0f;
        const float band = __int_as_float(kTwo23 | (b >> 1)) - 8388608.0f;
        const Vec2<float> p = {madd(8.0f, column, p0.x), madd(4.0f, band, p0.y)};
        const float4 g = stage.g[q];
        const float g_color = madd(g.x, splat.color.x, madd(g.y, splat.color.y, g.z * splat.color.z));
        float contribution = 0;
        ShapeGrad<float> of_pixel = {{0, 0}, {0, 0, 0}};
#pragma unroll
        for (int s = 0; s < kOwn; ++s) {
          const int node = kGroup == 1 ? s : first + s;
          const float alpha = F::alpha(splat.terms, p, node);
          const bool mask = alpha >= float(kAlphaMin) && k0 + j < stage.last_of(s, q, g);
          if (s == 0 && S == 1 && !__any_sync(kAllLanes, mask)) break;
          auto sample = stage.samples[s][q];
          const BlendGrad<float> grad = blend_sample_vjp(mask, alpha, g_color, sample.transmittance, sample.behind);
          stage.samples[s][q] = sample;
          if (kGrads) F::add_alpha_vjp(splat.terms, p, node, alpha, grad.dL_dalpha, shape);
          // Again for the pixel alone: to ask for it must not change the other sums by a bit.
          if (kAbs) F::add_alpha_vjp(splat.terms, p, node, alpha, grad.dL_dalpha, of_pixel);
          contribution = s == 0 ? grad.contribution : contribution + grad.contribution;
          weighted += grad.dL_dalpha * alpha;
        }
        color = {madd(contribution, g.x, color.x), madd(contribution, g.y, color.y), madd(contribution, g.z, color.z)};
        if (kAbs) {
          const Vec2<float> by_mean = transform_transposed(m, of_pixel.offset);
          abs2d = abs2d + Vec2<float>{abs(by_mean.x), abs(by_mean.y)};
        }
      }
      const int32_t row = __shfl_sync(kAllLanes, row_index, j);
      if (kGrads) {
        if (reached) shape = F::collect(splat.terms, shape, weighted);  // else there are no terms
        const float values[9] = {shape.offset.x, shape.offset.y, shape.shape.xx, shape.shape.xy, shape.shape.yy,
                                 weighted,       color.x,        color.y,        color.z};
        const float sum = sum_nine(values);
        if (value >= 0) {
          if constexpr (kGroup == 1) {
            put(row, value, sum);
          } else {
            group.sums[warp][j][value] = sum;
          }
        }
      }
      if (kAbs) {
        const Vec2<float> total = {warp_sum(abs2d.x), warp_sum(abs2d.y)};
        if (lane == 1) put(row, 9, total.x);
        if (lane == 3) put(row, 10, total.y);
      }
    }
    if constexpr (kGroup > 1) {
      __syncthreads();
      for (int t = threadIdx.x; t < 9 * (k1 - k0); t += 32 * kGroup) {
        const int j = t / 9, v = t % 9;
        float sum = group.sums[0][j][v];
#pragma unroll
        for (int w = 1; w < kGroup; ++w) sum += group.sums[w][j][v];
        put(group.rows[j], v, sum);
      }
    }
  }
}

/// With too many pairs there is a row per splat that all tiles add to.
template <class F> __global__ void clear_splat_grads_kernel(const BlendVjpTask task) {
  if (task.lists.counts->pairs <= task.lists.capacity) return;
  const int64_t n = task.lists.n * kPairGradWidth;
  for (int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x; i < n; i += int64_t(gridDim.x) * blockDim.x)
    task.pair_grads[i] = 0;
}

template <class F, Sums kSums> void launch_blend_vjp(const BlendVjpTask& task, cudaStream_t stream) {
  constexpr int kOwn = kVjpSamples<F, kSums>, kWarps = kVjpWarps<F, kSums>, kGroup = F::kSamples / kOwn;
  const size_t bytes = kWarps * sizeof(VjpPixels<kOwn>) + kWarps / kGroup * sizeof(VjpGroup<F, kGroup>);
  const auto kernel = blend_vjp_kernel<F, kSums>;
  if (bytes > 48 * 1024) cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, int(bytes));
  kernel<<<blocks_of(task.max_chunks, kWarps / kGroup), 32 * kWarps, bytes, stream>>>(task);
}
template <class F> void blend_vjp(const BlendVjpTask& task, cudaStream_t stream) {
  clear_splat_grads_kernel<F><<<kRestBlocks, kBlendThreads, 0, stream>>>(task);
  for_each_tile_footprint<F, AdaptiveBoxesVjp>(stream, [&](auto f, cudaStream_t side) {
    using Tile = decltype(f);
    constexpr bool kAtOnce = kVjpSamples<Tile, Sums::kGrads> == Tile::kSamples;
    if (!kAtOnce || !task.absolute) launch_blend_vjp<Tile, Sums::kGrads>(task, side);
    if (task.absolute) launch_blend_vjp<Tile, kAtOnce ? Sums::kBoth : Sums::kAbs>(task, side);
  });
}

}  // namespace ar::cuda
