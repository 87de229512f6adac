// Kernels of blend_vjp for up to four channels.
#pragma once

#include <algorithm>

#include "cuda/composite.cuh"
#include "cuda/launch.cuh"

namespace ar::cuda {

/// What a kernel of blend_vjp sums: gradients, MeanSums, or both at once.
enum class Sums { kGrads, kMeans, kBoth };

/// Samples of a pixel that a warp of blend_vjp takes. More are shared out to the warps of a block: one warp would be
/// busy for long with their chunk. Only MeanSums need a pixel's sum at once.
template <class F, Sums kSums>
inline constexpr int kVjpSamples = F::kSamples <= 4 || kSums == Sums::kMeans ? F::kSamples : 4;

/// Splats in blend_vjp, and what each of the warps that share them sums.
template <class F, int C, int kGroup> struct VjpGroup {
  TileSplat<F, C> splats[32];
  int32_t rows[kGroup > 1 ? 32 : 1];
  float sums[kGroup > 1 ? kGroup : 1][kGroup > 1 ? 32 : 1][6 + C];
};

/// A warp's pixels in blend_vjp, S samples of each.
template <int S, int C> struct VjpPixels {
  static constexpr bool kPacked = C == 3;  // the fourth number of g is sample 0's `last`, as bits
  static constexpr int kLasts = kPacked ? S - 1 : S;
  struct Sample {
    float transmittance, behind;
  };
  float4 g[kTilePixels];  // gradient with respect to one sample's channels
  Sample samples[S][kTilePixels];
  int last[kLasts > 0 ? kLasts : 1][kLasts > 0 ? kTilePixels : 1];

  __device__ int last_of(int s, int pixel, const float4& g_pixel) const {
    if (kPacked) return s == 0 ? __float_as_int(g_pixel.w) : last[s > 0 ? s - 1 : 0][pixel];
    return last[kPacked ? 0 : s][pixel];
  }
  __device__ void set(int pixel, const Values<C>& values) {
    g[pixel] = {values.v[0], values.v[1], values.v[2], kPacked ? 0 : values.v[C - 1]};
  }
  __device__ void set_last(int s, int pixel, int value) {
    if (!kPacked) {
      last[kPacked ? 0 : s][pixel] = value;
    } else if (s == 0) {
      g[pixel].w = __int_as_float(value);
    } else {
      last[s > 0 ? s - 1 : 0][pixel] = value;
    }
  }
};

template <int C> __device__ float dot(const Values<C>& a, const Values<C>& b) {
  float sum = a.v[0] * b.v[0];
#pragma unroll
  for (int c = 1; c < C; ++c) sum = sum + a.v[c] * b.v[c];
  return sum;
}

/// Blocks of blend_vjp that an SM should hold: bounds the registers.
template <class F, int C>
inline constexpr int kVjpBlocks = F::kSamples > 1                ? 1
                                  : sizeof(TileSplat<F, C>) > 48 ? 5
                                  : C == 3                       ? 7
                                                                 : 6;

/// Warps of a block of blend_vjp: as many as leave room for a few blocks in shared memory.
template <class F, Sums kSums>
inline constexpr int kVjpWarps = F::kSamples > kVjpSamples<F, kSums> ? F::kSamples / kVjpSamples<F, kSums>
                                 : F::kSamples <= 2                  ? 4
                                 : F::kSamples <= 8                  ? 2
                                                                     : 1;

/// A warp's share of a chunk, back to front over all pixels of the tile: every pair is summed in one place, so the sums
/// need no atomics, whose order would change from run to run. `first`: the first of the samples that the warp takes.
template <class F, int C, Sums kSums>
__device__ __forceinline__ void blend_chunk_vjp(const BlendVjpParams& params, int64_t item, int first,
                                                VjpPixels<kVjpSamples<F, kSums>, C>& stage,
                                                VjpGroup<F, C, F::kSamples / kVjpSamples<F, kSums>>& group) {
  constexpr int S = F::kSamples, kLength = chunk_length(S), kSumCount = 6 + C;
  constexpr int kOwn = kVjpSamples<F, kSums>, kGroup = S / kOwn;  // samples of a warp, warps of a chunk
  // Where the code for a subtile is short, each has its own: of 58 instructions 11 would work out where its pixels are.
  constexpr bool kUnroll = S == 1 && sizeof(TileSplat<F, C>) <= 48;
  constexpr bool kGrads = kSums != Sums::kMeans, kMeans = kSums != Sums::kGrads;
  // A shared-out sample's number is not known when the code is compiled: keep its node indexable.
  using VjpSplat = std::conditional_t<kGroup == 1, TileSplatRef<F, C>, const TileSplat<F, C>&>;
  const int lane = lane_id(), warp = threadIdx.x / 32;
  const auto group_sync = [] {
    if constexpr (kGroup > 1) {
      __syncthreads();
    } else {
      __syncwarp();
    }
  };
  const auto [tile, chunk, plane] = params.chunk_order[item];
  const TileList list = list_of(params.lists, params.grid, tile);
  const int begin = chunk * kLength, end = list.overflow ? list.count : min(list.count, begin + kLength);
  const int64_t image = int64_t(params.grid.width) * params.grid.height;
  const Vec2<float> size = {float(params.grid.width), float(params.grid.height)};
  const auto pixel_index = [&](int b) {  // in the image; -1 outside
    const Vec2<float> p = pixel_of(b, lane);
    const int x = list.x0 + int(p.x), y = list.y0 + int(p.y);
    return x < params.grid.width && y < params.grid.height ? int64_t(y) * params.grid.width + x : int64_t(-1);
  };

  int subtile_last[kSubtiles], tile_last = 0;
#pragma unroll
  for (int b = 0; b < kSubtiles; ++b) {
    const int64_t i = pixel_index(b);
    int last = 0;
#pragma unroll
    for (int s = 0; s < S; ++s) last = max(last, i < 0 ? 0 : params.last[s * image + i]);
    subtile_last[b] = warp_max(last);
    tile_last = max(tile_last, subtile_last[b]);
  }
  if (kGrads && !list.overflow) {
    for (int k = max(begin, min(tile_last, end)) + lane; k < end; k += 32) {  // pairs that nothing reached
      auto* row = reinterpret_cast<float4*>(params.pair_grads + int64_t(list.slot(k)) * kPairGradWidth);
#pragma unroll
      for (int q = 0; q < kPairGradWidth / 4; ++q) row[q] = {0, 0, 0, 0};
    }
  }
  if (begin >= tile_last) return;

  const bool final = tile_last <= end;
  const auto* checkpoints = reinterpret_cast<const Checkpoint<C>*>(params.checkpoints + int64_t(plane) * kTilePixels);
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const Vec2<float> p0 = pixel_of(0, lane);
  constexpr int kTwo23 = 0x4b000000;
  const int value = summed_value<kSumCount>(lane);  // that sum_values leaves here
  float* const sums = params.pair_grads + (value == 9 ? kPairFourthChannel : value);
  const float* dL_dplanes[C];  // of three channels all are there
  Values<C> background;
#pragma unroll
  for (int c = 0; c < C; ++c) {
    const bool used = C == 3 || c < params.channels.count;
    dL_dplanes[c] = C == 3 ? params.dL_dimage.first + c * image : used ? params.dL_dimage.plane(c, image) : nullptr;
    background.v[c] = used ? params.background[c] : 0;
  }
#pragma unroll
  for (int b = 0; b < kSubtiles; ++b) {
    const int64_t i = pixel_index(b);
    const int q = b * 32 + lane;
    const float scale = i < 0 ? 0 : 1.0f / S;
    Values<C> g;
#pragma unroll
    for (int c = 0; c < C; ++c) g.v[c] = i >= 0 && (C == 3 || dL_dplanes[c]) ? scale * dL_dplanes[c][i] : 0;
    stage.set(q, g);
#pragma unroll
    for (int s = 0; s < kOwn; ++s) {
      const int last = i < 0 ? 0 : params.last[(first + s) * image + i];
      float transmittance = 1, behind = 0;
      if (final) {
        transmittance = i < 0 ? 1.0f : params.transmittance[(first + s) * image + i];
        behind = dot(g, background);
      } else {
        const Checkpoint<C> c = checkpoints[(first + s) * kTilePixels + q];
        transmittance = abs(c.transmittance);
        behind = dot(g, c.channels) / transmittance;
      }
      // Alpha is 1 - transmittance: its gradient acts like one more channel whose background is -1.
      if (params.dL_dalpha && i >= 0) {
        const float open = final ? 1 : params.transmittance[(first + s) * image + i] / transmittance;
        behind -= scale * params.dL_dalpha[i] * open;
      }
      stage.samples[s][q] = {transmittance, behind};
      stage.set_last(s, q, last);
    }
  }

  const auto put = [&](int32_t row, int column, float x) {
    put_sum(params.pair_grads, kPairGradWidth, list.overflow, row, column, x);
  };
  static_assert(kLength % 32 == 0);  // no batch begins before `begin`
  for (int k1 = min(end, tile_last); k1 > begin; k1 = (k1 - 1) / 32 * 32) {
    const int k0 = (k1 - 1) / 32 * 32, k = k0 + lane;
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
      if (reach && first == 0)
        group.splats[lane] = {tile_terms(splat, list), channels_of<C>(params.channels, splat, id)};
      if (kMeans) mean_map = F::mean_map(splat.shape);
      if (kGroup > 1 && first == 0) group.rows[lane] = row_index;
    }
    uint32_t reaching = 0;  // of lane b the splats that reach subtile b
#pragma unroll
    for (int b = 0; b < kSubtiles; ++b) {
      const uint32_t splats_of_b = __ballot_sync(kAllLanes, reach >> b & 1);
      if (lane == b) reaching = splats_of_b;
    }
    group_sync();
    for (int at = k1 - 1; at >= k0; --at) {
      const int j = at & 31;
      // The same in all lanes, and by a ballot, so that the compiler knows that they branch alike.
      const uint32_t reached = __ballot_sync(kAllLanes, reaching >> j & 1);
      VjpSplat splat = group.splats[j];  // not there if it reaches no subtile, and then not looked at
      const Mat2<float> m =
          !kMeans ? mean_map
                  : Mat2<float>{__shfl_sync(kAllLanes, mean_map.xx, j), __shfl_sync(kAllLanes, mean_map.xy, j),
                                __shfl_sync(kAllLanes, mean_map.yx, j), __shfl_sync(kAllLanes, mean_map.yy, j)};
      ShapeGrad<float> shape = {{0, 0}, {0, 0, 0}};
      float weighted = 0;
      Values<C> channels = {};
      Vec2<float> mean_sums = {0, 0};
      const auto visit = [&](int b, Vec2<float> p) {
        const int q = b * 32 + lane;
        const float4 g = stage.g[q];
        const Values<4> of_pixel_g = {{g.x, g.y, g.z, g.w}};
        float g_color = madd(g.x, splat.channels.v[0], madd(g.y, splat.channels.v[1], g.z * splat.channels.v[2]));
        if (C > 3) g_color = madd(g.w, splat.channels.v[C - 1], g_color);
        float contribution = 0;
        ShapeGrad<float> of_pixel = {{0, 0}, {0, 0, 0}};
#pragma unroll
        for (int s = 0; s < kOwn; ++s) {
          const int node = kGroup == 1 ? s : first + s;
          const float alpha = F::alpha(splat.terms, p, node);
          const bool mask = alpha >= float(kAlphaMin) && at < stage.last_of(s, q, g);
          if (s == 0 && S == 1 && !__any_sync(kAllLanes, mask)) break;
          auto sample = stage.samples[s][q];
          const BlendGrad<float> grad = blend_sample_vjp(mask, alpha, g_color, sample.transmittance, sample.behind);
          stage.samples[s][q] = sample;
          if (kGrads) F::add_alpha_vjp(splat.terms, p, node, alpha, grad.dL_dalpha, shape);
          // Again for the pixel alone: to ask for it must not change the other sums by a bit.
          if (kMeans) F::add_alpha_vjp(splat.terms, p, node, alpha, grad.dL_dalpha, of_pixel);
          contribution = s == 0 ? grad.contribution : contribution + grad.contribution;
          weighted += grad.dL_dalpha * alpha;
        }
#pragma unroll
        for (int c = 0; c < C; ++c) channels.v[c] = madd(contribution, of_pixel_g.v[c], channels.v[c]);
        if (kMeans) {
          const Vec2<float> dL_dmean = transform_transposed(m, of_pixel.offset);
          mean_sums = mean_sums + mean_sums_of(params.mean_sums, size, dL_dmean);
        }
      };
      if constexpr (kUnroll) {
#pragma unroll
        for (int b = 0; b < kSubtiles; ++b) {
          if (reached >> b & 1) visit(b, {p0.x + float(8 * (b & 1)), p0.y + float(4 * (b >> 1))});
        }
      } else {
        for (uint32_t hit = reached; hit != 0; hit &= hit - 1) {
          const int b = __ffs(hit) - 1;
          // pixel_of(b, lane); an integer below 2^23 set into the mantissa of 2^23 is that float, plus 2^23
          const float column = __int_as_float(kTwo23 | (b & 1)) - 8388608.0f;
          const float band = __int_as_float(kTwo23 | (b >> 1)) - 8388608.0f;
          visit(b, {madd(8.0f, column, p0.x), madd(4.0f, band, p0.y)});
        }
      }
      const int32_t row = __shfl_sync(kAllLanes, row_index, j);
      if (kGrads) {
        if (reached) shape = F::collect(splat.terms, shape, weighted);  // else there are no terms
        float values[kSumCount] = {shape.offset.x, shape.offset.y, shape.shape.xx,
                                   shape.shape.xy, shape.shape.yy, weighted};
#pragma unroll
        for (int c = 0; c < C; ++c) values[6 + c] = channels.v[c];
        const float sum = sum_values(values);
        if constexpr (kGroup > 1) {
          if (has_value_first<kSumCount>(lane)) group.sums[warp][j][value] = sum;
        } else if (!list.overflow) {
          sums[int64_t(row) * kPairGradWidth] = sum;  // of all lanes: to find the first ones takes longer
        } else if (has_value_first<kSumCount>(lane)) {
          atomicAdd(&sums[int64_t(row) * kPairGradWidth], sum);
        }
      }
      if (kMeans) {
        const Vec2<float> total = {warp_sum(mean_sums.x), warp_sum(mean_sums.y)};
        if (lane == 1) put(row, kPairMeans, total.x);
        if (lane == 3) put(row, kPairMeans + 1, total.y);
      }
    }
    if constexpr (kGroup > 1 && kGrads) {
      __syncthreads();
      for (int t = threadIdx.x; t < kSumCount * (k1 - k0); t += 32 * kGroup) {
        const int j = t / kSumCount, v = t % kSumCount;
        float sum = group.sums[0][j][v];
#pragma unroll
        for (int w = 1; w < kGroup; ++w) sum += group.sums[w][j][v];
        put(group.rows[j], v == 9 ? kPairFourthChannel : v, sum);
      }
    }
  }
}

