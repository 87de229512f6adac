// Samples that move: TilePlaces is their state. Replay composites a tile again for blend_vjp.h and logs alphas and
// positions, which do not follow from later ones.
#pragma once

#include <algorithm>
#include <cstring>

#include "core/blend.h"
#include "cpu/tile.h"

namespace ar::AR_ISA {

/// Two numbers per sample of a tile. Empty unless P moves.
template <class P, typename T, bool kMoves = P::kMoves> struct TilePairs {};
template <class P, typename T> struct TilePairs<P, T, true> {
  using V = typename LanesOf<T>::Type;
  alignas(64) T x[P::kSamples][kTilePixels], y[P::kSamples][kTilePixels];

  AR_HD Vec2<V> at(int s, int pixel) const { return {load(x[s] + pixel, V()), load(y[s] + pixel, V())}; }
  AR_HD void set(int s, int pixel, Vec2<V> pair) {
    store(x[s] + pixel, pair.x);
    store(y[s] + pixel, pair.y);
  }
};

/// Positions of samples [px] from the centres of their pixels. Empty unless P moves.
template <class P, typename T, bool kMoves = P::kMoves> struct TilePlaces {};
template <class P, typename T> struct TilePlaces<P, T, true> {
  using V = typename LanesOf<T>::Type;
  static constexpr int kCount = LanesOf<T>::kCount, kSamples = P::kSamples;
  TilePairs<P, T> places;
  Bounds<T> cells[kSamples];

  TilePlaces() {
    for (int s = 0; s < kSamples; ++s) {
      std::fill_n(places.x[s], kTilePixels, T(P::node(s).x));
      std::fill_n(places.y[s], kTilePixels, T(P::node(s).y));
      cells[s] = P::template cell<T>(s);
    }
  }

  AR_HD Bounds<V> bounds(int s) const {
    const Bounds<T> cell = kSamples == kGroup ? P::template cell<T>(s) : cells[s];
    return {{V(cell.lo.x), V(cell.lo.y)}, {V(cell.hi.x), V(cell.hi.y)}};
  }

  /// Samples in registers together.
  static constexpr int kGroup = kSamples % 4 == 0 ? 4 : 1;

  /// A group in a pack of pixels.
  struct Group {
    Vec2<V> z[kGroup];    ///< Whitened coordinates.
    V log_alpha[kGroup];  ///< To base 2.
  };

  /// For whitened pixels z. False if no alpha reaches its minimum.
  template <class Terms> AR_HD bool look(const Terms& terms, Vec2<V> z, int first, int pixel, Group& group) const {
    V most = V(T(kLogAlphaMin - 1));
    AR_UNROLL for (int j = 0; j < kGroup; ++j) {
      group.z[j] = P::whitened_node(terms, z, places.at(first + j, pixel));
      group.log_alpha[j] = P::log_alpha(terms, group.z[j]);
      most = max(most, group.log_alpha[j]);
    }
    return bits(most >= V(T(kLogAlphaMin))) != 0;
  }
};

template <class P, typename T> struct ReplayTile {
  const cpu::BlendVjpParams<T>& params;
  const TileView& view;
  const int32_t (&last)[P::kSamples][kTilePixels];  ///< Pairs up to the last composited.
  const LastPairs<T>& pack_last;                    ///< The largest of a pack.
  int64_t begin;                                    ///< First pair.
  int32_t count;
  T* memory;  ///< [cpu::kReplayNumbers].
};

/// Alphas, and positions before each pair, from the last pair of a tile to the first. Empty unless P moves.
///
/// The walk back needs no exponentials. A full log begins anew: earlier pairs are composited again from the nearest of
/// kStates states. So memory does not depend on the list.
template <class P, typename T, bool kMoves = P::kMoves> class Replay {
  using V = typename LanesOf<T>::Type;
  using Places = TilePlaces<P, T>;
  static constexpr int kCount = LanesOf<T>::kCount, kSamples = P::kSamples;

 public:
  static constexpr int kGroup = Places::kGroup;

  struct Found {
    int first;              ///< Sample.
    const uint32_t* lanes;  ///< [kGroup] where the pair was composited.
    const T* numbers;       ///< Of the next sample.

    /// Of the next sample. Zero and `otherwise` where the pair was not composited.
    AR_HD void read(int j, Vec2<V> otherwise, V& raw, Vec2<V>& place) {
      const int stored = lanes_stored(lanes[j], V());
      raw = load_lanes(numbers, lanes[j], V(T(0)));
      place = {load_lanes(numbers + stored, lanes[j], otherwise.x),
               load_lanes(numbers + 2 * stored, lanes[j], otherwise.y)};
      numbers += 3 * stored;
    }
  };

  explicit Replay(const ReplayTile<P, T>& tile)
      : tile_(tile), spacing_(std::max(kMinSpacing, (tile.count + kStates - 1) / kStates)), first_(tile.count) {
    if (tile.count > 0) composite(0, tile.count, true);
  }

  /// For every k, last first, before take().
  void enter(int32_t k) {
    if (k >= first_) return;
    const int32_t kept = k / spacing_;
    samples_.places = kept_states()[kept];
    composite(kept * spacing_, k + 1, false);
  }

  AR_HD Bounds<V> bounds(int s) const { return samples_.bounds(s); }

  AR_HD bool has(int32_t k) const { return entries_ != 0 && end_[-entries_].pair == k; }

  AR_HD int pixel() const { return end_[-entries_].pixel; }

  /// A group that the pair was composited into, pack by pack.
  AR_HD Found take() {
    const Entry& entry = end_[-entries_--];
    for (const uint32_t lanes : entry.lanes) top_ -= 3 * lanes_stored(lanes, V());
    return {entry.first, entry.lanes, top_};
  }

 private:
  struct Entry {
    int32_t pair;
    uint16_t pixel, first;
    uint32_t lanes[kGroup];
  };
  using States = TilePairs<P, T>;
  static constexpr int32_t kStates = 16;
  static constexpr int32_t kMinSpacing = 64;  ///< Pairs between states.
  static constexpr int64_t kBytes = cpu::kReplayNumbers * int64_t(sizeof(T));
  static constexpr int64_t kPacksOfPair = kTilePixels / kCount;
  static constexpr int64_t kBytesOfPair =
      kPacksOfPair * int64_t(kSamples * (sizeof(Entry) + 3 * kCount * sizeof(T))) + kCount * int64_t(sizeof(T));
  static_assert(kStates * int64_t(sizeof(States)) + kBytesOfPair <= kBytes, "the log must hold what one pair finds");

  std::byte* memory() const { return reinterpret_cast<std::byte*>(tile_.memory); }
  States* kept_states() const { return reinterpret_cast<States*>(memory()); }

  /// Numbers are at its start, entries at its end.
  void clear_log() {
    top_ = reinterpret_cast<T*>(kept_states() + kStates);
    end_ = reinterpret_cast<Entry*>(memory() + kBytes);
    entries_ = 0;
  }
  bool log_is_full() const {
    return reinterpret_cast<std::byte*>(end_ - entries_) - reinterpret_cast<std::byte*>(top_) < kBytesOfPair;
  }

  void composite(int32_t from, int32_t to, bool keep) {
    const cpu::BlendVjpParams<T>& p = tile_.params;
    const TileView& view = tile_.view;
    const int32_t* pairs = p.lists.pairs + tile_.begin;
    first_ = from;
    clear_log();
    TileSplat<P, T> batch[kBatch];
    for (int32_t first = from; first < to; first += kBatch) {
      const int count = std::min(kBatch, to - first);
      const PackSet<T> open = tile_.pack_last.from(IndexOf<V>(first));
      for (int i = 0; i < count; ++i) {
        if (first + i + kPrefetch < to) prefetch_splat(p.splats, pairs[first + i + kPrefetch]);
        batch[i] = tile_splat<P>(p.splats, pairs[first + i], view);
      }
      for (int32_t k = first; k < first + count; ++k) {
        if (keep && k % spacing_ == 0) kept_states()[k / spacing_] = samples_.places;
        if (log_is_full()) first_ = k, clear_log();
        find(batch[k - first], k, open);
      }
    }
  }

  AR_HD void find(const TileSplat<P, T>& splat, int32_t k, const PackSet<T>& open) {
    const auto& terms = splat.terms;
    T* top = top_;
    const IndexOf<V> index(k);
    for_each_pack(splat.reach, open, [&](int pixel) AR_HD_LAMBDA {
      const Vec2<V> at = {load(kTilePixelsOf<T>.x + pixel, V()), load(kTilePixelsOf<T>.y + pixel, V())};
      const Vec2<V> z = P::whitened(terms, at, 0);
      for (int group_first = 0; group_first < kSamples; group_first += kGroup) {
        typename Places::Group group;
        if (!samples_.look(terms, z, group_first, pixel, group)) continue;
        Entry& entry = end_[-entries_ - 1];
        uint32_t composited = 0;
        AR_UNROLL for (int j = 0; j < kGroup; ++j) {
          const int s = group_first + j;
          const V raw = exp2(group.log_alpha[j]);
          const MaskOf<V> mask = (raw >= V(T(kAlphaMin))) & (index < load_index(tile_.last[s] + pixel, V()));
          const uint32_t lanes = bits(mask);
          entry.lanes[j] = lanes;
          if (lanes == 0) continue;
          const V found = select(mask, raw, V(T(0)));
          const Vec2<V> place = samples_.places.at(s, pixel);
          const int stored = lanes_stored(lanes, V());
          store_lanes(top, lanes, found);
          store_lanes(top + stored, lanes, place.x);
          store_lanes(top + 2 * stored, lanes, place.y);
          top += 3 * stored;
          composited |= lanes;
          const V alpha = min(found, V(T(kAlphaMax)));
          samples_.places.set(s, pixel, P::move_in(terms, group.z[j], alpha, mask, place, samples_.bounds(s)));
        }
        entry.pair = k;
        entry.pixel = pixel;
        entry.first = group_first;
        entries_ += composited != 0;
      }
    });
    top_ = top;
  }

  ReplayTile<P, T> tile_;
  TilePlaces<P, T> samples_;
  int32_t spacing_;
  int32_t first_;  ///< Pair of the log.
  T* top_;
  Entry* end_;
  int64_t entries_ = 0;
};
template <class P, typename T> class Replay<P, T, false> {
 public:
  explicit Replay(const ReplayTile<P, T>&) {}
};

}  // namespace ar::AR_ISA
