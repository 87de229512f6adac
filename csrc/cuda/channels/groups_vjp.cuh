// Kernel blend_groups_vjp: the backward pass for one group of channels; later groups add to pair_grads. A block per
// tile, a warp per subtile, walks the list back to front; lanes share channels as in groups.cuh.
//
// dL/dalpha is linear in the image's gradient: each group adds its share to the sums of a pair. MeanSums are not: for
// them the first group makes all sums of shapes, from the channels of all groups.
#pragma once

#include "cuda/channels/groups.cuh"

namespace ar::cuda {

/// PairGrad and MeanSums.
inline constexpr int kShapeSums = 8;

template <class F, int C> struct GroupVjpShared {
  static constexpr int kBatch = ChannelsPolicy::kVjpBatch<C == kSmallGroup>;

  TileSplat<F, 0> splats[kBatch];
  GroupChannels<kBatch, C> channels;
  float sums[kSubtiles][kBatch][C + kShapeSums];  ///< of a warp
  uint32_t hits[kSubtiles][kBatch / 32];          ///< splats with sums of a warp
  int32_t rows[kBatch];
  Mat2<float> mean_maps[kBatch];
  int last[kSubtiles];  ///< pairs up to the last that a subtile composited
  uint8_t reach[kBatch];
};

/// Of one sample of this lane's pixels, in its channels.
template <class F, int C>
__device__ ChannelShare<C> share_of_gradient(const BlendVjpParams& params, const TileList& list, int first) {
  using Share = ChannelShare<C>;
  Share g;
  AR_UNROLL for (int i = 0; i < Share::kPixels; ++i) {
    const Pixel pixel(list, params.grid, pixel_of<F>(threadIdx.x / 32, Share::lane_of(i)));
    AR_UNROLL for (int k = 0; k < Share::kOwn; ++k) g.v[i][k] =
        sample_gradient<F>(params, pixel, first + Share::channel(k));
  }
  return g;
}

/// F: what a lane blends. kWithShape: makes sums of shapes too.
template <class F, int C, bool kWithShape>
__global__ void __launch_bounds__(kBlendThreads, kGroupBlocks<F, C>)
    blend_groups_vjp_kernel(const BlendVjpParams params, int first) {
  wait_for_earlier_kernels();
  using Shared = GroupVjpShared<F, C>;
  constexpr int S = F::kSamples, kBatch = Shared::kBatch;
  using Share = ChannelShare<C>;
  auto& shared = *reinterpret_cast<Shared*>(dynamic_shared());
  const int tile = listed_tile(params, int(blockIdx.x));
  if (tile < 0) return;
  const TileList list = list_of(params.lists, params.grid, tile);
  const int lane = lane_id(), warp = threadIdx.x / 32, channel_count = params.channels.count;
  const bool with_means = kWithShape && params.mean_sums != MeanSums::kNone;
  const bool all_at_once = with_means && channel_count > C;
  const Vec2<float> p = position_of<F>(warp, lane);
  const Pixel pixel(list, params.grid, pixel_of<F>(warp, lane));
  int last[S], own_last = 0;
  AR_UNROLL for (int s = 0; s < S; ++s) {
    last[s] = pixel.inside ? params.last[sample_index<F>(pixel, s)] : 0;
    own_last = max(own_last, last[s]);
  }
  own_last = warp_max(own_last);
  if (lane == 0) shared.last[warp] = own_last;
  __syncthreads();
  int end = 0;  // pairs up to the last that any pixel composited
  AR_UNROLL for (int b = 0; b < kSubtiles; ++b) end = max(end, shared.last[b]);
  // Pairs that nothing reached. Later groups of one width find the zeros of the first.
  if ((first == 0 || C == kSmallGroup) && !list.of_patch) {
    for (int k = end + threadIdx.x / kClearThreads; k < list.count; k += kBlendThreads / kClearThreads)
      clear_pair_together<C>(params, list.slot(k), first == 0);
  }
  if (end == 0) return;

  const auto gradient = [&params, pixel](int c) { return sample_gradient<F>(params, pixel, c); };
  const Share g = share_of_gradient<F, C>(params, list, first);
  float through = 0;  // scalar product of the gradient and the background
  if (kWithShape) {
    float background[Share::kOwn];
    AR_UNROLL for (int k = 0; k < Share::kOwn; ++k) {
      const int c = first + Share::channel(k);
      background[k] = c < channel_count ? params.background[c] : 0;
    }
    through = g.dot(background);
  }
  if (all_at_once) {
    for (int c = C; c < channel_count; ++c) through += gradient(c) * params.background[c];
  }
  // Alpha is a channel with background -1.
  if (first == 0 && params.dL_dalpha && pixel.inside) through -= kSampleShare<F> * params.dL_dalpha[pixel.index];
  float transmittance[S], farther[S];  // as in blend_sample_vjp, after the list
  AR_UNROLL for (int s = 0; s < S; ++s) {
    transmittance[s] = pixel.inside ? params.transmittance[sample_index<F>(pixel, s)] : 1;
    farther[s] = through;
  }
  const auto splat_of_batch = [&](int k1) {
    const int k = max(k1 - kBatch, 0) + int(threadIdx.x);
    return threadIdx.x < kBatch && k < k1 ? list.splat(k) : -1;
  };
  int id = splat_of_batch(end);
  for (int k1 = end; k1 > 0; k1 -= kBatch) {
    const int k0 = max(k1 - kBatch, 0), count = k1 - k0;
    const int32_t next_id = splat_of_batch(k0);
    __syncthreads();  // all have read what the last batch left
    if (threadIdx.x < kBatch) {
      uint32_t reach = 0;
      const int t = threadIdx.x, k = k0 + t;
      if (k < k1) {
        const Splat<F, float> splat = load_splat<F>(params.splats, id);
        reach = subtile_reach<F>(splat, list.x0, list.y0);
        AR_UNROLL for (int b = 0; b < kSubtiles; ++b) reach &= ~(uint32_t(k >= shared.last[b]) << b);
        if (reach) shared.splats[t] = {tile_terms(splat, list), {}};
        if (with_means) shared.mean_maps[t] = F::mean_map(splat.shape);
        shared.channels.ids[t] = id;
        shared.rows[t] = list.slot(k);
      }
      shared.reach[t] = uint8_t(reach);
    }
    __syncthreads();
    if constexpr (kWithShape) {
      shared.channels.load(params.channels, first, count, shared.reach);
      __syncthreads();
    }
    if (next_id >= 0) {
      prefetch_splat(params.splats, next_id);
      if (kWithShape) prefetch(params.channels.row(next_id) + first);
    }
    id = next_id;
    for (int part = kBatch / 32 - 1; part >= 0; --part) {
      uint32_t hits = 0, mask = __ballot_sync(kAllLanes, shared.reach[32 * part + lane] >> warp & 1);
      while (mask != 0) {
        const int bit = 31 - __clz(mask), j = 32 * part + bit;
        mask ^= 1u << bit;
        TileSplatRef<F, 0> splat = shared.splats[j];
        float alpha[S];
        bool any = false;
        AR_UNROLL for (int s = 0; s < S; ++s) {
          alpha[s] = F::alpha(splat.terms, p, s);
          any |= alpha[s] >= float(kAlphaMin) && k0 + j < last[s];
        }
        if (!__any_sync(kAllLanes, any)) continue;
        hits |= 1u << bit;
        float g_color = kWithShape ? g.dot(shared.channels.values[j]) : 0.0f;
        if (all_at_once) {
          const float* row = params.channels.row(shared.channels.ids[j]);
          for (int c = C; c < channel_count; ++c) g_color = madd(gradient(c), row[c], g_color);
        }
        ShapeGrad<float> shape = {{0, 0}, {0, 0, 0}};
        float weighted = 0, contribution = 0;
        AR_UNROLL for (int s = 0; s < S; ++s) {
          const bool hit = alpha[s] >= float(kAlphaMin) && k0 + j < last[s];
          const BlendGrad<float> grad = blend_sample_vjp(hit, alpha[s], g_color, transmittance[s], farther[s]);
          if (kWithShape) F::add_alpha_vjp(splat.terms, p, s, grad.of_alpha, shape);
          contribution += grad.contribution;
          weighted += grad.of_alpha.weighted;
        }
        float* sums = shared.sums[warp][j];
        if constexpr (kWithShape) {
          Vec2<float> means = {0, 0};
          if (with_means) {
            const Vec2<float> size = {float(params.grid.width), float(params.grid.height)};
            const Vec2<float> offset = {sum_of_pixel<F>(shape.offset.x), sum_of_pixel<F>(shape.offset.y)};
            means = mean_sums_of(params.mean_sums, size, transform_transposed(shared.mean_maps[j], offset));
            if (!writes_pixel<F>(lane)) means = {0, 0};
          }
          const float values[kShapeSums] = {shape.offset.x, shape.offset.y, shape.shape.xx, shape.shape.xy,
                                            shape.shape.yy, weighted,       means.x,        means.y};
          const float sum = sum_values(values);
          if (lane % 4 == 0) sums[C + lane / 4] = sum;
        }
        const float channel_sum = g.weighted_sum(contribution);
        if (Share::has_sum()) sums[Share::summed_channel()] = channel_sum;
      }
      if (lane == 0) shared.hits[warp][part] = hits;
    }
    __syncthreads();
    for (int j = warp; j < count; j += kSubtiles) {
      const uint32_t of_warps = __ballot_sync(kAllLanes, shared.hits[lane % kSubtiles][j / 32] >> j % 32 & 1);
      const int32_t row = shared.rows[j];
      AR_UNROLL for (int v = lane; v < C + (kWithShape ? kShapeSums : 0); v += 32) {
        float sum = 0;
        AR_UNROLL for (int w = 0; w < kSubtiles; ++w) {
          if (of_warps >> w & 1) sum += shared.sums[w][j][v];
        }
        if (v >= C) {
          const int column = v - C < kPairChannels ? v - C : kPairMeans + v - C - kPairChannels;
          if (first > 0 && !list.of_patch) sum += params.pair_grads[int64_t(row) * kPairGradWidth + column];
          put_sum(params.pair_grads, kPairGradWidth, list.of_patch, row, column, sum);
        } else if (params.channel_sums) {
          put_sum(params.channel_sums, C, list.of_patch, row, v, sum);
        } else if (v < kFewChannels) {
          const int column = v == 3 ? kPairFourthChannel : kPairChannels + v;
          put_sum(params.pair_grads, kPairGradWidth, list.of_patch, row, column, sum);
        }
      }
    }
  }
}

template <class F, int C> void launch_group_vjp(const BlendVjpParams& p, int first, cudaStream_t stream) {
  const LaunchShape blocks = {unsigned(p.grid.tiles()), kBlendThreads, sizeof(GroupVjpShared<F, C>)};
  const bool with_shape = p.mean_sums == MeanSums::kNone || first == 0;
  const auto kernel = with_shape ? blend_groups_vjp_kernel<F, C, true> : blend_groups_vjp_kernel<F, C, false>;
  launch(kernel, blocks, stream, p, first);
}
template <class F> void launch_blend_groups_vjp(const BlendVjpParams& p, int first, cudaStream_t stream) {
  if constexpr (!F::kGeneric) {
    if (group_width<F>(p.channels.count - first) == kSmallGroup)
      return launch_group_vjp<F, kSmallGroup>(p, first, stream);
  }
  launch_group_vjp<F, kChannelGroup>(p, first, stream);
}

}  // namespace ar::cuda
