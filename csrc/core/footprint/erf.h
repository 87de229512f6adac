// The footprint `erf`, a reference: the window of `analytic` with the exact normal distribution instead of the
// logistic.
#pragma once

#include "core/footprint/eigenframe.h"
#include "core/footprint/gaussian.h"
#include "core/footprint/normal.h"

namespace ar {

/// I = 2 pi s1 s2 [Phi]_u [Phi]_v, with Phi over the window of each axis (docs/internals/numerics.md, "The rotated
/// window"). The adjoint holds the frame fixed.
struct Erf : FootprintDefaults {
  static constexpr const char* kName = "erf";
  static constexpr bool kExpensive = true;
  static constexpr bool kReference = true, kGeneric = true;
  static constexpr double kExtraLevel = 2 * box_excess(1 / kPixelVariance);

  /// For finite reciprocals [px].
  static constexpr double kMinSigma = 1e-9;

  template <typename T> struct Shape {
    Vec2<T> inv_sigma;  ///< along the major and the minor axis [1/px]
    Vec2<T> axis;       ///< (cos, sin) of the major axis
    T area;             ///< s1 s2 [px^2]
  };
  template <typename T> struct Terms {
    Mat2<T> w;       ///< whitening matrix, rows along the axes
    Vec2<T> origin;  ///< whitened
    Vec2<T> width;   ///< of the window, in standard deviations
    T mass;          ///< opacity * s1 s2 [px^2]
  };

  AR_HD static double radius_variance(FootprintOptions) { return 0; }
  AR_HD static double support_variance(FootprintOptions) { return kPixelVariance; }

  template <typename T> AR_HD static Shape<T> prepare(Cov2d<T> cov, FootprintOptions) {
    const Eigenframe<T> frame = eigenframe(cov);
    const T s1 = max(frame.sigma.x, T(kMinSigma)), s2 = max(frame.sigma.y, T(kMinSigma));
    return {{T(1) / s1, T(1) / s2}, frame.axis, s1 * s2};
  }

  template <typename T> AR_HD static Mat2<T> ellipse(const Shape<T>& g) {
    return scaled_axes(widened_by_pixel(g.inv_sigma), g.axis);
  }

  template <typename T> AR_HD static T level(const Shape<T>& g, T opacity) {
    const Vec2<T> w = widened_by_pixel(g.inv_sigma);
    return gaussian_level(w.x * w.y * g.area, opacity) + box_excess(w.x * w.x) + box_excess(w.y * w.y);
  }

  template <typename T> AR_HD static Terms<T> terms(const Shape<T>& g, T opacity, Vec2<T> origin = {T(0), T(0)}) {
    const Mat2<T> w = mean_map(g);
    return {w, transform(w, origin), g.inv_sigma, opacity * g.area};
  }

  template <typename T, class V> AR_HD static V alpha(const Terms<T>& t, Vec2<V> p, int) {
    const Vec2<V> z = transform(t.w, p, t.origin);
    return V(t.mass) * along(z.x, t.width.x).value * along(z.y, t.width.y).value;
  }

  /// Moments of z = w d over the window.
  template <typename T, class V>
  AR_HD static void add_alpha_vjp(const Terms<T>& t, Vec2<V> p, int, AlphaGrad<V> grad, ShapeGrad<V>& sums) {
    const Vec2<V> z = transform(t.w, p, t.origin);
    const NormalMoments<V> f = along(z.x, t.width.x), g = along(z.y, t.width.y);
    const V scale = grad.dL_dalpha * V(t.mass), of_f = scale * g.value, of_g = scale * f.value;
    sums.offset = {madd(of_f, f.first, sums.offset.x), madd(of_g, g.first, sums.offset.y)};
    sums.shape = {madd(of_f, f.second, sums.shape.xx), madd(scale * f.first, g.first, sums.shape.xy),
                  madd(of_g, g.second, sums.shape.yy)};
  }

  template <typename T> AR_HD static Mat2<T> mean_map(const Shape<T>& g) { return scaled_axes(g.inv_sigma, g.axis); }

  template <typename T>
  AR_HD static SplatGrad<T> prepare_vjp(Cov2d<T>, const Shape<T>& g, ShapeGrad<T> sums, T, FootprintOptions) {
    return moments_vjp(mean_map(g), sums, GradFrame::kAxes);
  }

 private:
  template <typename T, class V> AR_HD static NormalMoments<V> along(V z, T width) {
    if (width <= T(0.5)) return short_interval_moments(z, V(width));
    return interval_moments(z - V(T(0.5) * width), z + V(T(0.5) * width));
  }
};

}  // namespace ar
