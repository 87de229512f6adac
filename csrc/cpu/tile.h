// What blend and blend_vjp share: the pixels of a tile, which of them a splat reaches, and how a tile reads splats.
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

/// How the pixels of a tile lie in memory: pack by pack, the packs of a column of the tile one behind the other. A pack
/// is a block of pixels, as square as its lanes allow, because a splat meets fewer of these than parts of rows.
template <typename T> struct Packs {
  static constexpr int kLanes = LanesOf<T>::kCount, kCount = kTilePixels / kLanes;
  static constexpr int kWidth = kLanes >= 8 ? 4 : kLanes >= 4 ? 2 : 1, kHeight = kLanes / kWidth;
  static constexpr int kColumns = kTile / kWidth, kRows = kTile / kHeight;  ///< of packs

  /// The place of the pixel in column x and row y of the tile.
  static constexpr int place(int x, int y) {
    return (x / kWidth * kRows + y / kHeight) * kLanes + y % kHeight * kWidth + x % kWidth;
  }
};

/// Column and row of the pixels of a tile. `left` and `top` are those of the first pixel of each pack, for the packs of
/// the first column and for as many more as one load of lanes reads.
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

/// A set of packs of a tile: bit i of all words for pack i.
template <typename T> struct PackSet {
  static constexpr int kBits = 64;
  uint64_t words[(Packs<T>::kCount + kBits - 1) / kBits];

  /// Adds the packs from `first` on whose bit is set.
  AR_HD void add(int first, uint64_t bits) { words[first / kBits] |= bits << first % kBits; }
  AR_HD bool is_empty() const {
    uint64_t any = 0;
    for (const uint64_t word : words) any |= word;
    return any == 0;
  }
};

/// Calls visit(place of the first pixel) for the packs that are in both sets.
template <typename T, class Visit>
AR_HD void for_each_pack(const PackSet<T>& a, const PackSet<T>& b, const Visit& visit) {
  constexpr int kBits = PackSet<T>::kBits;
  for (int first = 0; first < Packs<T>::kCount; first += kBits) {
    for (uint64_t word = a.words[first / kBits] & b.words[first / kBits]; word != 0; word &= word - 1)
      visit((first + __builtin_ctzll(word)) * Packs<T>::kLanes);
  }
}

/// The pixels of one tile, and which of them lie in the image.
struct TileView {
  int x0, y0, columns, rows;

  TileView(TileGrid grid, int64_t tile)
      : x0(int(tile % grid.columns()) * kTile),
        y0(int(tile / grid.columns()) * kTile),
        columns(std::min(kTile, grid.width - x0)),
        rows(std::min(kTile, grid.height - y0)) {}

  int64_t pixel(TileGrid grid, int row) const { return int64_t(y0 + row) * grid.width + x0; }
};

/// Calls copy(place in the tile, place in the image, count) for the pixels of a tile that lie in the image, in runs
/// that are together in both.
template <typename T, class Copy> AR_HD void for_each_run(const TileView& view, TileGrid grid, const Copy& copy) {
  constexpr int kWidth = Packs<T>::kWidth;
  for (int y = 0; y < view.rows; ++y) {
    const int64_t first = view.pixel(grid, y);
    int x = 0;
    for (; x + kWidth <= view.columns; x += kWidth) copy(Packs<T>::place(x, y), first + x, kWidth);
    if (x < view.columns) copy(Packs<T>::place(x, y), first + x, view.columns - x);
  }
}

/// Copies the part of a tile that lies in the image, between image and tile. The tile is laid out for lanes of T.
template <typename T, typename Number>
void load_tile(const TileView& view, TileGrid grid, const Number* image, Number* tile) {
  for_each_run<T>(view, grid, [&](int place, int64_t pixel, int count) AR_HD_LAMBDA {
    std::memcpy(tile + place, image + pixel, count * sizeof(Number));
  });
}
template <typename T, typename Number>
void store_tile(const TileView& view, TileGrid grid, const Number* tile, Number* image) {
  for_each_run<T>(view, grid, [&](int place, int64_t pixel, int count) AR_HD_LAMBDA {
    std::memcpy(image + pixel, tile + place, count * sizeof(Number));
  });
}

/// The channels of a tile lie pack by pack: those of one pack of pixels side by side, so that whatever their number a
/// pixel's are together. Channel c of the pack that begins with `pixel` is at pixel * channels + c * lanes.
template <typename T> AR_HD T* channels_at(T* tile, int pixel, int channels) { return tile + pixel * channels; }

