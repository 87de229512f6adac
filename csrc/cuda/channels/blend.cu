// Launches blend_groups (groups.cuh): the forward pass for any number of channels, in groups of 32 or 8.
//
// Tried and lost (H200, plant hd, `box` 1, 8 channels; docs/internals/log.md, "More than four channels"): backward,
// batches of 32 splats (1214 instead of 930 us) or 128 (1495 us) for 64; a warp per splat in sum_channels, which took
// as long for 8 channels as for 32; and lists cut into segments, 65 kernels without a gain ("Features that are gone").
#include "cuda/channels/groups.cuh"

namespace ar::cuda {

void blend_channels(int footprint, const BlendParams& p, cudaStream_t stream) {
  visit_lanes<Family::kChannels>(
      footprint, p.grid, [&](auto of_lane) { launch_blend_groups<decltype(of_lane)>(with_channels(p), stream); });
}

}  // namespace ar::cuda
