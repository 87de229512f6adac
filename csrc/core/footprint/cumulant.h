// The footprint `cumulant`: the axis-aligned unit pixel through its cumulants, with one exponential, smooth in Sigma
// and without eigenvectors (docs/internals/numerics.md, "Weights").
#pragma once

#include "core/footprint/gaussian.h"

namespace ar {

/// One axis of the correction to the exponent, h(p, t) = s(p, t) of that section. t is the diagonal entry of the conic.
/// Weights beyond the cap are below 2e-6.
template <typename T> struct CumulantAxis {
  T c4, c6, linear, cap;
  T dc4, dc6, dlinear, dconstant;  // by t

  /// Of `unit` times h, for p and t in coordinates in which the conic is divided by `scale`
  /// (docs/internals/numerics.md, "Units of the exponent").
  AR_HD static CumulantAxis at(T t, T unit = T(1), T scale = T(1)) {
    const T dx = scale * T(kPixelVariance), x = t * dx;
    const bool floored = T(1) - x < T(1e-6);
    const T u2 = unit * scale * scale, u3 = u2 * scale, u4 = u3 * scale, u6 = u4 * scale * scale;
    CumulantAxis a;
    a.c4 = u4 * (T(1) + x * (T(20.0 / 7) + x * T(0.4366)));
    a.dc4 = u4 * dx * (T(20.0 / 7) + x * T(2 * 0.4366));
    a.c6 = u6 * (floored ? T(1e-6) : T(1) - x) / T(63);
    a.dc6 = floored ? T(0) : -u6 * dx / T(63);
    a.linear = u3 * T(6) * t * (T(1) + x * (T(10.0 / 7) + x * T(0.6240)));
    a.dlinear = u3 * T(6) * (T(1) + x * (T(2 * 10.0 / 7) + x * T(3 * 0.6240)));
    a.dconstant = u2 * T(3) * t * (T(2) + x * (T(3 * 20.0 / 21) + x * T(4 * 0.6975)));
    a.cap = (a.c4 + sqrt(a.c4 * a.c4 - T(3) * a.c6 * a.linear)) / (T(3) * a.c6);
    return a;
  }

  AR_HD static T constant(T t, T unit = T(1), T scale = T(1)) {
    const T x = t * scale * T(kPixelVariance);
    return unit * scale * scale * T(3) * t * t * (T(1) + x * (T(20.0 / 21) + x * T(0.6975)));
  }

  template <class V> AR_HD V capped(V p) const { return min(p * p, V(cap)); }
  /// v less the part of h that depends on p.
  template <class V> AR_HD V subtract_from(V v, V P) const { return madd(-P, inner(P), v); }
  /// Half of dh/dp.
  template <class V> AR_HD V half_by_p(V p, V P) const { return p * madd(P, madd(V(-c6), P, quartic(P)), inner(P)); }
  template <class V> AR_HD V by_t(V P) const {
    return madd(P, madd(P, madd(V(-dc6), P, V(dc4)), V(-dlinear)), V(dconstant));
  }

 private:
  template <class V> AR_HD V quartic(V P) const { return madd(V(-c6), P, V(c4)); }
  template <class V> AR_HD V inner(V P) const { return madd(P, quartic(P), V(-linear)); }
};

struct Cumulant : FootprintDefaults {
  static constexpr const char *kName = "cumulant", *kPage = "cumulants";
  static constexpr bool kExpensive = true;
  static constexpr double kExtraLevel = 2.4;  // see level(): both a and c are at most 12
  static constexpr double kOrder4 = 1.0 / 2880;
  template <typename T> using Shape = GaussianShape<T>;

  template <typename T> struct Terms {
    Lower2<T> w;           ///< whitening matrix times kBase2
    CumulantAxis<T> x, y;  ///< of the exponent to base 2
    Vec2<T> origin;        ///< whitened
    T log_peak;            ///< log2(opacity * amp) less the constants of x and y
  };

  AR_HD static double radius_variance(FootprintOptions) { return kPixelVariance; }
  AR_HD static double support_variance(FootprintOptions) { return kPixelVariance; }

