// Adds the Blur to a projected covariance, and lowers the amplitude, to keep the splat's mass. And the adjoint.
#pragma once

#include "core/covariance.h"

namespace ar {

template <typename T> struct BlurredCov {
  Cov2d<T> streaked, all;  ///< with the streak; with streak and defocus
  Vec2<T> adj_streak;      ///< adj(Sigma) streak
};

/// Sums of products of the factors, since entries of Sigma would cancel for a needle along the streak.
template <typename T>
AR_HD BlurredCov<T> blurred(const Factors<T>& f, const Gaussians<T>& g, int64_t i, const Blur<T>& by) {
  const Vec2<T>& b = by.streak;
  const Vec3<T> x = g.cov3ds ? f.jacobian.x : f.row_x, y = g.cov3ds ? f.jacobian.y : f.row_y;
  const Vec3<T> across = b.x * y - b.y * x, weighted = g.cov3ds ? g.cov3ds[i] * across : across;
  const T gain = dot(across, weighted);  // negative by rounding of a cov3d
  const Cov2d<T>& c = f.cov;
  const Cov2d<T> streaked = {c.xx + b.x * b.x, c.xy + b.x * b.y, c.yy + b.y * b.y, c.det + (gain < T(0) ? T(0) : gain)};
  return {streaked, blur(streaked, by.variance), {dot(y, weighted), -dot(x, weighted)}};
}

/// What the footprint gets, and a factor of the opacity.
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
      // A negative definite matrix has a positive determinant.
      const bool has_mass = c.det >= T(kMinBlurredDet) && c.xx >= T(0) && c.yy >= T(0);
      return {all, has_mass ? sqrt(c.det / all.det) : T(0)};
    }
  }
  return {f.cov, T(1)};
}

/// 1 / sqrt(a b), where a b may overflow.
template <typename T> AR_HD T inverse_root(T a, T b) { return T(1) / (sqrt(a) * sqrt(b)); }

template <class B, typename T> struct BlurContext {
  B blur;
  BlurredCov<T> cov;
  T weighted;  ///< by the logarithm of the amplitude
};
template <typename T> struct BlurContext<NoBlur, T> {};

template <typename T> AR_HD Sym2<T> blur_amp_grad(const Cov2d<T>& c, T variance, const BlurredCov<T>& cov) {
  const T inv = inverse_root(c.det, cov.streaked.det), x = inv * cov.adj_streak.x, y = inv * cov.adj_streak.y;
  return Sym2<T>{T(0.5) * x * x, T(0.5) * x * y, T(0.5) * y * y} + log_amp_grad(cov.streaked, variance);
}

/// docs/internals/numerics.md, "Gradient with respect to a blur". For a thin needle g.yy may cancel the amplitude, so
/// both multiply the same numbers.
template <typename T>
AR_HD Blur<T> seen_covariance_vjp(const SplatGrad<T>& grad, const BlurContext<Blur<T>, T>& context) {
  const Vec2<T>& b = context.blur.streak;
  const Cov2d<T>& all = context.cov.all;
  const T v = context.blur.variance, u = grad.variance;
  const Vec2<T> adj_b = {context.cov.adj_streak.x + v * b.x, context.cov.adj_streak.y + v * b.y};  // adj(Sigma') b
  // w^T w = (Sigma' + u I)^-1 is known without w. The remainder needs whitened coordinates, because its entries cancel
  // along the streak.
  const Cov2d<T> seen = blur(all, u);
  const T across = grad.frame == GradFrame::kPixels ? T(0) : grad.dL_dwhite.yy;
  const T own = across / seen.det, inv = context.weighted / all.det;
  SplatGrad<T> rest = grad;
  rest.dL_dwhite = {grad.dL_dwhite.xx - across, grad.dL_dwhite.xy, grad.dL_dwhite.yy - across};
  const Sym2<T>& g = rest.dL_dwhite;
  const Sym2<T> by_all = cov_grad(all, rest);
  const Vec2<T> z = transform(grad.w, b);
  Vec2<T> by_b = transform_transposed(grad.w, Vec2<T>{g.xx * z.x + g.xy * z.y, g.xy * z.x + g.yy * z.y});
  if (grad.dL_dlog_amp != T(0)) {
    const T scale = T(0.5) * grad.dL_dlog_amp * u / seen.det;
    by_b = by_b + Vec2<T>{scale * (((all.yy + u) * adj_b.x - all.xy * adj_b.y) / all.det),
                          scale * (((all.xx + u) * adj_b.y - all.xy * adj_b.x) / all.det)};
  }
  return {{T(2) * (by_b.x + own * (adj_b.x + u * b.x)) - inv * adj_b.x,
           T(2) * (by_b.y + own * (adj_b.y + u * b.y)) - inv * adj_b.y},
          by_all.xx + by_all.yy + own * (seen.xx + seen.yy) - T(0.5) * inv * (all.xx + all.yy)};
}

}  // namespace ar
