// Loop of blend in the order along rays (core/order.h): pack after pack of a tile, each over the whole list.
#pragma once

#include "cpu/blend.h"
#include "cpu/ray_walk.h"

namespace ar::AR_ISA {

/// The samples of a pack.
template <class P, typename T> struct RaySamples {
  using V = typename LanesOf<T>::Type;
  static constexpr int kSamples = P::kSamples;
  V transmittance[kSamples];
  Vec2<V> places[P::kMoves ? kSamples : 1];  ///< Of samples that move, from the pixel's centre [px].

  /// 1, or -1 outside the image.
  explicit RaySamples(const T* inside) {
    for (int s = 0; s < kSamples; ++s) {
      transmittance[s] = load(inside, V());
      if constexpr (P::kMoves) places[s] = {V(T(P::node(s).x)), V(T(P::node(s).y))};
    }
  }
  AR_HD bool any_open() const {
    V largest(T(0));
    for (int s = 0; s < kSamples; ++s) largest = max(largest, transmittance[s]);
    return bits(largest > V(T(0))) != 0;
  }

  /// What a sample that moves sees: whitened coordinates, and opacity * weight in the entry's lanes.
  struct Seen {
    Vec2<V> z;
    V raw;
  };
  template <class Terms> AR_HD Seen see(const Terms& terms, Vec2<V> at, MaskOf<V> valid, int s) const {
    const Vec2<V> z = P::whitened_node(terms, P::whitened(terms, at, 0), places[s]);
    return {z, select(valid, exp2(P::log_alpha(terms, z)), V(T(0)))};
  }
  AR_HD static Bounds<V> bounds(int s) {
    const Bounds<T> cell = P::template cell<T>(s);
    return {{V(cell.lo.x), V(cell.lo.y)}, {V(cell.hi.x), V(cell.hi.y)}};
  }
};

/// Composites an entry into all samples. visit(sample, opacity * weight, Blended) comes before a sample moves.
template <class P, typename T, class Entry, class Visit>
AR_HD void blend_entry(const RayList<P, T>& list, const Entry& entry, const int32_t* places, uint32_t lanes,
                       Vec2<typename LanesOf<T>::Type> at, RaySamples<P, T>& samples, const Visit& visit) {
  using V = typename LanesOf<T>::Type;
  if constexpr (P::kMoves) {
    const auto terms = gather_terms<P, T>(list, lanes, places);
    const MaskOf<V> valid = IndexOf<V>(int32_t(-1)) < entry.place;
    for (int s = 0; s < P::kSamples; ++s) {
      const auto seen = samples.see(terms, at, valid, s);
      Vec2<V> place = samples.places[s];
      const Blended<V> blended =
          blend_placed_sample<P>(terms, seen.z, seen.raw, samples.bounds(s), samples.transmittance[s], place);
      visit(s, seen.raw, blended);
      samples.places[s] = place;
    }
  } else {
    for (int s = 0; s < P::kSamples; ++s) visit(s, entry.raw[s], blend_sample(entry.raw[s], samples.transmittance[s]));
  }
}

/// `colors`: scratch.
template <class P, typename T> AR_ONE_COPY void blend_rays_tile(const cpu::BlendParams<T>& p, int64_t tile, T* colors) {
  using V = typename LanesOf<T>::Type;
  constexpr int kCount = LanesOf<T>::kCount, kSamples = P::kSamples;
  RayList<P, T> list(p, tile);
  const int channels = p.channels.count;
  alignas(64) T transmittance[kSamples][kTilePixels], inside[kTilePixels];
  alignas(64) const int32_t last[kSamples][kTilePixels] = {};  // The backward pass composites again.
  std::fill_n(inside, kTilePixels, T(-1));
  for_each_run<T>(list.view, p.grid,
                  [&](int first, int64_t, int count) AR_HD_LAMBDA { std::fill_n(inside + first, count, T(1)); });
  for (int pixel = 0; pixel < kTilePixels; pixel += kCount) {
    RaySamples<P, T> samples(inside + pixel);
    RayWalk<P, T> walk(list, pixel, p.order.window);
    V sums[kMaxRayChannels] = {V(T(0)), V(T(0)), V(T(0)), V(T(0))};
    const auto leave = [&](const auto& entry, uint32_t lanes) AR_HD_LAMBDA {
      alignas(64) int32_t places[kCount];
      store_index(places, entry.place);
      V contribution(T(0));
      blend_entry<P, T>(list, entry, places, lanes, walk.at, samples,
                        [&](int, V, const Blended<V>& blended)
                            AR_HD_LAMBDA { contribution = contribution + blended.contribution; });
      const uint32_t shown = bits(contribution > V(T(0)));
      alignas(64) T numbers[kMaxRayChannels][kCount] = {};
      for_each_lane(shown, [&](int lane) AR_HD_LAMBDA {
        const T* from = list[places[lane]].channels;
        for (int c = 0; c < channels; ++c) numbers[c][lane] = from[c];
      });
      for (int c = 0; c < channels; ++c) sums[c] = madd(contribution, load(numbers[c], V()), sums[c]);
      return samples.any_open();
    };
    if (samples.any_open()) walk.run(leave);
    for (int s = 0; s < kSamples; ++s) store(transmittance[s] + pixel, samples.transmittance[s]);
    for (int c = 0; c < channels; ++c) store(channels_at(colors, pixel, channels) + c * kCount, sums[c]);
  }
  store_pixels<kSamples>(p, list.view, transmittance, last, colors);
}

template <class P, typename T> void blend_rays(const cpu::BlendParams<T>& p) {
  cpu::parallel_for(p.grid.tiles(), p.threads, [&](int64_t tile, int thread) {
    blend_rays_tile<P, T>(p, tile, p.scratch + thread * int64_t(p.channels.count) * kTilePixels);
  });
}

}  // namespace ar::AR_ISA
