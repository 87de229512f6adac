// Kernel segment_vjp: the last step of the backward pass through lists that are cut, for footprints whose samples move.
// launch_segment_vjp_kernel launches it after the kernels of maps.cuh. It reads adjoint_maps and checkpoints, takes
// each segment back to front, and writes rows of pair_grads and channel_sums.
//
// The samples of neighbouring pixels are a group, which a warp takes through a segment. Groups do not have equally much
// to do: in some all pixels have closed, or no splat is there. So a warp claims the next group when it is done with
// one.
#pragma once

#include <algorithm>

#include "cuda/moment/vjp_walk.cuh"

namespace ar::cuda {

/// SegmentLayout with groups that are claimed, by fewer warps.
template <class F, int kSide, class Cells = SegmentLayout<F, kSide>>
using ClaimedLayout = CellLayout<Cells::kCells, Cells::kLanes, kSide,
                                 Cells::kGroups / groups_of_warp(F::kSamples, kSide < kMovingTile), true>;

/// Whether the sums of the groups of a tile are in shared memory, or else in BlendVjpParams::group_sums.
template <class Layout> inline constexpr bool kSumsInside = Layout::kGroups <= kMostSumsInside;

/// kCount Sums, or nothing.
template <class Sums, int kCount> struct SumsOfGroups {
  Sums of_group[kCount];
};
template <class Sums> struct SumsOfGroups<Sums, 0> {};

/// What a block keeps in shared memory. Sums of a pair: PairGrad, C channels, MeanSums.
template <class F, int C, class Layout, int kSegment> struct SegmentVjpShared {
  static constexpr int kMeans = 6 + C, kSums = kMeans + 2;
  static constexpr int kBatch = std::min(kSegment, segment_batch(kSumsInside<Layout>)), kChunks = kBatch / kStateChunk;
  /// What a group writes for each pair of a batch.
  using SumsOfGroup = float[kBatch][kSums];
  SumsOfGroups<SumsOfGroup, kSumsInside<Layout> ? Layout::kGroups : 0> inside;
  MovingStage<F, C, Layout, kBatch> stage;
  uint32_t hits[Layout::kGroups][kChunks];  ///< splats that have sums of a group
  int32_t rows[kBatch];
  Mat2<float> mean_maps[kBatch];
  int segment;     ///< that the block works on
  int next_group;  ///< that a warp claims next
  int last;        ///< number of pairs up to the last that was composited into any sample

  /// Loads the batch of pairs [k0, k1), with channels from `first` on, and with_means also what MeanSums need. All
  /// threads must call it.
  __device__ void load(const float* splats, const BlendVjpParams& params, int first, const TileList& list, int k0,
                       int k1, bool with_means) {
    for (int t = threadIdx.x; t < kBatch; t += Layout::kThreads) {
      const int32_t id = k0 + t < k1 ? list.splat(k0 + t) : -1;
      stage.load_one(t, params, first, list, id);
      if (id < 0) continue;
      rows[t] = list.slot(k0 + t);
      if (with_means) mean_maps[t] = F::mean_map(load_splat<F>(splats, id).shape);
    }
    if (threadIdx.x == 0) next_group = 0;
  }
  /// The sums of this block's groups. `outside`: BlendVjpParams::group_sums.
  __device__ SumsOfGroup* sums_of_groups(float* outside) {
    if constexpr (kSumsInside<Layout>) {
      return inside.of_group;
    } else {
      return reinterpret_cast<SumsOfGroup*>(outside) + int64_t(blockIdx.x) * Layout::kGroups;
    }
  }
  /// Claims a group for the warp; false if none is left. All lanes must call it.
  __device__ bool claim_group() {
    int group = 0;
    if (lane_id() == 0) group = atomicAdd(&next_group, 1);
    group = shuffle(group, 0);
    if (lane_id() == 0) taken_group() = group;
    __syncwarp();
    return group < Layout::kGroups;
  }
  /// Value v of the sums of all groups for pair j.
  __device__ float total(const SumsOfGroup* sums, int j, int v) const {
    float sum = 0;
    for (uint32_t left = stage.reach[j]; left != 0; left &= left - 1) {
      const int group = __ffs(int(left)) - 1;
      if (hits[group][j / kStateChunk] >> (j % kStateChunk) & 1) sum += sums[group][j][v];
    }
    return sum;
  }
};

/// Takes a group of a segment's samples back to front through the staged batch of pairs [k0, k1).
template <class F, int C, class Layout, int kSegment>
__device__ void group_vjp(const BlendVjpParams& params, int first, int in_shared,
                          SegmentVjpShared<F, C, Layout, kSegment>& shared,
                          typename SegmentVjpShared<F, C, Layout, kSegment>::SumsOfGroup& group_sums,
                          const TileList& list, const StatePlaces& places, const ListSegment& segment, int k0, int k1,
                          bool with_means) {
  using Shared = SegmentVjpShared<F, C, Layout, kSegment>;
  using Samples = MovingSamples<F, Layout, true>;
  constexpr int kCells = Layout::kCells;
  const int group = Layout::group(), begin = segment.index * kSegment, end = begin + kSegment;
  const Vec2<float> p = Layout::pixel();
  const Pixel pixel(list, params.grid, p);
  const CellCorners<F, Layout> corners(p);
  Samples samples(pixel.inside);
  const SamplesLast<F, Layout> lasts(params.last, pixel);
  const int (&last)[kCells] = lasts.samples;
  const SampleGrad<F, C> grad(params, pixel, first);
  // A sample's Adjoint after the batch is that of the background, of the next segment's map, or of the next batch,
  // which stored it in the part of this segment's own map that nobody needs any more.
  constexpr int kCarried = 3;
  const auto map_of = [&](int i) {
    return MapMemory<F, Layout::kTilePixels>(params.adjoint_maps, Layout::first_sample() + i, Layout::pixel_number());
  };
  Adjoint adjoint[kCells];
#pragma unroll
  for (int i = 0; i < kCells; ++i) {
    adjoint[i] = {grad.through, {0, 0}};
    if (last[i] <= k1) continue;
    adjoint[i] = k1 == end ? map_of(i).adjoint(segment.number + 1) : map_of(i).adjoint(segment.number, kCarried);
  }
  EarlierPositions<Layout> earlier(sizeof(Shared), in_shared);
  for (int from = (Shared::kChunks - 1) * kStateChunk; from >= 0; from -= kStateChunk) {
    uint32_t shown = 0;
    if (k0 + from < lasts.warp) {
      samples.load(params.checkpoints + places.of_chunk_at(k0 + from) * Samples::kCheckpoint, k0 + from, last);
      shown = replay_chunk<F, Layout>(shared.stage, from, k0, corners, last, samples, &earlier);
    }
    const uint32_t hits = chunk_vjp<F, C, Layout>(params, shared, group_sums, list, k0, from, shown, pixel, corners,
                                                  last, grad, earlier, with_means, samples, adjoint);
    if (lane_id() == 0) shared.hits[group][from / kStateChunk] = hits;
  }
  if (k0 == begin) return;
#pragma unroll
  for (int i = 0; i < kCells; ++i)
    if (last[i] > k0) map_of(i).put(segment.number, adjoint[i], kCarried);
}

/// Each block claims one segment after the other. For the C channels from `first` on; `Layout`: a ClaimedLayout;
/// `kSegment`: pairs of a segment; `in_shared`: of EarlierPositions, whose shared memory follows Shared.
template <class F, int C, class Layout, int kSegment>
__global__ void __launch_bounds__(Layout::kThreads, kMovingVjpBlocks<C, Layout, true>)
    segment_vjp_kernel(const BlendVjpParams params, int first, int in_shared) {
  wait_for_earlier_kernels();
  using Shared = SegmentVjpShared<F, C, Layout, kSegment>;
  static_assert(kSegment % Shared::kBatch == 0);
  Shared& shared = *reinterpret_cast<Shared*>(dynamic_shared());
  auto* const sums = shared.sums_of_groups(params.group_sums);
  const bool with_means = params.mean_sums != MeanSums::kNone;
  const bool all_at_once = C > kFewChannels && with_means && params.channels.count > C;
  const bool with_shape = !all_at_once || first == 0;
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
    const StatePlaces places(params.lists, list, params.grid, segment.tile);
    for (int group = warp; group < Layout::kGroups; group += Layout::kWarps) {
      if (lane == 0) taken_group() = group;
      __syncwarp();
      const SamplesLast<F, Layout> lasts(params.last, Pixel(list, params.grid, Layout::pixel()));
      if (lane == 0) atomicMax(&shared.last, lasts.warp);
      __syncwarp();
    }
    __syncthreads();
    const int begin = segment.index * kSegment, end = begin + kSegment, stop = min(shared.last, end);
    if (first % kChannelGroup == 0 && !list.of_patch) {  // pairs that nothing reached
      const int list_end = min(list.count, end);
      for (int k = max(shared.last, begin) + threadIdx.x / kClearThreads; k < list_end;
           k += Layout::kThreads / kClearThreads)
        clear_pair_together<kChannelGroup>(params, list.slot(k), first == 0);
    }
    for (int k1 = stop, k0 = 0; k1 > begin; k1 = k0) {
      k0 = (k1 - 1) / Shared::kBatch * Shared::kBatch;
      __syncthreads();  // all have read what the last batch left
      shared.load(params.splats, params, first, list, k0, k1, with_means);
      __syncthreads();
      while (shared.claim_group())
        group_vjp<F, C, Layout, kSegment>(params, first, in_shared, shared, sums[Layout::group()], list, places,
                                          segment, k0, k1, with_means && with_shape);
      __syncthreads();
      write_pairs<C, Layout::kThreads>(params, first, with_means, with_shape, list, shared.rows, k1 - k0,
                                       [&](int j, int v) { return shared.total(sums, j, v); });
    }
  }
}

