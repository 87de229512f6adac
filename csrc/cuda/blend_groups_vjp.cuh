// Kernel of blend_vjp for any number of channels, a group after the other: a block per tile and segment of its list, a
// warp per subtile, a pixel per lane, back to front. Lanes share the channels as in blend_groups.cuh.
//
// The sums of shapes come from dL/dalpha, which is linear in the gradient of the image: each group could add its share
// to the sums of a pair, which a single block owns. To add a share costs as much as to add the sum of two, so the
// kernel of every other group of 32 adds the shares of two groups, and that of the second one only sums channels.
// MeanSums, which are not linear, need the channels of all groups: where they are wanted, the first group makes all
// sums of shapes, and reads the channels of the others where they lie.
#pragma once

#include <algorithm>

#include "cuda/blend_segments.cuh"
#include "cuda/launch.cuh"

namespace ar::cuda {

/// The kernel of a group of C channels makes the sums of shapes for kShapeGroups groups: 2, 1 or, if another one does,
/// none. This is how many splats a block takes between barriers: many, as its warps do not all meet equally many of
/// them, but no more than leave room for a few blocks in shared memory.
template <int C, int kShapeGroups> inline constexpr int kVjpBatch = C == kSmallGroup || kShapeGroups == 2 ? 64 : 32;
/// Sums of a pair besides its channels: PairGrad, and MeanSums.
inline constexpr int kShapeSums = 8;

/// What a block keeps in shared memory.
template <class F, int C, int kShapeGroups> struct GroupVjpShared {
  static constexpr int kBatch = kVjpBatch<C, kShapeGroups>;

  TileSplat<F, 0> splats[kBatch];
  GroupChannels<kBatch, C> channels[std::max(kShapeGroups, 1)];
  float sums[kSubtiles][kBatch][C + kShapeSums];  ///< of a warp's pixels
  uint32_t hits[kSubtiles][kBatch / 32];          ///< splats that have sums of a warp
  int32_t rows[kBatch];
  Mat2<float> mean_maps[kBatch];
  int last[kSubtiles];  ///< place behind the last splat that a subtile composited
  uint8_t reach[kBatch];
};

/// The gradient with respect to one of the samples of this lane's pixels, in its channels of the group that begins with
/// channel `first`.
template <class F, int C>
__device__ ChannelShare<C> share_of_gradient(const BlendVjpParams& params, const TileList& list, int first) {
  using Share = ChannelShare<C>;
  Share g;
#pragma unroll
  for (int i = 0; i < Share::kPixels; ++i) {
    const Pixel pixel(list, params.grid, pixel_of<F>(threadIdx.x / 32, Share::lane_of(i)));
#pragma unroll
    for (int k = 0; k < Share::kOwn; ++k) g.v[i][k] = sample_gradient<F>(params, pixel, first + Share::channel(k));
  }
  return g;
}

/// Blocks of the kernels below that a multiprocessor should hold at once. It limits the registers of a thread.
template <class F, int C, int kShapeGroups>
inline constexpr int kGroupVjpBlocks = F::kSamples > 4                        ? 1
                                       : F::kSamples > 1 || kShapeGroups == 2 ? 2
                                       : C > kSmallGroup                      ? 4
                                                                              : 5;

/// Channels [first, first + C), and the sums of shapes for kShapeGroups groups, from this one on.
template <class F, int C, int kShapeGroups>
__global__ void __launch_bounds__(kBlendThreads, kGroupVjpBlocks<F, C, kShapeGroups>)
    blend_groups_vjp_kernel(const BlendVjpParams params, int first) {
  wait_for_earlier_kernels();
  constexpr int S = F::kSamples, kBatch = kVjpBatch<C, kShapeGroups>;
  constexpr bool kWithShape = kShapeGroups > 0;
  using Share = ChannelShare<C>;
  auto& shared = *reinterpret_cast<GroupVjpShared<F, C, kShapeGroups>*>(dynamic_shared());
  const Segments& segments = params.segments;
  const int tile = listed_tile<S>(params, int(blockIdx.x) / segments.count);
  if (tile < 0) return;
  const Segment<F> segment(params.lists, params.grid, tile, int(blockIdx.x) % segments.count, segments.count,
                           params.last);
  const TileList& list = segment.list;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const int lane = lane_id(), warp = threadIdx.x / 32, channel_count = params.channels.count;
  const bool with_means = kWithShape && params.mean_sums != MeanSums::kNone;
  const bool all_at_once = with_means && channel_count > C;
  const Vec2<float> p = segment.p;
  const Pixel& pixel = segment.pixel;
  const int (&last)[S] = segment.last;
  int own_last = 0;
#pragma unroll
  for (int s = 0; s < S; ++s) own_last = max(own_last, last[s]);
  own_last = warp_max(own_last);
  if (lane == 0) shared.last[warp] = own_last;
  __syncthreads();
  // Pairs that nothing reached. A later group of the same width finds the zeros of the first.
  if ((first == 0 || C == kSmallGroup) && !list.of_patch && segment.number + 1 == segments.count) {
    for (int k = segment.end + threadIdx.x / kClearThreads; k < list.count; k += kBlendThreads / kClearThreads)
      clear_pair_together<C>(params, list.slot(k), true);
  }
  if (segment.begin == segment.end) return;

  const auto gradient = [&params, pixel](int c) { return sample_gradient<F>(params, pixel, c); };
  Share g[std::max(kShapeGroups, 1)];
  g[0] = share_of_gradient<F, C>(params, list, first);
  if constexpr (kShapeGroups == 2) g[1] = share_of_gradient<F, C>(params, list, first + C);
  float through = 0;  // what the background gives
#pragma unroll
  for (int i = 0; i < kShapeGroups; ++i) {
    float background[Share::kOwn];
#pragma unroll
    for (int k = 0; k < Share::kOwn; ++k) {
      const int c = first + i * C + Share::channel(k);
      background[k] = c < channel_count ? params.background[c] : 0;
    }
    through += g[i].dot(background);
  }
  if (all_at_once) {
    for (int c = C; c < channel_count; ++c) through += gradient(c) * params.background[c];
  }
  // Alpha is 1 - transmittance: its gradient acts like one more channel whose background is -1.
  if (first == 0 && params.dL_dalpha && pixel.inside) through -= kSampleShare<F> * params.dL_dalpha[pixel.index];
  float transmittance[S], behind[S];  // at the end of the segment
#pragma unroll
  for (int s = 0; s < S; ++s) {
    transmittance[s] = pixel.inside ? params.transmittance[sample_index<F>(pixel, s)] : 1;
    behind[s] = through;
    if (last[s] <= segment.end) continue;
    float rest = transmittance[s] * through;
    for (int k = segment.number + 1; kWithShape && k < segments.count; ++k)
      rest += segments.shown_at(tile, k, s)[threadIdx.x];
    transmittance[s] = segments.transmittance_at(tile, segment.number + 1, s)[threadIdx.x];
    behind[s] = rest / transmittance[s];
  }
  // The splat of this thread in the batch that ends at k1, for the threads that there are splats for.
  const auto splat_of_batch = [&](int k1) {
    const int k = max(k1 - kBatch, segment.begin) + int(threadIdx.x);
    return threadIdx.x < kBatch && k < k1 ? list.splat(k) : -1;
  };
  // Those of the staged splats [from, from + 32) that reach this warp's subtile.
  const auto reached = [&](int from) { return __ballot_sync(kAllLanes, shared.reach[from + lane] >> warp & 1); };
  int id = splat_of_batch(segment.end);
  for (int k1 = segment.end; k1 > segment.begin; k1 = max(k1 - kBatch, segment.begin)) {
    const int k0 = max(k1 - kBatch, segment.begin), count = k1 - k0;
    const int32_t next_id = splat_of_batch(k0);
    __syncthreads();  // all have read what the last batch left
    if (threadIdx.x < kBatch) {
      uint32_t reach = 0;
      const int t = threadIdx.x, k = k0 + t;
      if (k < k1) {
        const Splat<F, float> splat = splats[id];
        reach = subtile_reach<F>(splat, list.x0, list.y0);
#pragma unroll
        for (int b = 0; b < kSubtiles; ++b) reach &= ~(uint32_t(k >= shared.last[b]) << b);
        if (reach) shared.splats[t] = {tile_terms(splat, list), {}};
        if (with_means) shared.mean_maps[t] = F::mean_map(splat.shape);
#pragma unroll
        for (int i = 0; i < kShapeGroups; ++i) shared.channels[i].ids[t] = id;
        shared.rows[t] = list.slot(k);
      }
      shared.reach[t] = uint8_t(reach);
    }
    __syncthreads();
#pragma unroll
    for (int i = 0; i < kShapeGroups; ++i) shared.channels[i].load(params.channels, first + i * C, count, shared.reach);
    if (kWithShape) __syncthreads();
    if (next_id >= 0) {  // so that the next batch need not wait for memory
      prefetch(splats + next_id);
#pragma unroll
      for (int i = 0; i < kShapeGroups; ++i) prefetch(params.channels.row(next_id) + first + i * C);
    }
    id = next_id;
    for (int part = kBatch / 32 - 1; part >= 0; --part) {
      uint32_t hits = 0, mask = reached(32 * part);
      while (mask != 0) {
        const int bit = 31 - __clz(mask), j = 32 * part + bit;
        mask ^= 1u << bit;
        TileSplatRef<F, 0> splat = shared.splats[j];
        float alpha[S];
        bool any = false;
#pragma unroll
        for (int s = 0; s < S; ++s) {
          alpha[s] = F::alpha(splat.terms, p, s);
          any |= alpha[s] >= float(kAlphaMin) && k0 + j < last[s];
        }
        if (!__any_sync(kAllLanes, any)) continue;
        hits |= 1u << bit;
        float g_color = 0;
#pragma unroll
        for (int i = 0; i < kShapeGroups; ++i) g_color += g[i].dot(shared.channels[i].values[j]);
        if (all_at_once) {
          const float* row = params.channels.row(shared.channels[0].ids[j]);
          for (int c = C; c < channel_count; ++c) g_color = madd(gradient(c), row[c], g_color);
        }
        ShapeGrad<float> shape = {{0, 0}, {0, 0, 0}};
        float weighted = 0, contribution = 0;
#pragma unroll
        for (int s = 0; s < S; ++s) {
          const bool hit = alpha[s] >= float(kAlphaMin) && k0 + j < last[s];
          const BlendGrad<float> grad = blend_sample_vjp(hit, alpha[s], g_color, transmittance[s], behind[s]);
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
          shape = F::collect(splat.terms, shape, weighted);
          const float values[kShapeSums] = {shape.offset.x, shape.offset.y, shape.shape.xx, shape.shape.xy,
                                            shape.shape.yy, weighted,       means.x,        means.y};
          const float sum = sum_values(values);
          if (lane % 4 == 0) sums[C + lane / 4] = sum;
        }
        const float channel_sum = g[0].weighted_sum(contribution);
        if (Share::has_sum()) sums[Share::summed_channel()] = channel_sum;
      }
      if (lane == 0) shared.hits[warp][part] = hits;
    }
    __syncthreads();
    for (int j = warp; j < count; j += kSubtiles) {
      const uint32_t of_warps = __ballot_sync(kAllLanes, shared.hits[lane % kSubtiles][j / 32] >> j % 32 & 1);
      const int32_t row = shared.rows[j];
#pragma unroll
      for (int v = lane; v < C + (kWithShape ? kShapeSums : 0); v += 32) {
        float sum = 0;
#pragma unroll
        for (int w = 0; w < kSubtiles; ++w) {
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

/// What the segments behind the first add to each pixel, as its gradient weighs it: what those before them see.
/// `add`: to what another group of channels left.
template <class F, int C>
__global__ void __launch_bounds__(kBlendThreads, kGroupVjpBlocks<F, C, 1>)
    segment_shown_kernel(const BlendVjpParams params, int first, bool add) {
  wait_for_earlier_kernels();
  constexpr int S = F::kSamples;
  const Segments& segments = params.segments;
  const int tile = listed_tile<S>(params, int(blockIdx.x) / segments.count), number = int(blockIdx.x) % segments.count;
  if (tile < 0 || number == 0) return;
  const Segment<F> segment(params.lists, params.grid, tile, number, segments.count, params.last);
  const int channel_count = params.channels.count;
  const auto gradient = [&params, pixel = segment.pixel](int c) { return sample_gradient<F>(params, pixel, c); };
  const bool all_at_once = params.mean_sums != MeanSums::kNone && first == 0;
  const ChannelShare<C> g = share_of_gradient<F, C>(params, segment.list, first);
  float transmittance[S], shown[S];
#pragma unroll
  for (int s = 0; s < S; ++s) {
    transmittance[s] = segments.transmittance_at(tile, number, s)[threadIdx.x];
    shown[s] = add ? segments.shown_at(tile, number, s)[threadIdx.x] : 0;
  }
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  walk_segment<F, C>(splats, params.channels, first, segment, transmittance,
                     [&](int32_t id, const Eighth<C>(&values)[8], const float (&contributions)[S]) {
                       float g_color = g.dot(values);
                       for (int c = C; all_at_once && c < channel_count; ++c)
                         g_color = madd(gradient(c), params.channels.row(id)[c], g_color);
#pragma unroll
                       for (int s = 0; s < S; ++s) shown[s] = madd(contributions[s], g_color, shown[s]);
                     });
#pragma unroll
  for (int s = 0; s < S; ++s) segments.shown_at(tile, number, s)[threadIdx.x] = shown[s];
}

/// Channels [first, first + C), and the sums of shapes for kShapeGroups groups, from this one on.
template <class F, int C, int kShapeGroups>
void launch_groups_vjp(const BlendVjpParams& p, int first, cudaStream_t stream) {
  const unsigned blocks = unsigned(p.grid.tiles() * p.segments.count);
  if constexpr (!F::kReference) {
    for (int i = 0; p.segments.count > 1 && i < kShapeGroups; ++i)
      launch(segment_shown_kernel<F, C>, {blocks, kBlendThreads}, stream, p, first + i * C, i > 0);
  }
  const LaunchShape shape = {blocks, kBlendThreads, sizeof(GroupVjpShared<F, C, kShapeGroups>)};
  launch(blend_groups_vjp_kernel<F, C, kShapeGroups>, shape, stream, p, first);
}

/// For how many groups the kernel of the one that begins with channel `first` makes the sums of shapes.
template <class F> int shape_groups(const BlendVjpParams& p, int first) {
  if (p.mean_sums != MeanSums::kNone) return first == 0;
  const auto is_wide = [&](int begin) { return group_width<F>(p.channels.count - begin) == kChannelGroup; };
  if (F::kReference || !is_wide(first)) return 1;
  // Two groups at once take 100 KiB, which the blocks of some devices cannot have: 7.5, 8.6, 8.9, 12.0.
  if (sizeof(GroupVjpShared<F, kChannelGroup, 2>) > max_shared_bytes()) return 1;
  if (first / kChannelGroup % 2 == 1) return 0;
  return is_wide(first + kChannelGroup) ? 2 : 1;
}

/// The group that begins with channel `first`.
template <class F> void blend_vjp_group(const BlendVjpParams& p, int first, cudaStream_t stream) {
  const int shapes = shape_groups<F>(p, first);
  if constexpr (!F::kReference) {
    if (group_width<F>(p.channels.count - first) == kSmallGroup) {
      if (shapes == 0) return launch_groups_vjp<F, kSmallGroup, 0>(p, first, stream);
      return launch_groups_vjp<F, kSmallGroup, 1>(p, first, stream);
    }
    if (shapes == 2) return launch_groups_vjp<F, kChannelGroup, 2>(p, first, stream);
  }
  if (shapes == 0) return launch_groups_vjp<F, kChannelGroup, 0>(p, first, stream);
  launch_groups_vjp<F, kChannelGroup, 1>(p, first, stream);
}

}  // namespace ar::cuda
