// Launches of blend_vjp.
#include "cuda/blend_groups_vjp.cuh"
#include "cuda/blend_moving_maps.cuh"
#include "cuda/blend_moving_vjp.cuh"
#include "cuda/blend_vjp.cuh"
#include "cuda/launch.cuh"

namespace ar::cuda {
namespace {

/// No chunk has been begun. With too many pairs there is a row per splat that all tiles add to, and which must be zero;
/// the sums of shapes stay from group to group. The group begins with channel `first` and has `width` of them.
__global__ void clear_sums_kernel(const BlendVjpParams params, int first, int width) {
  wait_for_earlier_kernels();
  if (blockIdx.x == 0 && threadIdx.x < kSampleClasses) params.chunks_taken[threadIdx.x] = 0;
  if (params.lists.counts->pairs <= params.lists.capacity) return;
  const auto clear = [&](float* to, int width) {
    const int64_t n = params.lists.n * width;
    for (int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x; i < n; i += int64_t(gridDim.x) * blockDim.x)
      to[i] = 0;
  };
  if (first == 0) clear(params.pair_grads, kPairGradWidth);
  if (params.channel_sums) clear(params.channel_sums, width);
}

/// Lists in segments, side by side.
template <class F, int C> void launch_segments_vjp(const BlendVjpParams& p, int first, cudaStream_t stream) {
  using Layout = SegmentLayout<F>;
  constexpr int kSegment = kMovingSegment<F>;
  const auto pieces = unsigned(max_pieces(p.lists.capacity, kSegment, p.grid));
  using Maps = MapLayout<F>;
  launch(segment_maps_kernel<F, C, kSegment>, {pieces * Maps::kBlocks, Maps::kThreads}, stream, p, first);
  const auto blocks = unsigned(p.grid.tiles() * F::kSamples);
  launch(chain_maps_kernel<F, kSegment>, {blocks, kMovingPixels}, stream, p);
  launch_moving_vjp_kernel<F, C, Layout, kSegment>(p, pieces, first, false, stream);
}
template <class F, int C, bool kSmall> void launch_tiles_vjp(const BlendVjpParams& p, int first, cudaStream_t stream) {
  using Layout = EvenLayout<F, true, kSmall>;
  launch_moving_vjp_kernel<F, C, Layout, 0>(p, unsigned(p.grid.tiles()), first, kSmall, stream);
}
template <class F, int C> void launch_moving_vjp(const BlendVjpParams& p, int first, cudaStream_t stream) {
  if (is_small_image(p.grid)) {
    launch_segments_vjp<F, C>(p, first, stream);
    launch_tiles_vjp<F, C, true>(p, first, stream);
  } else {
    launch_tiles_vjp<F, C, false>(p, first, stream);
  }
}
/// The group that begins with channel `first_of_group`; 0 where they are few.
template <class F> void blend_vjp_moving(const BlendVjpParams& p, int first_of_group, cudaStream_t stream) {
  if (!p.channels.data) return launch_moving_vjp<F, 3>(p, 0, stream);
  if (p.channels.count <= kFewChannels) return launch_moving_vjp<F, 4>(p, 0, stream);
  const int end = std::min(first_of_group + kChannelGroup, p.channels.count);
  for (int first = first_of_group; first < end; first += kMovingChannels)
    launch_moving_vjp<F, kMovingChannels>(p, first, stream);
}

}  // namespace

int64_t max_adjoint_maps(int footprint, int64_t capacity, TileGrid grid) {
  int64_t maps = 0;
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    using F = decltype(f);
    if (F::kMoves && is_small_image(grid)) maps = max_pieces(capacity, kMovingSegment<F>, grid) * F::kSamples;
  });
  return maps * SegmentMap::kNumbers * kMovingPixels;
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
      blend_vjp_moving<F>(p, first, side);
    } else {
      if constexpr (!F::kYardstick) {
        if (!p.channels.data) return blend_vjp_few<F, 3>(p, side);
        if (p.channels.count <= kFewChannels) return blend_vjp_few<F, 4>(p, side);
      }
      blend_vjp_group<F>(with_channels(p), first, side);
    }
  });
}

}  // namespace ar::cuda
