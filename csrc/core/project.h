// Projects a Gaussian to a splat: project_gaussian makes mean, covariance, opacity and depth, shape_splat shape and
// support, splat_color the colour. project_vjp is the adjoint of all.
#pragma once

#include <type_traits>

#include "core/bin.h"
#include "core/covariance_vjp.h"
#include "core/sh.h"

namespace ar {

/// docs/internals/numerics.md, "Culling bound".
template <typename T> struct CullBounds {
  T variance;  ///< that the footprint adds [px^2]
  T level;     ///< of the support ellipse at opacity 1
};

template <typename T> CullBounds<T> cull_bounds(FootprintChoice footprint) {
  CullBounds<T> bounds = {};
  visit_footprint(footprint.index, Footprints{}, [&](auto f) AR_HD_LAMBDA {
    using F = decltype(f);
    const double support = F::support_variance(footprint.options), radius = F::radius_variance(footprint.options);
    bounds = {T(max(support, radius + std::sqrt(kRadiusMinGap))),
              T(2 * std::log(1 / kAlphaMin) + F::kExtraLevel + kLevelSlack)};
  });
  return bounds;
}

template <typename T> AR_HD T max_sigma(const Gaussians<T>& g, int64_t i) {
  if (g.cov3ds) return sqrt(g.cov3ds[i].xx + g.cov3ds[i].yy + g.cov3ds[i].zz);
  const Vec3<T> s = g.scales[i];
  return g.scale_modifier * max(abs(s.x), max(abs(s.y), abs(s.z)));
}

/// A cheap test, true for all that are kept. Writes the projected mean.
template <class Cam, typename T>
AR_HD bool may_be_visible(const Cam& camera, const Gaussians<T>& g, int64_t i, CullBounds<T> bounds,
                          ProjectedMean<T>& p) {
  const T largest = max_sigma(g, i), opacity = g.opacities[i];  // loads first, to wait once
  p = project_mean(camera, g.means[i]);
  if (!p.valid) return false;
  T variance = bounds.variance;
  if constexpr (Cam::kFull) {
    const Blur<T> blur = blur_of(camera, p.view);
    variance += blur.streak.x * blur.streak.x + blur.streak.y * blur.streak.y + blur.variance;
  }
  const T stretch = largest_stretch(camera, p.view);
  const T sigma = approx_sqrt(largest_zoom2(camera) * stretch * stretch * largest * largest + variance);
  const T level = bounds.level + (opacity > T(1) ? T(2) * std::log(opacity) : T(0));
  const T reach = T(2) + T(kReachMargin) * sigma * approx_sqrt(level);
  return p.pixel.x + reach >= T(0) && p.pixel.x - reach <= camera.size.x - T(1) && p.pixel.y + reach >= T(0) &&
         p.pixel.y - reach <= camera.size.y - T(1);
}

template <class Cam, typename T>
AR_HD bool may_be_visible(const Cam& camera, const Gaussians<T>& g, int64_t i, CullBounds<T> bounds) {
  ProjectedMean<T> mean;
  return may_be_visible(camera, g, i, bounds, mean);
}

template <typename T> struct ProjectedGaussian {
  Vec2<T> mean;  ///< px
  Cov2d<T> cov;
  T opacity;  ///< with the amplitude of a camera's blur
  T depth;
  Vec2<T> slope = {T(0), T(0)};  ///< of RayDepth (core/order.h), if the order is along rays
};

/// False if this is no covariance, or derived numbers would overflow a float.
template <typename T> AR_HD bool is_drawable(const ProjectedGaussian<T>& p) {
  const Cov2d<T>& cov = p.cov;
  return cov.det >= T(0) && cov.det < T(kMaxDet) && cov.xx >= T(0) && cov.yy >= T(0) && within(cov.xx, 1e18) &&
         within(cov.yy, 1e18) && !(p.opacity > T(kMaxOpacity));
}

/// False if it would be culled, or the depth is negative or NaN.
template <typename T> AR_HD bool read_row(const ProjectedRows<T>& rows, int64_t i, ProjectedGaussian<T>& out) {
  const Sym2<T> c = rows.cov2d[i];
  const Vec2<T> m = rows.means2d[i];
  out = {{m.x - rows.center, m.y - rows.center}, {c.xx, c.xy, c.yy, rows.dets[i]}, rows.opacities[i], rows.depths[i]};
  return within(out.mean.x, 1e9) && within(out.mean.y, 1e9) && out.depth >= T(0) && is_drawable(out);
}

template <typename T> AR_HD bool read_row(const PackedRow<T>& row, ProjectedGaussian<T>& out) {
  out = {row.mean, {row.cov.xx, row.cov.xy, row.cov.yy, row.det}, row.opacity, row.depth};
  return within(out.mean.x, 1e9) && within(out.mean.y, 1e9) && out.depth >= T(0) && is_drawable(out);
}

/// False if Gaussian i is culled: out of sight, not finite, or degenerate.
template <class Cam, typename T>
AR_HD bool project_gaussian(const Cam& camera, const Gaussians<T>& g, int64_t i, const ProjectedMean<T>& mean,
                            ProjectedGaussian<T>& out) {
  if (!mean.valid) return false;
  const Factors<T> factors = project_covariance(camera, g, i, mean.view);
  if (g.scales &&
      !(within(factors.scale.x, kMaxScale) && within(factors.scale.y, kMaxScale) && within(factors.scale.z, kMaxScale)))
    return false;
  const SeenCov<T> seen = seen_covariance(camera, g, i, mean.view, factors);
  out = {mean.pixel, seen.cov, seen.amp * g.opacities[i], depth_at(camera, mean.view)};
  // Before a blur, which must not make a degenerate Gaussian valid.
  return is_drawable(out) && !(g.opacities[i] > T(kMaxOpacity));
}

/// 3DGS's radius [px]: ceil(3 sigma) along the major axis.
template <typename T> AR_HD int splat_radius(Cov2d<T> cov, T variance) {
  const T half_gap = max(T(0.5) * eigenvalue_gap(cov), sqrt(T(kRadiusMinGap)));
  const T largest = T(0.5) * (cov.xx + cov.yy) + half_gap + variance;
  return int(min(std::ceil(T(3) * sqrt(largest)), T(1e9)));
}

/// Writes a splat without its colour, and its support if splat.level > 0. Returns 3DGS's radius, or 0 if culled
/// (outside the image, or its shape overflows).
template <typename T>
AR_HD int shape_splat(const ProjectedGaussian<T>& p, FootprintChoice footprint, TileGrid grid, SplatRow<T>& splat,
                      Support<T>* support = nullptr) {
  splat.mean = p.mean;
  splat.opacity = p.opacity;
  splat.level = T(0);
  Mat2<T> w = {};
  T level = T(0), reach = T(0), radius_variance = T(0);
  visit_footprint(footprint.index, Footprints{}, [&](auto f) AR_HD_LAMBDA {
    using F = decltype(f);
    const auto shape = F::prepare(p.cov, footprint.options);
    w = F::ellipse(shape);
    level = F::level(shape, p.opacity);
    reach = T(F::kReach);
    radius_variance = T(F::radius_variance(footprint.options));
    set_shape<F>(splat, shape);
  });
  if (!within(w.xx, kMaxWhitening) || !within(w.xy, kMaxWhitening) || !within(w.yx, kMaxWhitening) ||
      !within(w.yy, kMaxWhitening))
    return 0;
  if (!within(level, 1e6)) return 0;  // opacity <= 0 or not finite, or zero determinant
  const int radius = splat_radius(p.cov, radius_variance);
  const bool on_image = p.mean.x + T(radius) >= T(0) && p.mean.x - T(radius) <= T(grid.width - 1) &&
                        p.mean.y + T(radius) >= T(0) && p.mean.y - T(radius) <= T(grid.height - 1);
  const Support<T> found = make_support(p.mean, w, level, reach);
  const bool touches = level > T(0) && touches_image(found, grid);
  if (touches) splat.level = level;
  if (support) *support = found;
  return touches || on_image ? radius : 0;
}

/// False if the colour is not finite.
template <class Cam, typename T>
AR_HD bool splat_color(const Cam& camera, const Gaussians<T>& g, int64_t i, const Vec3<T>* sh, Vec3<T>& color) {
  if (g.colors) {
    color = g.colors[i];
  } else if (!g.shs) {
    color = {T(0), T(0), T(0)};
  } else {
    T basis[sh_count(Cam::kShDegree)] = {};
    sh_basis<Cam::kShDegree>(g.sh_degree, view_direction(camera, g.means[i]).unit, basis);
    color = sh_color<Cam::kShDegree>(g.sh_degree, basis, sh);
  }
  const bool finite = within(color.x, kMaxColor) && within(color.y, kMaxColor) && within(color.z, kMaxColor);
  if (!g.colors) color = {max(color.x, T(0)), max(color.y, T(0)), max(color.z, T(0))};
  return finite;
}

/// Writes row i if there is room. Radius 0: it touches no pixel.
template <typename T>
AR_HD void write_packed(const PackedRows<T>& to, int64_t i, const ProjectedGaussian<T>& p, Vec3<T> color, int radius) {
  const int64_t place = *to.first + to.ends[i] - 1;
  if (place < 0 || place >= to.room) return;
  PackedRow<T> row = {p.mean, {p.cov.xx, p.cov.xy, p.cov.yy}, p.opacity, p.depth, color, p.cov.det, {}};
  if (radius == 0) row.det = T(-1);
  row.id = decltype(row.id)(to.first_id + i);
  to.rows[place] = row;
  to.radii[place] = radius;
  to.ids[place] = int32_t(i);
}

/// Writes the gradient of the colour's parameters, returns that of the model's ray. `dL_dsh` may be null or `sh`.
template <class Cam, typename T, class Out>
AR_HD Vec3<T> splat_color_vjp(const Cam& camera, const Gaussians<T>& g, const Out& out, int64_t i, const Vec3<T>* sh,
                              Vec3<T>* dL_dsh, Vec3<T> dL_dcolor) {
  if (g.colors && out.colors) put(out, out.colors[i], dL_dcolor);
  if (!g.shs) return {T(0), T(0), T(0)};
  constexpr int kCount = sh_count(Cam::kShDegree);
  T basis[kCount] = {}, weight[kCount];
  const Direction<T> d = view_direction(camera, g.means[i]);
  sh_basis<Cam::kShDegree>(g.sh_degree, d.unit, basis);
  const Vec3<T> c = sh_color<Cam::kShDegree>(g.sh_degree, basis, sh);
  const Vec3<T> free = {c.x >= T(0) ? dL_dcolor.x : T(0), c.y >= T(0) ? dL_dcolor.y : T(0),
                        c.z >= T(0) ? dL_dcolor.z : T(0)};
  const int used = sh_count(g.sh_degree);
  AR_UNROLL for (int k = 0; k < kCount; ++k) weight[k] = k < used ? dot(free, sh[k]) : T(0);
  if (dL_dsh) {
    AR_UNROLL for (int k = 0; k < kCount; ++k) {
      if (k < used) dL_dsh[k] = out.adds_shs() ? dL_dsh[k] + basis[k] * free : basis[k] * free;
    }
    for (int k = used; k < g.sh_stride && !out.adds_shs(); ++k) dL_dsh[k] = {T(0), T(0), T(0)};
  }
  if (g.sh_degree == 0) return {T(0), T(0), T(0)};
  const Vec3<T> dL_dunit = sh_basis_vjp<Cam::kShDegree>(g.sh_degree, d.unit, weight);
  return d.inv_length * (dL_dunit - dot(dL_dunit, d.unit) * d.unit);
}

template <class Cam, typename T>
AR_HD int project_shape(const Cam& camera, const Gaussians<T>& g, int64_t i, const ProjectedMean<T>& mean,
                        FootprintChoice footprint, SplatRow<T>& splat, T& depth, Support<T>* support = nullptr) {
  ProjectedGaussian<T> p;
  splat.level = T(0);
  if (!project_gaussian(camera, g, i, mean, p)) return 0;
  depth = p.depth;
  return shape_splat(p, footprint, camera.grid, splat, support);
}

/// Also culls if the colour is not finite.
template <class Cam, typename T>
AR_HD int project(const Cam& camera, const Gaussians<T>& g, int64_t i, FootprintChoice footprint, SplatRow<T>& splat,
                  T& depth) {
  const int radius = project_shape(camera, g, i, project_mean(camera, g.means[i]), footprint, splat, depth);
  if (!(splat.level > T(0))) return radius;
  if (splat_color(camera, g, i, g.shs ? g.shs + i * g.sh_stride : nullptr, splat.color)) return radius;
  splat.level = T(0);
  return 0;
}

template <typename T> AR_HD void write_channels(const ChannelRows<T>& rows, int64_t i, Vec3<T> color, T depth) {
  T* row = rows.data + i * rows.stride;
  if (rows.color >= 0) row[rows.color] = color.x, row[rows.color + 1] = color.y, row[rows.color + 2] = color.z;
  if (rows.depth >= 0) row[rows.depth] = depth;
  if (rows.inverse_depth >= 0) row[rows.inverse_depth] = T(1) / depth;
}

template <typename T>
AR_HD void add_channels_vjp(const ChannelRows<const T>& rows, int64_t i, T depth, ShownGrad<T>& shown) {
  const T* row = rows.data + i * rows.stride;
  if (rows.color >= 0) shown.color += Vec3<T>{row[rows.color], row[rows.color + 1], row[rows.color + 2]};
  if (rows.depth >= 0) shown.depth += row[rows.depth];
  if (rows.inverse_depth >= 0) shown.depth -= row[rows.inverse_depth] / (depth * depth);
}

template <typename T> struct ProjectedGrad {
  SplatGrad<T> splat;
  T weighted;  ///< by the logarithm of the opacity
};

template <typename T>
AR_HD ProjectedGrad<T> projected_grad(FootprintChoice footprint, const Cov2d<T>& cov, const PairGrad<T>& sums) {
  ProjectedGrad<T> grad = {};
  grad.weighted = sums.weighted;
  visit_footprint(footprint.index, Footprints{}, [&](auto f) AR_HD_LAMBDA {
    using F = decltype(f);
    grad.splat = F::prepare_vjp(cov, F::prepare(cov, footprint.options), sums.shape, sums.weighted, footprint.options);
  });
  return grad;
}

template <typename T>
AR_HD void write_packed_grad(T* to, int width, Vec2<T> mean, Sym2<T> cov, T opacity, Vec3<T> color, Vec2<T> absolute) {
  to[kPackedMean] = mean.x, to[kPackedMean + 1] = mean.y;
  to[kPackedCov] = cov.xx, to[kPackedCov + 1] = cov.xy, to[kPackedCov + 2] = cov.yy;
  to[kPackedOpacity] = opacity;
  to[kPackedColor] = color.x, to[kPackedColor + 1] = color.y, to[kPackedColor + 2] = color.z;
  if (width > kPackedAbsolute) to[kPackedAbsolute] = absolute.x, to[kPackedAbsolute + 1] = absolute.y;
}

template <class Cam, typename T>
AR_HD Vec3<T> shown_depth_vjp(const Cam& camera, Vec3<T> view, const ShownGrad<T>& shown) {
  return depth_vjp(camera, view, shown.depth);
}

/// All but out.shs; adds a full camera's to `camera_grad`, if not null. grad_of(covariance, opacity) returns the
/// ProjectedGrad. `sh` and `dL_dsh` as for splat_color_vjp.
template <class Cam, typename T, class GradOf, class Shown, class Out>
AR_HD void project_vjp(const Cam& camera, const Gaussians<T>& g, int64_t i, const GradOf& grad_of, const Shown& shown,
                       const Vec3<T>* sh, Vec3<T>* dL_dsh, const Out& out, CameraGrad<T>* camera_grad = nullptr) {
  const ProjectedMean<T> mean = project_mean(camera, g.means[i]);
  const Factors<T> factors = project_covariance(camera, g, i, mean.view);
  const SeenCov<T> seen = seen_covariance(camera, g, i, mean.view, factors);
  const ProjectedGrad<T> projected = grad_of(seen.cov, seen.amp * g.opacities[i]);
  const SplatGrad<T>& grad = projected.splat;
  JacobianGrad<T> dL_djacobian;
  Vec3<T> dL_dview = shown_depth_vjp(camera, mean.view, shown);
  bool has_blur = false;
  if constexpr (Cam::kFull) {
    const Blur<T> blur = blur_of(camera, mean.view);
    has_blur = blur.any();
    // A blur of zero has a zero gradient (docs/internals/numerics.md, "Lens and shutter").
    if (has_blur) {
      const BlurContext<Blur<T>, T> context = {blur, blurred(factors, g, i, blur), projected.weighted};
      dL_djacobian = project_covariance_vjp(g, out, i, factors, grad, context);
      dL_dview += blur_vjp(camera, mean.view, seen_covariance_vjp(grad, context), camera_grad);
    }
  }
  if (!has_blur) dL_djacobian = project_covariance_vjp(g, out, i, factors, grad, BlurContext<NoBlur, T>{});
  dL_dview += jacobian_vjp(camera, factors.jacobian, mean.view, dL_djacobian);
  Vec3<T> dL_dmean = project_mean_vjp(camera, mean, grad.dL_dmean, dL_dview);
  const Vec3<T> dL_ddirection = splat_color_vjp(camera, g, out, i, sh, dL_dsh, shown.color);
  if constexpr (Cam::kFull) {
    if (camera_grad) {
      add_camera_vjp(camera, g.means[i], mean, grad.dL_dmean, dL_dview, factors.jacobian, dL_djacobian, dL_ddirection,
                     *camera_grad);
    }
  }
  ray_vjp(camera, dL_ddirection, dL_dmean);
  if (out.means) put(out, out.means[i], dL_dmean);
  if (out.opacities) put(out, out.opacities[i], projected.weighted / g.opacities[i]);
  if (out.means2d) {
    T* row = out.means2d + i * out.means2d_stride;
    row[0] = T(0.5) * camera.size.x * grad.dL_dmean.x;
    row[1] = T(0.5) * camera.size.y * grad.dL_dmean.y;
    for (int k = 2; k < out.means2d_stride; ++k) row[k] = T(0);
  }
}

template <typename T> AR_HD void write_mean_sums(const GaussianGrads<T>& out, int64_t i, Vec2<T> size, Vec2<T> sums) {
  if (!out.means2d || out.mean_sums == MeanSums::kNone) return;
  T* row = out.means2d + i * out.means2d_stride;
  const Vec2<T> absolute = {T(0.5) * size.x * sums.x, T(0.5) * size.y * sums.y};
  if (out.means2d_stride == 4) {
    row[2] = absolute.x;
    row[3] = absolute.y;
  } else {
    row[2] = out.mean_sums == MeanSums::kNorm ? sums.x : absolute.x + absolute.y;
  }
}

/// `dL_dsh` may be null.
template <typename T, class Out>
AR_HD void zero_grads(const Gaussians<T>& g, int64_t i, const Out& out, Vec3<T>* dL_dsh) {
  const Vec3<T> zero = {T(0), T(0), T(0)};
  if (out.adds()) {
    for (int k = 0; dL_dsh && !out.adds_shs() && k < g.sh_stride; ++k) dL_dsh[k] = zero;
    return;
  }
  if (out.means) out.means[i] = zero;
  if (out.scales) out.scales[i] = zero;
  if (out.rotations) out.rotations[i] = {T(0), T(0), T(0), T(0)};
  if (out.cov3ds) out.cov3ds[i] = {T(0), T(0), T(0), T(0), T(0), T(0)};
  if (out.opacities) out.opacities[i] = T(0);
  if (out.colors) out.colors[i] = zero;
  if (out.means2d) {
    for (int k = 0; k < out.means2d_stride; ++k) out.means2d[i * out.means2d_stride + k] = T(0);
  }
  for (int k = 0; dL_dsh && k < g.sh_stride; ++k) dL_dsh[k] = zero;
}
template <typename T, class Out> AR_HD void zero_grads(const Gaussians<T>& g, int64_t i, const Out& out) {
  zero_grads(g, i, out, out.shs ? out.shs + i * g.sh_stride : nullptr);
}

}  // namespace ar
