// Launches blend_rays (blend.cuh).
#include "cuda/rays/blend.cuh"

#include "cuda/dispatch.h"

namespace ar::cuda {

void blend_rays(int footprint, const BlendParams& p, cudaStream_t stream) {
  visit_along_rays(footprint, [&](auto chosen) {
    using F = decltype(chosen);
    const size_t bytes = sizeof(RayStage<F>) + RayWindow::bytes(p.order.window);
    with_few_channels(p.channels, [&](auto channels) {
      launch(blend_rays_kernel<F, channels>, {unsigned(p.grid.tiles() * kRayHalves), 32, bytes}, stream, p);
    });
  });
}

}  // namespace ar::cuda
