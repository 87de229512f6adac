// Launches of what goes through the lists of tiles forwards: blend, choose_samples, inspect.
#include <algorithm>

#include "cuda/blend.cuh"
#include "cuda/blend_groups.cuh"
#include "cuda/blend_listed.cuh"
#include "cuda/blend_moving.cuh"
#include "cuda/blend_segments.cuh"
#include "cuda/choose_samples.cuh"
#include "cuda/inspect.cuh"

namespace ar::cuda {

namespace {

/// C channels from `first` on, in tiles of kSide x kSide pixels. The kernel for lists that are cut is launched first,
/// because the longest of them may outlast everything else, and the kernel for the other lists begins beside it.
template <class F, int C, int kSide, bool kKeep>
void launch_moving_blend_kernels(const BlendParams& p, const ListCut& cut, int first, cudaStream_t stream) {
  using Layout = EvenLayout<F, false, kSide>;
  const unsigned blocks = cut.max_lists > 0 ? ListedLayouts<F, kSide>::blocks(cut, p.grid) : 0;
  if (blocks > 0) launch(listed_blend_kernel<F, C, kSide, kKeep>, {blocks, 32 * kListedWarps<F>}, stream, p, first);
  const LaunchShape tiles = {unsigned(p.grid.tiles() + 1), Layout::kThreads};
  launch(moving_blend_kernel<F, C, Layout, kKeep>, tiles, stream, p, first, blocks > 0);
}
template <class F, int C, int kSide>
void launch_moving_blend(const BlendParams& p, const ListCut& cut, int first, cudaStream_t stream) {
  if (p.transmittance && first == 0) {
    launch_moving_blend_kernels<F, C, kSide, true>(p, cut, first, stream);
  } else {
    launch_moving_blend_kernels<F, C, kSide, false>(p, cut, first, stream);
  }
}
template <class F, int kSide> void blend_moving(const BlendParams& p, cudaStream_t stream) {
  const ListCut cut = moving_list_cut(F::kSamples, p.lists.capacity, p.grid);
  const int64_t pieces = int64_t(cut.max_segments) * moving_segment(F::kSamples, kSide) / kFilterPiece;
  const auto blocks = unsigned(cuts_all_lists(p.grid) ? pieces : std::min<int64_t>(pieces, kFilterBlocks));
  if (blocks > 0) launch(filter_kernel<F, kSide>, {blocks, kFilterPiece}, stream, p);
  if (!p.channels.data) return launch_moving_blend<F, 3, kSide>(p, cut, 0, stream);
  if (p.channels.count <= kFewChannels) return launch_moving_blend<F, 4, kSide>(p, cut, 0, stream);
  for (int first = 0; first < p.channels.count; first += kMovingChannels)
    launch_moving_blend<F, kMovingChannels, kSide>(p, cut, first, stream);
}

/// Blends with an F whose samples do not move.
template <class F> void blend_still(const BlendParams& p, const BlendParams* in_chunks, cudaStream_t stream) {
  if constexpr (!F::kReference) {
    if (!p.channels.data) return blend_few<F, 3>(p, stream);
    if (p.channels.count <= kFewChannels) return blend_few<F, 4>(p, stream);
    if (p.segments.count > 1) return blend_segments<F>(p, *in_chunks, stream);
  }
  blend_groups<F>(with_channels(p), stream);
}

bool always_whole_lists(int footprint) {
  bool always = false;
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    using F = decltype(f);
    always = F::kReference || F::kMoves;
  });
  return always;
}

}  // namespace

int64_t max_state_planes(int footprint, int64_t capacity) {
  int planes = 0;
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    using F = decltype(f);
    if (F::kMoves) planes = state_planes(F::kSamples);
  });
  return capacity / kStateChunk * planes;
}

ListCut list_cut(int footprint, int64_t channels, int64_t capacity, TileGrid grid) {
  ListCut cut = {always_whole_lists(footprint) || channels > kFewChannels};
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    using F = decltype(f);
    if (F::kMoves) cut = moving_list_cut(F::kSamples, capacity, grid);
  });
  return cut;
}

int64_t max_reach_words(const ListCut& cut, TileGrid grid) {
  return int64_t(cut.max_segments) * (cut.segment / 32) * grid.side() * grid.side();
}

int list_segments(int footprint, int64_t channels, TileGrid grid) {
  constexpr int64_t kMost = 16;
  if (always_whole_lists(footprint) || channels <= kFewChannels || 2 * grid.tiles() > kManyBlocks) return 1;
  return int(std::min(kMost, kManyBlocks / grid.tiles()));
}

int samples_of_lane(int footprint, TileGrid grid) {
  int samples = 0;
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    using F = decltype(f);
    samples = F::kSamples;
    if constexpr (!F::kMoves) with_lanes<F>(grid, [&](auto lanes) { samples = decltype(lanes)::kSamples; });
  });
  return samples;
}

void choose_samples(const ChooseParams& p, cudaStream_t stream) { launch_choose_samples<Adaptive>(p, stream); }

void blend(int footprint, const BlendParams& p, const BlendParams* in_chunks, cudaStream_t stream) {
  visit_tile_footprints<AdaptiveBoxes>(footprint, stream, [&](auto f, cudaStream_t side) {
    using F = decltype(f);
    if constexpr (F::kMoves) {
      with_tile_side<F>(p.grid, [&](auto px) { blend_moving<F, decltype(px)::value>(p, side); });
    } else {
      with_lanes<F>(p.grid, [&](auto lanes) { blend_still<decltype(lanes)>(p, in_chunks, side); });
    }
  });
}

void inspect(int footprint, const InspectParams& p, cudaStream_t stream) {
  visit_tile_footprints<AdaptiveBoxes>(footprint, stream,
                                       [&](auto f, cudaStream_t side) { launch_inspect<decltype(f)>(p, side); });
}

}  // namespace ar::cuda
