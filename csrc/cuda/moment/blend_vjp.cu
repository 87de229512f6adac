// Launches the backward pass of footprints whose samples move: segment_maps, chain_maps and segment_vjp for lists that
// are cut into segments, moving_vjp for the others.
#include "cuda/dispatch.h"
#include "cuda/moment/vjp_segments.cuh"

namespace ar::cuda {
namespace {

template <class F, int C, int kSide> void launch_group(const BlendVjpParams& p, int first, cudaStream_t stream) {
  constexpr int kSegment = moving_segment(F::kSamples, kSide);
  if (p.cut.max_segments > 0) {
    using Maps = MapLayout<F, kSide>;
    const auto segments = unsigned(p.cut.max_segments), lists = unsigned(p.cut.max_lists);
    const LaunchShape maps = {segments * Maps::kBlocks, Maps::kThreads};
    launch(segment_maps_kernel<F, C, kSide, kSegment>, maps, stream, p, first);
    launch(chain_maps_kernel<F, kSide, kSegment>, {lists * F::kSamples, kSide * kSide}, stream, p);
    using Claimed = ClaimedLayout<F, kSide>;
    launch_vjp<SegmentVjpShared<F, C, Claimed, kSegment>, C, Claimed, true>(
        segment_vjp_kernel<F, C, Claimed, kSegment>, p, unsigned(segment_vjp_blocks<C, Claimed>(segments)), first,
        stream);
  }
  using Even = EvenLayout<F, kSide>;
  launch_vjp<MovingVjpShared<F, C, Even>, C, Even, false>(moving_vjp_kernel<F, C, Even>, p, unsigned(p.grid.tiles()),
                                                          first, stream);
}

/// Up to kChannelGroup channels.
template <class F, int kSide> void launch_blend_vjp(const BlendVjpParams& p, int first_of_group, cudaStream_t stream) {
  if (p.channels.count <= kFewChannels)
    return with_few_channels(p.channels, [&](auto channels) { launch_group<F, channels, kSide>(p, 0, stream); });
  const int end = std::min(first_of_group + kChannelGroup, p.channels.count);
  for (int first = first_of_group; first < end; first += MomentPolicy::kChannels)
    launch_group<F, MomentPolicy::kChannels, kSide>(p, first, stream);
}

}  // namespace

int64_t max_group_sums(int footprint, const Channels<float>& channels, const ListCut& cut, TileGrid grid) {
  int64_t numbers = 0;
  if (cut.max_segments == 0) return 0;
  visit_tiles(footprint, grid, [&](auto f, auto side) {
    using F = decltype(f);
    constexpr int kSide = decltype(side)::value, kSegment = moving_segment(F::kSamples, kSide);
    using Layout = ClaimedLayout<F, kSide>;
    if (channels.count <= kFewChannels)
      with_few_channels(channels,
                        [&](auto count) { numbers = group_sums_of<F, count, Layout, kSegment>(cut.max_segments); });
    else
      numbers = group_sums_of<F, MomentPolicy::kChannels, Layout, kSegment>(cut.max_segments);
  });
  return numbers;
}

void blend_vjp_moment(int footprint, const BlendVjpParams& p, int first, cudaStream_t stream) {
  visit_tiles(footprint, p.grid,
              [&](auto f, auto side) { launch_blend_vjp<decltype(f), decltype(side)::value>(p, first, stream); });
}

}  // namespace ar::cuda
