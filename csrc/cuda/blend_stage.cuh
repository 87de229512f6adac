// How the kernels of blend for up to four channels composite: what a pixel carries from splat to splat, and the splats
// that a block stages for its pixels.
#pragma once

#include <type_traits>

#include "cuda/composite.cuh"

namespace ar::cuda {

/// What compositing carries from splat to splat, for one pixel with S samples and C channels. kSets is the number of
/// sets of channels: one for all samples, or one per sample where checkpoints need it.
template <int S, int C, int kSets> struct PixelState {
  float transmittance[S];
  Values<C> channels[kSets];
  int last[S];

  __device__ void start(bool open) {
#pragma unroll
    for (int s = 0; s < S; ++s) transmittance[s] = open ? 1.0f : -1.0f, last[s] = 0;
    clear_channels();
  }
  __device__ void clear_channels() {
#pragma unroll
    for (int k = 0; k < kSets; ++k) channels[k] = {};
  }
  __device__ Values<C> total() const {
    Values<C> sum = channels[0];
#pragma unroll
    for (int k = 1; k < kSets; ++k) sum += channels[k];
    return sum;
  }
  __device__ bool open() const {
    bool any = false;
#pragma unroll
    for (int s = 0; s < S; ++s) any |= transmittance[s] > 0;
    return any;
  }
};

/// The splats that a block blends together, and lists of those that reach each warp's pixels.
template <class F, int C> struct BlendStage : Stage<F, C, kBlendThreads> {
  static constexpr int kBatch = kBlendThreads;
  /// With one sample, where little else is done for a splat, a list holds places in memory, and is read four at a time.
  /// With more it holds the splats' numbers.
  static constexpr bool kPlaces = F::kSamples == 1;
  using Lists = std::conditional_t<kPlaces, ReachLists<uint32_t, sizeof(TileSplat<F, C>), 4, kSubtiles, kBatch>,
                                   ReachLists<uint8_t, 1, 1, kSubtiles, kBatch>>;
  Lists lists;

  /// Lists those of the `count` staged splats that reach this warp's pixels, and returns how many there are. All lanes
  /// must call it.
  __device__ int list_reached(int count) { return lists.list(this->reach, 0, count); }
  /// Calls visit(splat, entry) for the splats [from, to) of the list.
  template <class Visit> __device__ __forceinline__ void for_each_listed(int from, int to, Visit&& visit) const {
    lists.for_each(from, to, [&](auto entry) { visit(Lists::splat_of(this->splats, entry), entry); });
  }
};

/// Composites a splat into a pixel; last[s] becomes `place` where it was composited into sample s.
template <class F, int C, int kSets>
__device__ __forceinline__ void composite(const TileSplat<F, C>& splat, Vec2<float> p, int place,
                                          PixelState<F::kSamples, C, kSets>& state, int (&last)[F::kSamples]) {
  const auto composite_sample = [&](int s) {
    const Blended<float> b = blend_sample(F::alpha(splat.terms, p, s), state.transmittance[s]);
    last[s] = b.mask ? place : last[s];
    return b;
  };
  if constexpr (kSets == 1) {
    add_samples<F::kSamples>(state.channels[0], splat.channels, composite_sample);
  } else {
#pragma unroll
    for (int s = 0; s < F::kSamples; ++s) {
      const Blended<float> b = composite_sample(s);
      if (b.mask) state.channels[s].add(b.if_shown, splat.channels);
    }
  }
}

/// Composites the staged splats into a pixel; `index` is the place of the first of them in the tile's list.
template <class F, int C, int kSets>
__device__ void composite_all(BlendStage<F, C>& stage, int count, int index, Vec2<float> p,
                              PixelState<F::kSamples, C, kSets>& state) {
  using Stage = BlendStage<F, C>;
  constexpr int kBetweenVotes = 16;
  const int reached = stage.list_reached(count);
  int entries[] = {-1};  // of the last splat of this batch, where lists hold places
  for (int from = 0; from < reached; from += kBetweenVotes) {
    if (!__any_sync(kAllLanes, state.open())) break;
    stage.for_each_listed(from, min(reached, from + kBetweenVotes), [&](TileSplatRef<F, C> splat, auto entry) {
      if constexpr (Stage::kPlaces) {
        composite<F>(splat, p, int(entry), state, entries);
      } else {
        composite<F>(splat, p, index + int(entry) + 1, state, state.last);
      }
    });
  }
  if (Stage::kPlaces && entries[0] >= 0) state.last[0] = index + Stage::Lists::number_of(uint32_t(entries[0])) + 1;
}

/// Blocks of blend_front and tail_blend that a streaming multiprocessor should hold at once. It limits the registers of
/// a thread.
template <class F, int C>
inline constexpr int kFrontBlocks = F::kSamples > 1                                 ? 1
                                    : F::kExpensive || sizeof(TileSplat<F, C>) > 96 ? 4
                                                                                    : 5;
template <class F> inline constexpr int kTailBlendBlocks = F::kSamples > 4 ? 1 : F::kSamples > 1 ? 3 : 4;
/// Of tail_through.
template <class F> inline constexpr int kTailThroughBlocks = F::kSamples > 1 ? 3 : kFrontBlocks<F, 0>;

}  // namespace ar::cuda
