// Tiles on the CPU: Packs lays out pixels, reach_of() finds those that a splat reaches, tile_splat() prepares a splat.
#pragma once

#include <algorithm>
#include <cstring>
#include <type_traits>

#include "core/bin.h"
#include "cpu/pack.h"
#include "cpu/prefetch.h"
#include "cpu/stages.h"

namespace ar::AR_ISA {

inline constexpr int kTilePixels = kTile * kTile;

/// Down each column of packs. A splat meets fewer of nearly square blocks than of rows.
template <typename T> struct Packs {
  static constexpr int kLanes = LanesOf<T>::kCount, kCount = kTilePixels / kLanes;
  static constexpr int kWidth = kLanes >= 8 ? 4 : kLanes >= 4 ? 2 : 1, kHeight = kLanes / kWidth;
  static constexpr int kColumns = kTile / kWidth, kRows = kTile / kHeight;  ///< Of packs.

  static constexpr int place(int x, int y) {
    return (x / kWidth * kRows + y / kHeight) * kLanes + y % kHeight * kWidth + x % kWidth;
  }
};

/// Of pixels (x, y), and first pixels of packs (left, top), for a column of packs or a load of lanes.
template <typename T> struct TilePixels {
  static constexpr int kFirst = Packs<T>::kRows < Packs<T>::kLanes ? Packs<T>::kLanes : Packs<T>::kRows;
  alignas(64) T x[kTilePixels] = {}, y[kTilePixels] = {};
  alignas(64) T left[kFirst] = {}, top[kFirst] = {};
  constexpr TilePixels() {
    for (int row = 0; row < kTile; ++row) {
      for (int column = 0; column < kTile; ++column) {
        x[Packs<T>::place(column, row)] = T(column);
        y[Packs<T>::place(column, row)] = T(row);
      }
    }
    for (int pack = 0; pack < kFirst; ++pack) {
      left[pack] = x[pack * Packs<T>::kLanes];
      top[pack] = y[pack * Packs<T>::kLanes];
    }
  }
};
template <typename T> inline constexpr TilePixels<T> kTilePixelsOf = {};

template <typename T> struct PackSet {
  static constexpr int kBits = 64;
  uint64_t words[(Packs<T>::kCount + kBits - 1) / kBits];

  /// Bit i: pack first + i.
  AR_HD void add(int first, uint64_t bits) { words[first / kBits] |= bits << first % kBits; }
  AR_HD bool has(int pack) const { return words[pack / kBits] >> pack % kBits & 1; }
  AR_HD bool is_empty() const {
    uint64_t any = 0;
    for (const uint64_t word : words) any |= word;
    return any == 0;
  }
};

/// visit(index of the first pixel) for packs in both sets.
template <typename T, class Visit>
AR_HD void for_each_pack(const PackSet<T>& a, const PackSet<T>& b, const Visit& visit) {
  constexpr int kBits = PackSet<T>::kBits;
  for (int first = 0; first < Packs<T>::kCount; first += kBits) {
    for (uint64_t word = a.words[first / kBits] & b.words[first / kBits]; word != 0; word &= word - 1)
      visit((first + __builtin_ctzll(word)) * Packs<T>::kLanes);
  }
}

struct TileView {
  int x0, y0, columns, rows;

  TileView(TileGrid grid, int64_t tile)
      : x0(int(tile % grid.columns()) * kTile),
        y0(int(tile / grid.columns()) * kTile),
        columns(std::min(kTile, grid.width - x0)),
        rows(std::min(kTile, grid.height - y0)) {}

