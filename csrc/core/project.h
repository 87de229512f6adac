// One Gaussian to one splat: cov3d, EWA projection [EWA, Eq. 29-31], colour; and back.
#pragma once

#include <type_traits>

#include "core/bin.h"
#include "core/camera.h"
#include "core/sh.h"

namespace ar {

/// No smaller than the largest standard deviation of Gaussian i.
template <typename T> AR_HD T max_sigma(const Gaussians<T>& g, int64_t i) {
  if (g.cov3ds) return sqrt(g.cov3ds[i].xx + g.cov3ds[i].yy + g.cov3ds[i].zz);
  const Vec3<T> s = g.scales[i];
  return g.scale_modifier * max(abs(s.x), max(abs(s.y), abs(s.z)));
}

/// Whether Gaussian i may touch the image, from its mean and its largest standard deviation: cheap,
/// and never false for one that project() keeps. `blur` is the largest variance a footprint adds.
template <class Cam, typename T>
AR_HD bool may_be_visible(const Cam& camera, const Gaussians<T>& g, int64_t i, T blur) {
  const T largest = max_sigma(g, i), opacity = g.opacities[i];  // loads first: they wait together
  const ProjectedMean<T> p = project_mean(camera, g.means[i]);
  if (!p.valid) return false;
  if constexpr (Cam::kFull) {
    const Blur<T> more = blur_of(camera, p.view);
    blur += more.streak.x * more.streak.x + more.streak.y * more.streak.y + more.variance;
  }
  const T stretch = largest_stretch(camera, p.view.z);
  const T sigma = sqrt(stretch * stretch * largest * largest + blur);
  const T level = T(kMaxLevel) + (opacity > T(1) ? T(2) * std::log(opacity) : T(0));
  const T reach = T(2) + sigma * sqrt(level);
  return p.pixel.x + reach >= T(0) && p.pixel.x - reach <= camera.size.x - T(1) && p.pixel.y + reach >= T(0) &&
         p.pixel.y - reach <= camera.size.y - T(1);
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

template <class Cam, typename T>
AR_HD Factors<T> project_covariance(const Cam& camera, const Gaussians<T>& g, int64_t i, Vec3<T> view) {
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

/// Sigma with blur: after the streak, and after all of it.
template <typename T> struct BlurredCov {
  Cov2d<T> streaked, all;
  Vec2<T> pull;  ///< adj(Sigma) streak
};
/// Products of adj(Sigma) with the streak are sums in the factors; in the entries they cancel for a needle along it.
template <typename T>
AR_HD BlurredCov<T> blurred(const Factors<T>& f, const Gaussians<T>& g, int64_t i, const Blur<T>& by) {
  const Vec2<T>& b = by.streak;
  const Vec3<T> x = g.cov3ds ? f.jacobian.x : f.row_x, y = g.cov3ds ? f.jacobian.y : f.row_y;
  const Vec3<T> across = b.x * y - b.y * x, weighted = g.cov3ds ? g.cov3ds[i] * across : across;
  const T gain = dot(across, weighted);  // negative by rounding of the entries of a cov3d
  const Cov2d<T>& c = f.cov;
  const Cov2d<T> streaked = {c.xx + b.x * b.x, c.xy + b.x * b.y, c.yy + b.y * b.y, c.det + (gain < T(0) ? T(0) : gain)};
  return {streaked, blur(streaked, by.variance), {dot(y, weighted), -dot(x, weighted)}};
}
/// The covariance that the footprint sees, and the amplitude that keeps the mass of the splat.
template <typename T> struct SeenCov {
  Cov2d<T> cov;
  T amp;
};
template <class Cam, typename T>
AR_HD SeenCov<T> seen_covariance(const Cam& camera, const Gaussians<T>& g, int64_t i, Vec3<T> view,
                                 const Factors<T>& f) {
  if constexpr (Cam::kFull) {
    const Blur<T> by = blur_of(camera, view);
    if (by.any()) {
      const Cov2d<T>&c = f.cov, all = blurred(f, g, i, by).all;
      // What is negative definite has a positive determinant, and what is added may hide it.
      const bool has_mass = c.det >= T(kMinBlurredDet) && c.xx >= T(0) && c.yy >= T(0);
      return {all, has_mass ? sqrt(c.det / all.det) : T(0)};
    }
  }
  return {f.cov, T(1)};
}

/// 1 / sqrt(a b), whose product no float may hold.
template <typename T> AR_HD T inverse_root(T a, T b) { return T(1) / (sqrt(a) * sqrt(b)); }

/// What turned_vjp knows of a blur; of NoBlur nothing.
template <class B, typename T> struct BlurContext {
  B blur;
  BlurredCov<T> cov;
  T weighted;  ///< gradient by the logarithm of its amplitude
};
template <typename T> struct BlurContext<NoBlur, T> {};

/// H_kl = t_k . dL/dSigma t_l of the columns t_k of A R, which hold the gradient of all that Sigma = A R S^2 R^T A^T is
/// made of; and dL/dSigma t_k, as two rows.
template <typename T> struct TurnedGrad {
  Vec3<T> diagonal, off;  ///< H_kk; H_12, H_20, H_01
  Vec3<T> x, y;
  Vec3<T> pull_x, pull_y;  ///< another part of x and y, times s_k
};

/// A covariance M = Sigma + c c^T + v I in the coordinates t_k.
template <typename T> struct TurnedCov {
  Cov2d<T> cov;
  Vec3<T> x, y;  ///< adj(M) t_k, as two rows
  Vec3<T> c;     ///< c x t_k; zero without blur
  T v;
};

/// Adds the gradient of weight log sqrt(det M / det(M + v I)): v adj(M) (adj(M) + v) / (2 det det').
template <bool kBlurred, typename T>
AR_HD void add_log_amp_vjp(const Factors<T>& f, const TurnedCov<T>& m, T weight, T v, TurnedGrad<T>& h) {
  if (weight == T(0) || v == T(0)) return;
  const Vec3<T>&tx = f.turned_x, &ty = f.turned_y, square = mul(f.scale, f.scale);
  const T l = T(0.5) * weight * v / blur(m.cov, v).det, inv = T(1) / sqrt(m.cov.det);
  const Vec3<T> n = inv * cross(tx, ty), nn = mul(n, n), cx = inv * m.x, cy = inv * m.y;
  // t_k . adj(M) t_l / det M
  Vec3<T> own = {square.y * nn.z + square.z * nn.y, square.z * nn.x + square.x * nn.z,
                 square.x * nn.y + square.y * nn.x};
  Vec3<T> mixed = T(-1) * mul(square, shifted_products(n, n));
  if constexpr (kBlurred) {
    const T spread = inv * sqrt(m.v);
    const Vec3<T> e = inv * m.c, ex = spread * tx, ey = spread * ty;
    own += mul(e, e) + mul(ex, ex) + mul(ey, ey);
    mixed += shifted_products(e, e) + shifted_products(ex, ex) + shifted_products(ey, ey);
  }
  h.diagonal += l * (mul(cx, cx) + mul(cy, cy) + v * own);
  h.off += l * (shifted_products(cx, cx) + shifted_products(cy, cy) + v * mixed);
  h.x += (l * inv) * ((m.cov.yy + v) * cx - m.cov.xy * cy);
  h.y += (l * inv) * ((m.cov.xx + v) * cy - m.cov.xy * cx);
}

/// Every product is taken in coordinates, whitened or of the factors, where its terms do not cancel: errors grow
/// neither with the length of a needle outside the image nor with the size of a splat.
template <class B, typename T>
AR_HD TurnedGrad<T> turned_vjp(const Factors<T>& f, const SplatGrad<T>& grad, const BlurContext<B, T>& context) {
  constexpr bool kBlurred = !std::is_same_v<B, NoBlur>;
  const Vec3<T>&tx = f.turned_x, &ty = f.turned_y, zero = {T(0), T(0), T(0)};
  const Mat2<T>& w = grad.w;
  const Sym2<T>& g = grad.dL_dwhite;
  TurnedGrad<T> h = {zero, zero, zero, zero, zero, zero};
  // adj(Sigma) t_k is a sum of two terms: across a needle's long axis t_k it is as small as the needle is thin.
  const Vec3<T> square = mul(f.scale, f.scale), n = cross(tx, ty);
  TurnedCov<T> m = {f.cov, cross(mul(square, ty), n), cross(n, mul(square, tx)), zero, T(0)};
  if constexpr (kBlurred) {
    const Vec2<T>& b = context.blur.streak;
    const Cov2d<T>& streaked = context.cov.streaked;
    m.c = b.x * ty - b.y * tx;
    // log sqrt(det Sigma / det streaked) has the gradient u u^T / 2, u = adj(Sigma) b / sqrt(det Sigma det streaked).
    const T half = T(0.5) * context.weighted, inv = inverse_root(f.cov.det, streaked.det);
    const Vec3<T> e = inv * (b.x * m.x + b.y * m.y);
    h.diagonal += half * mul(e, e);
    h.off += half * shifted_products(e, e);
    h.x += (half * (inv * context.cov.pull.x)) * e;
    h.y += (half * (inv * context.cov.pull.y)) * e;
    m = {streaked, m.x - b.y * m.c, m.y + b.x * m.c, m.c, T(0)};
    const T v = context.blur.variance;
    add_log_amp_vjp<true>(f, m, context.weighted, v, h);
    m = {context.cov.all, m.x + v * tx, m.y + v * ty, m.c, v};
  }
  const T v = grad.variance;
  Vec3<T> qx, qy;  // w t_k
  if (grad.triangular) {
    // The second row of whiten() takes from one row of V its projection on the other, (adj(M) + v) t / wide.
    const bool wide_x = w.xx != T(0);
    const T along = w.xx + w.xy, across = (wide_x ? w.yy : w.yx) * along * along;
    qx = along * (wide_x ? tx : ty);
    qy = across * (wide_x ? m.y + v * ty : m.x + v * tx);
  } else {
    qx = w.xx * tx + w.xy * ty;
    qy = w.yx * tx + w.yy * ty;
  }
  const Vec3<T> ex = g.xx * qx + g.xy * qy, ey = g.xy * qx + g.yy * qy;
  h.diagonal += mul(qx, ex) + mul(qy, ey);
  if (!grad.triangular) {
    // (w t_k).(w t_l) = t_k . M^-1 t_l is known without w. A window that holds all of a thin needle's width
    // gives much of it, g.yy, which no turn changes: products of w would leave eps (s1/s2)^2 of it.
    const T c = m.cov.det > T(0) ? g.yy / m.cov.det : T(0);
    const Vec3<T> rx = (g.xx - g.yy) * qx + g.xy * qy, ry = g.xy * qx;
    h.off += shifted_products(qx, rx) + shifted_products(qy, ry) - c * mul(square, shifted_products(n, n));
    h.x += w.xx * rx + w.yx * ry;
    h.y += w.xy * rx + w.yy * ry;
    h.pull_x = c * cross(f.row_y, f.normal);
    h.pull_y = c * cross(f.normal, f.row_x);
    if constexpr (kBlurred) {
      const Vec2<T>& b = context.blur.streak;
      h.off += c * (shifted_products(m.c, m.c) + m.v * (shifted_products(tx, tx) + shifted_products(ty, ty)));
      h.pull_x += c * mul(f.scale, m.v * tx - b.y * m.c);
      h.pull_y += c * mul(f.scale, m.v * ty + b.x * m.c);
    }
    return h;
  }
  h.off += shifted_products(qx, ex) + shifted_products(qy, ey);
  h.x += w.xx * ex + w.yx * ey;
  h.y += w.xy * ex + w.yy * ey;
  add_log_amp_vjp<kBlurred>(f, m, grad.dL_dlog_amp, v, h);
  return h;
}

/// Gradient by Sigma of the logarithm of a blur's amplitude, as a matrix.
template <typename T> AR_HD Sym2<T> blur_amp_grad(const Cov2d<T>& c, T variance, const BlurredCov<T>& cov) {
  const T inv = inverse_root(c.det, cov.streaked.det), x = inv * cov.pull.x, y = inv * cov.pull.y;
  return Sym2<T>{T(0.5) * x * x, T(0.5) * x * y, T(0.5) * y * y} + log_amp_grad(cov.streaked, variance);
}

/// Writes the gradients of scale and rotation, or of cov3d, and returns that of the Jacobian.
template <class B, typename T>
AR_HD JacobianGrad<T> project_covariance_vjp(const Gaussians<T>& g, const GaussianGrads<T>& out, int64_t i,
                                             const Factors<T>& f, const SplatGrad<T>& grad,
                                             const BlurContext<B, T>& context) {
  const Vec3<T>&ax = f.jacobian.x, &ay = f.jacobian.y;
  if (g.cov3ds) {
    Sym2<T> s;
    if constexpr (std::is_same_v<B, NoBlur>) {
      s = cov_grad(f.cov, grad);
    } else {
      const Sym2<T> amp = blur_amp_grad(f.cov, context.blur.variance, context.cov);
      const T k = context.weighted;
      s = cov_grad(context.cov.all, grad) + Sym2<T>{k * amp.xx, k * amp.xy, k * amp.yy};
    }
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
    return {dL_dax, dL_day, dot(dL_dax, ax) + dot(dL_day, ay)};
  }
  const TurnedGrad<T> h = turned_vjp(f, grad, context);
  const Vec3<T>& s = f.scale;
  const Vec3<T> by_scale = T(2) * mul(s, h.diagonal);
  if (out.scales) out.scales[i] = g.scale_modifier * by_scale;
  if (out.rotations) {
    // A turn about an axis mixes the other two, as far as they differ.
    const Vec3<T> gap = {(s.y - s.z) * (s.y + s.z), (s.z - s.x) * (s.z + s.x), (s.x - s.y) * (s.x + s.y)};
    out.rotations[i] = rotation_vjp(f.quaternion, T(2) * mul(gap, h.off));
  }
  const Vec3<T> by_x = T(2) * mul(s, mul(s, h.x) + h.pull_x), by_y = T(2) * mul(s, mul(s, h.y) + h.pull_y);
  return {f.rotation * by_x, f.rotation * by_y, dot(s, by_scale)};
}

/// Gradient by the blur itself. Of its amplitude only det Sigma' depends on it: -Sigma'^-1 b and -tr(Sigma'^-1) / 2.
template <typename T>
AR_HD Blur<T> seen_covariance_vjp(const SplatGrad<T>& grad, const BlurContext<Blur<T>, T>& context) {
  const Vec2<T>& b = context.blur.streak;
  const Cov2d<T>& all = context.cov.all;
  const T v = context.blur.variance, u = grad.variance;
  const Vec2<T> pull = {context.cov.pull.x + v * b.x, context.cov.pull.y + v * b.y};  // adj(Sigma') b
  // What the footprint gives across a thin needle, g.yy, may cancel the amplitude. w^T w = (Sigma' + u I)^-1 is known
  // without w, so that both multiply the same numbers; what remains is taken in whitened coordinates, as its entries
  // cancel for a needle along the streak.
  const Cov2d<T> seen = blur(all, u);
  const T own = grad.dL_dwhite.yy / seen.det, inv = context.weighted / all.det;
  SplatGrad<T> rest = grad;
  rest.dL_dwhite = {grad.dL_dwhite.xx - grad.dL_dwhite.yy, grad.dL_dwhite.xy, T(0)};
  const Sym2<T>& g = rest.dL_dwhite;
  const Sym2<T> by_all = cov_grad(all, rest);
  const Vec2<T> z = transform(grad.w, b);
  Vec2<T> by_b = transform_transposed(grad.w, Vec2<T>{g.xx * z.x + g.xy * z.y, g.xy * z.x});
  if (grad.dL_dlog_amp != T(0)) {
    const T scale = T(0.5) * grad.dL_dlog_amp * u / seen.det;
    by_b = by_b + Vec2<T>{scale * (((all.yy + u) * pull.x - all.xy * pull.y) / all.det),
                          scale * (((all.xx + u) * pull.y - all.xy * pull.x) / all.det)};
  }
  return {{T(2) * (by_b.x + own * (pull.x + u * b.x)) - inv * pull.x,
           T(2) * (by_b.y + own * (pull.y + u * b.y)) - inv * pull.y},
          by_all.xx + by_all.yy + own * (seen.xx + seen.yy) - T(0.5) * inv * (all.xx + all.yy)};
}

/// Colour of Gaussian i, whose coefficients are `sh`. False if it is not finite.
template <class Cam, typename T>
AR_HD bool splat_color(const Cam& camera, const Gaussians<T>& g, int64_t i, const Vec3<T>* sh, Vec3<T>& color) {
  if (g.colors) {
    color = g.colors[i];
  } else {
    T basis[sh_count(Cam::kShDegree)] = {};
    sh_basis<Cam::kShDegree>(g.sh_degree, view_direction(camera, g.means[i]).unit, basis);
    color = sh_color<Cam::kShDegree>(g.sh_degree, basis, sh);
  }
  const bool finite = within(color.x, kMaxColor) && within(color.y, kMaxColor) && within(color.z, kMaxColor);
  if (!g.colors) color = {max(color.x, T(0)), max(color.y, T(0)), max(color.z, T(0))};
  return finite;
}

/// Writes the gradient of the colour's parameters and returns its part in that of the direction, as long as it
/// is. `sh` are the coefficients, `dL_dsh` takes their gradient, or is null; they may be the same memory.
template <class Cam, typename T>
AR_HD Vec3<T> splat_color_vjp(const Cam& camera, const Gaussians<T>& g, const GaussianGrads<T>& out, int64_t i,
                              const Vec3<T>* sh, Vec3<T>* dL_dsh, Vec3<T> dL_dcolor) {
  if (g.colors) {
    if (out.colors) out.colors[i] = dL_dcolor;
    return {T(0), T(0), T(0)};
  }
  constexpr int kCount = sh_count(Cam::kShDegree);
  T basis[kCount] = {}, weight[kCount];
  const Direction<T> d = view_direction(camera, g.means[i]);
  sh_basis<Cam::kShDegree>(g.sh_degree, d.unit, basis);
  const Vec3<T> c = sh_color<Cam::kShDegree>(g.sh_degree, basis, sh);
  const Vec3<T> free = {c.x >= T(0) ? dL_dcolor.x : T(0), c.y >= T(0) ? dL_dcolor.y : T(0),
                        c.z >= T(0) ? dL_dcolor.z : T(0)};
  const int used = sh_count(g.sh_degree);
  AR_UNROLL
  for (int k = 0; k < kCount; ++k) weight[k] = k < used ? dot(free, sh[k]) : T(0);
  if (dL_dsh) {
    AR_UNROLL
    for (int k = 0; k < kCount; ++k) {
      if (k < used) dL_dsh[k] = basis[k] * free;
    }
    for (int k = used; k < g.sh_stride; ++k) dL_dsh[k] = {T(0), T(0), T(0)};
  }
  if (g.sh_degree == 0) return {T(0), T(0), T(0)};
  const Vec3<T> by_unit = sh_basis_vjp<Cam::kShDegree>(g.sh_degree, d.unit, weight);
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
template <class F, class Cam, typename T>
AR_HD int project_shape(const Cam& camera, const Gaussians<T>& g, int64_t i, FootprintOptions options,
                        Splat<F, T>& splat, T& depth) {
  const ProjectedMean<T> mean = project_mean(camera, g.means[i]);
  splat.level = T(0);
  if (!mean.valid) return 0;
  const Factors<T> factors = project_covariance(camera, g, i, mean.view);
  if (g.scales &&
      !(within(factors.scale.x, kMaxScale) && within(factors.scale.y, kMaxScale) && within(factors.scale.z, kMaxScale)))
    return 0;
  const SeenCov<T> seen = seen_covariance(camera, g, i, mean.view, factors);
  const Cov2d<T>& cov = seen.cov;
  if (!(cov.det >= T(0) && cov.det < T(kMaxDet) && cov.xx >= T(0) && cov.yy >= T(0)) || !within(cov.xx, 1e18) ||
      !within(cov.yy, 1e18))
    return 0;
  splat.shape = F::prepare(cov, options);
  const Mat2<T> w = F::ellipse(splat.shape);
  if (!within(w.xx, kMaxWhitening) || !within(w.xy, kMaxWhitening) || !within(w.yx, kMaxWhitening) ||
      !within(w.yy, kMaxWhitening))
    return 0;
  const T opacity = g.opacities[i], peak = seen.amp * opacity, level = F::level(splat.shape, peak);
  if (!within(level, 1e6) || opacity > T(kMaxOpacity))
    return 0;  // zero, negative or non-finite opacity, zero determinant
  const int radius = splat_radius(cov, T(F::radius_variance(options)));
  const bool on_image = mean.pixel.x + T(radius) >= T(0) && mean.pixel.x - T(radius) <= camera.size.x - T(1) &&
                        mean.pixel.y + T(radius) >= T(0) && mean.pixel.y - T(radius) <= camera.size.y - T(1);
  splat.mean = mean.pixel;
  splat.opacity = peak;
  depth = mean.view.z;
  splat.level = level;
  const bool touches = level > T(0) && touches_image(support_of(splat), camera.grid);
  if (!touches) splat.level = T(0);
  return touches || on_image ? radius : 0;
}

/// Projects Gaussian i. Culls it too where its colour is not finite.
template <class F, class Cam, typename T>
AR_HD int project(const Cam& camera, const Gaussians<T>& g, int64_t i, FootprintOptions options, Splat<F, T>& splat,
                  T& depth) {
  const int radius = project_shape(camera, g, i, options, splat, depth);
  if (!(splat.level > T(0))) return radius;
  if (splat_color(camera, g, i, g.shs ? g.shs + i * g.sh_stride : nullptr, splat.color)) return radius;
  splat.level = T(0);
  return 0;
}

/// Writes every gradient of Gaussian i, from the sums over its pairs, and adds that of a full camera to
/// `camera_grad`, if not null. `sh` and `dL_dsh` as for splat_color_vjp; out.shs is not touched.
template <class F, class Cam, typename T>
AR_HD void project_vjp(const Cam& camera, const Gaussians<T>& g, int64_t i, FootprintOptions options,
                       const PairGrad<T>& sums, const Vec3<T>* sh, Vec3<T>* dL_dsh, const GaussianGrads<T>& out,
                       CameraGrad<T>* camera_grad = nullptr) {
  const ProjectedMean<T> mean = project_mean(camera, g.means[i]);
  const Factors<T> factors = project_covariance(camera, g, i, mean.view);
  const Cov2d<T> cov = seen_covariance(camera, g, i, mean.view, factors).cov;
  const SplatGrad<T> grad = F::prepare_vjp(cov, F::prepare(cov, options), sums.shape, sums.weighted, options);
  JacobianGrad<T> by_jacobian;
  Vec3<T> dL_dview = {T(0), T(0), T(0)};
  bool has_blur = false;
  if constexpr (Cam::kFull) {
    const Blur<T> blur = blur_of(camera, mean.view);
    has_blur = blur.any();
    // At zero the streak has no gradient, and a defocused variance only by the way it grows, which is zero too.
    if (has_blur) {
      const BlurContext<Blur<T>, T> context = {blur, blurred(factors, g, i, blur), sums.weighted};
      by_jacobian = project_covariance_vjp(g, out, i, factors, grad, context);
      dL_dview = blur_vjp(camera, mean.view, seen_covariance_vjp(grad, context), camera_grad);
    }
  }
  if (!has_blur) by_jacobian = project_covariance_vjp(g, out, i, factors, grad, BlurContext<NoBlur, T>{});
  dL_dview += jacobian_vjp(camera, factors.jacobian, mean.view, by_jacobian);
  Vec3<T> dL_dmean = project_mean_vjp(camera, mean, grad.dL_dmean, dL_dview);
  const Vec3<T> by_direction = splat_color_vjp(camera, g, out, i, sh, dL_dsh, sums.color);
  bool sees_along = false;
  if constexpr (Cam::kFull) {
    sees_along = camera.lens.orthographic();
    if (camera_grad) {
      add_project_mean_vjp(camera, mean, g.means[i], grad.dL_dmean, dL_dview, *camera_grad);
      add_jacobian_vjp(camera, factors.jacobian, mean.view, by_jacobian, *camera_grad);
      if (sees_along) {
        add_xyz(camera_grad->view_z, by_direction);
      } else {
        camera_grad->position += T(-1) * by_direction;
      }
    }
  }
  if (!sees_along) dL_dmean += by_direction;
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
template <class F, class Cam, typename T>
AR_HD void project_vjp(const Cam& camera, const Gaussians<T>& g, int64_t i, FootprintOptions options,
                       const PairGrad<T>& sums, const GaussianGrads<T>& out, CameraGrad<T>* camera_grad = nullptr) {
  project_vjp<F>(camera, g, i, options, sums, g.shs ? g.shs + i * g.sh_stride : nullptr,
                 out.shs ? out.shs + i * g.sh_stride : nullptr, out, camera_grad);
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
