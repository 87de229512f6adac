// Launches the forward kernels of footprints whose samples stay, for up to four channels. dispatch.cu calls
// blend_still().
#include "cuda/dispatch.h"
#include "cuda/still/front.cuh"

namespace ar::cuda {

void blend_still(int footprint, const BlendParams& p, cudaStream_t stream) {
  visit_pixels(footprint, [&](auto f) {
    using F = decltype(f);
    if constexpr (family_of<F>(kFewChannels) == Family::kStill) {
      with_lanes<F>(p.grid, [&](auto of_lane) {
        using OfLane = decltype(of_lane);
        if (!p.channels.data) return launch_blend_few<OfLane, 3>(p, stream);
        launch_blend_few<OfLane, kFewChannels>(p, stream);
      });
    }
  });
}

}  // namespace ar::cuda
