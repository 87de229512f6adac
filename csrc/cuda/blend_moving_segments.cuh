// Kernel of blend_vjp for footprints whose samples move, for segments of lists that are cut: from what
// blend_moving_maps.cuh has found, back to front.
//
// The samples of a tile are in groups, those of neighbouring pixels, which a warp takes through the segment at once.
// Groups do not have equally much to do: in some all pixels have closed, or nothing is there. So groups are not shared
// out among the warps of a block; a warp takes the next one when it is done with the last.
#pragma once

#include <algorithm>

#include "cuda/blend_moving_maps.cuh"
#include "cuda/blend_moving_vjp.cuh"

namespace ar::cuda {

/// Whether what the groups of a tile have for each pair of a batch is added up in shared memory. Where they are many
/// that would leave room for too few blocks, and it is in BlendVjpParams::group_sums.
template <class Layout> inline constexpr bool kSumsInside = Layout::kGroups <= 2;
/// Pairs of a segment that a block takes between barriers.
template <class Layout> inline constexpr int kSegmentBatch = kSumsInside<Layout> ? 64 : 128;

/// So many `Sums`, or none.
template <class Sums, int kCount> struct SumsOfGroups {
  Sums of_group[kCount];
};
template <class Sums> struct SumsOfGroups<Sums, 0> {};

/// What a block keeps in shared memory. Sums of a pair: PairGrad, C channels, MeanSums.
template <class F, int C, class Layout, int kSegment> struct SegmentVjpShared {
  static constexpr int kMeans = 6 + C, kSums = kMeans + 2;
  static constexpr int kBatch = std::min(kSegment, kSegmentBatch<Layout>), kChunks = kBatch / kStateChunk;
  /// What a group leaves for each pair of a batch.
  using SumsOfGroup = float[kBatch][kSums];
  SumsOfGroups<SumsOfGroup, kSumsInside<Layout> ? Layout::kGroups : 0> inside;
  MovingStage<F, C, Layout, kBatch> stage;
  uint32_t hits[Layout::kGroups][kChunks];  ///< splats that have sums of a group
  int32_t rows[kBatch];
  Mat2<float> mean_maps[kBatch];
  int segment, next_group;  ///< that is taken next
  int last;                 ///< place behind the last pair that was composited into any sample

  /// Loads the batch of pairs [k0, k1), with channels from `first` on and with_means what MeanSums need. All threads
  /// must call it.
  __device__ void load(const Splat<F, float>* splats, const BlendVjpParams& params, int first, const TileList& list,
                       int k0, int k1, bool with_means) {
    for (int t = threadIdx.x; t < kBatch; t += Layout::kThreads) {
      const int32_t id = k0 + t < k1 ? list.splat(k0 + t) : -1;
      stage.load_one(t, splats, params.channels, first, list, id);
      if (id < 0) continue;
      rows[t] = list.slot(k0 + t);
      if (with_means) mean_maps[t] = F::mean_map(splats[id].shape);
    }
    if (threadIdx.x == 0) next_group = 0;
  }
  /// Where the groups leave their sums. `outside`: BlendVjpParams::group_sums.
  __device__ SumsOfGroup* sums_of_groups(float* outside) {
    if constexpr (kSumsInside<Layout>) {
      return inside.of_group;
    } else {
      return reinterpret_cast<SumsOfGroup*>(outside) + int64_t(blockIdx.x) * Layout::kGroups;
    }
  }
  /// Takes a group for the warp; false if there is none left. All lanes must call it.
  __device__ bool take_group() {
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

/// A group of a segment's samples back to front through the batch of pairs [k0, k1) that is staged.
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
  // What the samples carry is the background, what the map of the segment behind gives, or what the batch behind has
  // left in a place of the segment's own map that is not needed any more.
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
  PlacesInFront<Layout> in_front(sizeof(Shared), in_shared);
  for (int from = (Shared::kChunks - 1) * kStateChunk; from >= 0; from -= kStateChunk) {
    uint32_t shown = 0;
    if (k0 + from < lasts.warp) {
      samples.load(params.checkpoints + places.of_chunk_at(k0 + from) * Samples::kCheckpoint, k0 + from, last);
      shown = replay_chunk<F, Layout>(shared.stage, from, k0, corners, last, samples, &in_front);
    }
    const uint32_t hits = chunk_vjp<F, C, Layout>(params, shared, group_sums, list, k0, from, shown, pixel, corners,
                                                  last, grad, in_front, with_means, samples, adjoint);
    if (lane_id() == 0) shared.hits[group][from / kStateChunk] = hits;
  }
  if (k0 == begin) return;
#pragma unroll
  for (int i = 0; i < kCells; ++i)
    if (last[i] > k0) map_of(i).put(segment.number, adjoint[i], kCarried);
}

/// Blocks that are on the device at once, each of which takes one segment after the other.
template <class F, int C, class Layout, int kSegment>
__global__ void __launch_bounds__(Layout::kThreads, kMovingVjpBlocks<F, C, Layout, kSegment>)
    segment_vjp_kernel(const BlendVjpParams params, int first, int in_shared) {
  wait_for_earlier_kernels();
  using Shared = SegmentVjpShared<F, C, Layout, kSegment>;
  static_assert(kSegment % Shared::kBatch == 0);
  Shared& shared = *reinterpret_cast<Shared*>(dynamic_shared());
  auto* const sums = shared.sums_of_groups(params.group_sums);
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
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
      const int rest = min(list.count, end);
      for (int k = max(shared.last, begin) + threadIdx.x / kClearThreads; k < rest;
           k += Layout::kThreads / kClearThreads)
        clear_pair_together<kChannelGroup>(params, list.slot(k), first == 0);
    }
    for (int k1 = stop, k0 = 0; k1 > begin; k1 = k0) {
      k0 = (k1 - 1) / Shared::kBatch * Shared::kBatch;
      __syncthreads();  // all have read what the last batch left
      shared.load(splats, params, first, list, k0, k1, with_means);
      __syncthreads();
      while (shared.take_group())
        group_vjp<F, C, Layout, kSegment>(params, first, in_shared, shared, sums[Layout::group()], list, places,
                                          segment, k0, k1, with_means && with_shape);
      __syncthreads();
      write_pairs<C, Layout::kThreads>(params, first, with_means, with_shape, list, shared.rows, k1 - k0,
                                       [&](int j, int v) { return shared.total(sums, j, v); });
    }
  }
}

/// Launches segment_vjp_kernel with as much of PlacesInFront in shared memory as leaves room for kMovingVjpBlocks on an
/// SM.
template <class F, int C, class Layout, int kSegment>
void launch_segment_vjp_kernel(const BlendVjpParams& p, int segments, int first, cudaStream_t stream) {
  using Shared = SegmentVjpShared<F, C, Layout, kSegment>;
  constexpr int kBlocks = kMovingVjpBlocks<F, C, Layout, kSegment>;
  const int in_shared = PlacesInFront<Layout>::in_shared_of_blocks(kBlocks, sizeof(Shared));
  int64_t blocks = std::min<int64_t>(segments, multiprocessors() * kBlocks);
  if (!kSumsInside<Layout>)
    blocks = std::min(blocks, p.max_group_sums / int64_t(Layout::kGroups * sizeof(typename Shared::SumsOfGroup) / 4));
  const LaunchShape shape = {unsigned(blocks), Layout::kThreads,
                             sizeof(Shared) + in_shared * PlacesInFront<Layout>::kBytes};
  launch(segment_vjp_kernel<F, C, Layout, kSegment>, shape, stream, p, first, in_shared);
}

}  // namespace ar::cuda
