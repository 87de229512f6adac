// Launches of what goes through the lists of tiles forwards: blend, choose_samples, inspect.
#include <algorithm>

#include "cuda/blend.cuh"
#include "cuda/blend_groups.cuh"
#include "cuda/blend_segments.cuh"
#include "cuda/choose_samples.cuh"
#include "cuda/inspect.cuh"

namespace ar::cuda {

bool blends_groups(int footprint, int64_t channels) {
  bool always = false;
  visit_footprint(footprint, Footprints{}, [&](auto f) { always = kOnlyGroups<decltype(f)>; });
  return always || channels > kFewChannels;
}

int64_t max_state_planes(int footprint, int64_t capacity) {
  int planes = 0;
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    using F = decltype(f);
    if (F::kMoves) planes = state_planes(F::kSamples);
  });
  return capacity / kStateChunk * planes;
}

int list_segments(int footprint, int64_t channels, TileGrid grid) {
  constexpr int64_t kBlocks = 1056, kMost = 16;  // eight for each SM of a large device
  bool only_groups = false;
  visit_footprint(footprint, Footprints{}, [&](auto f) { only_groups = kOnlyGroups<decltype(f)>; });
  if (only_groups || channels <= kFewChannels || 2 * grid.tiles() > kBlocks) return 1;
  return int(std::min(kMost, kBlocks / grid.tiles()));
}

void choose_samples(const ChooseParams& p, cudaStream_t stream) { launch_choose_samples<Adaptive>(p, stream); }

void blend(int footprint, const BlendParams& p, const BlendParams* cut, cudaStream_t stream) {
  visit_tile_footprints<AdaptiveBoxes>(footprint, stream, [&](auto f, cudaStream_t side) {
    using F = decltype(f);
    if constexpr (!kOnlyGroups<F>) {
      if (!p.channels.data) return blend_few<F, 3>(p, side);
      if (p.channels.count <= kFewChannels) return blend_few<F, 4>(p, side);
      if (p.segments.count > 1) return blend_segments<F>(p, *cut, side);
    }
    blend_groups<F>(with_channels(p), side);
  });
}

void inspect(int footprint, const InspectParams& p, cudaStream_t stream) {
  visit_tile_footprints<AdaptiveBoxes>(footprint, stream,
                                       [&](auto f, cudaStream_t side) { launch_inspect<decltype(f)>(p, side); });
}

}  // namespace ar::cuda
