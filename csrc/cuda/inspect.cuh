// Kernel inspect: walks lists as blending does, and writes statistics of pixels and Gaussians (core/inspect.h).
#pragma once

#include <algorithm>

#include "core/camera.h"
#include "core/inspect.h"
#include "cuda/launch.cuh"
#include "cuda/tile/stage.cuh"

namespace ar::cuda {

template <int kSide> inline constexpr int kInspectThreads = std::max(32, kSide* kSide);

/// By the formula of `project`, with its bits.
__device__ inline float depth_of_splat(const InspectParams& params, int32_t id) {
  if (params.depths) return params.depths[id];
  const Vec3<float> mean = params.means[id];
  return params.camera.lens ? depth_of(load_full_camera(params.camera), mean)
                            : depth_of(load_camera(params.camera), mean);
}

__device__ inline void add_shown(const InspectParams& params, int32_t id, const Shown<float>& shown) {
  const int touched = __popc(__ballot_sync(kAllLanes, shown.weight > 0));
  if (touched == 0) return;
  const int in_front = __popc(__ballot_sync(kAllLanes, shown.in_front));
  const int64_t units = warp_sum(weight_units(shown.weight));
  const int largest = warp_max(__float_as_int(shown.weight));  // its bits have its order
  if (lane_id() != 0) return;
  atomicAdd(&params.touched[id], touched);
  if (in_front) atomicAdd(&params.in_front[id], in_front);
  atomicAdd(reinterpret_cast<unsigned long long*>(&params.units[id]), static_cast<unsigned long long>(units));
  atomicMax(&params.largest[id], largest);
}

/// A block per tile, a warp per subtile.
template <class F, int kSide, Look kLook>
__global__ void __launch_bounds__(kInspectThreads<kSide>) inspect_kernel(const InspectParams params) {
  wait_for_earlier_kernels();
  constexpr int kThreads = kInspectThreads<kSide>;
  __shared__ Stage<F, 0, kThreads> stage;
  __shared__ int32_t ids[kThreads];
  const int tile = int(blockIdx.x), subtile = int(threadIdx.x) / 32 * (kSide < kTile ? 2 : 1);
  const int lane = lane_id();
  const TileList list = list_of(params.lists, params.grid, tile);
  const Vec2<float> p = pixel_of<F>(subtile, lane);
  const bool inside = max(p.x, p.y) < kSide && Pixel(list, params.grid, p).inside;
  PixelSummary<float, F, kLook> summary;
  summary.start(inside);
  for (int k = 0; k < list.count && __syncthreads_or(summary.open()); k += kThreads) {
    const int count = stage.load(params.splats, {}, list, k, list.count);
    if (int(threadIdx.x) < count) ids[threadIdx.x] = list.splat(k + threadIdx.x);
    __syncthreads();
    for (int first = 0; first < count && __any_sync(kAllLanes, summary.open()); first += 32) {
      for (uint32_t left = stage.reached(first, subtile); left != 0;) {
        const int j = first + take_first(left), id = ids[j];
        const Shown<float> shown = summary.add(stage.splats[j].terms, p, id);
        if constexpr (kLook == Look::kStatistics) add_shown(params, id, shown);
      }
    }
  }
  if (!inside) return;
  const int64_t i = Pixel(list, params.grid, p).index;
  if (params.median) params.median[i] = summary.median >= 0 ? depth_of_splat(params, summary.median) : 0;
  if constexpr (kLook != Look::kMedian) {
    if (params.dominant) params.dominant[i] = summary.dominant;
  }
  if constexpr (kLook == Look::kStatistics) {
    if (summary.dominant >= 0) atomicAdd(&params.dominated[summary.dominant], 1);
  }
}

}  // namespace ar::cuda
