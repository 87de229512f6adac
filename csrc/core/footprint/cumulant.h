// The axis-aligned unit pixel through its cumulants: one exponential, smooth in Sigma, no
// eigenvectors. "Q6" of docs/numerics.md.
#pragma once

#include "core/footprint/gaussian.h"

namespace ar {

/// One axis of the correction to the exponent, s(p, t) = P^2 (c4 - c6 min(P, c4 / (2 c6))) - 6 P t k2
/// + 3 t^2 k0 with P = p^2 and t the conic's diagonal entry: fourth and sixth cumulant of the box.
/// The min() keeps the P^2 term non-negative; without it the far tail diverges.
template <typename T> struct CumulantAxis {
  T c4, c6, cap;                   // of P^2
  T linear, constant;              // 6 t k2, 3 t^2 k0
  T dc4, dc6, dlinear, dconstant;  // derivatives by t

  AR_HD static CumulantAxis at(T t) {
    const T x = t * T(kPixelVariance), dx = T(kPixelVariance);
    CumulantAxis a;
    a.c4 = T(1) + T(20.0 / 7) * x + T(0.4366) * x * x;
    a.dc4 = (T(20.0 / 7) + T(2 * 0.4366) * x) * dx;
    const T k2 = T(1) + T(10.0 / 7) * x + T(0.6240) * x * x;
    const T dk2 = (T(10.0 / 7) + T(2 * 0.6240) * x) * dx;
    const T k0 = T(1) + T(20.0 / 21) * x + T(0.6975) * x * x;
    const T dk0 = (T(20.0 / 21) + T(2 * 0.6975) * x) * dx;
    const bool floored = T(1) - x < T(1e-6);
    a.c6 = (floored ? T(1e-6) : T(1) - x) / T(63);
    a.dc6 = floored ? T(0) : -dx / T(63);
    a.cap = a.c4 / (T(2) * a.c6);
    a.linear = T(6) * t * k2;
    a.dlinear = T(6) * (k2 + t * dk2);
    a.constant = T(3) * t * t * k0;
    a.dconstant = T(3) * t * (T(2) * k0 + t * dk0);
    return a;
  }

  template <class V> AR_HD V value(V p) const {
    const V P = p * p;
    const V quartic = V(c4) - V(c6) * min(P, V(cap));
    return madd(P, madd(P, quartic, V(-linear)), V(constant));
  }
  template <class V> AR_HD V by_p(V p) const {
    const V P = p * p;
    const V quartic = V(c4) - V(c6) * min(P, V(cap));
    const V falling = select(P < V(cap), V(c6) * P, V(T(0)));  // -dquartic/dP * P
    return V(T(2)) * p * (P * (quartic + quartic - falling) - V(linear));
  }
  template <class V> AR_HD V by_t(V p) const {
    const V P = p * p;
    const V dquartic = select(P < V(cap), V(dc4) - V(dc6) * P, V(T(0.5) * dc4));
    return madd(P, madd(P, dquartic, V(-dlinear)), V(dconstant));
  }
};

struct Cumulant {
  static constexpr const char* kName = "cumulant";
  static constexpr int kSamples = 1;
  static constexpr double kReach = 0;
  static constexpr double kOrder4 = 1.0 / 2880;
  template <typename T> using Shape = GaussianShape<T>;

  template <typename T> struct Terms {
    Mat2<T> w;
    Vec2<T> origin;  ///< whitened
    T peak;          ///< opacity * amp
    CumulantAxis<T> x, y;
  };

  AR_HD static double radius_variance(FootprintOptions) { return kPixelVariance; }

  template <typename T> AR_HD static Shape<T> prepare(Cov2d<T> cov, FootprintOptions) {
    const Cov2d<T> blurred = blur(cov, T(kPixelVariance));
    return {whiten(blurred), sqrt(cov.det / blurred.det)};
  }

  template <typename T> AR_HD static Mat2<T> ellipse(const Shape<T>& shape) { return shape.w; }

  /// The correction adds at most (a^2 + c^2)/124 to the level (docs/numerics.md, "Support").
  template <typename T> AR_HD static T level(const Shape<T>& shape, T opacity) {
    const T a = conic_xx(shape.w), c = conic_yy(shape.w);
    return gaussian_level(shape.amp, opacity) + (a * a + c * c) / T(124);
  }

  template <typename T> AR_HD static Terms<T> terms(const Shape<T>& shape, T opacity, Vec2<T> origin = {T(0), T(0)}) {
    return {shape.w, transform(shape.w, origin), opacity * shape.amp, CumulantAxis<T>::at(conic_xx(shape.w)),
            CumulantAxis<T>::at(conic_yy(shape.w))};
  }

  template <typename T, class V> AR_HD static V alpha(const Terms<T>& t, Vec2<V> pixel, int) {
    const Vec2<V> z = transform(t.w, pixel, t.origin), p = transform_transposed(t.w, z);
    const V correction = t.x.value(p.x) + t.y.value(p.y);
    const V q = madd(z.x, z.x, z.y * z.y);
    return V(t.peak) * exp2(madd(correction, V(T(-kOrder4 * kLog2e)), V(T(-0.5 * kLog2e)) * q));
  }

  /// With h the correction, p = C d and e = w dh/dp, in whitened coordinates:
  /// d log I = (z + e).w dmu + tr(w^T (z z^T / 2 + sym(e z^T) + w diag(dh/da, dh/dc) w^T) w dSigma).
  template <typename T, class V>
  AR_HD static void add_alpha_vjp(const Terms<T>& t, Vec2<V> pixel, int, V alpha, V dL_dalpha, ShapeGrad<V>& sums) {
    const Vec2<V> z = transform(t.w, pixel, t.origin), p = transform_transposed(t.w, z);
    const V scale = V(T(kOrder4)), twice = V(T(2 * kOrder4));
    const Vec2<V> e = transform(t.w, Vec2<V>{scale * t.x.by_p(p.x), scale * t.y.by_p(p.y)});
    const V ha = twice * t.x.by_t(p.x), hc = twice * t.y.by_t(p.y);
    const V g = dL_dalpha * alpha;
    const Mat2<T>& w = t.w;
    const V xx = madd(z.x, z.x + e.x + e.x, madd(V(w.xx * w.xx), ha, V(w.xy * w.xy) * hc));
    const V xy = madd(z.x, z.y + e.y, madd(e.x, z.y, madd(V(w.xx * w.yx), ha, V(w.xy * w.yy) * hc)));
    const V yy = madd(z.y, z.y + e.y + e.y, madd(V(w.yx * w.yx), ha, V(w.yy * w.yy) * hc));
    sums.offset = {madd(g, z.x + e.x, sums.offset.x), madd(g, z.y + e.y, sums.offset.y)};
    sums.shape = {madd(g, xx, sums.shape.xx), madd(g, xy, sums.shape.xy), madd(g, yy, sums.shape.yy)};
  }

  template <typename T> AR_HD static Mat2<T> mean_map(const Shape<T>& shape) { return shape.w; }

  template <typename T>
  AR_HD static SplatGrad<T> prepare_vjp(Cov2d<T>, const Shape<T>& shape, ShapeGrad<T> sums, T weighted) {
    return gaussian_vjp(shape.w, sums, weighted);
  }

 private:
  template <typename T> AR_HD static T conic_xx(const Mat2<T>& w) { return w.xx * w.xx + w.yx * w.yx; }
  template <typename T> AR_HD static T conic_yy(const Mat2<T>& w) { return w.xy * w.xy + w.yy * w.yy; }
};

}  // namespace ar
