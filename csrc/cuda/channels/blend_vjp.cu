// Launches blend_groups_vjp (groups_vjp.cuh), the backward pass of a group of channels.
#include "cuda/channels/groups_vjp.cuh"

namespace ar::cuda {

void blend_vjp_channels(int footprint, const BlendVjpParams& p, int first, cudaStream_t stream) {
  visit_lanes<Family::kChannels>(footprint, p.grid, [&](auto of_lane) {
    launch_blend_groups_vjp<decltype(of_lane)>(with_channels(p), first, stream);
  });
}

}  // namespace ar::cuda
