// Launches blend_rays_vjp (vjp.cuh).
#include <algorithm>

#include "cuda/dispatch.h"
#include "cuda/rays/vjp.cuh"

namespace ar::cuda {

RayLog ray_log(int footprint, TileGrid grid, int64_t& words) {
  RayLog log = {};
  words = 0;
  visit_along_rays(footprint, [&](auto chosen) {
    using F = decltype(chosen);
    log.blocks = int(std::min<int64_t>(grid.tiles(), RayPolicy::kVjpBlocks * multiprocessors()));
    const int64_t of_row = int64_t(std::max(log.blocks, 1)) * 32 * kLogWords<F>;
    const int64_t most = RayPolicy::kLogBytes / int64_t(sizeof(uint32_t)) / of_row;
    log.rows = RayPolicy::kLogRows;
    while (log.rows > std::max<int64_t>(most, 1)) log.rows /= 2;
    words = log.rows * of_row;
  });
  return log;
}

void blend_vjp_rays(int footprint, const BlendVjpParams& p, cudaStream_t stream) {
  visit_along_rays(footprint, [&](auto chosen) {
    using F = decltype(chosen);
    with_few_channels(p.channels, [&](auto channels) {
      const size_t bytes = sizeof(RayStage<F>) + RayWindow::bytes(p.order.window);
      launch(blend_rays_vjp_kernel<F, channels>, {unsigned(p.ray_log.blocks), 32, bytes}, stream, p);
    });
  });
}

}  // namespace ar::cuda
