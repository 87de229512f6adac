// Kernel blend_groups: the forward pass for any number of channels, in groups of 32 or, at the end, 8. A block per tile
// and group walks the whole list.
#pragma once

#include "cuda/channels/policy.h"
#include "cuda/dispatch.h"
#include "cuda/launch.cuh"
#include "cuda/occupancy.h"
#include "cuda/tile/stage.cuh"

namespace ar::cuda {

template <int C> struct alignas(C / 2) Eighth {
  float v[C / 8];
};

/// A lane computes the weights of its own pixel, but sums a quarter of the C channels of four pixels, which share a
/// load. Pixel i of lane l is the own pixel of lane l ^ 8 i. Lane l has eighths l / 4 and l / 4 ^ 1 of the channels.
template <int C> struct ChannelShare {
  static constexpr int kPixels = 4, kOwn = C / 4, kHalf = C / 8;

  float v[kPixels][kOwn];

  __device__ static int lane_of(int i) { return lane_id() ^ 8 * i; }
  __device__ static int channel(int k) { return (lane_id() / 4 ^ k / kHalf) * kHalf + k % kHalf; }

  __device__ static void spread(float own, float (&of_pixels)[kPixels]) {
    of_pixels[0] = own;
    AR_UNROLL for (int i = 1; i < kPixels; ++i) of_pixels[i] = __shfl_xor_sync(kAllLanes, own, 8 * i);
  }
  __device__ static void read(const Eighth<C> (&splat)[8], float (&own)[kOwn]) {
    const Eighth<C> first = splat[lane_id() / 4], second = splat[lane_id() / 4 ^ 1];
    AR_UNROLL for (int k = 0; k < kHalf; ++k) own[k] = first.v[k], own[k + kHalf] = second.v[k];
  }

  __device__ void add(float contribution, const Eighth<C> (&splat)[8]) {
    float contributions[kPixels], own[kOwn];
    spread(contribution, contributions);
    read(splat, own);
    AR_UNROLL for (int i = 0; i < kPixels; ++i) {
      AR_UNROLL for (int k = 0; k < kOwn; ++k) v[i][k] = madd(contributions[i], own[k], v[i][k]);
    }
  }
  /// Each lane of the pixel gets the sum.
  template <int kLanes> __device__ void add_lanes() {
    static_assert(kLanes == 1 || kLanes == 4 || kLanes == 16);
    if constexpr (kLanes > 1) {  // four lanes with the same channels
      add_from_lane(1, 0);
      add_from_lane(2, 0);
    }
    if constexpr (kLanes == 16) {
      add_from_lane(4, kHalf);                          // its eighths are in the other order
      AR_UNROLL for (int i = 0; i < kPixels; i += 2) {  // lanes that are 8 apart
        AR_UNROLL for (int k = 0; k < kOwn; ++k) v[i][k] = v[i + 1][k] = v[i][k] + v[i + 1][k];
      }
    }
  }
  /// From channel `first` of lane_id() ^ offset on, cyclically.
  __device__ void add_from_lane(int offset, int first) {
    AR_UNROLL for (int i = 0; i < kPixels; ++i) {
      float given[kOwn];
      AR_UNROLL for (int k = 0; k < kOwn; ++k) given[k] = __shfl_xor_sync(kAllLanes, v[i][(k + first) % kOwn], offset);
      AR_UNROLL for (int k = 0; k < kOwn; ++k) v[i][k] += given[k];
    }
  }
  /// Of the own pixel, with a number per channel.
  __device__ float dot(const float (&own)[kOwn]) const {
    float parts[kPixels];
    AR_UNROLL for (int i = 0; i < kPixels; ++i) {
      parts[i] = v[i][0] * own[0];
      AR_UNROLL for (int k = 1; k < kOwn; ++k) parts[i] = madd(v[i][k], own[k], parts[i]);
    }
    float sum = parts[0];
    AR_UNROLL for (int i = 1; i < kPixels; ++i) sum += __shfl_xor_sync(kAllLanes, parts[i], 8 * i);
    return sum;
  }
  __device__ float dot(const Eighth<C> (&splat)[8]) const {
    float own[kOwn];
    read(splat, own);
    return dot(own);
  }
  /// The sum over all pixels, times `weight` of the own pixel: of channel summed_channel() in this lane.
  __device__ float weighted_sum(float weight) const {
    static_assert(kOwn == 2 || kOwn == 8);
    float weights[kPixels], sums[kOwn];
    spread(weight, weights);
    AR_UNROLL for (int k = 0; k < kOwn; ++k) {
      sums[k] = weights[0] * v[0][k];
      AR_UNROLL for (int i = 1; i < kPixels; ++i) sums[k] = madd(weights[i], v[i][k], sums[k]);
    }
    AR_UNROLL for (int k = 0; k < kHalf; ++k) sums[k] += __shfl_xor_sync(kAllLanes, sums[k + kHalf], 4);
    int count = kHalf;
    AR_UNROLL for (int offset = 2; offset > 0; offset /= 2) {
      const bool upper = lane_id() & offset;
      if (count == 1) {
        sums[0] += __shfl_xor_sync(kAllLanes, sums[0], offset);
        continue;
      }
      count /= 2;
      AR_UNROLL for (int k = 0; k < count; ++k) sums[k] = sum_of_pair(sums[k], sums[k + count], upper, offset);
    }
    return sums[0];
  }
  /// This lane's channel of weighted_sum(); whether it is the first with it.
  __device__ static int summed_channel() { return lane_id() / (32 / C); }
  __device__ static bool has_sum() { return lane_id() % (32 / C) == 0; }
};

/// Channels [first, first + C), then zeros.
template <int kBatch, int C> struct GroupChannels {
  int32_t ids[kBatch];
  Eighth<C> values[kBatch][8];

  /// A lane per channel. All threads must know `reach` and `ids`.
  __device__ void load(const Channels<float>& channels, int first, int count, const uint8_t* reach) {
    constexpr int kAhead = 4;  // loads that wait together
    constexpr int kRows = kBlendThreads / C;
    const int c = threadIdx.x % C;
    const bool used = first + c < channels.count;
    for (int j0 = threadIdx.x / C; j0 < count; j0 += kRows * kAhead) {
      float x[kAhead];
      AR_UNROLL for (int i = 0; i < kAhead; ++i) {
        const int j = j0 + kRows * i;
        x[i] = used && j < count && reach[j] ? channels.row(ids[j])[first + c] : 0;
      }
      AR_UNROLL for (int i = 0; i < kAhead; ++i) {
        const int j = j0 + kRows * i;
        if (j < count) reinterpret_cast<float*>(values[j])[c] = x[i];
      }
    }
  }
};

template <class F, int C>
inline constexpr int kGroupBlocks = blocks_per_sm(ChannelsPolicy::kBlocks<F, C == kSmallGroup>, kBlendThreads);

/// Block (tile, g) has channels [first_group + g C, first_group + (g + 1) C). F: what a lane blends.
template <class F, int C>
__global__ void __launch_bounds__(kBlendThreads, kGroupBlocks<F, C>)
    blend_groups_kernel(const BlendParams params, int first_group) {
  wait_for_earlier_kernels();
  constexpr int S = F::kSamples;
  using Share = ChannelShare<C>;
  __shared__ Stage<F, 0, ChannelsPolicy::kBatch> stage;
  __shared__ GroupChannels<ChannelsPolicy::kBatch, C> staged;
  const int first = first_group + int(blockIdx.y) * C, lane = lane_id();
  const int tile = params.plan.tile_order[blockIdx.x];
  const TileList list = list_of(params.lists, params.grid, tile);
  const Vec2<float> p = position_of<F>(threadIdx.x / 32, lane);
  const Pixel pixel(list, params.grid, pixel_of<F>(threadIdx.x / 32, lane));
  Share sums = {};
  PixelState<S, 0, 1> state;
  state.start(pixel.inside);
  for (int k = 0; k < list.count && __syncthreads_or(state.open()); k += ChannelsPolicy::kBatch) {
    const int count = stage.load(params.splats, params.channels, list, k, list.count);
    if (int(threadIdx.x) < count) staged.ids[threadIdx.x] = list.splat(k + threadIdx.x);
    __syncthreads();
    staged.load(params.channels, first, count, stage.reach);
    __syncthreads();
    for (int from = 0; from < count; from += 32) {
      if (!__any_sync(kAllLanes, state.open())) break;
      for (uint32_t left = stage.reached(from); left != 0;) {
        const int j = from + take_first(left);
        TileSplatRef<F, 0> splat = stage.splats[j];
        float contribution = 0;
        AR_UNROLL for (int s = 0; s < S; ++s) {
          const Blended<float> b = blend_sample(F::alpha(splat.terms, p, s), state.transmittance[s]);
          contribution += b.contribution;
          state.last[s] = b.mask ? k + j + 1 : state.last[s];
        }
        if (!__any_sync(kAllLanes, contribution > 0)) continue;
        sums.add(contribution, staged.values[j]);
      }
    }
  }
  float through = 0;
  AR_UNROLL for (int s = 0; s < S; ++s) {
    through += abs(state.transmittance[s]);
    if (first == 0 && params.transmittance && pixel.inside) {
      params.transmittance[sample_index<F>(pixel, s)] = abs(state.transmittance[s]);
      params.last[sample_index<F>(pixel, s)] = state.last[s];
    }
  }
  through = sum_of_pixel<F>(through);
  sums.template add_lanes<F::kLanes>();
  const float scale = kSampleShare<F>;
  if (first == 0 && params.alpha && pixel.inside && writes_pixel<F>(lane))
    params.alpha[pixel.index] = 1 - scale * through;
  float throughs[Share::kPixels];
  Share::spread(through, throughs);
  AR_UNROLL for (int i = 0; i < Share::kPixels; ++i) {
    const Pixel of_place(list, params.grid, pixel_of<F>(threadIdx.x / 32, Share::lane_of(i)));
    if (!of_place.inside || !writes_pixel<F>(Share::lane_of(i))) continue;
    AR_UNROLL for (int k = 0; k < Share::kOwn; ++k) {
      const int c = first + Share::channel(k);
      if (c >= params.channels.count) continue;
      params.image.plane(c, of_place.image)[of_place.index] =
          scale * sums.v[i][k] + scale * throughs[i] * params.background[c];
    }
  }
}

/// The colours in the splats as rows of channels.
template <class Params> Params with_channels(Params p) {
  if (!p.channels.data) p.channels = {p.splats + kSplatColor, kSplatWidth, nullptr, 3};
  return p;
}

template <class F> void launch_blend_groups(const BlendParams& p, cudaStream_t stream) {
  const unsigned tiles = unsigned(p.grid.tiles());
  int first = 0;
  while (first < p.channels.count && group_width<F>(p.channels.count - first) == kChannelGroup) first += kChannelGroup;
  if (first > 0) {
    const dim3 blocks(tiles, unsigned(first / kChannelGroup));
    launch(blend_groups_kernel<F, kChannelGroup>, {blocks, kBlendThreads}, stream, p, 0);
  }
  if constexpr (!F::kGeneric) {
    if (first < p.channels.count) launch(blend_groups_kernel<F, kSmallGroup>, {tiles, kBlendThreads}, stream, p, first);
  }
}

}  // namespace ar::cuda
