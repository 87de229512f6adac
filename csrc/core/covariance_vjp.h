// The adjoint of covariance.h: gradients by scale and rotation, or a 3D covariance, and by the camera's Jacobian. In
// coordinates in which terms do not cancel (docs/internals/numerics.md, from "Gradient in the turned frame" on).
#pragma once

#include "core/blur.h"

namespace ar {

template <class Out, class V> AR_HD void put(const Out& out, V& to, V gradient) {
  if (out.adds()) {
    to = to + gradient;
  } else {
    to = gradient;
  }
}

/// In the columns t_k of A R, Sigma = A R S^2 R^T A^T: H_kl = t_k . dL/dSigma t_l.
template <typename T> struct TurnedGrad {
  Vec3<T> diagonal, off;       ///< H_kk; H_12, H_20, H_01
  Vec3<T> x, y;                ///< rows of dL/dSigma t_k
  Vec3<T> scaled_x, scaled_y;  ///< more of x and y, times s_k
};

/// M = Sigma + c c^T + v I in the coordinates t_k.
template <typename T> struct TurnedCov {
  Cov2d<T> cov;
  Vec3<T> x, y;  ///< rows of adj(M) t_k
  Vec3<T> c;     ///< c x t_k; zero without blur
  T v;
};

/// Adds the gradient of weight log sqrt(det M / det(M + v I)).
template <bool kBlurred, typename T>
AR_HD void add_log_amp_vjp(const Factors<T>& f, const TurnedCov<T>& m, T weight, T v, TurnedGrad<T>& h) {
  if (weight == T(0) || v == T(0)) return;
  const Vec3<T>&tx = f.turned_x, &ty = f.turned_y, square = mul(f.scale, f.scale);
  const T l = quotient(T(0.5) * weight * v, blur(m.cov, v).det), inv = quotient(T(1), sqrt(m.cov.det));
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

template <class B, typename T>
AR_HD TurnedGrad<T> turned_vjp(const Factors<T>& f, const SplatGrad<T>& grad, const BlurContext<B, T>& context) {
  constexpr bool kBlurred = !std::is_same_v<B, NoBlur>;
  const Vec3<T>&tx = f.turned_x, &ty = f.turned_y, zero = {T(0), T(0), T(0)};
  const Mat2<T>& w = grad.w;
  const Sym2<T>& g = grad.dL_dwhite;
  TurnedGrad<T> h = {zero, zero, zero, zero, zero, zero};
  const Vec3<T> square = mul(f.scale, f.scale), n = cross(tx, ty);
  TurnedCov<T> m = {f.cov, cross(mul(square, ty), n), cross(n, mul(square, tx)), zero, T(0)};
  if constexpr (kBlurred) {
    const Vec2<T>& b = context.blur.streak;
    const Cov2d<T>& streaked = context.cov.streaked;
    m.c = b.x * ty - b.y * tx;
    // docs/internals/numerics.md, "Gradient through a blur": e_k = t_k . u.
    const T half = T(0.5) * context.weighted, inv = inverse_root(f.cov.det, streaked.det);
    const Vec3<T> e = inv * (b.x * m.x + b.y * m.y);
    h.diagonal += half * mul(e, e);
    h.off += half * shifted_products(e, e);
    h.x += (half * (inv * context.cov.adj_streak.x)) * e;
    h.y += (half * (inv * context.cov.adj_streak.y)) * e;
    m = {streaked, m.x - b.y * m.c, m.y + b.x * m.c, m.c, T(0)};
    const T v = context.blur.variance;
    add_log_amp_vjp<true>(f, m, context.weighted, v, h);
    m = {context.cov.all, m.x + v * tx, m.y + v * ty, m.c, v};
  }
  const T v = grad.variance;
  Vec3<T> qx, qy;  // w t_k
  if (grad.frame == GradFrame::kTriangular) {
    // "Cholesky factors" of docs/internals/numerics.md, "Gradient in whitened coordinates".
    const bool x_first = w.xx != T(0);
    const T along = w.xx + w.xy, across = (x_first ? w.yy : w.yx) * along * along;
    qx = along * (x_first ? tx : ty);
    qy = across * (x_first ? m.y + v * ty : m.x + v * tx);
  } else {
    qx = w.xx * tx + w.xy * ty;
    qy = w.yx * tx + w.yy * ty;
  }
  const Vec3<T> ex = g.xx * qx + g.xy * qy, ey = g.xy * qx + g.yy * qy;
  h.diagonal += mul(qx, ex) + mul(qy, ey);
  if (grad.frame == GradFrame::kAxes) {
    // "Eigenframes" of the same section: of g.yy, products of w would leave eps (s1/s2)^2.
    const T c = m.cov.det > T(0) ? quotient(g.yy, m.cov.det) : T(0);
    const Vec3<T> rx = (g.xx - g.yy) * qx + g.xy * qy, ry = g.xy * qx;
    h.off += shifted_products(qx, rx) + shifted_products(qy, ry) - c * mul(square, shifted_products(n, n));
    h.x += w.xx * rx + w.yx * ry;
    h.y += w.xy * rx + w.yy * ry;
    h.scaled_x = c * cross(f.row_y, f.normal);
    h.scaled_y = c * cross(f.normal, f.row_x);
    if constexpr (kBlurred) {
      const Vec2<T>& b = context.blur.streak;
      h.off += c * (shifted_products(m.c, m.c) + m.v * (shifted_products(tx, tx) + shifted_products(ty, ty)));
      h.scaled_x += c * mul(f.scale, m.v * tx - b.y * m.c);
      h.scaled_y += c * mul(f.scale, m.v * ty + b.x * m.c);
    }
    return h;
  }
  h.off += shifted_products(qx, ex) + shifted_products(qy, ey);
  h.x += w.xx * ex + w.yx * ey;
  h.y += w.xy * ex + w.yy * ey;
  add_log_amp_vjp<kBlurred>(f, m, grad.dL_dlog_amp, v, h);
  return h;
}

template <class B, typename T, class Out>
AR_HD JacobianGrad<T> project_covariance_vjp(const Gaussians<T>& g, const Out& out, int64_t i, const Factors<T>& f,
                                             const SplatGrad<T>& grad, const BlurContext<B, T>& context) {
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
      const Sym3<T> gradient = {u.x * ax.x + v.x * ay.x,
                                u.x * ax.y + u.y * ax.x + v.x * ay.y + v.y * ay.x,
                                u.x * ax.z + u.z * ax.x + v.x * ay.z + v.z * ay.x,
                                u.y * ax.y + v.y * ay.y,
                                u.y * ax.z + u.z * ax.y + v.y * ay.z + v.z * ay.y,
                                u.z * ax.z + v.z * ay.z};
      put(out, out.cov3ds[i], gradient);
    }
    const Vec3<T> dL_dax = T(2) * (c * u), dL_day = T(2) * (c * v);
    return {dL_dax, dL_day, dot(dL_dax, ax) + dot(dL_day, ay)};
  }
  const TurnedGrad<T> h = turned_vjp(f, grad, context);
  const Vec3<T>& s = f.scale;
  const Vec3<T> by_scale = T(2) * mul(s, h.diagonal);
  if (out.scales) put(out, out.scales[i], g.scale_modifier * by_scale);
  if (out.rotations) {
    const Vec3<T> gap = {(s.y - s.z) * (s.y + s.z), (s.z - s.x) * (s.z + s.x), (s.x - s.y) * (s.x + s.y)};
    put(out, out.rotations[i], rotation_vjp(f.quaternion, T(2) * mul(gap, h.off)));
  }
  const Vec3<T> by_x = T(2) * mul(s, mul(s, h.x) + h.scaled_x), by_y = T(2) * mul(s, mul(s, h.y) + h.scaled_y);
  return {f.rotation * by_x, f.rotation * by_y, dot(s, by_scale)};
}

}  // namespace ar
