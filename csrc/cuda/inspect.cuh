// Kernel of inspect: which Gaussians pixels show, and pixels Gaussians.
#pragma once

#include "core/inspect.h"
#include "cuda/composite.cuh"

namespace ar::cuda {

/// A block per tile, a warp per subtile.
template <class F> __global__ void __launch_bounds__(kBlendThreads) inspect_kernel(const InspectParams params) {
  __shared__ Stage<F, 0, kBlendThreads> stage;
  __shared__ int32_t ids[kBlendThreads];
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const int tile = int(blockIdx.x), warp = threadIdx.x / 32, lane = lane_id();
  if (!has_samples<F::kSamples>(params.lists, tile)) return;
  const TileList list = list_of(params.lists, params.grid, tile);
  const Vec2<float> p = pixel_of(warp, lane);
  const int x = list.x0 + int(p.x), y = list.y0 + int(p.y);
  const bool inside = x < params.grid.width && y < params.grid.height;
  PixelSummary<float, F> pixel;
  pixel.start(inside);
  for (int k = 0; k < list.count && __syncthreads_or(pixel.open()); k += kBlendThreads) {
    const int count = stage.load(splats, {}, list, k, list.count);
    if (int(threadIdx.x) < count) ids[threadIdx.x] = list.splat(k + threadIdx.x);
    __syncthreads();
    for (int first = 0; first < count; first += 32) {
      for (uint32_t mask = stage.reached(first); mask != 0; mask &= mask - 1) {
        const int j = first + __ffs(mask) - 1, id = ids[j];
        const float weight = pixel.add(stage.splats[j].terms, p, id);
        const int touched = __popc(__ballot_sync(kAllLanes, weight > 0));
        if (touched == 0) continue;
        const int64_t units = warp_sum(weight_units(weight));
        const int largest = warp_max(__float_as_int(weight));  // not negative: the bits have its order
        if (lane == 0) {
          atomicAdd(&params.touched[id], touched);
          atomicAdd(reinterpret_cast<unsigned long long*>(&params.units[id]), static_cast<unsigned long long>(units));
          atomicMax(&params.largest[id], largest);
        }
      }
    }
  }
  if (!inside) return;
  const int64_t i = int64_t(y) * params.grid.width + x;
  params.median[i] = pixel.median;
  params.dominant[i] = pixel.dominant;
}

template <class F> void launch_inspect(const InspectParams& p, cudaStream_t stream) {
  inspect_kernel<F><<<unsigned(p.grid.tiles()), kBlendThreads, 0, stream>>>(p);
}

}  // namespace ar::cuda
