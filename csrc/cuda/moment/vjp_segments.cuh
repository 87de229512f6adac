// Kernel segment_vjp: the last step of the backward pass for lists that are cut. A block claims a segment and goes back
// through it in batches, whose groups, unequal work, its warps claim. adjoint_maps keeps Adjoints between batches.
#pragma once

#include <algorithm>

#include "cuda/moment/vjp_walk.cuh"

namespace ar::cuda {

/// Fewer warps, which claim groups.
template <class F, int kSide, class Cells = SegmentLayout<F, kSide>>
using ClaimedLayout = CellLayout<Cells::kCells, Cells::kLanes, kSide,
                                 Cells::kGroups / MomentPolicy::groups_of_warp(F::kSamples, kSide < kMovingTile), true>;

/// Whether sums of groups are in shared memory, else in group_sums [blocks, kGroups, kBatch, kSums].
template <class Layout> inline constexpr bool kSumsInside = Layout::kGroups <= MomentPolicy::kMostSumsInside;
template <class F, int C, class Layout, int kSegment>
using SegmentBatch =
    VjpBatch<F, C, Layout, std::min(kSegment, MomentPolicy::segment_batch(kSumsInside<Layout>)), kSumsInside<Layout>>;

template <class F, int C, class Layout, int kSegment> struct SegmentVjpShared : SegmentBatch<F, C, Layout, kSegment> {
  using SumsOfGroup = typename SegmentBatch<F, C, Layout, kSegment>::SumsOfGroup;
  int segment;
  int next_group;
  int last;  ///< SamplesLast of all groups

  /// False if no group is left.
  __device__ bool claim_group() {
    int group = 0;
    if (lane_id() == 0) group = atomicAdd(&next_group, 1);
    group = shuffle(group, 0);
    if (lane_id() == 0) claimed_group() = group;
    __syncwarp();
    return group < Layout::kGroups;
  }
  __device__ float total(const SumsOfGroup* sums, int j, int v) const {
    float sum = 0;
    for (uint32_t left = this->stage.reach[j]; left != 0; left &= left - 1) {
      const int group = __ffs(int(left)) - 1;
      if (this->is_hit(group, j)) sum += sums[group][j][v];
    }
    return sum;
  }
};

/// Takes the warp's group back through the staged pairs [k0, k1).
template <class F, int C, class Layout, int kSegment, class Shared>
__device__ void group_vjp(const BlendVjpParams& params, int first, int in_shared, Shared& shared,
                          typename Shared::SumsOfGroup* sums, const TileList& list, const TileCheckpoints& stored,
                          const ListSegment& segment, int k0, int k1, WantedSums<C> wanted) {
  using Lane = VjpLane<F, C, Layout, true>;
  const int begin = segment.index * kSegment, end = begin + kSegment;
  const int group = Layout::group();
  Lane lane(params, list);
  lane.begin(params, first, wanted);
  const int (&last)[Layout::kCells] = lane.last.samples;
  // Where a batch leaves the Adjoint for the next: in the segment's map, no longer needed.
  constexpr int kCarried = 3;
  const auto map_of = [&](int i) {
    return MapMemory<F, Layout::kTilePixels>(params.adjoint_maps, Layout::first_sample() + i, Layout::pixel_number());
  };
  AR_UNROLL for (int i = 0; i < Layout::kCells; ++i) {
    if (last[i] <= k1) continue;
    lane.adjoint[i] = k1 == end ? map_of(i).template get<Adjoint>(segment.number + 1)
                                : map_of(i).template get<Adjoint>(segment.number, kCarried);
  }
  EarlierPositions<Layout> earlier(sizeof(Shared), in_shared);
  batch_vjp(params, shared, group, sums[group], list, k0, wanted.means, lane, earlier, [&](int from) {
    lane.samples.load(stored.at<typename Lane::Samples>(params.checkpoints, k0 + from), k0 + from, last);
  });
  if (k0 == begin) return;
  AR_UNROLL for (int i = 0; i < Layout::kCells; ++i) if (last[i] > k0) map_of(i).put(segment.number, lane.adjoint[i],
                                                                                     kCarried);
}

/// Reads the channels [first, first + C). `in_shared`: of EarlierPositions, which follow Shared in memory.
template <class F, int C, class Layout, int kSegment>
__global__ void __launch_bounds__(Layout::kThreads, kMovingVjpBlocks<C, Layout, true>)
    segment_vjp_kernel(const BlendVjpParams params, int first, int in_shared) {
  wait_for_earlier_kernels();
  using Shared = SegmentVjpShared<F, C, Layout, kSegment>;
  static_assert(kSegment % Shared::kBatch == 0);
  Shared& shared = *reinterpret_cast<Shared*>(dynamic_shared());
  auto* const outside =
      reinterpret_cast<typename Shared::SumsOfGroup*>(params.group_sums) + int64_t(blockIdx.x) * Layout::kGroups;
  auto* const sums = kSumsInside<Layout> ? reinterpret_cast<typename Shared::SumsOfGroup*>(&shared.inside) : outside;
  const WantedSums<C> wanted(params, first);
  const int warp = threadIdx.x / 32, lane = lane_id();
  while (true) {
    __syncthreads();  // all have read what the last segment left
    if (threadIdx.x == 0) {
      shared.segment = atomicAdd(params.chunks_taken, 1);
      shared.last = 0;
    }
    __syncthreads();
    const ListSegment segment(*params.plan, params.chunk_order, shared.segment);
    if (segment.tile < 0) return;
    const TileList list = list_of(params.lists, params.grid, segment.tile);
    const TileCheckpoints stored(params.lists, list, params.grid, segment.tile);
    for (int group = warp; group < Layout::kGroups; group += Layout::kWarps) {
      if (lane == 0) claimed_group() = group;
      __syncwarp();
      const SamplesLast<F, Layout> lasts(params.last, Pixel(list, params.grid, Layout::pixel()));
      if (lane == 0) atomicMax(&shared.last, lasts.warp);
      __syncwarp();
    }
    __syncthreads();
    const int begin = segment.index * kSegment, end = begin + kSegment, stop = min(shared.last, end);
    clear_pairs<Layout::kThreads>(params, list, max(shared.last, begin), min(list.count, end), first);
    for (int k1 = stop, k0 = 0; k1 > begin; k1 = k0) {
      k0 = (k1 - 1) / Shared::kBatch * Shared::kBatch;
      __syncthreads();  // all have read what the last batch left
      for (int t = threadIdx.x; t < Shared::kBatch; t += Layout::kThreads)
        shared.load(t, params, first, list, k0, k0 + t < k1 ? list.splat(k0 + t) : -1, wanted.means);
      if (threadIdx.x == 0) shared.next_group = 0;
      __syncthreads();
      while (shared.claim_group())
        group_vjp<F, C, Layout, kSegment>(params, first, in_shared, shared, sums, list, stored, segment, k0, k1,
                                          wanted);
      __syncthreads();
      shared.write(params, first, wanted, list, k1 - k0, [&](int j, int v) { return shared.total(sums, j, v); });
    }
  }
}

template <int C, class Layout> int64_t segment_vjp_blocks(int64_t segments) {
  return std::min(segments, int64_t(multiprocessors()) * kMovingVjpBlocks<C, Layout, true>);
}
/// Of BlendVjpParams::group_sums.
template <class F, int C, class Layout, int kSegment> int64_t group_sums_of(int64_t segments) {
  using SumsOfGroup = typename SegmentVjpShared<F, C, Layout, kSegment>::SumsOfGroup;
  if (kSumsInside<Layout>) return 0;
  return segment_vjp_blocks<C, Layout>(segments) * Layout::kGroups * int64_t(sizeof(SumsOfGroup) / sizeof(float));
}

}  // namespace ar::cuda