/// Three channels of a splat on every lane, which the loops over pixels keep in registers; zero if there are not three.
template <class V, typename T> AR_HD Vec3<V> three_channels(const T* shown, bool three) {
  return three ? Vec3<V>{V(shown[0]), V(shown[1]), V(shown[2])} : Vec3<V>{V(T(0)), V(T(0)), V(T(0))};
}

/// The packs of a tile that a splat reaches, and perhaps some that it passes closely.
template <class P, typename T> AR_HD PackSet<T> reach_of(const Splat<P, T>& splat, const TileView& view) {
  using V = typename LanesOf<T>::Type;
  constexpr int kLanes = Packs<T>::kLanes, kRows = Packs<T>::kRows, kWidth = Packs<T>::kWidth;
  constexpr int kTogether = kLanes > kRows ? kLanes / kRows : 1;  // columns of packs that are looked at together
  static_assert(kRows % kLanes == 0 || kLanes % kRows == 0);
  static_assert(Packs<T>::kColumns % kTogether == 0);
  const Vec2<T> middle = {T(0.5 * (kWidth - 1)), T(0.5 * (Packs<T>::kHeight - 1))};  // of a pack, from its first pixel
  const Mat2<T> w = P::ellipse(splat.shape);
  const Vec2<T> origin = {T(view.x0) - splat.mean.x, T(view.y0) - splat.mean.y};
  const BoxReach<T> reach = make_box_reach(w, splat.level, {middle.x + T(P::kReach), middle.y + T(P::kReach)},
                                           T(kTile) + max(abs(origin.x), abs(origin.y)));
  const Vec2<T> first = {origin.x + middle.x, origin.y + middle.y};
  PackSet<T> reached = {};
  const auto look = [&](int pack) AR_HD_LAMBDA {  // at the packs from this one on, and those as high in other columns
    const TilePixels<T>& of_tile = kTilePixelsOf<T>;
    const Vec2<V> center = {V(first.x) + load(of_tile.left + pack, V()), V(first.y) + load(of_tile.top + pack, V())};
    const Vec2<V> z = transform(w, center);
    AR_UNROLL
    for (int c = 0; c < Packs<T>::kColumns; c += kTogether) {
      const T to_right = T(c * kWidth);
      reached.add(c * kRows + pack,
                  bits(reaches_box(reach, Vec2<V>{z.x + V(w.xx * to_right), z.y + V(w.yx * to_right)})));
    }
  };
  if constexpr (kLanes == 1) {  // every pixel is a pack of its own: unrolled, the loop takes half of the build
    for (int pack = 0; pack < kRows; ++pack) look(pack);
  } else {
    AR_UNROLL
    for (int pack = 0; pack < kRows; pack += kLanes) look(pack);
  }
  return reached;
}

/// Row j of `splats`.
template <class P, typename T> AR_HD const Splat<P, T>& splat_at(const T* splats, int32_t j) {
  return reinterpret_cast<const Splat<P, T>*>(splats)[j];
}

/// So many pairs before a splat is read, its row is asked for.
inline constexpr int kPrefetch = 16;

/// So many pairs of a list are prepared, then composited: where the loops over pixels branch is known before they come.
inline constexpr int kBatch = 16;

/// What P needs of a splat to blend it into the pixels of a tile, counted from the tile's first.
template <class P, typename T> AR_HD auto terms_in_tile(const Splat<P, T>& splat, const TileView& view) {
  const Vec2<T> origin = {T(view.x0) - splat.mean.x, T(view.y0) - splat.mean.y};
  return P::terms(splat.shape, splat.opacity, origin);
}

/// A splat in a tile.
template <class P, typename T> struct TileSplat {
  Splat<P, T> splat;
  decltype(P::terms(splat.shape, T(1), Vec2<T>{})) terms;
  PackSet<T> reach;
};
template <class P, typename T> AR_HD TileSplat<P, T> tile_splat(const T* splats, int32_t j, const TileView& view) {
  const Splat<P, T>& splat = splat_at<P>(splats, j);
  return {splat, terms_in_tile<P>(splat, view), reach_of(splat, view)};
}

/// Of every pack the number of pairs up to the last one that the forward pass composited into one of its samples.
template <typename T> struct LastPairs {
  using V = typename LanesOf<T>::Type;
  alignas(64) int32_t of_pack[Packs<T>::kCount];

  /// The packs with a sample that composited the pair at `index`, or one behind it.
  AR_HD PackSet<T> behind(IndexOf<V> index) const {
    PackSet<T> packs = {};
    AR_UNROLL
    for (int i = 0; i < Packs<T>::kCount; i += Packs<T>::kLanes)
      packs.add(i, bits(index < load_index(of_pack + i, V())));
    return packs;
  }
};

}  // namespace ar::AR_ISA
