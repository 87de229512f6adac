// Launches the forward kernel for any number of channels. dispatch.cu calls blend_channels().
#include "cuda/channels/groups.cuh"

namespace ar::cuda {

void blend_channels(int footprint, const BlendParams& p, cudaStream_t stream) {
  visit_pixels(footprint, [&](auto f) {
    using F = decltype(f);
    if constexpr (!F::kMoves) {
      with_lanes<F>(p.grid, [&](auto of_lane) { launch_blend_groups<decltype(of_lane)>(with_channels(p), stream); });
    }
  });
}

}  // namespace ar::cuda
