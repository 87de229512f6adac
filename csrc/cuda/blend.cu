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

template <class F, int C, bool kKeep>
void launch_moving_blend_kernels(const BlendParams& p, int first, cudaStream_t stream) {
  const auto tiles = unsigned(p.grid.tiles());
  if (is_small_image(p.grid)) {
    launch(listed_blend_kernel<F, C, kKeep>, {tiles * kListedBlocks<F>, 32}, stream, p, first);
    using Layout = EvenLayout<F, false, true>;
    launch(moving_blend_kernel<F, C, Layout, kKeep>, {tiles, Layout::kThreads}, stream, p, first, true);
  } else {
    using Layout = EvenLayout<F, false, false>;
    launch(moving_blend_kernel<F, C, Layout, kKeep>, {tiles, Layout::kThreads}, stream, p, first, false);
  }
}
template <class F, int C> void launch_moving_blend(const BlendParams& p, int first, cudaStream_t stream) {
  if (p.transmittance && first == 0) {
    launch_moving_blend_kernels<F, C, true>(p, first, stream);
  } else {
    launch_moving_blend_kernels<F, C, false>(p, first, stream);
  }
}
template <class F> void blend_moving(const BlendParams& p, cudaStream_t stream) {
  if (is_small_image(p.grid)) {
    const auto pieces = unsigned(max_pieces(p.lists.capacity, kFilterPiece, p.grid));
    launch(filter_kernel<F>, {pieces, kFilterPiece}, stream, p);
  }
  if (!p.channels.data) return launch_moving_blend<F, 3>(p, 0, stream);
  if (p.channels.count <= kFewChannels) return launch_moving_blend<F, 4>(p, 0, stream);
  for (int first = 0; first < p.channels.count; first += kMovingChannels)
    launch_moving_blend<F, kMovingChannels>(p, first, stream);
}

bool always_whole_lists(int footprint) {
  bool always = false;
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    using F = decltype(f);
    always = F::kYardstick || F::kMoves;
  });
  return always;
}

}  // namespace

bool blends_whole_lists(int footprint, int64_t channels) {
  return always_whole_lists(footprint) || channels > kFewChannels;
}

int64_t max_state_planes(int footprint, int64_t capacity) {
  int planes = 0;
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    using F = decltype(f);
    if (F::kMoves) planes = state_planes(F::kSamples);
  });
  return capacity / kStateChunk * planes;
}

int64_t max_reach_words(int footprint, int64_t capacity, TileGrid grid) {
  int64_t words = 0;
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    using F = decltype(f);
    if constexpr (F::kMoves) {
      if (is_small_image(grid)) words = filter_words(capacity, grid);
    }
  });
  return words;
}

int list_segments(int footprint, int64_t channels, TileGrid grid) {
  constexpr int64_t kBlocks = 1056, kMost = 16;  // eight for each SM of a large device
  if (always_whole_lists(footprint) || channels <= kFewChannels || 2 * grid.tiles() > kBlocks) return 1;
  return int(std::min(kMost, kBlocks / grid.tiles()));
}

void choose_samples(const ChooseParams& p, cudaStream_t stream) { launch_choose_samples<Adaptive>(p, stream); }

void blend(int footprint, const BlendParams& p, const BlendParams* cut, cudaStream_t stream) {
  visit_tile_footprints<AdaptiveBoxes>(footprint, stream, [&](auto f, cudaStream_t side) {
    using F = decltype(f);
    if constexpr (F::kMoves) {
      blend_moving<F>(p, side);
    } else {
      if constexpr (!F::kYardstick) {
        if (!p.channels.data) return blend_few<F, 3>(p, side);
        if (p.channels.count <= kFewChannels) return blend_few<F, 4>(p, side);
        if (p.segments.count > 1) return blend_segments<F>(p, *cut, side);
      }
      blend_groups<F>(with_channels(p), side);
    }
  });
}

void inspect(int footprint, const InspectParams& p, cudaStream_t stream) {
  visit_tile_footprints<AdaptiveBoxes>(footprint, stream,
                                       [&](auto f, cudaStream_t side) { launch_inspect<decltype(f)>(p, side); });
}

}  // namespace ar::cuda
