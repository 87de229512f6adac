// Kernel of blend_vjp for any number of channels, a group of 32 after the other: a block per tile and segment of its
// list, a warp per subtile, a pixel per lane, back to front.
//
// dL/dalpha is linear in the gradient of the image: each group adds its share to the six sums of a pair, which a single
// block owns. Only MeanSums need the channels of all groups at once: where they are wanted, the
// first group makes all sums, and reads the channels of the others where they lie.
#pragma once

#include "cuda/blend_segments.cuh"

namespace ar::cuda {

/// Splats that a block takes between barriers: many, as its warps do not all meet equally many of them.
inline constexpr int kVjpBatch = 64;
/// Sums of a pair besides its channels: PairGrad, and MeanSums.
inline constexpr int kShapeSums = 8;

/// What a block keeps in shared memory.
template <class F> struct GroupVjpShared {
  TileSplat<F, 0> splats[kVjpBatch];
  GroupChannels<kVjpBatch> channels;
  float4 contributions[kSubtiles][2]
                      [8];  ///< of a warp's 32 pixels; two, so that one can be read while the next is written
  float sums[kSubtiles][kVjpBatch][kChannelGroup + kShapeSums];  ///< of a warp's pixels
  uint32_t hits[kSubtiles][kVjpBatch / 32];                      ///< splats that have sums of a warp
  int32_t rows[kVjpBatch];
  Mat2<float> mean_maps[kVjpBatch];
  int last[kSubtiles];  ///< place behind the last splat that a subtile composited
  uint8_t reach[kVjpBatch];
};

__device__ inline float dot(const float (&g)[kChannelGroup], const float4 (&values)[kChannelGroup / 4]) {
  float sum[4] = {0, 0, 0, 0};
#pragma unroll
  for (int q = 0; q < kChannelGroup / 4; ++q) {
    const float4 v = values[q];
    sum[0] = madd(g[4 * q], v.x, sum[0]);
    sum[1] = madd(g[4 * q + 1], v.y, sum[1]);
    sum[2] = madd(g[4 * q + 2], v.z, sum[2]);
    sum[3] = madd(g[4 * q + 3], v.w, sum[3]);
  }
  return (sum[0] + sum[1]) + (sum[2] + sum[3]);
}

/// The gradient of a pixel with respect to a channel of one of its S samples.
struct SampleGradient {
  const BlendVjpParams& params;
  const Pixel& pixel;
  int samples;

