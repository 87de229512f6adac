// Kernel of choose_samples: the samples of every tile.
#pragma once

#include "core/choose.h"
#include "cuda/composite.cuh"
#include "cuda/launch.cuh"

namespace ar::cuda {

/// Running product and sum, in a fixed order.
struct Passed {
  float product, sum;
};
__device__ inline Passed operator+(Passed front, Passed behind) {
  return {front.product * behind.product, front.sum + behind.sum};
}
__device__ inline Passed shuffle(Passed p, int lane) { return {shuffle(p.product, lane), shuffle(p.sum, lane)}; }
__device__ inline Passed shuffle_up(Passed p, int offset) {
  return {shuffle_up(p.product, offset), shuffle_up(p.sum, offset)};
}

/// The emit kernel's test, for lists of patches of tiles.
template <class F> __device__ bool reaches_tile(const Splat<F, float>& splat, const TileList& list) {
  const Span<float> span = columns_of(support_of(splat), float(list.y0), float(list.y0 + kTile - 1));
  return span.lo <= float(list.x0 + kTile - 1) && span.hi >= float(list.x0);
}

__device__ inline Vec3<float> warp_sum(Vec3<float> v) { return {warp_sum(v.x), warp_sum(v.y), warp_sum(v.z)}; }

inline constexpr int kChooseThreads = 256;

/// kWarps warps per tile: one, or a whole block. SampleEstimate goes through a list in order; here each
/// thread adds one splat of a group, with what is in front of it from a scan.
template <class F, int kWarps>
__global__ void __launch_bounds__(kChooseThreads)
    choose_samples_kernel(const ChooseParams params, SampleLimits<float> limits) {
  wait_for_earlier_kernels();
  constexpr int kThreads = 32 * kWarps;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const int64_t tile = (int64_t(blockIdx.x) * kChooseThreads + threadIdx.x) / kThreads;
  if (tile >= params.grid.tiles()) return;
  const int rank = int(threadIdx.x) % kThreads;
  const TileList list = list_of(params.lists, params.grid, int(tile));
  const Vec2<float> center = tile_center<float>(params.grid, tile);
  SampleEstimate<float> own = {};
  Passed passed = {1, 0};
  float behind = 1;           // transmittance behind the last splat that counts
  Splat<F, float> next = {};  // loaded while the one before is worked on
  if (rank < list.count) next = splats[list.splat(rank)];
  for (int k = rank; k - rank < list.count && passed.product >= float(SampleEstimate<float>::kDark); k += kThreads) {
    const Splat<F, float> splat = next;
    if (k + kThreads < list.count) next = splats[list.splat(k + kThreads)];
    TileShare<float> share = {0, 0, 0};
    if (k < list.count && (!list.of_patch || reaches_tile(splat, list)))
      share = tile_share(splat.shape, splat.opacity, {center.x - splat.mean.x, center.y - splat.mean.y});
    const Vec3<float> color = k < list.count ? splat.color : Vec3<float>{0, 0, 0};
    SampleEstimate<float> alone = {};
    alone.add(share, color);
    Passed all;
    const Passed front = passed + sum_before<kWarps>(Passed{alone.transmittance, alone.front}, {1, 0}, all);
    own.transmittance = front.product;
    own.front = front.sum;
    if (!own.dark()) {
      own.add(share, color);
      behind = own.transmittance;
    }
    passed = passed + all;
  }
  SampleEstimate<float> part = {};
  part.total = warp_sum(own.total);
  part.first = warp_sum(own.first);
  part.second = warp_sum(own.second);
  part.color = warp_sum(own.color);
#pragma unroll
  for (int offset = 16; offset > 0; offset /= 2) behind = min(behind, __shfl_xor_sync(kAllLanes, behind, offset));
  part.transmittance = behind;
  if constexpr (kWarps > 1) {
    __shared__ SampleEstimate<float> parts[kWarps];
    if (lane_id() == 0) parts[threadIdx.x / 32] = part;
    __syncthreads();
    for (int w = 1; w < kWarps && rank == 0; ++w) {
      part.total += parts[w].total;
      part.first += parts[w].first;
      part.second += parts[w].second;
      part.color += parts[w].color;
      part.transmittance = min(part.transmittance, parts[w].transmittance);
    }
  }
  if (rank > 0) return;
  const auto background = [&](int c) { return c < params.background_count ? params.background[c] : 0.0f; };
  params.tile_samples[tile] = limits.choose(part.value({background(0), background(1), background(2)}));
}

/// Few tiles have long lists and leave the device empty: a block for each. Many have short ones, of which the front is
/// enough: a warp.
template <class F> void launch_choose_samples(const ChooseParams& p, cudaStream_t stream) {
  constexpr int kWarps = kChooseThreads / 32;
  const SampleLimits<float> limits = sample_limits<float>(p.options.number);
  const int64_t tiles = p.grid.tiles();
  if (tiles >= 2048) {
    launch(choose_samples_kernel<F, 1>, {blocks_of(tiles, kWarps), kChooseThreads}, stream, p, limits);
  } else {
    launch(choose_samples_kernel<F, kWarps>, {unsigned(tiles), kChooseThreads}, stream, p, limits);
  }
}

}  // namespace ar::cuda