  template <typename T> AR_HD static Shape<T> prepare(Cov2d<T> cov, FootprintOptions) {
    const Cov2d<T> blurred = blur(cov, T(kPixelVariance));
    return gaussian_shape(blurred, sqrt(cov.det / blurred.det));
  }

  template <typename T> AR_HD static Mat2<T> ellipse(const Shape<T>& shape) { return wide_first(shape); }

  /// See docs/internals/numerics.md, "Support".
  template <typename T> AR_HD static T level(const Shape<T>& shape, T opacity) {
    const T a = conic_xx(shape.w), c = conic_yy(shape.w);
    return gaussian_level(shape.amp, opacity) + (a * a + c * c) / T(124);
  }

  template <typename T> AR_HD static Terms<T> terms(const Shape<T>& shape, T opacity, Vec2<T> origin = {T(0), T(0)}) {
    const Lower2<T> w = T(kBase2) * shape.w;
    const T unit = T(kOrder4 * kLog2e), scale = T(1 / (kBase2 * kBase2));
    const T a = conic_xx(w), c = conic_yy(w);
    const T constant = CumulantAxis<T>::constant(a, unit, scale) + CumulantAxis<T>::constant(c, unit, scale);
    return {w, CumulantAxis<T>::at(a, unit, scale), CumulantAxis<T>::at(c, unit, scale), transform(w, origin),
            log2(opacity * shape.amp) - constant};
  }

  template <typename T, class V> AR_HD static V alpha(const Terms<T>& t, Vec2<V> pixel, int) {
    const Vec2<V> z = transform(t.w, pixel, t.origin), p = transform_transposed(t.w, z);
    const V gaussian = madd(-z.x, z.x, madd(-z.y, z.y, V(t.log_peak)));
    return exp2(t.x.subtract_from(t.y.subtract_from(gaussian, t.y.capped(p.y)), t.x.capped(p.x)));
  }

  /// z + e and the matrix of docs/internals/numerics.md, "Gradients of the weights", to base 2.
  template <typename T, class V>
  AR_HD static void add_alpha_vjp(const Terms<T>& t, Vec2<V> pixel, int, AlphaGrad<V> grad, ShapeGrad<V>& sums) {
    const Lower2<T>& w = t.w;
    const Vec2<V> z = transform(w, pixel, t.origin), p = transform_transposed(w, z);
    const V px = t.x.capped(p.x), py = t.y.capped(p.y);
    const Vec2<V> e = transform(w, Vec2<V>{t.x.half_by_p(p.x, px), t.y.half_by_p(p.y, py)});
    const V ha = t.x.by_t(px), hc = t.y.by_t(py), g = grad.weighted;
    const Vec2<V> u = {z.x + e.x, z.y + e.y};
    const V wx = V(w.xx) * ha;
    const V xx = madd(z.x, u.x + e.x, wx * V(w.xx)), xy = madd(z.x, u.y, madd(e.x, z.y, wx * V(w.yx)));
    const V yy = madd(z.y, u.y + e.y, madd(V(w.yx) * ha, V(w.yx), V(w.yy) * hc * V(w.yy)));
    sums.offset = {madd(g, u.x, sums.offset.x), madd(g, u.y, sums.offset.y)};
    sums.shape = {madd(g, xx, sums.shape.xx), madd(g, xy, sums.shape.xy), madd(g, yy, sums.shape.yy)};
  }

  template <typename T> AR_HD static Mat2<T> mean_map(const Shape<T>& shape) { return all_of(T(1 / kBase2) * shape.w); }

  template <typename T>
  AR_HD static SplatGrad<T> prepare_vjp(Cov2d<T>, const Shape<T>& shape, ShapeGrad<T> sums, T weighted,
                                        FootprintOptions) {
    return gaussian_vjp(shape.w, sums, weighted, T(kPixelVariance));
  }

 private:
  template <typename T> AR_HD static T conic_xx(const Lower2<T>& w) { return w.xx * w.xx + w.yx * w.yx; }
  template <typename T> AR_HD static T conic_yy(const Lower2<T>& w) { return w.yy * w.yy; }
};

}  // namespace ar
