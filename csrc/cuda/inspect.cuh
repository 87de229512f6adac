// Kernel inspect; dispatch.cu launches it. It walks lists as blending does, and writes statistics of pixels and
// Gaussians (core/inspect.h).
#pragma once

#include <algorithm>

#include "core/inspect.h"
#include "cuda/launch.cuh"
#include "cuda/tile.cuh"

namespace ar::cuda {

template <int kSide> inline constexpr int kInspectThreads = std::max(32, kSide* kSide);

/// A block per tile of kSide x kSide pixels, a warp per subtile. Tiles of 8x8 pixels have the subtiles of a column,
/// tiles of 4x4 a part of one subtile. F: the footprint.
template <class F, int kSide>
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
  PixelSummary<float, F> summary;
  summary.start(inside);
  for (int k = 0; k < list.count && __syncthreads_or(summary.open()); k += kThreads) {
    const int count = stage.load(params.splats, {}, list, k, list.count);
    if (int(threadIdx.x) < count) ids[threadIdx.x] = list.splat(k + threadIdx.x);
    __syncthreads();
    for (int first = 0; first < count; first += 32) {
      for (uint32_t left = stage.reached(first, subtile); left != 0;) {
        const int j = first + take_first(left), id = ids[j];
        const Shown<float> shown = summary.add(stage.splats[j].terms, p, id);
        const int touched = __popc(__ballot_sync(kAllLanes, shown.weight > 0));
        if (touched == 0) continue;
        const int in_front = __popc(__ballot_sync(kAllLanes, shown.in_front));
        const int64_t units = warp_sum(weight_units(shown.weight));
        const int largest = warp_max(__float_as_int(shown.weight));  // its bits have its order
        if (lane == 0) {
          atomicAdd(&params.touched[id], touched);
          if (in_front) atomicAdd(&params.in_front[id], in_front);
          atomicAdd(reinterpret_cast<unsigned long long*>(&params.units[id]), static_cast<unsigned long long>(units));
          atomicMax(&params.largest[id], largest);
        }
      }
    }
  }
  if (!inside) return;
  const int64_t i = Pixel(list, params.grid, p).index;
  params.median[i] = summary.median;
  params.dominant[i] = summary.dominant;
  if (summary.dominant >= 0) atomicAdd(&params.dominated[summary.dominant], 1);
}

}  // namespace ar::cuda