  __device__ float operator()(int channel) const {
    const float* plane = channel < params.channels.count ? params.dL_dimage.plane(channel, pixel.image) : nullptr;
    return pixel.inside && plane ? 1.0f / samples * plane[pixel.index] : 0.0f;
  }
};

template <class F>
__global__ void __launch_bounds__(kBlendThreads, F::kSamples > 4 ? 1 : 2)
    blend_groups_vjp_kernel(const BlendVjpParams params, int group) {
  constexpr int S = F::kSamples;
  auto& shared = *reinterpret_cast<GroupVjpShared<F>*>(dynamic_shared());
  const Segments& segments = params.segments;
  const int tile = listed_tile<S>(params, int(blockIdx.x) / segments.count);
  if (tile < 0) return;
  const Segment<S> segment(params.lists, params.grid, tile, int(blockIdx.x) % segments.count, segments.count,
                           params.last);
  const TileList& list = segment.list;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const int first = group * kChannelGroup, lane = lane_id(), warp = threadIdx.x / 32,
            channel_count = params.channels.count;
  const bool with_means = params.mean_sums != MeanSums::kNone,
             all_at_once = with_means && channel_count > kChannelGroup;
  const bool with_shape = !all_at_once || group == 0;
  const Vec2<float> p = segment.p;
  const Pixel& pixel = segment.pixel;
  const int (&last)[S] = segment.last;
  int own_last = 0;
#pragma unroll
  for (int s = 0; s < S; ++s) own_last = max(own_last, last[s]);
  own_last = warp_max(own_last);
  if (lane == 0) shared.last[warp] = own_last;
  __syncthreads();
  if (group == 0 && !list.overflow && segment.number + 1 == segments.count) {  // pairs that nothing reached
    for (int k = segment.end + threadIdx.x / 8; k < list.count; k += kBlendThreads / 8) {
      const int q = threadIdx.x % 8;
      const int64_t slot = list.slot(k);
      const float4 zero = {0, 0, 0, 0};
      if (q < kPairGradWidth / 4) reinterpret_cast<float4*>(params.pair_grads + slot * kPairGradWidth)[q] = zero;
      if (params.channel_sums) reinterpret_cast<float4*>(params.channel_sums + slot * kChannelGroup)[q] = zero;
    }
  }
  if (segment.begin == segment.end) return;

  const SampleGradient gradient = {params, pixel, S};
  float g[kChannelGroup];          // this lane's pixel, all channels
  float g_channel[kChannelGroup];  // this lane's channel, all pixels
  float through = 0;               // what the background gives
#pragma unroll
  for (int c = 0; c < kChannelGroup; ++c) {
    g[c] = gradient(first + c);
    if (first + c < channel_count) through += g[c] * params.background[first + c];
  }
  if (all_at_once && group == 0) {
    for (int c = kChannelGroup; c < channel_count; ++c) through += gradient(c) * params.background[c];
  }
  // Alpha is 1 - transmittance: its gradient acts like one more channel whose background is -1.
  if (group == 0 && params.dL_dalpha && pixel.inside) through -= 1.0f / S * params.dL_dalpha[pixel.index];
  float transmittance[S], behind[S];  // at the end of the segment
#pragma unroll
  for (int s = 0; s < S; ++s) {
    transmittance[s] = pixel.inside ? params.transmittance[s * pixel.image + pixel.index] : 1;
    behind[s] = through;
    if (last[s] <= segment.end) continue;
    float rest = transmittance[s] * through;
    for (int k = segment.number + 1; k < segments.count; ++k) rest += segments.shown_at(tile, k, s)[threadIdx.x];
    transmittance[s] = segments.transmittance_at(tile, segment.number + 1, s)[threadIdx.x];
    behind[s] = rest / transmittance[s];
  }
  {
    constexpr int kStride = kChannelGroup + 1;  // keeps the lanes on different banks
    static_assert(32 * kStride <= kVjpBatch * (kChannelGroup + kShapeSums));
    float* transposed = &shared.sums[warp][0][0];
#pragma unroll
    for (int c = 0; c < kChannelGroup; ++c) transposed[lane * kStride + c] = g[c];
    __syncwarp();
#pragma unroll
    for (int q = 0; q < 32; ++q) g_channel[q] = transposed[q * kStride + lane];
  }

  // The splat of this thread in the batch that ends at k1, for the threads that there are splats for.
  const auto splat_of_batch = [&](int k1) {
    const int k = max(k1 - kVjpBatch, segment.begin) + int(threadIdx.x);
    return threadIdx.x < kVjpBatch && k < k1 ? list.splat(k) : -1;
  };
  // Those of the staged splats [from, from + 32) that reach this warp's subtile.
  const auto reached = [&](int from) { return __ballot_sync(kAllLanes, shared.reach[from + lane] >> warp & 1); };
  int turn = 0, id = splat_of_batch(segment.end);
  for (int k1 = segment.end; k1 > segment.begin; k1 = max(k1 - kVjpBatch, segment.begin)) {
    const int k0 = max(k1 - kVjpBatch, segment.begin), count = k1 - k0;
    const int32_t next_id = splat_of_batch(k0);
    __syncthreads();  // all have read what the last batch left
    if (threadIdx.x < kVjpBatch) {
      uint32_t reach = 0;
      const int t = threadIdx.x, k = k0 + t;
      if (k < k1) {
        const Splat<F, float> splat = splats[id];
        reach = subtile_reach(support_of(splat), list.x0, list.y0);
#pragma unroll
        for (int b = 0; b < kSubtiles; ++b) reach &= ~(uint32_t(k >= shared.last[b]) << b);
        if (reach) shared.splats[t] = {tile_terms(splat, list), {}};
        if (with_means) shared.mean_maps[t] = F::mean_map(splat.shape);
        shared.channels.ids[t] = id;
        shared.rows[t] = list.overflow ? id : list.slot(k);
      }
      shared.reach[t] = uint8_t(reach);
    }
    __syncthreads();
    shared.channels.load(params.channels, first, count, shared.reach);
    __syncthreads();
    if (next_id >= 0) {  // so that the next batch need not wait for memory
      prefetch(splats + next_id);
      prefetch(params.channels.row(next_id) + first);
    }
    id = next_id;
    for (int part = kVjpBatch / 32 - 1; part >= 0; --part) {
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
        float g_color = dot(g, shared.channels.values[j]);
        if (all_at_once && group == 0) {
          const float* row = params.channels.row(shared.channels.ids[j]);
          for (int c = kChannelGroup; c < channel_count; ++c) g_color = madd(gradient(c), row[c], g_color);
        }
        ShapeGrad<float> shape = {{0, 0}, {0, 0, 0}};
        float weighted = 0, contribution = 0;
#pragma unroll
        for (int s = 0; s < S; ++s) {
          const bool hit = alpha[s] >= float(kAlphaMin) && k0 + j < last[s];
          const BlendGrad<float> grad = blend_sample_vjp(hit, alpha[s], g_color, transmittance[s], behind[s]);
          if (with_shape) F::add_alpha_vjp(splat.terms, p, s, alpha[s], grad.dL_dalpha, shape);
          contribution += grad.contribution;
          weighted += grad.dL_dalpha * alpha[s];
        }
        turn ^= 1;
        reinterpret_cast<float*>(shared.contributions[warp][turn])[lane] = contribution;
        float* sums = shared.sums[warp][j];
        if (with_shape) {
          Vec2<float> means = {0, 0};
          if (with_means) {
            const Vec2<float> size = {float(params.grid.width), float(params.grid.height)};
            means = mean_sums_of(params.mean_sums, size, transform_transposed(shared.mean_maps[j], shape.offset));
          }
          shape = F::collect(splat.terms, shape, weighted);
          const float values[kShapeSums] = {shape.offset.x, shape.offset.y, shape.shape.xx, shape.shape.xy,
                                            shape.shape.yy, weighted,       means.x,        means.y};
          const float sum = sum_values(values);
          if (lane % 4 == 0) sums[kChannelGroup + lane / 4] = sum;
        }
        __syncwarp();
        sums[lane] = dot(g_channel, shared.contributions[warp][turn]);
      }
      if (lane == 0) shared.hits[warp][part] = hits;
    }
    __syncthreads();
    for (int j = warp; j < count; j += kSubtiles) {
      float sum = 0, shape_sum = 0;
      const uint32_t of_warps = __ballot_sync(kAllLanes, shared.hits[lane % kSubtiles][j / 32] >> j % 32 & 1);
#pragma unroll
      for (int w = 0; w < kSubtiles; ++w) {
        if (of_warps >> w & 1) {
          sum += shared.sums[w][j][lane];
          if (lane < kShapeSums) shape_sum += shared.sums[w][j][kChannelGroup + lane];
        }
      }
      const int32_t row = shared.rows[j];
      if (params.channel_sums) {
        put_sum(params.channel_sums, kChannelGroup, list.overflow, row, lane, sum);
      } else if (lane < kFewChannels) {
        const int column = lane == 3 ? kPairFourthChannel : kPairChannels + lane;
        put_sum(params.pair_grads, kPairGradWidth, list.overflow, row, column, sum);
      }
      if (with_shape && lane < kShapeSums) {
        const int column = lane < kPairChannels ? lane : kPairMeans + lane - kPairChannels;
        if (group > 0 && !list.overflow) shape_sum += params.pair_grads[int64_t(row) * kPairGradWidth + column];
        put_sum(params.pair_grads, kPairGradWidth, list.overflow, row, column, shape_sum);
      }
    }
  }
}

