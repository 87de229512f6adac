// Kernel of blend for any number of channels, in groups of 32: a block per tile and group walks the whole list, a pixel
// per lane. The weights are computed again for every group, which costs less than keeping them. Yardstick footprints
// (`erf`, `exact`) use this kernel for few channels too, because their weights are slow anyway.
#pragma once

#include "cuda/composite.cuh"
#include "cuda/launch.cuh"

namespace ar::cuda {

/// Channels [first, first + kChannelGroup) of kBatch splats; zeros where there are no so many.
template <int kBatch> struct GroupChannels {
  int32_t ids[kBatch];
  float4 values[kBatch][kChannelGroup / 4];

  /// A warp per row. `reach` and `ids` of the first `count` rows must be known to all threads.
  __device__ void load(const Channels<float>& channels, int first, int count, const uint8_t* reach) {
    constexpr int kAhead = 4;  // loads before stores, so that they wait together
    const int lane = lane_id(), warp = threadIdx.x / 32;
    const bool used = first + lane < channels.count;
    for (int j0 = warp; j0 < count; j0 += kSubtiles * kAhead) {
      float x[kAhead];
#pragma unroll
      for (int i = 0; i < kAhead; ++i) {
        const int j = j0 + kSubtiles * i;
        x[i] = used && j < count && reach[j] ? channels.row(ids[j])[first + lane] : 0;
      }
#pragma unroll
      for (int i = 0; i < kAhead; ++i) {
        const int j = j0 + kSubtiles * i;
        if (j < count) reinterpret_cast<float*>(values[j])[lane] = x[i];
      }
    }
  }
};

/// `sums` += contribution times values.
__device__ inline void add_channels(float contribution, const float4 (&values)[kChannelGroup / 4],
                                    float (&sums)[kChannelGroup]) {
#pragma unroll
  for (int q = 0; q < kChannelGroup / 4; ++q) {
    const float4 v = values[q];
    sums[4 * q] = madd(contribution, v.x, sums[4 * q]);
    sums[4 * q + 1] = madd(contribution, v.y, sums[4 * q + 1]);
    sums[4 * q + 2] = madd(contribution, v.z, sums[4 * q + 2]);
    sums[4 * q + 3] = madd(contribution, v.w, sums[4 * q + 3]);
  }
}

inline constexpr int kGroupBatch = 128;

template <class F>
__global__ void __launch_bounds__(kBlendThreads, F::kSamples > 4   ? 1
                                                 : F::kSamples > 1 ? 2
                                                                   : 3) blend_groups_kernel(const BlendParams params) {
  constexpr int S = F::kSamples;
  __shared__ Stage<F, 0, kGroupBatch> stage;
  __shared__ GroupChannels<kGroupBatch> staged;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const int place = tile_place<S>(params, int(blockIdx.x));
  if (place < 0) return;
  const int first = int(blockIdx.y) * kChannelGroup, lane = lane_id();
  const int tile = params.plan.tile_order[place];
  const TileList list = list_of(params.lists, params.grid, tile);
  const Vec2<float> p = pixel_of(threadIdx.x / 32, lane);
  const Pixel pixel(list, params.grid, p);
  float transmittance[S], sums[kChannelGroup];
  int last[S];
#pragma unroll
  for (int s = 0; s < S; ++s) transmittance[s] = pixel.inside ? 1.0f : -1.0f, last[s] = 0;
#pragma unroll
  for (int c = 0; c < kChannelGroup; ++c) sums[c] = 0;
  const auto open = [&] {
    bool any = false;
#pragma unroll
    for (int s = 0; s < S; ++s) any |= transmittance[s] > 0;
    return any;
  };
  for (int k = 0; k < list.count && __syncthreads_or(open()); k += kGroupBatch) {
    const int count = stage.load(splats, params.channels, list, k, list.count);
    if (int(threadIdx.x) < count) staged.ids[threadIdx.x] = list.splat(k + threadIdx.x);
    __syncthreads();
    staged.load(params.channels, first, count, stage.reach);
    __syncthreads();
    for (int from = 0; from < count; from += 32) {
      if (!__any_sync(kAllLanes, open())) break;
      for (uint32_t mask = stage.reached(from); mask != 0; mask &= mask - 1) {
        const int j = from + __ffs(mask) - 1;
        TileSplatRef<F, 0> splat = stage.splats[j];
        float contribution = 0;
#pragma unroll
        for (int s = 0; s < S; ++s) {
          const Blended<float> b = blend_sample(F::alpha(splat.terms, p, s), transmittance[s]);
          contribution += b.contribution;
          last[s] = b.mask ? k + j + 1 : last[s];
        }
        if (!__any_sync(kAllLanes, contribution > 0)) continue;
        add_channels(contribution, staged.values[j], sums);
      }
    }
  }
  if (!pixel.inside) return;
  float through = 0;
#pragma unroll
  for (int s = 0; s < S; ++s) {
    through += abs(transmittance[s]);
    if (first == 0 && params.transmittance) {
      params.transmittance[s * pixel.image + pixel.index] = abs(transmittance[s]);
      params.last[s * pixel.image + pixel.index] = last[s];
    }
  }
  const float scale = 1.0f / S;
#pragma unroll
  for (int c = 0; c < kChannelGroup; ++c) {
    if (first + c >= params.channels.count) break;
    params.image.plane(first + c, pixel.image)[pixel.index] =
        scale * sums[c] + scale * through * params.background[first + c];
  }
  if (first == 0 && params.alpha) params.alpha[pixel.index] = 1 - scale * through;
}

/// The three colours in the splats are channels like others here.
template <class Params> Params with_channels(Params p) {
  if (!p.channels.data) p.channels = {p.splats + kSplatColor, kSplatWidth, nullptr, 3};
  return p;
}

template <class F> void blend_groups(const BlendParams& p, cudaStream_t stream) {
  const dim3 blocks(unsigned(p.grid.tiles()), blocks_of(p.channels.count, kChannelGroup));
  launch(blend_groups_kernel<F>, {blocks, kBlendThreads}, stream, p);
}

}  // namespace ar::cuda