  int64_t pixel(TileGrid grid, int row) const { return int64_t(y0 + row) * grid.width + x0; }
};

/// copy(index in tile, index in image, count) for runs of pixels that are adjacent in both.
template <typename T, class Copy> AR_HD void for_each_run(const TileView& view, TileGrid grid, const Copy& copy) {
  constexpr int kWidth = Packs<T>::kWidth;
  for (int y = 0; y < view.rows; ++y) {
    const int64_t first = view.pixel(grid, y);
    int x = 0;
    for (; x + kWidth <= view.columns; x += kWidth) copy(Packs<T>::place(x, y), first + x, kWidth);
    if (x < view.columns) copy(Packs<T>::place(x, y), first + x, view.columns - x);
  }
}

/// The tile has the layout of Packs<T>.
template <typename T, typename Number>
void load_tile(const TileView& view, TileGrid grid, const Number* image, Number* tile) {
  for_each_run<T>(view, grid, [&](int first, int64_t pixel, int count) AR_HD_LAMBDA {
    std::memcpy(tile + first, image + pixel, count * sizeof(Number));
  });
}
template <typename T, typename Number>
void store_tile(const TileView& view, TileGrid grid, const Number* tile, Number* image) {
  for_each_run<T>(view, grid, [&](int first, int64_t pixel, int count) AR_HD_LAMBDA {
    std::memcpy(image + pixel, tile + first, count * sizeof(Number));
  });
}

/// Of a pack, whose channels are adjacent: channel c is c * lanes farther.
template <typename T> AR_HD T* channels_at(T* tile, int pixel, int channels) { return tile + pixel * channels; }

template <class V, typename T> AR_HD Vec3<V> three_channels(const T* shown, bool three) {
  return three ? Vec3<V>{V(shown[0]), V(shown[1]), V(shown[2])} : Vec3<V>{V(T(0)), V(T(0)), V(T(0))};
}

/// And perhaps a few more.
template <class P, typename T> AR_HD PackSet<T> reach_of(const Splat<P, T>& splat, const TileView& view) {
  using V = typename LanesOf<T>::Type;
  constexpr int kLanes = Packs<T>::kLanes, kRows = Packs<T>::kRows, kWidth = Packs<T>::kWidth;
  constexpr int kTogether = kLanes > kRows ? kLanes / kRows : 1;  // Columns of packs per step.
  static_assert(kRows % kLanes == 0 || kLanes % kRows == 0);
  static_assert(Packs<T>::kColumns % kTogether == 0);
  const Vec2<T> middle = {T(0.5 * (kWidth - 1)), T(0.5 * (Packs<T>::kHeight - 1))};  // From a pack's first pixel.
  const Mat2<T> w = P::ellipse(splat.shape);
  const Vec2<T> origin = {T(view.x0) - splat.mean.x, T(view.y0) - splat.mean.y};
  const BoxReach<T> reach = make_box_reach(w, splat.level, {middle.x + T(P::kReach), middle.y + T(P::kReach)},
                                           T(kTile) + max(abs(origin.x), abs(origin.y)));
  const Vec2<T> first = {origin.x + middle.x, origin.y + middle.y};
  PackSet<T> reached = {};
  const auto look = [&](int pack) AR_HD_LAMBDA {  // At packs from this one on, in all columns.
    const TilePixels<T>& of_tile = kTilePixelsOf<T>;
    const Vec2<V> center = {V(first.x) + load(of_tile.left + pack, V()), V(first.y) + load(of_tile.top + pack, V())};
    const Vec2<V> z = transform(w, center);
    AR_UNROLL for (int c = 0; c < Packs<T>::kColumns; c += kTogether) {
      const T to_right = T(c * kWidth);
      reached.add(c * kRows + pack,
                  bits(reaches_box(reach, Vec2<V>{z.x + V(w.xx * to_right), z.y + V(w.yx * to_right)})));
    }
  };
  if constexpr (kLanes == 1) {  // Unrolled, this would take half of the build.
    for (int pack = 0; pack < kRows; ++pack) look(pack);
  } else {
    AR_UNROLL for (int pack = 0; pack < kRows; pack += kLanes) look(pack);
  }
  return reached;
}

template <class P, typename T> AR_HD const Splat<P, T>& splat_at(const T* splats, int32_t j) {
  return reinterpret_cast<const Splat<P, T>*>(splats)[j];
}

/// Pairs from prefetch to use.
inline constexpr int kPrefetch = 16;

/// Prepared together, so that branches over pixels are known early.
inline constexpr int kBatch = 16;

template <class P, typename T> AR_HD auto terms_in_tile(const Splat<P, T>& splat, const TileView& view) {
  const Vec2<T> origin = {T(view.x0) - splat.mean.x, T(view.y0) - splat.mean.y};
  return P::terms(splat.shape, splat.opacity, origin);
}

template <class P, typename T> struct TileSplat {
  Splat<P, T> splat;
  decltype(P::terms(splat.shape, T(1), Vec2<T>{})) terms;
  PackSet<T> reach;
};
template <class P, typename T> AR_HD TileSplat<P, T> tile_splat(const T* splats, int32_t j, const TileView& view) {
  const Splat<P, T>& splat = splat_at<P>(splats, j);
  return {splat, terms_in_tile<P>(splat, view), reach_of(splat, view)};
}

/// Per pack, pairs up to the last that the forward pass composited.
template <typename T> struct LastPairs {
  using V = typename LanesOf<T>::Type;
  alignas(64) int32_t of_pack[Packs<T>::kCount];

  /// The packs that composited pair `index` or a later one.
  AR_HD PackSet<T> from(IndexOf<V> index) const {
    PackSet<T> packs = {};
    AR_UNROLL for (int i = 0; i < Packs<T>::kCount; i += Packs<T>::kLanes)
        packs.add(i, bits(index < load_index(of_pack + i, V())));
    return packs;
  }
};

}  // namespace ar::AR_ISA
