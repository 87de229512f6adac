// Kernels of blend for up to four channels.
//
// The list of a tile is cut into chunks. The first few chunks are the front, and the others the tail. They are blended
// by five kernels, one after the other:
//
//   blend_front    a block per tile composites the chunks of the front in order, until all pixels have stopped.
//                  If some are open behind the front and there are pairs left, the next kernels finish the tile
//   tail_through   a block per chunk of the tail finds how much light the chunk lets through by itself
//   tail_scan      multiplies these up to the transmittance in front of every chunk
//   tail_blend     a block per chunk composites it, exactly as if the chunks before it had just been composited
//   tail_sum       adds up the chunks
//
// Since chunks of the tail are handled side by side, few tiles with long lists, as in small images of large scenes,
// still fill the device. The last bits of the result depend on nothing but the lists.
//
// kKeep says whether what the backward pass needs is kept: at the end of every chunk a checkpoint with the
// transmittance and the channels of every sample.
#pragma once

#include "cuda/composite.cuh"
#include "cuda/launch.cuh"

namespace ar::cuda {

/// What compositing carries from splat to splat, for one pixel with S samples and C channels. kSets is the number of
/// sets of channels: one for all samples, or one per sample where checkpoints need it.
template <int S, int C, int kSets> struct PixelState {
  float transmittance[S];
  Values<C> channels[kSets];
  int last[S];

  __device__ void start(bool open) {
#pragma unroll
    for (int s = 0; s < S; ++s) transmittance[s] = open ? 1.0f : -1.0f, last[s] = 0;
    clear_channels();
  }
  __device__ void clear_channels() {
#pragma unroll
    for (int k = 0; k < kSets; ++k) channels[k] = {};
  }
  __device__ Values<C> total() const {
    Values<C> sum = channels[0];
#pragma unroll
    for (int k = 1; k < kSets; ++k) sum += channels[k];
    return sum;
  }
  __device__ bool open() const {
    bool any = false;
#pragma unroll
    for (int s = 0; s < S; ++s) any |= transmittance[s] > 0;
    return any;
  }
};

/// The splats that a block blends together; and for each warp a list of those that reach its pixels, which costs less
/// per splat than to look for the next bit of a mask.
template <class F, int C> struct BlendStage : Stage<F, C, kBlendThreads> {
  static constexpr int kBatch = kBlendThreads;
  /// With one sample, where little else is done for a splat, a list holds places in memory, and is read four at a time.
  /// With more it holds the splats' numbers.
  static constexpr bool kPlaces = F::kSamples == 1;
  using Entry = std::conditional_t<kPlaces, uint32_t, uint8_t>;
  static constexpr int kUnit = kPlaces ? sizeof(TileSplat<F, C>) : 1, kAhead = kPlaces ? 4 : 1;
  struct alignas(kAhead * sizeof(Entry)) Entries {
    Entry of[kAhead];
  };
  alignas(Entries) Entry lists[kSubtiles][kBatch];

  /// Lists those of the `count` staged splats that reach this warp's pixels, and returns how many there are. All lanes
  /// must call it.
  __device__ int list_reached(int count) {
    const int warp = threadIdx.x / 32;
    Entry* list = lists[warp];
    int n = 0;
    for (int k = 0; k < count; k += 32) {
      const bool reached = this->reach[k + lane_id()] >> warp & 1;
      const uint32_t all = __ballot_sync(kAllLanes, reached);
      if (reached) list[n + __popc(all & ((1u << lane_id()) - 1))] = Entry((k + lane_id()) * kUnit);
      n += __popc(all);
    }
    __syncwarp();
    return n;
  }
  /// The number of a listed splat among those that are staged.
  __device__ static int number_of(Entry entry) { return int(entry) / kUnit; }
  /// Calls visit(splat, entry) for the splats [from, to) of the list; `from` is a multiple of kAhead.
  template <class Visit> __device__ __forceinline__ void for_each_listed(int from, int to, Visit&& visit) const {
    const Entry* list = lists[threadIdx.x / 32];
    const auto* memory = reinterpret_cast<const char*>(this->splats);
    const auto see = [&](Entry entry) {
      visit(*reinterpret_cast<const TileSplat<F, C>*>(memory + entry * (sizeof(TileSplat<F, C>) / kUnit)), entry);
    };
    int k = from;
#pragma unroll 1
    for (; k + kAhead <= to; k += kAhead) {
      const Entries entries = *reinterpret_cast<const Entries*>(list + k);
#pragma unroll
      for (int i = 0; i < kAhead; ++i) see(entries.of[i]);
    }
#pragma unroll 1
    for (; k < to; ++k) see(list[k]);
  }
};

/// Composites a splat into a pixel; last[s] becomes `place` where it was composited into sample s.
template <class F, int C, int kSets>
__device__ __forceinline__ void composite(const TileSplat<F, C>& splat, Vec2<float> p, int place,
                                          PixelState<F::kSamples, C, kSets>& state, int (&last)[F::kSamples]) {
  float contribution = 0;
#pragma unroll
  for (int s = 0; s < F::kSamples; ++s) {
    const Blended<float> b = blend_sample(F::alpha(splat.terms, p, s), state.transmittance[s]);
    if (kSets == F::kSamples) {
      if (b.mask) state.channels[s % kSets].add(b.if_shown, splat.channels);
    } else {
      contribution = s == 0 ? b.contribution : contribution + b.contribution;
    }
    last[s] = b.mask ? place : last[s];
  }
  if (kSets < F::kSamples) state.channels[0].add(contribution, splat.channels);
}

/// Multiplies the transmittance by what the splats in shared memory let through, without a threshold at which to stop.
template <class F, int C>
__device__ void pass_all(BlendStage<F, C>& stage, int count, Vec2<float> p, float (&transmittance)[F::kSamples]) {
  const int reached = stage.list_reached(count);
  stage.for_each_listed(0, reached, [&](TileSplatRef<F, C> splat, auto) {
#pragma unroll
    for (int s = 0; s < F::kSamples; ++s)
      transmittance[s] -= transmittance[s] * effective_alpha(F::alpha(splat.terms, p, s));
  });
}

/// Composites the staged splats into a pixel; `index` is the place of the first of them in the tile's list.
template <class F, int C, int kSets>
__device__ void composite_all(BlendStage<F, C>& stage, int count, int index, Vec2<float> p,
                              PixelState<F::kSamples, C, kSets>& state) {
  using Stage = BlendStage<F, C>;
  constexpr int kBetweenVotes = 16;
  const int reached = stage.list_reached(count);
  int entries[] = {-1};  // of the last splat of this batch, where lists hold places
  for (int from = 0; from < reached; from += kBetweenVotes) {
    if (!__any_sync(kAllLanes, state.open())) break;
    stage.for_each_listed(from, min(reached, from + kBetweenVotes), [&](TileSplatRef<F, C> splat, auto entry) {
      if constexpr (Stage::kPlaces) {
        composite<F>(splat, p, int(entry), state, entries);
      } else {
        composite<F>(splat, p, index + int(entry) + 1, state, state.last);
      }
    });
  }
  if (Stage::kPlaces && entries[0] >= 0) state.last[0] = index + Stage::number_of(uint32_t(entries[0])) + 1;
}

/// List of the tiles with S samples that blend_front left open.
template <int S> __device__ int32_t* open_tiles(const BlendParams& params) {
  return params.open_tiles + sample_class(S) * params.grid.tiles();
}

/// Checkpoints of a pixel of a tile, with the layout of CheckpointLayout.
template <int S, int C, bool kKeep> struct PixelCheckpoints {
  float* base;  ///< of the tile's first plane
  int first_chunk, pixel;

  __device__ PixelCheckpoints(const BlendParams& params, int tile, int pixel)
      : base(params.checkpoints + int64_t(params.plan.tile_planes[tile]) * kTilePixels),
        first_chunk(kKeep ? 0 : front_chunks(params.grid, S) - 1),
        pixel(pixel) {}

  __device__ Checkpoint<C>& kept(int chunk, int s) const {
    return reinterpret_cast<Checkpoint<C>*>(base)[(int64_t(chunk) * S + s) * kTilePixels + pixel];
  }
  /// Plane k of a chunk without a backward pass: transmittance of every sample, then the channels.
  __device__ float& plane(int chunk, int k) const {
    return base[(int64_t(chunk - first_chunk) * (S + C) + k) * kTilePixels + pixel];
  }

  __device__ float& transmittance(int chunk, int s) const {
    if constexpr (kKeep) {
      return kept(chunk, s).transmittance;
    } else {
      return plane(chunk, s);
    }
  }
  /// Channels of a sample or, without a backward pass, of all.
  __device__ Values<C> channels(int chunk, int s) const {
    if constexpr (kKeep) {
      return kept(chunk, s).channels;
    } else {
      Values<C> values;
#pragma unroll
      for (int c = 0; c < C; ++c) values.v[c] = plane(chunk, S + c);
      return values;
    }
  }
  __device__ void set_total(int chunk, const Values<C>& values) const {
#pragma unroll
    for (int c = 0; c < C; ++c) plane(chunk, S + c) = values.v[c];
  }
};

/// A pixel's transmittance in the checkpoints, with or without a backward pass: for kernels that are compiled once for
/// any number of channels.
template <int S> struct TransmittancePlanes {
  float* base;
  int first_chunk;
  int64_t chunk_stride, sample_stride;

  __device__ TransmittancePlanes(const BlendParams& params, int tile, int pixel) {
    const CheckpointLayout layout = params.layout;
    const int of_sample = layout.keep ? layout.channels + 1 : 1;
    first_chunk = layout.first_chunk(params.grid, S);
    chunk_stride = int64_t(layout.planes(S)) * kTilePixels;
    sample_stride = int64_t(of_sample) * kTilePixels;
    base =
        params.checkpoints + int64_t(params.plan.tile_planes[tile]) * kTilePixels + pixel * of_sample + of_sample - 1;
  }
  __device__ float& at(int chunk, int s) const {
    return base[(chunk - first_chunk) * chunk_stride + s * sample_stride];
  }
};

template <int C> __device__ Values<C> background_of(const BlendParams& params) {
  Values<C> background;
#pragma unroll
  for (int c = 0; c < C; ++c) background.v[c] = C == 3 || c < params.channels.count ? params.background[c] : 0;
  return background;
}

/// Writes a pixel whose samples are complete. `total` is the sum of their channels.
template <int S, int C>
__device__ void store_pixel(const BlendParams& params, Pixel pixel, const Values<C>& total,
                            const float (&transmittance)[S]) {
  if (!pixel.inside) return;
  float through = 0;
#pragma unroll
  for (int s = 0; s < S; ++s) {
    through += abs(transmittance[s]);
    if (params.transmittance) params.transmittance[s * pixel.image + pixel.index] = abs(transmittance[s]);
  }
  const float scale = 1.0f / S;
#pragma unroll
  for (int c = 0; c < C; ++c) {
    if (C > 3 && c >= params.channels.count) break;
    params.image.plane(c, pixel.image)[pixel.index] = scale * total.v[c] + scale * through * params.background[c];
  }
  if (params.alpha) params.alpha[pixel.index] = 1 - scale * through;
}
template <int S> __device__ void store_last(const BlendParams& params, Pixel pixel, const int (&last)[S]) {
  if (!pixel.inside) return;
#pragma unroll
  for (int s = 0; s < S; ++s) params.last[s * pixel.image + pixel.index] = last[s];
}

/// Turns the checkpoints of a sample's first `n` chunks, which hold the channels of the chunk itself, into the channels
/// of everything behind the chunk, from which blend_vjp starts. `behind`: the channels of what is behind all of them.
/// These are sums of positive terms, which do not cancel. kBatch: chunks that are loaded before the first store, so
/// that the loads wait for memory together.
template <int kBatch, int S, int C>
__device__ void accumulate_behind(const PixelCheckpoints<S, C, true>& checkpoints, int n, int s, Values<C> behind) {
  for (int last = n - 1; last >= 0; last -= kBatch) {
    Values<C> own[kBatch];
#pragma unroll
    for (int k = 0; k < kBatch; ++k) {
      if (last >= k) own[k] = checkpoints.kept(last - k, s).channels;
    }
#pragma unroll
    for (int k = 0; k < kBatch; ++k) {
      if (last < k) continue;
      checkpoints.kept(last - k, s).channels = behind;
      behind += own[k];
    }
  }
}

/// Blocks of blend_front and tail_blend that a streaming multiprocessor should hold at once. It limits the registers of
/// a thread.
template <class F, int C>
inline constexpr int kFrontBlocks = F::kSamples > 1                ? 1
                                    : sizeof(TileSplat<F, C>) > 96 ? 4
                                                                   : 5;
template <class F> inline constexpr int kTailBlendBlocks = F::kSamples > 4 ? 1 : F::kSamples > 1 ? 3 : 4;
/// Of tail_through.
template <class F> inline constexpr int kTailThroughBlocks = F::kSamples > 1 ? 3 : kFrontBlocks<F, 0>;

/// A block per tile.
template <class F, int C, bool kKeep>
__global__ void __launch_bounds__(kBlendThreads, kFrontBlocks<F, C>) blend_front_kernel(const BlendParams params) {
  constexpr int S = F::kSamples, kLength = chunk_length(S), kSets = kKeep ? S : 1;
  __shared__ BlendStage<F, C> stage;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  PlanCounts& counts = params.plan.state->counts;
  const int place = tile_place<S>(params, int(blockIdx.x));
  if (place < 0) return;
  const int tile = params.plan.tile_order[place], front_length = front_chunks(params.grid, S);
  const TileList list = list_of(params.lists, params.grid, tile);
  const Vec2<float> p = pixel_of(threadIdx.x / 32, lane_id());
  const Pixel pixel(list, params.grid, p);
  const int front = list.overflow ? list.count : min(list.count, front_length * kLength);
  const bool several = !list.overflow && list.count > kLength;
  const PixelCheckpoints<S, C, kKeep> checkpoints(params, tile, int(threadIdx.x));
  PixelState<S, C, kSets> state;
  state.start(pixel.inside);
  Values<C> total = {};
  int k = 0, written = 0;
  while (k < front && __syncthreads_or(state.open())) {
    const int count = stage.load(splats, params.channels, list, k, front);
    __syncthreads();
    composite_all<F>(stage, count, k, p, state);
    k += count;
    if (several && k % kLength == 0 && k < list.count) {
      if constexpr (kKeep) {
#pragma unroll
        for (int s = 0; s < S; ++s) checkpoints.kept(written, s) = {state.channels[s], state.transmittance[s]};
      }
      ++written;
      total += state.total();
      state.clear_channels();
    }
  }
  const bool more = k == front && front < list.count && __syncthreads_or(state.open());
  if (threadIdx.x == 0) {
    params.tile_open[tile] = more;
    if (more) open_tiles<S>(params)[atomicAdd(&counts.open_tiles[sample_class(S)], 1)] = tile;
  }
  if (kKeep) store_last(params, pixel, state.last);
  if (!more) {
    total += state.total();
    store_pixel(params, pixel, total, state.transmittance);
    if constexpr (kKeep) {
      const Values<C> background = background_of<C>(params);
#pragma unroll
      for (int s = 0; s < S; ++s) {
        Values<C> behind = times(abs(state.transmittance[s]), background);
        behind += state.channels[s];
        accumulate_behind<8>(checkpoints, written, s, behind);
      }
    }
  } else if constexpr (!kKeep) {
    // The tail goes on from the last front chunk's checkpoint.
#pragma unroll
    for (int s = 0; s < S; ++s) checkpoints.transmittance(front_length - 1, s) = state.transmittance[s];
    checkpoints.set_total(front_length - 1, total);
  }
}

/// Blocks share the chunks. Writes the transmittance of each chunk alone.
template <class F>
__global__ void __launch_bounds__(kBlendThreads, kTailThroughBlocks<F>) tail_through_kernel(const BlendParams params) {
  constexpr int S = F::kSamples, kLength = chunk_length(S);
  __shared__ BlendStage<F, 0> stage;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const Vec2<float> p = pixel_of(threadIdx.x / 32, lane_id());
  const int items = params.plan.state->counts.tail;
  for (int item = blockIdx.x; item < items; item += gridDim.x) {
    const TileChunk tail = params.plan.tail[item];
    if (!has_samples<S>(params.lists, tail.tile) || !params.tile_open[tail.tile]) continue;
    const TileList list = list_of(params.lists, params.grid, tail.tile);
    const int end = min(list.count, (tail.chunk + 1) * kLength);
    float transmittance[S];
#pragma unroll
    for (int s = 0; s < S; ++s) transmittance[s] = 1;
    for (int k = tail.chunk * kLength; k < end; k += stage.kBatch) {
      __syncthreads();
      const int count = stage.load(splats, params.channels, list, k, end);
      __syncthreads();
      pass_all<F>(stage, count, p, transmittance);
    }
    const TransmittancePlanes<S> planes(params, tail.tile, int(threadIdx.x));
#pragma unroll
    for (int s = 0; s < S; ++s) planes.at(tail.chunk, s) = transmittance[s];
  }
}

/// A sample with less transmittance than this would be stopped by the next splat that it meets, since alpha is at least
/// kAlphaMin, and so it may count as stopped already. The margin above kTransmittanceMin is for the rounding of
/// products of chunks, which differs from that of single splats.
inline constexpr float kNearlyStopped = float(kTransmittanceMin * (1 + kAlphaMin / 2));

__device__ inline int chunks_of(const BlendParams& params, int tile, int length) {
  return int((params.lists.tile_offsets[tile + 1] - params.lists.tile_offsets[tile] + length - 1) / length);
}

/// The kernels that go through all tail chunks of a tile, a pixel per lane, have a block per warp: the pixels of a long
/// list are spread over several multiprocessors, as one alone reads too slowly. A part of a tile is 32 pixels.
inline constexpr int kTailParts = kTilePixels / 32;

/// Turns the transmittance of each chunk into that in front of the chunk, negative where a sample has stopped before.
/// Blocks share the parts of the open tiles.
template <int S> __global__ void __launch_bounds__(32) tail_scan_kernel(const BlendParams params) {
  constexpr int kBatch = 32;
  const int items = params.plan.state->counts.open_tiles[sample_class(S)] * S * kTailParts;
  for (int item = blockIdx.x; item < items; item += gridDim.x) {
    const int tile = open_tiles<S>(params)[item / (S * kTailParts)], s = item / kTailParts % S;
    const int chunks = chunks_of(params, tile, chunk_length(S)), front = front_chunks(params.grid, S);
    const TransmittancePlanes<S> planes(params, tile, item % kTailParts * 32 + lane_id());
    float transmittance = planes.at(front - 1, s), next[kBatch];
    const auto load = [&](int first) {
#pragma unroll
      for (int k = 0; k < kBatch; ++k) {
        if (first + k < chunks) next[k] = planes.at(first + k, s);
      }
    };
    load(front);
    for (int first = front; first < chunks; first += kBatch) {
      float through[kBatch];
#pragma unroll
      for (int k = 0; k < kBatch; ++k) through[k] = next[k];
      load(first + kBatch);  // before the stores, behind which loads would wait
#pragma unroll
      for (int k = 0; k < kBatch; ++k) {
        if (first + k >= chunks) break;
        planes.at(first + k, s) = transmittance;
        if (transmittance > 0) transmittance *= through[k];
        if (transmittance < kNearlyStopped) transmittance = -abs(transmittance);
      }
    }
  }
}

/// Blocks share the chunks. Writes the channels of each chunk and the transmittance at its end, which is zero where the
/// sample had stopped before the chunk.
template <class F, int C, bool kKeep>
__global__ void __launch_bounds__(kBlendThreads, kTailBlendBlocks<F>) tail_blend_kernel(const BlendParams params) {
  constexpr int S = F::kSamples, kLength = chunk_length(S), kSets = kKeep ? S : 1;
  __shared__ BlendStage<F, C> stage;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const Vec2<float> p = pixel_of(threadIdx.x / 32, lane_id());
  const int items = params.plan.state->counts.tail;
  for (int item = blockIdx.x; item < items; item += gridDim.x) {
    const TileChunk tail = params.plan.tail[item];
    if (!has_samples<S>(params.lists, tail.tile) || !params.tile_open[tail.tile]) continue;
    const TileList list = list_of(params.lists, params.grid, tail.tile);
    const int end = min(list.count, (tail.chunk + 1) * kLength);
    const PixelCheckpoints<S, C, kKeep> checkpoints(params, tail.tile, int(threadIdx.x));
    PixelState<S, C, kSets> state;
    state.start(false);
    bool started[S];
#pragma unroll
    for (int s = 0; s < S; ++s) {
      const float transmittance = checkpoints.transmittance(tail.chunk, s);
      started[s] = transmittance > 0;
      if (started[s]) state.transmittance[s] = transmittance;
    }
    int k = tail.chunk * kLength;
    while (k < end && __syncthreads_or(state.open())) {
      const int count = stage.load(splats, params.channels, list, k, end);
      __syncthreads();
      composite_all<F>(stage, count, k, p, state);
      k += count;
    }
    const Pixel pixel(list, params.grid, p);
#pragma unroll
    for (int s = 0; s < S; ++s) {
      const float transmittance = started[s] ? state.transmittance[s] : 0;
      if constexpr (kKeep) {
        checkpoints.kept(tail.chunk, s) = {state.channels[s], transmittance};
        if (pixel.inside && state.last[s] > 0) atomicMax(&params.last[s * pixel.image + pixel.index], state.last[s]);
      } else {
        checkpoints.transmittance(tail.chunk, s) = transmittance;
      }
    }
    if constexpr (!kKeep) checkpoints.set_total(tail.chunk, state.channels[0]);
    __syncthreads();
  }
}

/// Adds the chunks of the open tiles. Blocks share the parts of the tiles.
template <int S, int C, bool kKeep> __global__ void __launch_bounds__(32) tail_sum_kernel(const BlendParams params) {
  constexpr int kBatch = kKeep && C > 3 ? 16 : 32;  // chunks that are loaded together, into registers
  const Values<C> background = background_of<C>(params);
  const int items = params.plan.state->counts.open_tiles[sample_class(S)] * kTailParts;
  for (int item = blockIdx.x; item < items; item += gridDim.x) {
    const int tile = open_tiles<S>(params)[item / kTailParts], part = item % kTailParts;
    const int chunks = chunks_of(params, tile, chunk_length(S));
    const PixelCheckpoints<S, C, kKeep> checkpoints(params, tile, part * 32 + lane_id());
    Values<C> total = {};
    float transmittance[S];
#pragma unroll
    for (int s = 0; s < S; ++s) {
      float last = -1;
      for (int first = checkpoints.first_chunk; first < chunks; first += kBatch) {
        Values<C> own[kBatch];
        float ends[kBatch];
#pragma unroll
        for (int k = 0; k < kBatch; ++k) {
          ends[k] = 0;
          if (first + k >= chunks) continue;
          if (kKeep || s == 0) own[k] = checkpoints.channels(first + k, s);
          ends[k] = checkpoints.transmittance(first + k, s);
        }
#pragma unroll
        for (int k = 0; k < kBatch; ++k) {
          if ((kKeep || s == 0) && first + k < chunks) total += own[k];
          if (ends[k] != 0) last = ends[k];
        }
      }
      transmittance[s] = last;
      if constexpr (kKeep) accumulate_behind<kBatch>(checkpoints, chunks, s, times(abs(last), background));
    }
    const TileList list = list_of(params.lists, params.grid, tile);
    store_pixel(params, Pixel(list, params.grid, pixel_of(part, lane_id())), total, transmittance);
  }
}

/// Blocks of the kernels of the tail, which share the work: eight for each of the 132 multiprocessors of an H200.
inline constexpr int kTailBlocks = 132 * 8;

template <class F, int C, bool kKeep> void launch_blend(const BlendParams& p, cudaStream_t stream) {
  constexpr int S = F::kSamples;
  const LaunchShape of_chunks = {kTailBlocks, kBlendThreads}, of_parts = {kTailBlocks, 32};
  launch(blend_front_kernel<F, C, kKeep>, {unsigned(p.grid.tiles()), kBlendThreads}, stream, p);
  launch(tail_through_kernel<F>, of_chunks, stream, p);
  launch(tail_scan_kernel<S>, of_parts, stream, p);
  launch(tail_blend_kernel<F, C, kKeep>, of_chunks, stream, p);
  launch(tail_sum_kernel<S, C, kKeep>, of_parts, stream, p);
}
template <class F, int C> void blend_few(const BlendParams& p, cudaStream_t stream) {
  if (p.transmittance) {
    launch_blend<F, C, true>(p, stream);
  } else {
    launch_blend<F, C, false>(p, stream);
  }
}

}  // namespace ar::cuda
