// Launches blend_front (front.cuh) and the tail (tail.cuh).
//
// Tried and lost: docs/internals/log.md, "still/, forward" and "still/, backward".
#include "cuda/dispatch.h"
#include "cuda/still/front.cuh"
#include "cuda/still/tail.cuh"

namespace ar::cuda {
namespace {

template <class F, int C, bool kKeep> void launch_kernels(const BlendParams& p, cudaStream_t stream) {
  constexpr int S = F::kSamples;
  const unsigned blocks = kBlocksPerSm * multiprocessors();
  const LaunchShape of_chunks = {blocks, kBlendThreads}, of_parts = {blocks, 32}, of_sums = {blocks, kTailSumThreads};
  launch(blend_front_kernel<F, C, kKeep>, {unsigned(p.grid.tiles()), kBlendThreads}, stream, p);
  launch(tail_through_kernel<F>, of_chunks, stream, p);
  launch(tail_scan_kernel, of_parts, stream, p, S);
  launch(tail_blend_kernel<F, C, kKeep>, of_chunks, stream, p);
  launch(tail_sum_kernel<LaneSamples<S, F::kLanes>, C, kKeep>, of_sums, stream, p);
}

}  // namespace

void blend_still(int footprint, const BlendParams& p, cudaStream_t stream) {
  visit_lanes<Family::kStill>(footprint, p.grid, [&](auto of_lane) {
    using F = decltype(of_lane);
    with_few_channels(p.channels, [&](auto channels) {
      if (p.transmittance) return launch_kernels<F, channels, true>(p, stream);
      launch_kernels<F, channels, false>(p, stream);
    });
  });
}

}  // namespace ar::cuda