/// What the segments behind the first add to each pixel, as its gradient weighs it: what those before them see.
template <class F>
__global__ void __launch_bounds__(kBlendThreads, F::kSamples > 4 ? 1 : 2)
    segment_shown_kernel(const BlendVjpParams params, int group) {
  constexpr int S = F::kSamples;
  const Segments& segments = params.segments;
  const int tile = listed_tile<S>(params, int(blockIdx.x) / segments.count), number = int(blockIdx.x) % segments.count;
  if (tile < 0 || number == 0) return;
  const Segment<S> segment(params.lists, params.grid, tile, number, segments.count, params.last);
  const SampleGradient gradient = {params, segment.pixel, S};
  const int first = group * kChannelGroup, channel_count = params.channels.count;
  const bool all_at_once = params.mean_sums != MeanSums::kNone && group == 0;
  float g[kChannelGroup], transmittance[S], shown[S];
#pragma unroll
  for (int c = 0; c < kChannelGroup; ++c) g[c] = gradient(first + c);
#pragma unroll
  for (int s = 0; s < S; ++s) {
    transmittance[s] = segments.transmittance_at(tile, number, s)[threadIdx.x];
    shown[s] = 0;
  }
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  walk_segment<F>(splats, params.channels, first, segment, transmittance,
                  [&](int32_t id, const float4(&values)[kChannelGroup / 4], const float (&contributions)[S]) {
                    float g_color = dot(g, values);
                    for (int c = kChannelGroup; all_at_once && c < channel_count; ++c)
                      g_color = madd(gradient(c), params.channels.row(id)[c], g_color);
#pragma unroll
                    for (int s = 0; s < S; ++s) shown[s] = madd(contributions[s], g_color, shown[s]);
                  });
#pragma unroll
  for (int s = 0; s < S; ++s) segments.shown_at(tile, number, s)[threadIdx.x] = shown[s];
}

template <class F> void blend_vjp_groups(const BlendVjpParams& p, int group, cudaStream_t stream) {
  const unsigned blocks = unsigned(p.grid.tiles() * p.segments.count);
  if constexpr (!F::kYardstick) {
    // Only the sums of shapes read what it writes. With MeanSums the first group makes them for all channels.
    const bool with_shape = group == 0 || p.mean_sums == MeanSums::kNone;
    if (p.segments.count > 1 && with_shape) launch(segment_shown_kernel<F>, {blocks, kBlendThreads}, stream, p, group);
  }
  launch(blend_groups_vjp_kernel<F>, {blocks, kBlendThreads, sizeof(GroupVjpShared<F>)}, stream, p, group);
}

}  // namespace ar::cuda
