// Launches of blend_vjp.
#include "cuda/blend_groups_vjp.cuh"
#include "cuda/blend_moving_maps.cuh"
#include "cuda/blend_moving_segments.cuh"
#include "cuda/blend_moving_vjp.cuh"
#include "cuda/blend_vjp.cuh"
#include "cuda/launch.cuh"

namespace ar::cuda {
namespace {

/// No chunk has been begun. With more pairs than room there is a row per splat that all tiles add to, and which must be
/// zero; the sums of shapes stay from group to group. The group begins with channel `first` and has `width` of them.
__global__ void clear_sums_kernel(const BlendVjpParams params, int first, int width) {
  wait_for_earlier_kernels();
  if (blockIdx.x == 0 && threadIdx.x < kSampleClasses) params.chunks_taken[threadIdx.x] = 0;
  if (!params.lists.counts->in_patches(params.lists.capacity)) return;
  const auto clear = [&](float* to, int width) {
    const int64_t n = params.lists.n * width;
    for (int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x; i < n; i += int64_t(gridDim.x) * blockDim.x)
      to[i] = 0;
  };
  if (first == 0) clear(params.pair_grads, kPairGradWidth);
  if (params.channel_sums) clear(params.channel_sums, width);
}

/// Lists that are cut: their segments side by side.
template <class F, int C, int kSide>
void launch_segments_vjp(const BlendVjpParams& p, const ListCut& cut, int first, cudaStream_t stream) {
  using Maps = MapLayout<F, kSide>;
  constexpr int kSegment = moving_segment(F::kSamples, kSide);
  const auto segments = unsigned(cut.max_segments), lists = unsigned(cut.max_lists);
  const LaunchShape maps = {segments * Maps::kBlocks, Maps::kThreads};
  launch(segment_maps_kernel<F, C, kSide, kSegment>, maps, stream, p, first);
  launch(chain_maps_kernel<F, kSide, kSegment>, {lists * F::kSamples, kSide * kSide}, stream, p);
  launch_segment_vjp_kernel<F, C, TakenLayout<F, kSide>, kSegment>(p, cut.max_segments, first, stream);
}
template <class F, int C, int kSide>
void launch_moving_vjp(const BlendVjpParams& p, const ListCut& cut, int first, cudaStream_t stream) {
  if (cut.max_segments > 0) launch_segments_vjp<F, C, kSide>(p, cut, first, stream);
  launch_moving_vjp_kernel<F, C, EvenLayout<F, true, kSide>>(p, unsigned(p.grid.tiles()), first, stream);
}
/// The group that begins with channel `first_of_group`; 0 where they are few. In tiles of kSide x kSide pixels.
template <class F, int kSide> void blend_vjp_moving(const BlendVjpParams& p, int first_of_group, cudaStream_t stream) {
  const ListCut cut = moving_list_cut(F::kSamples, p.lists.capacity, p.grid);
  if (!p.channels.data) return launch_moving_vjp<F, 3, kSide>(p, cut, 0, stream);
  if (p.channels.count <= kFewChannels) return launch_moving_vjp<F, 4, kSide>(p, cut, 0, stream);
  const int end = std::min(first_of_group + kChannelGroup, p.channels.count);
  for (int first = first_of_group; first < end; first += kMovingChannels)
    launch_moving_vjp<F, kMovingChannels, kSide>(p, cut, first, stream);
}

/// The same for an F whose samples do not move.
template <class F> void blend_vjp_still(const BlendVjpParams& p, int first_of_group, cudaStream_t stream) {
  if constexpr (!F::kReference) {
    if (!p.channels.data) return blend_vjp_few<F, 3>(p, stream);
    if (p.channels.count <= kFewChannels) return blend_vjp_few<F, 4>(p, stream);
  }
  blend_vjp_group<F>(with_channels(p), first_of_group, stream);
}

}  // namespace

int64_t max_adjoint_maps(int samples, const ListCut& cut, TileGrid grid) {
  return int64_t(cut.max_segments) * SegmentMap::kNumbers * samples * grid.side() * grid.side();
}

int64_t max_group_sums(int footprint, const ListCut& cut, TileGrid grid) {
  if (cut.max_segments == 0) return 0;  // and the device need not be asked
  int pairs = 0;                        // of a batch whose sums are there
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    using F = decltype(f);
    if constexpr (F::kMoves) {
      with_tile_side<F>(grid, [&](auto px) {
        using Layout = TakenLayout<F, decltype(px)::value>;
        if (!kSumsInside<Layout>) pairs = kSegmentBatch<Layout>;
      });
    }
  });
  // Of three channels; of more, a multiprocessor has half as many warps. A block has up to 16 groups, of eight
  // channels.
  constexpr int kGroups = 32 * kMostGroupsOfWarp, kSums = 6 + 3 + 2, kOfBlock = 16, kMostSums = 6 + kMovingChannels + 2;
  return pairs * std::min<int64_t>(int64_t(multiprocessors()) * kGroups * kSums,
                                   int64_t(cut.max_segments) * kOfBlock * kMostSums);
}

int channel_group(int footprint, int left) {
  int width = 0;
  visit_footprint(footprint, Footprints{}, [&](auto f) { width = group_width<decltype(f)>(left); });
  return width;
}

void blend_vjp(int footprint, const BlendVjpParams& p, int first, cudaStream_t stream) {
  const int width = channel_group(footprint, p.channels.count - first);
  launch(clear_sums_kernel, {kClearBlocks, kBlendThreads}, stream, p, first, width);
  visit_tile_footprints<AdaptiveBoxesVjp>(footprint, stream, [&](auto f, cudaStream_t side) {
    using F = decltype(f);
    if constexpr (F::kMoves) {
      with_tile_side<F>(p.grid, [&](auto px) { blend_vjp_moving<F, decltype(px)::value>(p, first, side); });
    } else {
      with_lanes<F>(p.grid, [&](auto lanes) { blend_vjp_still<decltype(lanes)>(p, first, side); });
    }
  });
}

}  // namespace ar::cuda