/// Whether a warp has a chunk for itself. Then it takes the next one when it is done, and need not wait for the others
/// of its block, which have other chunks. Warps that share a chunk end with their block.
template <class F, Sums kSums> inline constexpr bool kTakesChunks = kVjpSamples<F, kSums> == F::kSamples;

template <class F, int C, Sums kSums>
__global__ void __launch_bounds__(32 * kVjpWarps<F, kSums>, kVjpBlocks<F, C>)
    blend_vjp_kernel(const BlendVjpParams params) {
  constexpr int kWarps = kVjpWarps<F, kSums>, kOwn = kVjpSamples<F, kSums>, kGroup = F::kSamples / kOwn;
  auto* pixels = reinterpret_cast<VjpPixels<kOwn, C>*>(dynamic_shared());
  auto* groups = reinterpret_cast<VjpGroup<F, C, kGroup>*>(pixels + kWarps);
  const int warp = threadIdx.x / 32, first = warp % kGroup * kOwn;
  const int32_t* firsts = params.plan->counts.chunks.first + sample_class(F::kSamples);
  const int begin = firsts[0], end = firsts[1];
  if constexpr (kTakesChunks<F, kSums>) {
    for (;;) {
      int taken = 0;
      if (lane_id() == 0) taken = atomicAdd(&params.chunks_taken[sample_class(F::kSamples)], 1);
      const int item = begin + shuffle(taken, 0);
      if (item >= end) return;
      blend_chunk_vjp<F, C, kSums>(params, item, first, pixels[warp], groups[warp]);
    }
  } else {
    const int64_t item = begin + (int64_t(blockIdx.x) * kWarps + warp) / kGroup;
    if (item < end) blend_chunk_vjp<F, C, kSums>(params, item, first, pixels[warp], groups[warp / kGroup]);
  }
}

