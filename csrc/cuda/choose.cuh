// Kernel of choose: the samples of every tile.
#pragma once

#include "core/choose.h"
#include "cuda/blend.cuh"

namespace ar::cuda {

/// Running product and sum over the threads of a block, exclusive, in a fixed order.
template <int kThreads> struct BlockScan {
  static constexpr int kWarps = kThreads / 32;
  struct Pair {
    float product, sum;
  };
  Pair warps[kWarps];

  /// What is in front of this thread; `all`: of all threads.
  __device__ Pair exclusive(Pair own, Pair& all) {
    const int lane = lane_id(), warp = threadIdx.x / 32;
    Pair scan = own;
#pragma unroll
    for (int offset = 1; offset < 32; offset *= 2) {
      const Pair before = {__shfl_up_sync(kAllLanes, scan.product, offset),
                           __shfl_up_sync(kAllLanes, scan.sum, offset)};
      if (lane >= offset) scan = {scan.product * before.product, scan.sum + before.sum};
    }
    __syncthreads();  // the last call's reading
    if (lane == 31) warps[warp] = scan;
    __syncthreads();
    Pair front = {1, 0};
    all = {1, 0};
#pragma unroll
    for (int w = 0; w < kWarps; ++w) {
      if (w == warp) front = all;
      all = {all.product * warps[w].product, all.sum + warps[w].sum};
    }
    const Pair before = {__shfl_up_sync(kAllLanes, scan.product, 1), __shfl_up_sync(kAllLanes, scan.sum, 1)};
    return lane == 0 ? front : Pair{front.product * before.product, front.sum + before.sum};
  }
};

/// The emit kernel's test, for lists that hold all splats.
template <class F> __device__ bool reaches_tile(const Splat<F, float>& splat, const TileList& list) {
  const Span<float> span = columns_of(support_of(splat), float(list.y0), float(list.y0 + kTile - 1));
  return span.lo <= float(list.x0 + kTile - 1) && span.hi >= float(list.x0);
}

__device__ inline Vec3<float> warp_sum(Vec3<float> v) { return {warp_sum(v.x), warp_sum(v.y), warp_sum(v.z)}; }

/// A block per tile. SampleEstimate goes through a list in order; here each thread adds one splat of a
/// group, with what is in front of it from a scan.
template <class F, int kThreads>
__global__ void __launch_bounds__(kThreads) choose_kernel(const ChooseTask task, SampleLimits<float> limits) {
  using Scan = BlockScan<kThreads>;
  __shared__ Scan scan;
  __shared__ SampleEstimate<float> parts[Scan::kWarps];
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(task.lists.splats);
  const int tile = blockIdx.x;
  const TileList list = list_of(task.lists, task.grid, tile);
  const Vec2<float> center = tile_center<float>(task.grid, tile);
  SampleEstimate<float> own = {};
  typename Scan::Pair passed = {1, 0};
  float behind = 1;  // transmittance behind the last splat that counts
  for (int k = 0; k < list.count && passed.product >= float(SampleEstimate<float>::kDark); k += kThreads) {
    TileShare<float> share = {0, 0, 0};
    Vec3<float> color = {0, 0, 0};
    if (k + int(threadIdx.x) < list.count) {
      const Splat<F, float> splat = splats[list.splat(k + threadIdx.x)];
      color = splat.color;
      if (!list.overflow || reaches_tile(splat, list))
        share = tile_share(splat.shape, splat.opacity, {center.x - splat.mean.x, center.y - splat.mean.y});
    }
    SampleEstimate<float> alone = {};
    alone.add(share, color);
    typename Scan::Pair all;
    const typename Scan::Pair before = scan.exclusive({alone.transmittance, alone.front}, all);
    own.transmittance = passed.product * before.product;
    own.front = passed.sum + before.sum;
    if (!own.dark()) {
      own.add(share, color);
      behind = own.transmittance;
    }
    passed = {passed.product * all.product, passed.sum + all.sum};
  }
  SampleEstimate<float> part = {};
  part.total = warp_sum(own.total);
  part.first = warp_sum(own.first);
  part.second = warp_sum(own.second);
  part.color = warp_sum(own.color);
#pragma unroll
  for (int offset = 16; offset > 0; offset /= 2) behind = min(behind, __shfl_xor_sync(kAllLanes, behind, offset));
  part.transmittance = behind;
  if (lane_id() == 0) parts[threadIdx.x / 32] = part;
  __syncthreads();
  if (threadIdx.x > 0) return;
  for (int w = 1; w < Scan::kWarps; ++w) {
    part.total += parts[w].total;
    part.first += parts[w].first;
    part.second += parts[w].second;
    part.color += parts[w].color;
    part.transmittance = min(part.transmittance, parts[w].transmittance);
  }
  task.lists.tile_samples[tile] =
      limits.choose(part.value({task.background[0], task.background[1], task.background[2]}));
}

/// Few tiles have long lists and leave the device empty: a block for each. Many have short ones, of which the
/// front is enough: a warp.
template <class F> void choose(const ChooseTask& task, cudaStream_t stream) {
  const SampleLimits<float> limits = sample_limits<float>(task.options.tolerance);
  const auto tiles = unsigned(task.grid.tiles());
  if (tiles >= 2048) {
    choose_kernel<F, 32><<<tiles, 32, 0, stream>>>(task, limits);
  } else {
    choose_kernel<F, 256><<<tiles, 256, 0, stream>>>(task, limits);
  }
}

}  // namespace ar::cuda
