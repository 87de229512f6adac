// Launches blend_groups (groups.cuh), the forward pass for any number of channels.
//
// Tried and lost: docs/internals/log.md, "More than four channels" and "Features that are gone".
#include "cuda/channels/groups.cuh"

namespace ar::cuda {

void blend_channels(int footprint, const BlendParams& p, cudaStream_t stream) {
  visit_lanes<Family::kChannels>(
      footprint, p.grid, [&](auto of_lane) { launch_blend_groups<decltype(of_lane)>(with_channels(p), stream); });
}

}  // namespace ar::cuda
