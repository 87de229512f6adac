// Which pixels and tiles a splat can touch: Support, an ellipse with exact extents, which culls splats and finds tiles;
// and BoxReach, a cheaper test of boxes of pixels, for blending (docs/internals/numerics.md, "Extents of the support").
#pragma once

#include "core/footprint/registry.h"
#include "core/stages.h"

namespace ar {

/// The ellipse |w (x - mean)|^2 <= level, grown by `reach` px in x and y to cover every sample of a pixel.
template <typename T> struct Support {
  Vec2<T> mean;
  T level, reach;
  T half_width, half_height;  ///< of the bounding box, without reach [px]
  T tip;                      ///< y - mean.y at the rightmost point
  T slope;                    ///< of the centres of chords: x - mean.x = slope (y - mean.y)
  T inv_a;  ///< half chord at y: sqrt((level - (det (y - mean.y))^2 / a) / a), a = |column 1 of w|^2 = 1 / inv_a
  T det2;
};

template <typename T> AR_HD Support<T> make_support(Vec2<T> mean, const Mat2<T>& w, T level, T reach) {
  const T a = w.xx * w.xx + w.yx * w.yx, b = w.xx * w.xy + w.yx * w.yy, c = w.xy * w.xy + w.yy * w.yy;
  const T det = difference_of_products(w.xx, w.yy, w.xy, w.yx);
  const T l = level + T(kLevelSlack);
  // kLevelSlack covers approximate extents, but not an approximate slope of a needle.
  const T scale = divide(approx_sqrt(l), abs(det)), inv_a = quotient(T(1), a), root_c = approx_sqrt(c);
  return {mean,       l,     reach,    scale * root_c, scale * approx_sqrt(a), -scale * divide(b, root_c),
          -b * inv_a, inv_a, det * det};
}

template <class F, typename T> AR_HD Support<T> support_of(const Splat<F, T>& splat) {
  return make_support(splat.mean, F::ellipse(splat.shape), splat.level, T(F::kReach));
}

template <class F, typename T> AR_HD void set_shape(SplatRow<T>& row, const typename F::template Shape<T>& shape) {
  static_assert(sizeof shape == sizeof row.shape, "a Shape is an aggregate of kShapeWidth numbers");
  memcpy(row.shape, &shape, sizeof shape);
}
template <class F, typename T> AR_HD typename F::template Shape<T> shape_of(const SplatRow<T>& row) {
  typename F::template Shape<T> shape;
  memcpy(&shape, row.shape, sizeof shape);
  return shape;
}

template <typename T> AR_HD Support<T> support_of(const SplatRow<T>& row, int footprint) {
  Mat2<T> w = {};
  T reach = T(0);
  visit_footprint(footprint, Footprints{}, [&](auto f) AR_HD_LAMBDA {
    using F = decltype(f);
    w = F::ellipse(shape_of<F>(row));
    reach = T(F::kReach);
  });
  return make_support(row.mean, w, row.level, reach);
}

/// Pixel coordinates; empty if hi < lo.
template <class V> struct Span {
  V lo, hi;
};

/// The rows may lie outside the image.
template <typename T> AR_HD Span<T> rows_of(const Support<T>& s) {
  const T half = s.half_height + s.reach;
  return {s.mean.y - half, s.mean.y + half};
}

/// Exact extent in x where y is in [y0, y1].
template <typename T> AR_HD Span<T> columns_of(const Support<T>& s, T y0, T y1) {
  const T height = s.half_height, zero = T(0);
  const T lo = max(y0 - (s.mean.y + s.reach), -height), hi = min(y1 - (s.mean.y - s.reach), height);
  const T right = min(max(s.tip, lo), hi), left = min(max(-s.tip, lo), hi);
  const T half_right = approx_sqrt(max(s.level - s.det2 * right * right * s.inv_a, zero) * s.inv_a);
  const T half_left = approx_sqrt(max(s.level - s.det2 * left * left * s.inv_a, zero) * s.inv_a);
  const T far = T(1e9);
  return {select(hi < lo, far, s.mean.x + s.slope * left - half_left - s.reach),
          select(hi < lo, -far, s.mean.x + s.slope * right + half_right + s.reach)};
}

/// Without division and root: in z = w (x - mean) the ellipse is a circle, compared with a bounding box of the box.
/// Near the ellipse it may say yes.
template <typename T> struct BoxReach {
  Vec2<T> half;  ///< of the box in z
  T level;
};

/// `half`: of the boxes, with the reach of samples [px]. `distance`: the largest in x or y from a box's centre to the
/// mean [px]. The margin covers rounding of z.
template <typename T> AR_HD BoxReach<T> make_box_reach(const Mat2<T>& w, T level, Vec2<T> half, T distance) {
  const T margin = T(kBoxRounding) * distance, x = half.x + margin, y = half.y + margin;
  return {{abs(w.xx) * x + abs(w.xy) * y, abs(w.yx) * x + abs(w.yy) * y}, level + T(kLevelSlack)};
}

template <typename T, class V> AR_HD MaskOf<V> reaches_box(const BoxReach<T>& s, Vec2<V> z) {
  const V zero = V(T(0)), x = max(abs(z.x) - V(s.half.x), zero), y = max(abs(z.y) - V(s.half.y), zero);
  return madd(x, x, y * y) <= V(s.level);
}

/// Empty if last < first.
struct Range {
  int first, last;
};
template <typename T> AR_HD Range clamp_range(Span<T> span, int n) {
  // Before the conversion, which is undefined beyond the range of int.
  const T lo = max(span.lo, T(0)), hi = min(span.hi, T(n - 1));
  if (!(lo <= hi)) return {0, -1};
  return {int(std::ceil(lo)), int(std::floor(hi))};
}

template <typename T> AR_HD bool touches_image(const Support<T>& s, TileGrid grid) {
  const T half = s.half_width + s.reach;
  const Range rows = clamp_range(rows_of(s), grid.height);
  const Range columns = clamp_range(Span<T>{s.mean.x - half, s.mean.x + half}, grid.width);
  return rows.first <= rows.last && columns.first <= columns.last;
}

AR_HD Range tiles_of(Range pixels, TileGrid grid) {
  return pixels.first <= pixels.last ? Range{pixels.first >> grid.tile_bits, pixels.last >> grid.tile_bits}
                                     : Range{0, -1};
}

template <typename T> AR_HD Range tile_columns_of(const Support<T>& s, TileGrid grid, Range rows, int tile_row) {
  const int top = tile_row << grid.tile_bits, bottom = top + grid.side() - 1;
  const T y0 = T(max(top, rows.first)), y1 = T(min(bottom, rows.last));
  return tiles_of(clamp_range(columns_of(s, y0, y1), grid.width), grid);
}

/// visit(tile row, range of tile columns).
template <typename T, class Visit> AR_HD void for_each_tile_row(const Support<T>& s, TileGrid grid, Visit&& visit) {
  const Range rows = clamp_range(rows_of(s), grid.height), tile_rows = tiles_of(rows, grid);
  for (int row = tile_rows.first; row <= tile_rows.last; ++row) visit(row, tile_columns_of(s, grid, rows, row));
}

/// Unsigned integers in the order of depths >= 0. -0 counts as 0.
template <typename T> AR_HD auto depth_bits(T depth) {
  std::conditional_t<sizeof(T) == 4, uint32_t, uint64_t> bits;
  const T without_sign = depth + T(0);
  static_assert(sizeof bits == sizeof without_sign);
  memcpy(&bits, &without_sign, sizeof bits);
  return bits;
}

/// Tiles among 8x8: bit 8 r + c is row r, column c.
using TileMask = uint64_t;

struct TileBox {
  TileMask mask;  ///< from (row, column) on; 0 if there is no tile, or one outside
  int row, column, count;
};
template <typename T> AR_HD TileBox find_tiles(const Support<T>& support, TileGrid grid) {
  const Range rows = tiles_of(clamp_range(rows_of(support), grid.height), grid);
  const T half = support.half_width + support.reach;
  const Span<T> columns = {support.mean.x - half, support.mean.x + half};
  TileBox found = {0, rows.first, tiles_of(clamp_range(columns, grid.width), grid).first, 0};
  int begin = 0, end = 0;  // of all columns; by rounding one may be before `found.column`
  for_each_tile_row(support, grid, [&](int, Range range) AR_HD_LAMBDA {
    const int first = range.first - found.column, width = range.last - range.first + 1;
    uint32_t bits = 0;
    if (width > 0) {
      found.count += width;
      begin = min(begin, first), end = max(end, first + width);
      bits = ((1u << width % 32) - 1) << first % 32u;
    }
    found.mask = found.mask >> 8 | TileMask(bits) << 56;
  });
  const int count = rows.last - rows.first + 1;
  const bool fits = begin == 0 && end <= 8 && count <= 8;
  found.mask = fits && count > 0 ? found.mask >> 8 * (8 - count) : 0;
  return found;
}

template <typename T, class Visit> AR_HD void for_each_tile(const Support<T>& s, TileGrid grid, Visit&& visit) {
  for_each_tile_row(s, grid, [&](int row, Range columns) AR_HD_LAMBDA {
    for (int column = columns.first; column <= columns.last; ++column) visit(int64_t(row) * grid.columns() + column);
  });
}

}  // namespace ar