/// Eight blocks for each of the 132 multiprocessors of an H200.
inline constexpr int kClearBlocks = 132 * 8;
/// As many blocks as any device holds: more would only find that no chunk is left.
inline constexpr unsigned kTakingBlocks = 256 * 8;

template <class F, int C, Sums kSums> void launch_blend_vjp(const BlendVjpParams& p, cudaStream_t stream) {
  constexpr int kOwn = kVjpSamples<F, kSums>, kWarps = kVjpWarps<F, kSums>, kGroup = F::kSamples / kOwn;
  const size_t bytes = kWarps * sizeof(VjpPixels<kOwn, C>) + kWarps / kGroup * sizeof(VjpGroup<F, C, kGroup>);
  unsigned blocks = blocks_of(p.max_chunks, kWarps / kGroup);
  if (kTakesChunks<F, kSums>) blocks = std::min(blocks, kTakingBlocks);
  launch(blend_vjp_kernel<F, C, kSums>, {blocks, 32 * kWarps, bytes}, stream, p);
}
template <class F, int C> void blend_vjp_few(const BlendVjpParams& p, cudaStream_t stream) {
  constexpr bool kAtOnce = kVjpSamples<F, Sums::kGrads> == F::kSamples;
  if (!kAtOnce || p.mean_sums == MeanSums::kNone) launch_blend_vjp<F, C, Sums::kGrads>(p, stream);
  if (p.mean_sums != MeanSums::kNone) launch_blend_vjp<F, C, kAtOnce ? Sums::kBoth : Sums::kMeans>(p, stream);
}

}  // namespace ar::cuda
