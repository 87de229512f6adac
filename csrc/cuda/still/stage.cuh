// How blend_front and the tail composite: a block stages splats, and each warp lists and blends those that reach its
// pixels.
#pragma once

#include <type_traits>

#include "cuda/still/policy.h"
#include "cuda/tile/stage.cuh"

namespace ar::cuda {

template <class F, int C> struct BlendStage : Stage<F, C, kBlendThreads> {
  static_assert(sizeof(TileSplat<F, C>) <= 112, "a splat in use is copied to registers");
  static constexpr int kBatch = kBlendThreads;
  /// Whether lists have offsets, read four at once: with one sample, where this is much of the work.
  static constexpr bool kOffsets = F::kSamples == 1;
  using Lists = std::conditional_t<kOffsets, ReachLists<uint32_t, sizeof(TileSplat<F, C>), 4, kSubtiles, kBatch>,
                                   ReachLists<uint8_t, 1, 1, kSubtiles, kBatch>>;
  Lists lists;

  /// Those of the `count` staged splats that reach this warp's pixels.
  __device__ int list_reached(int count) { return lists.list(this->reach, 0, count); }
  template <class Visit> __device__ __forceinline__ void for_each_listed(int from, int to, Visit&& visit) const {
    lists.for_each(from, to, [&](auto entry) { visit(Lists::splat_of(this->splats, entry), entry); });
  }
};

/// `index`: of the first in the tile's list.
template <class F, int C, int kSets>
__device__ void composite_all(BlendStage<F, C>& stage, int count, int index, Vec2<float> p,
                              PixelState<F::kSamples, C, kSets>& state) {
  using Stage = BlendStage<F, C>;
  constexpr int kStep = StillPolicy::kBetweenVotes;
  const int reached = stage.list_reached(count);
  int entries[F::kSamples] = {-1};  // of the last splat composited, if kOffsets
  int (&last)[F::kSamples] = Stage::kOffsets ? entries : state.last;
  const int first = Stage::kOffsets ? 0 : index + 1;
  for (int from = 0; from < reached; from += kStep) {
    if (!__any_sync(kAllLanes, state.open())) break;
    stage.for_each_listed(from, min(reached, from + kStep), [&](TileSplatRef<F, C> splat, auto entry) {
      const auto composite = [&](int s) {
        const Blended<float> b = blend_sample(F::alpha(splat.terms, p, s), state.transmittance[s]);
        last[s] = b.mask ? first + int(entry) : last[s];
        return b;
      };
      if constexpr (kSets == 1) {
        add_samples<F::kSamples>(state.channels[0], splat.channels, composite);
      } else {
        AR_UNROLL for (int s = 0; s < F::kSamples; ++s) {
          const Blended<float> b = composite(s);
          if (b.mask) state.channels[s].add(b.if_shown, splat.channels);
        }
      }
    });
  }
  if (Stage::kOffsets && entries[0] >= 0) state.last[0] = index + Stage::Lists::number_of(uint32_t(entries[0])) + 1;
}

}  // namespace ar::cuda
