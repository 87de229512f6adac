// Launches the forward pass of footprints whose samples move. Where lists are cut into segments (cut_lists.h), filter
// runs once. Then, for each group of channels, listed_blend takes the lists that are cut, and moving_blend the others.
//
// Tried and lost: docs/internals/log.md, the sections "moment/" and "The queue".
#include "cuda/dispatch.h"
#include "cuda/moment/listed.cuh"
#include "cuda/moment/walk.cuh"

namespace ar::cuda {
namespace {

/// Channels [first, first + C). The kernel for lists that are cut may end last, and is launched first.
template <class F, int C, int kSide> void launch_group(const BlendParams& p, int first, cudaStream_t stream) {
  using Layout = EvenLayout<F, kSide>;
  const bool keeps = p.transmittance && first == 0;
  const auto listed = keeps ? listed_blend_kernel<F, C, kSide, true> : listed_blend_kernel<F, C, kSide, false>;
  const auto others = keeps ? moving_blend_kernel<F, C, Layout, true> : moving_blend_kernel<F, C, Layout, false>;
  const unsigned blocks = p.cut.max_lists > 0 ? ListedLayouts<F, kSide>::blocks(p.cut, p.grid, multiprocessors()) : 0;
  if (blocks > 0) launch(listed, {blocks, 32 * kListedWarps<F>}, stream, p, first);
  launch(others, {unsigned(p.grid.tiles() + 1), Layout::kThreads}, stream, p, first, blocks > 0);
}

template <class F, int kSide> void launch_blend(const BlendParams& p, cudaStream_t stream) {
  const int64_t pieces = int64_t(p.cut.max_segments) * moving_segment(F::kSamples, kSide) / MomentPolicy::kFilterPiece;
  const int64_t most = MomentPolicy::kFilterBlocksPerSm * multiprocessors();
  const auto blocks = unsigned(cuts_all_lists(p.grid) ? pieces : std::min(pieces, most));
  if (blocks > 0) launch(filter_kernel<F, kSide>, {blocks, MomentPolicy::kFilterPiece}, stream, p);
  if (p.channels.count <= kFewChannels)
    return with_few_channels(p.channels, [&](auto channels) { launch_group<F, channels, kSide>(p, 0, stream); });
  for (int first = 0; first < p.channels.count; first += MomentPolicy::kChannels)
    launch_group<F, MomentPolicy::kChannels, kSide>(p, first, stream);
}

}  // namespace

void blend_moment(int footprint, const BlendParams& p, cudaStream_t stream) {
  visit_tiles(footprint, p.grid,
              [&](auto f, auto side) { launch_blend<decltype(f), decltype(side)::value>(p, stream); });
}

}  // namespace ar::cuda
