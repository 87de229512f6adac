// Launches of what goes through the lists of tiles forwards: blend, choose_samples, inspect.
#include "cuda/blend.cuh"
#include "cuda/blend_groups.cuh"
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

void choose_samples(const ChooseParams& p, cudaStream_t stream) { launch_choose_samples<Adaptive>(p, stream); }

void blend(int footprint, const BlendParams& p, cudaStream_t stream) {
  visit_tile_footprints<AdaptiveBoxes>(footprint, stream, [&](auto f, cudaStream_t side) {
    using F = decltype(f);
    if constexpr (!kOnlyGroups<F>) {
      if (!p.channels.data) return blend_few<F, 3>(p, side);
      if (p.channels.count <= kFewChannels) return blend_few<F, 4>(p, side);
    }
    blend_groups<F>(with_channels(p), side);
  });
}

void inspect(int footprint, const InspectParams& p, cudaStream_t stream) {
  visit_tile_footprints<AdaptiveBoxes>(footprint, stream,
                                       [&](auto f, cudaStream_t side) { launch_inspect<decltype(f)>(p, side); });
}

}  // namespace ar::cuda