/// Blocks of segment_vjp_kernel: as many as are on the device at once.
template <int C, class Layout> int64_t segment_vjp_blocks(int64_t segments) {
  return std::min(segments, int64_t(multiprocessors()) * kMovingVjpBlocks<C, Layout, true>);
}
/// Numbers of BlendVjpParams::group_sums that segment_vjp_kernel needs.
template <class F, int C, class Layout, int kSegment> int64_t group_sums_of(int64_t segments) {
  using Sums = typename SegmentVjpShared<F, C, Layout, kSegment>::SumsOfGroup;
  if (kSumsInside<Layout>) return 0;
  return segment_vjp_blocks<C, Layout>(segments) * Layout::kGroups * int64_t(sizeof(Sums) / sizeof(float));
}

/// Launches segment_vjp_kernel with as much of EarlierPositions in shared memory as leaves room for kMovingVjpBlocks on
/// a multiprocessor.
template <class F, int C, class Layout, int kSegment>
void launch_segment_vjp_kernel(const BlendVjpParams& p, int segments, int first, cudaStream_t stream) {
  constexpr size_t kShared = sizeof(SegmentVjpShared<F, C, Layout, kSegment>);
  const int in_shared = EarlierPositions<Layout>::in_shared_of_blocks(kMovingVjpBlocks<C, Layout, true>, kShared);
  const LaunchShape shape = {unsigned(segment_vjp_blocks<C, Layout>(segments)), Layout::kThreads,
                             kShared + in_shared * EarlierPositions<Layout>::kBytes};
  launch(segment_vjp_kernel<F, C, Layout, kSegment>, shape, stream, p, first, in_shared);
}

}  // namespace ar::cuda
