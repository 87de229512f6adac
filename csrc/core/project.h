// One Gaussian to one splat: cov3d, EWA projection [EWA, Eq. 29-31], colour; and back.
#pragma once

#include "core/bin.h"
#include "core/params.h"
#include "core/sh.h"

namespace ar {

/// Row r of a matrix stored transposed.
template <typename T> AR_HD Vec4<T> matrix_row(const T* m, int r) { return {m[r], m[4 + r], m[8 + r], m[12 + r]}; }

template <typename T> AR_HD Camera<T> load_camera(const CameraView<T>& c) {
  const T two = T(2), clamp = T(kFrustumClamp);
  return {matrix_row(c.view, 0),
          matrix_row(c.view, 1),
          matrix_row(c.view, 2),
          matrix_row(c.proj, 0),
          matrix_row(c.proj, 1),
          matrix_row(c.proj, 3),
          {c.position[0], c.position[1], c.position[2]},
          {T(c.width), T(c.height)},
          {T(c.width) / (two * c.tan_half_fov_x), T(c.height) / (two * c.tan_half_fov_y)},
          {clamp * c.tan_half_fov_x, clamp * c.tan_half_fov_y},
          {c.width, c.height}};
}

template <typename T> AR_HD Vec3<T> xyz(Vec4<T> v) { return {v.x, v.y, v.z}; }
template <typename T> AR_HD T apply_row(Vec4<T> row, Vec3<T> p) { return dot(xyz(row), p) + row.w; }

/// The mean in the image, and what the chain rule needs of the way there.
template <typename T> struct ProjectedMean {
  Vec3<T> view;  ///< camera space; z is the depth
  Vec2<T> ndc;
  T clip_w;
  Vec2<T> pixel;
  bool valid;  ///< in front of the near plane, and finite
};

template <typename T> AR_HD ProjectedMean<T> project_mean(const Camera<T>& camera, Vec3<T> mean) {
  ProjectedMean<T> p;
  p.view = {apply_row(camera.view_x, mean), apply_row(camera.view_y, mean), apply_row(camera.view_z, mean)};
  p.clip_w = apply_row(camera.clip_w, mean);
  const T inv_w = T(1) / p.clip_w;
  p.ndc = {inv_w * apply_row(camera.clip_x, mean), inv_w * apply_row(camera.clip_y, mean)};
  p.pixel = {T(0.5) * ((p.ndc.x + T(1)) * camera.size.x - T(1)), T(0.5) * ((p.ndc.y + T(1)) * camera.size.y - T(1))};
  p.valid = p.view.z > T(kNear) && p.clip_w > T(0) && within(p.view.x, 1e18) && within(p.view.y, 1e18) &&
            within(p.view.z, 1e18) && within(p.pixel.x, 1e9) && within(p.pixel.y, 1e9);
  return p;
}

template <typename T>
AR_HD Vec3<T> project_mean_vjp(const Camera<T>& camera, const ProjectedMean<T>& p, Vec2<T> dL_dpixel,
                               Vec3<T> dL_dview) {
  const Vec3<T> px = xyz(camera.clip_x), py = xyz(camera.clip_y), pw = xyz(camera.clip_w);
  const T gx = T(0.5) * camera.size.x * dL_dpixel.x / p.clip_w, gy = T(0.5) * camera.size.y * dL_dpixel.y / p.clip_w;
  return gx * px + gy * py - (gx * p.ndc.x + gy * p.ndc.y) * pw + dL_dview.x * xyz(camera.view_x) +
         dL_dview.y * xyz(camera.view_y) + dL_dview.z * xyz(camera.view_z);
}

/// No smaller than the largest standard deviation of Gaussian i.
template <typename T> AR_HD T max_sigma(const Gaussians<T>& g, int64_t i) {
  if (g.cov3ds) return sqrt(g.cov3ds[i].xx + g.cov3ds[i].yy + g.cov3ds[i].zz);
  const Vec3<T> s = g.scales[i];
  return g.scale_modifier * max(abs(s.x), max(abs(s.y), abs(s.z)));
}

/// Whether Gaussian i may touch the image, from its mean and its largest standard deviation: cheap,
/// and never false for one that project() keeps. `blur` is the largest variance a footprint adds.
template <typename T> AR_HD bool may_be_visible(const Camera<T>& camera, const Gaussians<T>& g, int64_t i, T blur) {
  const T largest = max_sigma(g, i), opacity = g.opacities[i];  // loads first: they wait together
  const ProjectedMean<T> p = project_mean(camera, g.means[i]);
  if (!p.valid) return false;
  // |J| <= f/z |(1, 0, -x/z; 0, 1, -y/z)| <= f/z sqrt(1 + (x/z)^2 + (y/z)^2), with x/z and y/z clamped
  const T stretch = max(camera.focal.x, camera.focal.y) / p.view.z *
                    sqrt(T(1) + camera.limit.x * camera.limit.x + camera.limit.y * camera.limit.y);
  const T sigma = sqrt(stretch * stretch * largest * largest + blur);
  const T level = T(kMaxLevel) + (opacity > T(1) ? T(2) * std::log(opacity) : T(0));
  const T reach = T(2) + sigma * sqrt(level);
  return p.pixel.x + reach >= T(0) && p.pixel.x - reach <= camera.size.x - T(1) && p.pixel.y + reach >= T(0) &&
         p.pixel.y - reach <= camera.size.y - T(1);
}

/// The linear part of the projection at a mean: rows of A = J W, world units to px.
template <typename T> struct Jacobian {
  Vec3<T> x, y;
  T ratio_x, ratio_y;  ///< x/z and y/z, clamped
  bool clamped_x, clamped_y;
};

template <typename T> AR_HD Jacobian<T> make_jacobian(const Camera<T>& camera, Vec3<T> view) {
  Jacobian<T> j;
  const T rx = view.x / view.z, ry = view.y / view.z;
  j.ratio_x = min(max(rx, -camera.limit.x), camera.limit.x);
  j.ratio_y = min(max(ry, -camera.limit.y), camera.limit.y);
  j.clamped_x = j.ratio_x != rx;
  j.clamped_y = j.ratio_y != ry;
  const Vec3<T> depth = xyz(camera.view_z);
  j.x = (camera.focal.x / view.z) * (xyz(camera.view_x) - j.ratio_x * depth);
  j.y = (camera.focal.y / view.z) * (xyz(camera.view_y) - j.ratio_y * depth);
  return j;
}

/// `dL_dlog_size` = dL_dx . j.x + dL_dy . j.y, the gradient by the logarithm of all of J.
template <typename T>
AR_HD Vec3<T> jacobian_vjp(const Camera<T>& camera, const Jacobian<T>& j, Vec3<T> view, Vec3<T> dL_dx, Vec3<T> dL_dy,
                           T dL_dlog_size) {
  const Vec3<T> depth = xyz(camera.view_z);
  const T by_ratio_x = -(camera.focal.x / view.z) * dot(dL_dx, depth),
          by_ratio_y = -(camera.focal.y / view.z) * dot(dL_dy, depth);
  Vec3<T> g = {T(0), T(0), -dL_dlog_size / view.z};
  // Where the ratio is clamped it is constant: its gradient is zero, in z too.
  if (!j.clamped_x) {
    g.x += by_ratio_x / view.z;
    g.z -= by_ratio_x * j.ratio_x / view.z;
  }
  if (!j.clamped_y) {
    g.y += by_ratio_y / view.z;
    g.z -= by_ratio_y * j.ratio_y / view.z;
  }
  return g;
}

/// A unit quaternion, and what normalising it divided by.
template <typename T> struct UnitQuaternion {
  T w, x, y, z;
  T inv_norm;  ///< no more than kMaxQuaternionGrad; 0 for a zero quaternion: the identity, without gradient
};

/// Deviates from 3DGS, which expects unit quaternions from the caller: any length survives.
template <typename T> AR_HD UnitQuaternion<T> normalize_quaternion(Vec4<T> q) {
  // Vec4 (x, y, z, w) holds the quaternion's (w, x, y, z). Dividing by the largest first keeps the
  // squares of tiny and huge ones in range.
  const T largest = max(max(abs(q.x), abs(q.y)), max(abs(q.z), abs(q.w)));
  // max() may drop a NaN; the sum does not.
  if (abs(q.x) + abs(q.y) + abs(q.z) + abs(q.w) == T(0)) return {T(1), T(0), T(0), T(0), T(0)};
  const T w = q.x / largest, x = q.y / largest, y = q.z / largest, z = q.w / largest;
  const T inv = T(1) / sqrt(w * w + x * x + y * y + z * z);
  return {w * inv, x * inv, y * inv, z * inv, min(inv / largest, T(kMaxQuaternionGrad))};
}

template <typename T> AR_HD Mat3<T> rotation_matrix(UnitQuaternion<T> q) {
  const T two = T(2), one = T(1);
  return {{{one - two * (q.y * q.y + q.z * q.z), two * (q.x * q.y - q.w * q.z), two * (q.x * q.z + q.w * q.y)},
           {two * (q.x * q.y + q.w * q.z), one - two * (q.x * q.x + q.z * q.z), two * (q.y * q.z - q.w * q.x)},
           {two * (q.x * q.z - q.w * q.y), two * (q.y * q.z + q.w * q.x), one - two * (q.x * q.x + q.y * q.y)}}};
}

/// Gradient by the quaternion as given, stored like it, from that by a turn about the axes it turns to:
/// R <- R exp([turn]x). It has no component along the quaternion.
template <typename T> AR_HD Vec4<T> rotation_vjp(UnitQuaternion<T> q, Vec3<T> dL_dturn) {
  const Vec3<T> raw = (T(2) * q.inv_norm) * dL_dturn;
  const T limit = T(kMaxQuaternionGrad);
  const Vec3<T> t = {max(min(raw.x, limit), -limit), max(min(raw.y, limit), -limit), max(min(raw.z, limit), -limit)};
  return {-q.x * t.x - q.y * t.y - q.z * t.z, q.w * t.x + q.y * t.z - q.z * t.y, q.w * t.y + q.z * t.x - q.x * t.z,
          q.w * t.z + q.x * t.y - q.y * t.x};
}

/// Factors of the projected covariance of one Gaussian. From scale and rotation: Sigma = V V^T with
/// V = A R S. From cov3d: Sigma = A cov3d A^T.
template <typename T> struct Factors {
  Jacobian<T> jacobian;
  UnitQuaternion<T> quaternion;
  Mat3<T> rotation;
  Vec3<T> scale;               ///< with the scale modifier
  Vec3<T> turned_x, turned_y;  ///< rows of A R
  Vec3<T> row_x, row_y;        ///< rows of V
  Vec3<T> normal;              ///< row_x x row_y: det Sigma = |normal|^2, without cancellation
  Cov2d<T> cov;
};

template <typename T> AR_HD Vec3<T> adjugate_times(const Sym3<T>& m, Vec3<T> v) {
  const Sym3<T> adj = {difference_of_products(m.yy, m.zz, m.yz, m.yz), difference_of_products(m.xz, m.yz, m.xy, m.zz),
                       difference_of_products(m.xy, m.yz, m.xz, m.yy), difference_of_products(m.xx, m.zz, m.xz, m.xz),
                       difference_of_products(m.xy, m.xz, m.xx, m.yz), difference_of_products(m.xx, m.yy, m.xy, m.xy)};
  return adj * v;
}

template <typename T>
AR_HD Factors<T> project_covariance(const Camera<T>& camera, const Gaussians<T>& g, int64_t i, Vec3<T> view) {
  Factors<T> f;
  f.jacobian = make_jacobian(camera, view);
  const Vec3<T>&ax = f.jacobian.x, &ay = f.jacobian.y;
  if (g.cov3ds) {
    const Sym3<T>& c = g.cov3ds[i];
    const Vec3<T> cx = c * ax, cy = c * ay, n = cross(ax, ay);
    f.cov = {dot(ax, cx), dot(ax, cy), dot(ay, cy), dot(n, adjugate_times(c, n))};
    // The entries of a needle, rounded to float, make no covariance any more but by this little.
    if (f.cov.det < T(0) && f.cov.det >= T(-kSingular) * f.cov.xx * f.cov.yy) f.cov.det = T(0);
  } else {
    f.quaternion = normalize_quaternion(g.rotations[i]);
    f.rotation = rotation_matrix(f.quaternion);
    f.scale = g.scale_modifier * g.scales[i];
    f.turned_x = combine_rows(ax, f.rotation);
    f.turned_y = combine_rows(ay, f.rotation);
    f.row_x = mul(f.turned_x, f.scale);
    f.row_y = mul(f.turned_y, f.scale);
    f.normal = cross(f.row_x, f.row_y);
    f.cov = {dot(f.row_x, f.row_x), dot(f.row_x, f.row_y), dot(f.row_y, f.row_y), dot(f.normal, f.normal)};
  }
  return f;
}

/// H_kl = t_k . dL/dSigma t_l of the columns t_k of A R, which hold the gradient of all that Sigma = A R S^2 R^T A^T is
/// made of; and dL/dSigma t_k, as two rows.
template <typename T> struct TurnedGrad {
  Vec3<T> diagonal, off;  ///< H_kk; H_12, H_20, H_01
  Vec3<T> x, y;
  Vec3<T> pull_x, pull_y;  ///< another part of x and y, times s_k
};

/// Every product is taken in coordinates, whitened or of the factors, where its terms do not cancel: errors grow
/// neither with the length of a needle outside the image nor with the size of a splat.
template <typename T> AR_HD TurnedGrad<T> turned_vjp(const Factors<T>& f, const SplatGrad<T>& grad) {
  const Vec3<T>&tx = f.turned_x, &ty = f.turned_y, zero = {T(0), T(0), T(0)};
  const Mat2<T>& w = grad.w;
  const Sym2<T>& g = grad.dL_dwhite;
  // b_k = adj(Sigma) t_k, a sum of two terms: across a needle's long axis t_k it is as small as the needle is thin.
  const Vec3<T> square = mul(f.scale, f.scale), m = cross(tx, ty);
  const Vec3<T> bx = cross(mul(square, ty), m), by = cross(m, mul(square, tx));
  const T v = grad.variance;
  Vec3<T> qx, qy;  // w t_k
  if (grad.triangular) {
    // The second row of whiten() takes from one row of V its projection on the other, (b + v t) / wide.
    const bool wide_x = w.xx != T(0);
    const T along = w.xx + w.xy, across = (wide_x ? w.yy : w.yx) * along * along;
    qx = along * (wide_x ? tx : ty);
    qy = across * (wide_x ? by + v * ty : bx + v * tx);
  } else {
    qx = w.xx * tx + w.xy * ty;
    qy = w.yx * tx + w.yy * ty;
  }
  const Vec3<T> ex = g.xx * qx + g.xy * qy, ey = g.xy * qx + g.yy * qy;
  TurnedGrad<T> h = {mul(qx, ex) + mul(qy, ey), zero, zero, zero, zero, zero};
  if (!grad.triangular) {
    // (w t_k).(w t_l) = t_k . Sigma^-1 t_l is known without w. A window that holds all of a thin needle's width
    // gives much of it, g.yy, which no turn changes: products of w would leave eps (s1/s2)^2 of it.
    const T c = f.cov.det > T(0) ? g.yy / f.cov.det : T(0);
    const Vec3<T> rx = (g.xx - g.yy) * qx + g.xy * qy, ry = g.xy * qx;
    h.off = shifted_products(qx, rx) + shifted_products(qy, ry) - c * mul(square, shifted_products(m, m));
    h.x = w.xx * rx + w.yx * ry;
    h.y = w.xy * rx + w.yy * ry;
    h.pull_x = c * cross(f.row_y, f.normal);
    h.pull_y = c * cross(f.normal, f.row_x);
    return h;
  }
  h.off = shifted_products(qx, ex) + shifted_products(qy, ey);
  h.x = w.xx * ex + w.yx * ey;
  h.y = w.xy * ex + w.yy * ey;
  if (grad.dL_dlog_amp == T(0) || v == T(0)) return h;
  // log amp: v adj(Sigma) (adj(Sigma) + v) / (2 det det')
  const T l = T(0.5) * grad.dL_dlog_amp * v / blur(f.cov, v).det, inv = T(1) / sqrt(f.cov.det);
  const Vec3<T> n = inv * m, nn = mul(n, n), cx = inv * bx, cy = inv * by;
  const Vec3<T> own = {square.y * nn.z + square.z * nn.y, square.z * nn.x + square.x * nn.z,
                       square.x * nn.y + square.y * nn.x};
  h.diagonal += l * (mul(cx, cx) + mul(cy, cy) + v * own);
  h.off += l * (shifted_products(cx, cx) + shifted_products(cy, cy) - v * mul(square, shifted_products(n, n)));
  h.x += (l * inv) * ((f.cov.yy + v) * cx - f.cov.xy * cy);
  h.y += (l * inv) * ((f.cov.xx + v) * cy - f.cov.xy * cx);
  return h;
}

/// Writes the gradients of scale and rotation, or of cov3d, and returns that of the camera-space mean.
template <typename T>
AR_HD Vec3<T> project_covariance_vjp(const Camera<T>& camera, const Gaussians<T>& g, const GaussianGrads<T>& out,
                                     int64_t i, Vec3<T> view, const Factors<T>& f, const SplatGrad<T>& grad) {
  const Vec3<T>&ax = f.jacobian.x, &ay = f.jacobian.y;
  if (g.cov3ds) {
    const Sym2<T> s = cov_grad(f.cov, grad);
    const Vec3<T> u = s.xx * ax + s.xy * ay, v = s.xy * ax + s.yy * ay;  // s A
    const Sym3<T>& c = g.cov3ds[i];
    if (out.cov3ds) {
      out.cov3ds[i] = {u.x * ax.x + v.x * ay.x,
                       u.x * ax.y + u.y * ax.x + v.x * ay.y + v.y * ay.x,
                       u.x * ax.z + u.z * ax.x + v.x * ay.z + v.z * ay.x,
                       u.y * ax.y + v.y * ay.y,
                       u.y * ax.z + u.z * ax.y + v.y * ay.z + v.z * ay.y,
                       u.z * ax.z + v.z * ay.z};
    }
    const Vec3<T> dL_dax = T(2) * (c * u), dL_day = T(2) * (c * v);
    return jacobian_vjp(camera, f.jacobian, view, dL_dax, dL_day, dot(dL_dax, ax) + dot(dL_day, ay));
  }
  const TurnedGrad<T> h = turned_vjp(f, grad);
  const Vec3<T>& s = f.scale;
  const Vec3<T> by_scale = T(2) * mul(s, h.diagonal);
  if (out.scales) out.scales[i] = g.scale_modifier * by_scale;
  if (out.rotations) {
    // A turn about an axis mixes the other two, as far as they differ.
    const Vec3<T> gap = {(s.y - s.z) * (s.y + s.z), (s.z - s.x) * (s.z + s.x), (s.x - s.y) * (s.x + s.y)};
    out.rotations[i] = rotation_vjp(f.quaternion, T(2) * mul(gap, h.off));
  }
  const Vec3<T> by_x = T(2) * mul(s, mul(s, h.x) + h.pull_x), by_y = T(2) * mul(s, mul(s, h.y) + h.pull_y);
  return jacobian_vjp(camera, f.jacobian, view, f.rotation * by_x, f.rotation * by_y, dot(s, by_scale));
}

/// Direction from the camera to the mean, and 1 / distance.
template <typename T> struct Direction {
  Vec3<T> unit;
  T inv_length;
};
template <typename T> AR_HD Direction<T> view_direction(const Camera<T>& camera, Vec3<T> mean) {
  const Vec3<T> d = mean - camera.position;
  const T inv = T(1) / sqrt(dot(d, d));
  return {inv * d, inv};
}

/// Colour of Gaussian i, whose coefficients are `sh`. False if it is not finite.
template <typename T>
AR_HD bool splat_color(const Camera<T>& camera, const Gaussians<T>& g, int64_t i, const Vec3<T>* sh, Vec3<T>& color) {
  if (g.colors) {
    color = g.colors[i];
  } else {
    T basis[kMaxShCount] = {};
    sh_basis(g.sh_degree, view_direction(camera, g.means[i]).unit, basis);
    color = sh_color(g.sh_degree, basis, sh);
  }
  const bool finite = within(color.x, kMaxColor) && within(color.y, kMaxColor) && within(color.z, kMaxColor);
  if (!g.colors) color = {max(color.x, T(0)), max(color.y, T(0)), max(color.z, T(0))};
  return finite;
}

/// Writes the gradient of the colour's parameters and returns its part in that of the mean. `sh` are
/// the coefficients, `dL_dsh` takes their gradient, or is null; they may be the same memory.
template <typename T>
AR_HD Vec3<T> splat_color_vjp(const Camera<T>& camera, const Gaussians<T>& g, const GaussianGrads<T>& out, int64_t i,
                              const Vec3<T>* sh, Vec3<T>* dL_dsh, Vec3<T> dL_dcolor) {
  if (g.colors) {
    if (out.colors) out.colors[i] = dL_dcolor;
    return {T(0), T(0), T(0)};
  }
  T basis[kMaxShCount] = {}, weight[kMaxShCount];
  const Direction<T> d = view_direction(camera, g.means[i]);
  sh_basis(g.sh_degree, d.unit, basis);
  const Vec3<T> c = sh_color(g.sh_degree, basis, sh);
  const Vec3<T> free = {c.x >= T(0) ? dL_dcolor.x : T(0), c.y >= T(0) ? dL_dcolor.y : T(0),
                        c.z >= T(0) ? dL_dcolor.z : T(0)};
  const int used = sh_count(g.sh_degree);
  AR_UNROLL
  for (int k = 0; k < kMaxShCount; ++k) weight[k] = k < used ? dot(free, sh[k]) : T(0);
  if (dL_dsh) {
    AR_UNROLL
    for (int k = 0; k < kMaxShCount; ++k) {
      if (k < used) dL_dsh[k] = basis[k] * free;
    }
    for (int k = used; k < g.sh_stride; ++k) dL_dsh[k] = {T(0), T(0), T(0)};
  }
  if (g.sh_degree == 0) return {T(0), T(0), T(0)};
  const Vec3<T> by_unit = sh_basis_vjp(g.sh_degree, d.unit, weight);
  return d.inv_length * (by_unit - dot(by_unit, d.unit) * d.unit);
}

/// ceil(3 sigma) along the major axis: the radius that 3DGS reports [px].
template <typename T> AR_HD int splat_radius(Cov2d<T> cov, T variance) {
  const T largest = T(0.5) * (cov.xx + cov.yy + eigenvalue_gap(cov)) + variance;
  return int(min(std::ceil(T(3) * sqrt(largest)), T(1e9)));
}

/// Projects Gaussian i, all but its colour. Returns 3DGS's radius, 0 if it is culled: behind the near
/// plane, off the image, not finite, or degenerate. A splat that is kept may still touch no tile
/// (level <= 0) and then needs no colour.
template <class F, typename T>
AR_HD int project_shape(const Camera<T>& camera, const Gaussians<T>& g, int64_t i, FootprintOptions options,
                        Splat<F, T>& splat, T& depth) {
  const ProjectedMean<T> mean = project_mean(camera, g.means[i]);
  splat.level = T(0);
  if (!mean.valid) return 0;
  const Factors<T> factors = project_covariance(camera, g, i, mean.view);
  if (g.scales &&
      !(within(factors.scale.x, kMaxScale) && within(factors.scale.y, kMaxScale) && within(factors.scale.z, kMaxScale)))
    return 0;
  const Cov2d<T>& cov = factors.cov;
  if (!(cov.det >= T(0) && cov.det < T(kMaxDet) && cov.xx >= T(0) && cov.yy >= T(0)) || !within(cov.xx, 1e18) ||
      !within(cov.yy, 1e18))
    return 0;
  splat.shape = F::prepare(cov, options);
  const Mat2<T> w = F::ellipse(splat.shape);
  if (!within(w.xx, kMaxWhitening) || !within(w.xy, kMaxWhitening) || !within(w.yx, kMaxWhitening) ||
      !within(w.yy, kMaxWhitening))
    return 0;
  const T opacity = g.opacities[i], level = F::level(splat.shape, opacity);
  if (!within(level, 1e6) || opacity > T(kMaxOpacity))
    return 0;  // zero, negative or non-finite opacity, zero determinant
  const int radius = splat_radius(cov, T(F::radius_variance(options)));
  const bool on_image = mean.pixel.x + T(radius) >= T(0) && mean.pixel.x - T(radius) <= camera.size.x - T(1) &&
                        mean.pixel.y + T(radius) >= T(0) && mean.pixel.y - T(radius) <= camera.size.y - T(1);
  splat.mean = mean.pixel;
  splat.opacity = opacity;
  depth = mean.view.z;
  splat.level = level;
  const bool touches = level > T(0) && touches_image(support_of(splat), camera.grid);
  if (!touches) splat.level = T(0);
  return touches || on_image ? radius : 0;
}

/// Projects Gaussian i. Culls it too where its colour is not finite.
template <class F, typename T>
AR_HD int project(const Camera<T>& camera, const Gaussians<T>& g, int64_t i, FootprintOptions options,
                  Splat<F, T>& splat, T& depth) {
  const int radius = project_shape(camera, g, i, options, splat, depth);
  if (!(splat.level > T(0))) return radius;
  if (splat_color(camera, g, i, g.shs ? g.shs + i * g.sh_stride : nullptr, splat.color)) return radius;
  splat.level = T(0);
  return 0;
}

/// Writes every gradient of Gaussian i, from the sums over its pairs. `sh` and `dL_dsh` as for
/// splat_color_vjp; out.shs is not touched.
template <class F, typename T>
AR_HD void project_vjp(const Camera<T>& camera, const Gaussians<T>& g, int64_t i, FootprintOptions options,
                       const PairGrad<T>& sums, const Vec3<T>* sh, Vec3<T>* dL_dsh, const GaussianGrads<T>& out) {
  const ProjectedMean<T> mean = project_mean(camera, g.means[i]);
  const Factors<T> factors = project_covariance(camera, g, i, mean.view);
  const SplatGrad<T> grad =
      F::prepare_vjp(factors.cov, F::prepare(factors.cov, options), sums.shape, sums.weighted, options);
  const Vec3<T> dL_dview = project_covariance_vjp(camera, g, out, i, mean.view, factors, grad);
  Vec3<T> dL_dmean = project_mean_vjp(camera, mean, grad.dL_dmean, dL_dview);
  dL_dmean += splat_color_vjp(camera, g, out, i, sh, dL_dsh, sums.color);
  if (out.means) out.means[i] = dL_dmean;
  if (out.opacities) out.opacities[i] = sums.weighted / g.opacities[i];
  if (out.means2d) {
    T* row = out.means2d + i * out.means2d_stride;
    row[0] = T(0.5) * camera.size.x * grad.dL_dmean.x;
    row[1] = T(0.5) * camera.size.y * grad.dL_dmean.y;
    row[2] = T(0);
  }
}

/// The same with all coefficients in their place.
template <class F, typename T>
AR_HD void project_vjp(const Camera<T>& camera, const Gaussians<T>& g, int64_t i, FootprintOptions options,
                       const PairGrad<T>& sums, const GaussianGrads<T>& out) {
  project_vjp<F>(camera, g, i, options, sums, g.shs ? g.shs + i * g.sh_stride : nullptr,
                 out.shs ? out.shs + i * g.sh_stride : nullptr, out);
}

/// Zero gradient, for a Gaussian that touched no pixel. Coefficients go to `dL_dsh`, if not null.
template <typename T>
AR_HD void zero_grads(const Gaussians<T>& g, int64_t i, const GaussianGrads<T>& out, Vec3<T>* dL_dsh) {
  const Vec3<T> zero = {T(0), T(0), T(0)};
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
template <typename T> AR_HD void zero_grads(const Gaussians<T>& g, int64_t i, const GaussianGrads<T>& out) {
  zero_grads(g, i, out, out.shs ? out.shs + i * g.sh_stride : nullptr);
}

}  // namespace ar
