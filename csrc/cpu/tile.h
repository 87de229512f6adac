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

/// Copies the part of a tile that lies in the image, rows of `columns`, between image and tile.
template <typename T> void load_tile(const TileView& view, TileGrid grid, const T* image, T* tile) {
  for (int y = 0; y < view.rows; ++y)
    std::memcpy(tile + y * kTile, image + view.pixel(grid, y), view.columns * sizeof(T));
}
template <typename T> void store_tile(const TileView& view, TileGrid grid, const T* tile, T* image) {
  for (int y = 0; y < view.rows; ++y)
    std::memcpy(image + view.pixel(grid, y), tile + y * kTile, view.columns * sizeof(T));
}

/// 0, 1, 2, ... as scalars, to be loaded as lanes.
template <typename T> struct LaneIndex {
  alignas(64) T value[kTile];
  LaneIndex() {
    for (int i = 0; i < kTile; ++i) value[i] = T(i);
  }
};

/// The channels of a tile lie pack by pack: those of one pack of pixels side by side, so that whatever their number a
/// pixel's are together. Channel c of the pack that begins with `pixel` is at pixel * channels + c * lanes.
template <typename T> AR_HD T* channels_at(T* tile, int pixel, int channels) { return tile + pixel * channels; }

/// Three channels of a splat on every lane, which the loops over pixels keep in registers; zero if there are not three.
template <class V, typename T> AR_HD Vec3<V> three_channels(const T* shown, bool three) {
  return three ? Vec3<V>{V(shown[0]), V(shown[1]), V(shown[2])} : Vec3<V>{V(T(0)), V(T(0)), V(T(0))};
}

/// The packs of a tile that a splat can reach: bit r of rows[c] for pack c of row r.
template <typename T> struct TileMask {
  static constexpr int kCount = LanesOf<T>::kCount, kPacks = kTile / kCount;
  uint32_t rows[kPacks];
};

template <class P, typename T>
AR_HD TileMask<T> reach_of(const Splat<P, T>& splat, const TileView& view, const LaneIndex<T>& lanes) {
  using V = typename LanesOf<T>::Type;
  constexpr int kCount = TileMask<T>::kCount, kPacks = TileMask<T>::kPacks;
  const Support<T> support = support_of(splat);
  TileMask<T> mask = {};
  const auto look = [&](int row) AR_HD_LAMBDA {
    const V y = V(T(view.y0)) + load(lanes.value + row, V());
    const Span<V> span = P::kReach == 0 ? chord_of(support, y) : columns_of(support, y, y);
    AR_UNROLL
    for (int c = 0; c < kPacks; ++c) {
      const V first = V(T(view.x0 + c * kCount)), last = V(T(view.x0 + c * kCount + kCount - 1));
      mask.rows[c] |= bits((span.lo <= last) & (span.hi >= first)) << row;
    }
  };
  if constexpr (kCount == 1) {  // every pixel is a pack of its own: unrolled, the loop takes half of the build
    for (int row = 0; row < kTile; ++row) look(row);
  } else {
    AR_UNROLL
    for (int row = 0; row < kTile; row += kCount) look(row);
  }
  return mask;
}

/// How a tile of `adaptive` reads rows whose shape is not P's, so that the loops are compiled for P only. `collect` as
/// of a footprint, from the row. Called once per pair, through pointers.
template <class P, typename T> struct RowAdapter {
  typename P::template Shape<T> (*shape)(const SplatRow<T>& row);
  ShapeGrad<T> (*collect)(const SplatRow<T>& row, const ShapeGrad<T>& sums, T weighted);
};
template <class Box, typename T> typename PixelsOf<Box>::template Shape<T> box_shape(const SplatRow<T>& row) {
  const auto shape = shape_of<Box>(row);
  return {Box::ellipse(shape), Box::amplitude(shape)};
}
template <class Box, typename T>
ShapeGrad<T> collect_box(const SplatRow<T>& row, const ShapeGrad<T>& sums, T weighted) {
  return Box::collect(Box::terms(shape_of<Box>(row), row.opacity), sums, weighted);
}
template <class Box, typename T>
inline constexpr RowAdapter<PixelsOf<Box>, T> kAdapter = {box_shape<Box, T>, collect_box<Box, T>};

/// Row j of `splats`, as P reads it.
template <class P, typename T> AR_HD Splat<P, T> splat_at(const T* splats, int32_t j, const RowAdapter<P, T>* adapter) {
  Splat<P, T> splat = reinterpret_cast<const Splat<P, T>*>(splats)[j];
  if (adapter) splat.shape = adapter->shape(reinterpret_cast<const SplatRow<T>*>(splats)[j]);
  return splat;
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
  TileMask<T> reach;
};
template <class P, typename T>
AR_HD TileSplat<P, T> tile_splat(const T* splats, int32_t j, const RowAdapter<P, T>* adapter, const TileView& view,
                                 const LaneIndex<T>& lanes) {
  const Splat<P, T> splat = splat_at(splats, j, adapter);
  return {splat, terms_in_tile<P>(splat, view), reach_of(splat, view, lanes)};
}

/// visit(P{}, adapter) for what footprint F blends a tile with: its own pixels, or for `adaptive` those of the samples
/// that were chosen. Boxes are the lists of adaptive.h.
template <class F, class Boxes, typename T, class Visit>
void visit_tile(const int32_t* tile_samples, int64_t tile, const Visit& visit) {
  if constexpr (std::is_same_v<F, Adaptive>) {
    visit_samples(tile_samples[tile], Boxes{}, [&](auto box) {
      using Box = decltype(box);
      visit(PixelsOf<Box>{}, &kAdapter<Box, T>);
    });
  } else {
    visit(PixelsOf<F>{}, static_cast<const RowAdapter<PixelsOf<F>, T>*>(nullptr));
  }
}

}  // namespace ar::AR_ISA
