// The rows that the op `project` returns: which Gaussians have one (measure_row), what it holds (write_row), and its
// gradient.
#pragma once

#include "core/project.h"

namespace ar {

/// Of an opacity of 1, standard deviations at which alpha has fallen to kAlphaMin.
inline constexpr double kLargestExtent = 3.33;
inline constexpr double kLargestRadius = 1e9;  ///< px, fits an int32

template <class Cam, typename T> AR_HD T depth_by(DepthKind kind, const Cam& camera, Vec3<T> view) {
  if (kind == DepthKind::kZ) return view.z;
  if (kind == DepthKind::kDistance) return sqrt(dot(view, view));
  return depth_at(camera, view);
}
template <class Cam, typename T>
AR_HD Vec3<T> depth_by_vjp(DepthKind kind, const Cam& camera, Vec3<T> view, T dL_ddepth) {
  if (kind == DepthKind::kZ) return {T(0), T(0), dL_ddepth};
  if (kind == DepthKind::kDistance) return quotient(dL_ddepth, sqrt(dot(view, view))) * view;
  return depth_vjp(camera, view, dL_ddepth);
}
/// By the depth that orders splats, which is not negative.
template <class Cam, typename T> AR_HD T order_depth(DepthKind kind, const Cam& camera, Vec3<T> view) {
  return max(depth_by(kind, camera, view), T(0));
}
template <class Cam, typename T>
AR_HD Vec3<T> shown_depth_vjp(const Cam& camera, Vec3<T> view, const RowShownGrad<T>& shown) {
  const bool behind = shown.order == DepthKind::kZ && view.z < T(0);
  Vec3<T> out = depth_by_vjp(shown.order, camera, view, behind ? T(0) : shown.depth);
  if (shown.shown != DepthKind::kNone) out += depth_by_vjp(shown.shown, camera, view, shown.shown_depth);
  return out;
}

/// Half the width and height of the ellipse where alpha is kAlphaMin, in whole px, as gsplat has them; its conic, and
/// the opacity there.
template <typename T> struct RowMeasure {
  bool drawn;  ///< Its rectangle meets the image, and the rules leave it.
  int x, y;
  Vec3<T> conic;  ///< 1/px^2
  T opacity;
};

/// Rows not drawn would show nothing: pixel centres are half a pixel beyond the ellipse or more, where an integral over
/// the pixel too is below kAlphaMin.
template <typename T>
AR_HD RowMeasure<T> measure_row(const ProjectedGaussian<T>& p, const RowRules<T>& rules, TileGrid grid) {
  const T v = rules.variance, xx = p.cov.xx + v, yy = p.cov.yy + v;
  const T det = p.cov.det + v * (p.cov.xx + p.cov.yy) + v * v;  // from the entries it would cancel
  RowMeasure<T> m = {};
  m.conic = {yy / det, -p.cov.xy / det, xx / det};
  m.opacity = rules.compensated ? p.opacity * sqrt(p.cov.det / det) : p.opacity;
  const T level = T(2) * std::log(m.opacity / T(kAlphaMin));
  if (!(level > T(0))) return m;
  const T extent = min(sqrt(level), T(kLargestExtent)), most = T(kLargestRadius);
  const T rx = min(std::ceil(extent * sqrt(xx)), most), ry = min(std::ceil(extent * sqrt(yy)), most);
  const T x = p.mean.x + T(0.5), y = p.mean.y + T(0.5);
  const bool on_image = x + rx > T(0) && x - rx < T(grid.width) && y + ry > T(0) && y - ry < T(grid.height);
  const bool left = (rx > rules.radius_clip || ry > rules.radius_clip) && p.depth > rules.near && p.depth < rules.far;
  m.drawn = on_image && left && rx > T(0) && ry > T(0);
  m.x = int(rx);
  m.y = int(ry);
  return m;
}

/// `shown`: the depth of this kind. `radius`: 3DGS's.
template <typename T>
AR_HD void write_row(const RowOutputs<T>& to, int64_t row, int64_t gaussian, const ProjectedGaussian<T>& p,
                     Vec3<T> color, T shown, int radius, const RowMeasure<T>& m) {
  const Cov2d<T>& cov = p.cov;
  to.means2d[row] = {p.mean.x + to.center, p.mean.y + to.center};
  to.cov2d[row] = {cov.xx, cov.xy, cov.yy};
  to.dets[row] = cov.det;
  to.opacities[row] = p.opacity;
  to.depths[row] = p.depth;
  if (to.features) {
    T* features = to.features + row * to.stride;
    if (to.colored) features[0] = color.x, features[1] = color.y, features[2] = color.z;
    if (to.shows_depth) features[to.stride - 1] = shown;
  }
  if (to.conics) {
    to.conics[row] = m.conic;
    to.radii[2 * row] = m.x;
    to.radii[2 * row + 1] = m.y;
    if (to.shown_opacities) to.shown_opacities[row] = m.opacity;
  } else {
    to.radii[row] = radius;
  }
  if (to.slopes) to.slopes[row] = p.slope;
  if (to.gaussian_ids) to.gaussian_ids[row] = int32_t(gaussian);
  if (to.camera_ids) to.camera_ids[row] = to.camera;
}

/// Of a table.
template <typename T> AR_HD void write_no_row(const RowOutputs<T>& to, int64_t row, int64_t gaussian) {
  const T zero = T(0);
  const ProjectedGaussian<T> nothing = {{-to.center, -to.center}, {zero, zero, zero, T(-1)}, zero, zero};
  write_row(to, row, gaussian, nothing, {zero, zero, zero}, zero, 0, RowMeasure<T>{});
}

/// Writes the row of Gaussian i, or the flag of whether it has one. `radius`: as above; 0: it is not drawn, and neither
/// `view`, the mean in camera space, nor `p` is read. Gives `p` the depth of the row.
template <class Cam, typename T>
AR_HD void write_row_or_flag(const Cam& camera, const RowRules<T>& rules, const RowOutputs<T>& to, int32_t* flags,
                             int64_t i, Vec3<T> view, ProjectedGaussian<T>& p, Vec3<T> color, int radius) {
  RowMeasure<T> measure = {};
  bool drawn = radius > 0;
  if (drawn) p.depth = order_depth(rules.order, camera, view);
  if (drawn && rules.measured) {
    measure = measure_row(p, rules, camera.grid);
    drawn = measure.drawn;
  }
  if (flags) {
    flags[i] = drawn;
    return;
  }
  const int64_t row = to.places.of(i);
  if (drawn) {
    write_row(to, row, i, p, color, to.shows_depth ? depth_by(rules.shown, camera, view) : T(0), radius, measure);
  } else if (!to.places.ends) {
    write_no_row(to, row, i);
  }
}

template <typename T> AR_HD bool has_gradient(const ProjectedRowGrads<T>& rows, int64_t row) {
  bool found = false;
  const auto look = [&](T x) { found = found || x != T(0); };
  if (rows.means2d) look(rows.means2d[row].x), look(rows.means2d[row].y);
  if (rows.cov2d) look(rows.cov2d[row].xx), look(rows.cov2d[row].xy), look(rows.cov2d[row].yy);
  if (rows.opacities) look(rows.opacities[row]);
  if (rows.depths) look(rows.depths[row]);
  if (rows.colors) look(rows.colors[row].x), look(rows.colors[row].y), look(rows.colors[row].z);
  if (rows.shown_depths) look(rows.shown_depths[row]);
  return found;
}

template <typename T> AR_HD ProjectedGrad<T> projected_grad(const ProjectedRowGrads<T>& rows, int64_t row, T opacity) {
  const T zero = T(0);
  const Vec2<T> mean = rows.means2d ? rows.means2d[row] : Vec2<T>{zero, zero};
  const Sym2<T> g = rows.cov2d ? rows.cov2d[row] : Sym2<T>{zero, zero, zero};
  return {{mean, {T(1), zero, zero, T(1)}, {g.xx, T(0.5) * g.xy, g.yy}, zero, zero, GradFrame::kPixels},
          rows.opacities ? opacity * rows.opacities[row] : zero};
}

template <typename T> AR_HD RowShownGrad<T> shown_grad(const ProjectedRowGrads<T>& rows, int64_t row) {
  const T zero = T(0);
  return {{rows.colors ? rows.colors[row] : Vec3<T>{zero, zero, zero}, rows.depths ? rows.depths[row] : zero},
          rows.shown_depths ? rows.shown_depths[row] : zero,
          rows.order,
          rows.shown_depths ? rows.shown : DepthKind::kNone};
}

}  // namespace ar
