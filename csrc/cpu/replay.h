// The samples of a tile that move: their state while the tile is composited, in the forward pass, and composited once
// more for the backward pass, which logs the state in front of every splat.
#pragma once

#include <algorithm>
#include <cstring>

#include "core/blend.h"
#include "cpu/tile.h"

namespace ar::AR_ISA {

/// Two numbers for every sample of a tile. Nothing, unless P moves.
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

/// Where the samples of a tile are, from the centres of their pixels [px], and where they may be. Nothing, unless P
/// moves.
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
    // With one group loops over samples are unrolled, so that s is a constant, and so are the bounds.
    const Bounds<T> cell = kSamples == kGroup ? P::template cell<T>(s) : cells[s];
    return {{V(cell.lo.x), V(cell.lo.y)}, {V(cell.hi.x), V(cell.hi.y)}};
  }

  /// Samples that are composited together, one behind the other: as many as have their numbers in registers.
  static constexpr int kGroup = kSamples % 4 == 0 ? 4 : 1;

  /// The samples of a group in a pack of pixels.
  struct Group {
    Vec2<V> z[kGroup];    ///< whitened coordinates
    V log_alpha[kGroup];  ///< to base 2
  };

  /// Looks at the samples from `first` on of the pixels with the whitened coordinates z. Whether alpha may reach its
  /// minimum anywhere: no exponential is needed where it does not.
  template <class Terms> AR_HD bool look(const Terms& terms, Vec2<V> z, int first, int pixel, Group& group) const {
    V most = V(T(kLogAlphaMin - 1));
    AR_UNROLL
    for (int j = 0; j < kGroup; ++j) {
      group.z[j] = P::whitened_node(terms, z, places.at(first + j, pixel));
      group.log_alpha[j] = P::log_alpha(terms, group.z[j]);
      most = max(most, group.log_alpha[j]);
    }
    return bits(most >= V(T(kLogAlphaMin))) != 0;
  }
};

/// A tile on the way back.
template <class P, typename T> struct ReplayTile {
  const cpu::BlendVjpParams<T>& params;
  const TileView& view;
  const int32_t (&last)[P::kSamples][kTilePixels];  ///< pairs up to the last one composited
  const LastPairs<T>& pack_last;                    ///< the largest of them in a pack
  int64_t begin;                                    ///< of the tile's pairs
  int32_t count;
  T* memory;  ///< cpu::kReplayNumbers numbers
};

/// The alphas of every pair of a tile's list and the places of the samples in front of it, from the last pair to the
/// first. Nothing, unless P moves.
///
/// The places cannot be computed from those behind the pair, so the list is composited once more, and alphas and places
/// are logged where a pair was composited: the walk back looks at nothing else, and needs no exponentials. Where the
/// log is full it begins anew; the pairs before are composited again, from the nearest of a few states kept on the way,
/// when the walk gets there. So memory does not depend on the list, and a list that fits the log is composited once.
template <class P, typename T, bool kMoves = P::kMoves> class Replay {
  using V = typename LanesOf<T>::Type;
  using Places = TilePlaces<P, T>;
  static constexpr int kCount = LanesOf<T>::kCount, kSamples = P::kSamples;

 public:
  static constexpr int kGroup = Places::kGroup;

  /// What the log has of a pair in a group of samples of a pack of pixels.
  struct Found {
    int first;              ///< sample of the group
    const uint32_t* lanes;  ///< [kGroup] where the pair was composited
    const T* numbers;       ///< of the next sample

    /// opacity * I of the next sample of the group, zero where the pair was not composited, and its place in front of
    /// the pair, where it was; elsewhere `rest`.
    AR_HD void read(int j, Vec2<V> rest, V& raw, Vec2<V>& place) {
      const int stored = lanes_stored(lanes[j], V());
      raw = load_lanes(numbers, lanes[j], V(T(0)));
      place = {load_lanes(numbers + stored, lanes[j], rest.x), load_lanes(numbers + 2 * stored, lanes[j], rest.y)};
      numbers += 3 * stored;
    }
  };

  explicit Replay(const ReplayTile<P, T>& tile)
      : tile_(tile), spacing_(std::max(kMinSpacing, (tile.count + kStates - 1) / kStates)), first_(tile.count) {
    if (tile.count > 0) composite(0, tile.count, true);
  }

  /// Makes take() give what pair k found: for every k from the last to the first.
  void enter(int32_t k) {
    if (k >= first_) return;
    const int32_t kept = k / spacing_;
    samples_.places = kept_states()[kept];
    composite(kept * spacing_, k + 1, false);
  }

  AR_HD Bounds<V> bounds(int s) const { return samples_.bounds(s); }

  /// Whether there is anything to take of pair k, for which enter() was called.
  AR_HD bool has(int32_t k) const { return entries_ != 0 && end_[-entries_].pair == k; }

  /// The first pixel of the pack that take() is about, where has(k).
  AR_HD int pixel() const { return end_[-entries_].pixel; }

  /// A group of samples of this pack that the pair was composited into. The groups of a pack come one after the other.
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
  static constexpr int32_t kStates = 16;      ///< kept on the way
  static constexpr int32_t kMinSpacing = 64;  ///< pairs between them
  static constexpr int64_t kBytes = cpu::kReplayNumbers * int64_t(sizeof(T));
  static constexpr int64_t kPacksOfPair = kTilePixels / kCount;
  static constexpr int64_t kBytesOfPair =
      kPacksOfPair * int64_t(kSamples * (sizeof(Entry) + 3 * kCount * sizeof(T))) + kCount * int64_t(sizeof(T));
  static_assert(kStates * int64_t(sizeof(States)) + kBytesOfPair <= kBytes, "the log must hold what one pair finds");

  std::byte* memory() const { return reinterpret_cast<std::byte*>(tile_.memory); }
  States* kept_states() const { return reinterpret_cast<States*>(memory()); }

  /// The log. From its start, for every sample: the lanes of opacity * I and of the coordinates of its place. From its
  /// end the entries.
  void clear_log() {
    top_ = reinterpret_cast<T*>(kept_states() + kStates);
    end_ = reinterpret_cast<Entry*>(memory() + kBytes);
    entries_ = 0;
  }
  bool log_is_full() const {
    return reinterpret_cast<std::byte*>(end_ - entries_) - reinterpret_cast<std::byte*>(top_) < kBytesOfPair;
  }

  /// From the states in front of pair `from` to those behind pair `to` - 1.
  void composite(int32_t from, int32_t to, bool keep) {
    const cpu::BlendVjpParams<T>& p = tile_.params;
    const TileView& view = tile_.view;
    const int32_t* pairs = p.lists.pairs + tile_.begin;
    first_ = from;
    clear_log();
    TileSplat<P, T> batch[kBatch];
    for (int32_t first = from; first < to; first += kBatch) {
      const int count = std::min(kBatch, to - first);
      const PackSet<T> open = tile_.pack_last.behind(IndexOf<V>(first));
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

  /// Composites pair k, and logs what it finds.
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
        AR_UNROLL
        for (int j = 0; j < kGroup; ++j) {
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
  int32_t first_;  ///< pair that the log begins with
  T* top_;
  Entry* end_;
  int64_t entries_ = 0;
};
template <class P, typename T> class Replay<P, T, false> {
 public:
  explicit Replay(const ReplayTile<P, T>&) {}
};

}  // namespace ar::AR_ISA
