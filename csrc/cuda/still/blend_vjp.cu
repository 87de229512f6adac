// Launches blend_vjp (vjp.cuh).
#include "cuda/dispatch.h"
#include "cuda/still/vjp.cuh"

namespace ar::cuda {
namespace {

template <class F, int C, bool kMeans> void launch_kernel(const BlendVjpParams& p, cudaStream_t stream) {
  constexpr int kWarps = StillPolicy::kVjpWarps<F>;
  const unsigned blocks = std::min(blocks_of(p.max_chunks, kWarps), StillPolicy::kVjpBlocksPerSm * multiprocessors());
  launch(blend_vjp_kernel<F, C, kMeans>, {blocks, 32 * kWarps, sizeof(VjpShared<F, C>)}, stream, p);
}

}  // namespace

void blend_vjp_still(int footprint, const BlendVjpParams& p, cudaStream_t stream) {
  visit_lanes<Family::kStill>(footprint, p.grid, [&](auto of_lane) {
    using F = decltype(of_lane);
    with_few_channels(p.channels, [&](auto channels) {
      if (p.mean_sums == MeanSums::kNone) return launch_kernel<F, channels, false>(p, stream);
      launch_kernel<F, channels, true>(p, stream);
    });
  });
}

}  // namespace ar::cuda
