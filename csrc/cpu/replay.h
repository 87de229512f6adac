// The samples of a tile that move, on the way forwards and, for the backward pass, back again.
#pragma once

#include <algorithm>
#include <cstring>

#include "core/blend.h"
#include "cpu/tile.h"

namespace ar::AR_ISA {

/// The state of a tile's samples besides their transmittance: nothing, unless P moves.
template <class P, typename T, bool kMoves = P::kMoves> struct TileStates {
  using V = typename LanesOf<T>::Type;
  SampleState<V, false> at(int, int) const { return {}; }
  void set(int, int, SampleState<V, false>) {}
};
template <class P, typename T> struct TileStates<P, T, true> {
  using V = typename LanesOf<T>::Type;
  alignas(64) T x[P::kSamples][kTilePixels] = {}, y[P::kSamples][kTilePixels] = {};

  AR_HD SampleState<V, true> at(int s, int pixel) const { return {{load(x[s] + pixel, V()), load(y[s] + pixel, V())}}; }
  AR_HD void set(int s, int pixel, const SampleState<V, true>& state) {
    store(x[s] + pixel, state.moved.x);
    store(y[s] + pixel, state.moved.y);
  }
};

/// A tile on the way back.
template <class P, typename T> struct ReplayTile {
  const cpu::BlendVjpParams<T>& params;
  const TileView& view;
  const int32_t (&last)[P::kSamples][kTilePixels];  ///< pairs up to the last one composited
  const int32_t (&row_last)[kTile];                 ///< the largest of them in a row of pixels
  int64_t begin;                                    ///< of the tile's pairs
  int32_t count;
  T* memory;  ///< cpu::kReplayNumbers numbers
};

/// What blend_vjp composites once more where samples move. Nothing, where they do not.
template <class P, typename T, bool kMoves = P::kMoves> class Replay {
 public:
  explicit Replay(const ReplayTile<P, T>&) {}
  void enter(int32_t) {}
  AR_HD uint32_t rows(int) const { return ~0u; }
};

/// Transmittance and displacements in front of every pair of a tile's list, from the last to the first.
///
/// They cannot be had from those behind the pair, so the list is composited once more, and what every pair changes is
/// logged: to go back is to take the changes back. Where the log is full it begins anew; the pairs before are
/// composited again, from the nearest of a few states kept on the way, when the walk gets there. So memory does not
/// depend on the list, and a list whose changes fit the log is composited once.
template <class P, typename T> class Replay<P, T, true> {
  using V = typename LanesOf<T>::Type;
  static constexpr int kCount = LanesOf<T>::kCount, kSamples = P::kSamples;

 public:
  explicit Replay(const ReplayTile<P, T>& tile)
      : tile_(tile), spacing_((tile.count + kStates - 1) / kStates), first_(tile.count) {
    for (auto& plane : states_.transmittance) std::fill_n(plane, kTilePixels, T(1));
    if (tile.count > 0) composite(0, tile.count, true);
  }

  /// Makes transmittance() and state() those in front of pair k: for every k from the last to the first.
  void enter(int32_t k) {
    if (k < first_) {
      const int32_t kept = k / spacing_;
      std::memcpy(&states_, kept_state(kept), sizeof states_);
      composite(kept * spacing_, k + 1, false);
    }
    std::fill(std::begin(rows_), std::end(rows_), 0);
    for (; changes_ > 0; --changes_) {
      const Change& change = log()[changes_ - 1];
      if (change.pair != k) return;
      rows_[change.pixel % kTile / kCount] |= 1u << change.pixel / kTile;
      for (int s = 0; s < kSamples; ++s) {
        std::memcpy(states_.transmittance[s] + change.pixel, change.transmittance[s], sizeof change.transmittance[s]);
        std::memcpy(states_.moved.x[s] + change.pixel, change.x[s], sizeof change.x[s]);
        std::memcpy(states_.moved.y[s] + change.pixel, change.y[s], sizeof change.y[s]);
      }
    }
  }
  /// Bit r: pack c of row r holds a sample that the pair was composited into.
  AR_HD uint32_t rows(int c) const { return rows_[c]; }
  AR_HD V transmittance(int s, int pixel) const { return load(states_.transmittance[s] + pixel, V()); }
  AR_HD SampleState<V, true> state(int s, int pixel) const { return states_.moved.at(s, pixel); }

 private:
  struct States {
    alignas(64) T transmittance[kSamples][kTilePixels];
    TileStates<P, T> moved;
  };
  /// What a pair found in a pack of pixels.
  struct Change {
    int32_t pair, pixel;
    T transmittance[kSamples][kCount], x[kSamples][kCount], y[kSamples][kCount];
  };
  static constexpr int32_t kStates = 16;  ///< kept on the way
  static constexpr int64_t kBytes = cpu::kReplayNumbers * int64_t(sizeof(T));
  static constexpr int64_t kMaxChanges = (kBytes - kStates * int64_t(sizeof(States))) / int64_t(sizeof(Change));
  static constexpr int64_t kMaxOfPair = kTilePixels / kCount;
  static_assert(kMaxChanges >= kMaxOfPair, "the log must hold what one pair changes");

  std::byte* kept_state(int32_t i) const { return reinterpret_cast<std::byte*>(tile_.memory) + i * sizeof(States); }
  Change* log() const { return reinterpret_cast<Change*>(kept_state(kStates)); }

  /// From the states in front of pair `from` to those behind pair `to` - 1.
  void composite(int32_t from, int32_t to, bool keep) {
    const cpu::BlendVjpParams<T>& p = tile_.params;
    const TileView& view = tile_.view;
    const LaneIndex<T> lanes;
    const uint32_t rows_in_image = (1u << view.rows) - 1;
    first_ = from;
    changes_ = 0;
    for (int32_t k = from; k < to; ++k) {
      if (keep && k % spacing_ == 0) std::memcpy(kept_state(k / spacing_), &states_, sizeof states_);
      if (changes_ + kMaxOfPair > kMaxChanges) first_ = k, changes_ = 0;
      const auto splat = reinterpret_cast<const Splat<P, T>*>(p.splats)[p.lists.pairs[tile_.begin + k]];
      const TileMask<T> reach = reach_of(splat, view, lanes);
      const auto terms = P::terms(splat.shape, splat.opacity, {T(view.x0) - splat.mean.x, T(view.y0) - splat.mean.y});
      const IndexOf<V> index(k);
      for (int c = 0; c < TileMask<T>::kPacks; ++c) {
        const V x = load(lanes.value + c * kCount, V());
        for (uint32_t rows = reach.rows[c] & rows_in_image; rows != 0; rows &= rows - 1) {
          const int row = __builtin_ctz(rows), pixel = row * kTile + c * kCount;
          if (k >= tile_.row_last[row]) continue;
          const Vec2<V> at = {x, V(lanes.value[row])};
          V t[kSamples];
          SampleState<V, true> states[kSamples];
          uint32_t composited = 0;
          AR_UNROLL
          for (int s = 0; s < kSamples; ++s) {
            t[s] = transmittance(s, pixel);
            states[s] = state(s, pixel);
            const MaskOf<V> before = index < load_index(tile_.last[s] + pixel, V());
            composited |= bits(replay_sample<P>(terms, at, s, before, t[s], states[s]));
          }
          if (composited == 0) continue;
          Change& change = log()[changes_];
          for (int s = 0; s < kSamples; ++s) {
            std::memcpy(change.transmittance[s], states_.transmittance[s] + pixel, sizeof change.transmittance[s]);
            std::memcpy(change.x[s], states_.moved.x[s] + pixel, sizeof change.x[s]);
            std::memcpy(change.y[s], states_.moved.y[s] + pixel, sizeof change.y[s]);
            store(states_.transmittance[s] + pixel, t[s]);
            states_.moved.set(s, pixel, states[s]);
          }
          change.pair = k;
          change.pixel = pixel;
          ++changes_;
        }
      }
    }
  }

  ReplayTile<P, T> tile_;
  States states_;
  int32_t spacing_;
  int32_t first_;  ///< pair that the log begins with
  int64_t changes_ = 0;
  uint32_t rows_[TileMask<T>::kPacks] = {};
};

}  // namespace ar::AR_ISA
