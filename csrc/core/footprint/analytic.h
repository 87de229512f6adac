// The footprint `analytic`: the Gaussian over a unit pixel turned into its eigenframe, with a logistic approximation of
// the CDF [AS, Eq. 2-9]. Forms are those of docs/internals/numerics.md, "Logistic window".
#pragma once

#include "core/footprint/eigenframe.h"

namespace ar {

/// [AS, Eq. 5]: S(z) = 1 / (1 + exp(-f(z))), f(z) = 1.6 z + 0.07 z^3.
inline constexpr double kLogistic1 = 1.6;
inline constexpr double kLogistic3 = 0.07;

/// Least standard deviation [px]: r^3 fits a float. Thinner splats have weights below 2.6e-6.
inline constexpr double kMinSigma = 1e-6;

/// Along an axis, t = u/sigma.
template <typename T> struct LogisticAxis {
  T half;              // half a pixel, 1/(2 sigma)
  T constant, square;  // f(b) - f(a) = constant + square t^2

  AR_HD static LogisticAxis at(T inv_sigma) {
    const T r = inv_sigma;
    return {T(0.5) * r, r * (T(kLogistic1) + T(0.25 * kLogistic3) * r * r), T(3 * kLogistic3) * r};
  }
};

/// For the derivatives of F = sinh y / (cosh x + cosh y), with t >= 0 and h = half.
///
///   dx/dt = linear + 3 kLogistic3 t^2,              dy/dt = square t,
///   t dx/dt + h dx/dh = t (dx/dt + spread),         t dy/dt + h dy/dh = y + cube + square t^2
template <typename T> struct LogisticSlopes {
  T linear, spread, cube;

  AR_HD static LogisticSlopes at(const LogisticAxis<T>& axis) {
    const T h = axis.half, hh = h * h;
    return {T(kLogistic1) + T(3 * kLogistic3) * hh, T(6 * kLogistic3) * hh, T(2 * kLogistic3) * h * hh};
  }
};

/// F = S(t + half) - S(t - half), without cancellation. a, b = |t| -+ half.
template <class V> struct LogisticWindow {
  using T = ScalarOf<V>;
  V lower, upper;  // exp(f(a)), exp(-f(b))
  V numerator, denominator;

  AR_HD LogisticWindow(V t, const LogisticAxis<T>& axis) {
    const V one = V(T(1)), distance = abs(t);
    // Keeps products of four factors finite; F is then below 1e-17.
    lower = exp2(min(logistic_base2(distance - V(axis.half)), V(T(40 * kLog2e))));
    upper = exp2(-logistic_base2(distance + V(axis.half)));
    numerator = one_minus_exp(madd(V(axis.square) * t, t, V(axis.constant)), lower * upper);
    denominator = (one + lower) * (one + upper);
  }

 private:
  AR_HD static V logistic_base2(V z) { return z * madd(V(T(kLogistic3 * kLog2e)) * z, z, V(T(kLogistic1 * kLog2e))); }
};

/// `inverse` = 1 / window.denominator.
template <class V> struct LogisticValue {
  using T = ScalarOf<V>;
  V value;     // F
  V by_t;      // dF/dt
  V by_sigma;  // d(sigma F)/dsigma

  AR_HD LogisticValue(const LogisticWindow<V>& f, V inverse, V t, const LogisticAxis<T>& axis,
                      const LogisticSlopes<T>& slopes) {
    const V one = V(T(1)), distance = abs(t), tt = t * t;
    value = f.numerator * inverse;
    const V product = f.lower * f.upper;
    const V by_x = value * (f.upper - f.lower) * inverse;
    const V by_y = madd(V(T(4)), product, (f.lower + f.upper) * (one + product)) * inverse * inverse;
    const V dx = madd(V(T(3 * kLogistic3)), tt, V(slopes.linear)), dy = V(axis.square) * distance;
    const V by_distance = madd(by_x, dx, by_y * dy);
    by_t = select(t < V(T(0)), -by_distance, by_distance);
    // F - y dF/dy cancels for wide splats. There its first term y F (F - y/3) is better, with an error of y^5/90.
    const V y = V(T(0.5)) * madd(V(axis.square) * t, t, V(axis.constant));
    const V excess = select(y < V(T(kSmall<T>)), y * value * madd(V(T(-1.0 / 3)), y, value), value - y * by_y);
    by_sigma = excess - madd(by_x, distance * (dx + V(slopes.spread)), by_y * madd(V(axis.square), tt, V(slopes.cube)));
  }

 private:
  template <typename S> static constexpr double kSmall = sizeof(S) == 4 ? 0.04 : 3e-4;
};

enum class FrameGradient {
  kFrozen,  ///< of a fixed frame (docs/internals/numerics.md, "Frame gradient")
  kPaper,   ///< of the formula [AS, Eq. 10-16]: grows like 1/(l1 - l2)
};

/// I = 2 pi s1 s2 F(u / s1) F(v / s2), (u, v) = d in the eigenframe of Sigma. |S - CDF| < 4e-4.
template <FrameGradient kFrame> struct Analytic : FootprintDefaults {
  static constexpr const char *kName = "analytic", *kPage = "window";
  static constexpr bool kExpensive = true, kGeneric = kFrame == FrameGradient::kPaper, kAlongRays = !kGeneric;
  static constexpr const char* kKey = kFrame == FrameGradient::kFrozen ? "analytic" : "analytic_paper";
  static constexpr Option kOption = {"frame_gradient", kFrame == FrameGradient::kFrozen ? "frozen" : "paper", 0,
                                     kFrame == FrameGradient::kFrozen};
  static constexpr double kExtraLevel = 6.1;  // see level(): both w^2 are at most 12

  template <typename T> struct Shape {
    Vec2<T> inv_sigma;  ///< 1 / standard deviations along the major and the minor axis [1/px]
    Vec2<T> axis;       ///< (cos, sin) of the major axis
    T mass;             ///< 2 pi s1 s2 [px^2]
  };
  template <typename T> struct Terms {
    LogisticSlopes<T> du, dv;
    Mat2<T> frame;   ///< rows: axes over their sigma
    Vec2<T> origin;  ///< in that frame
    T mass;          ///< opacity * 2 pi s1 s2
    LogisticAxis<T> u, v;
  };

  AR_HD static double radius_variance(FootprintOptions) { return 0; }
  AR_HD static double support_variance(FootprintOptions) { return kPixelVariance; }

  /// Deviates: [AS, Eq. 2] is 0/0 for some covariances (docs/internals/numerics.md, "Eigenframe").
  template <typename T> AR_HD static Shape<T> prepare(Cov2d<T> cov, FootprintOptions) {
    const Eigenframe<T> frame = eigenframe(cov);
    const T s1 = max(frame.sigma.x, T(kMinSigma)), s2 = max(frame.sigma.y, T(kMinSigma));
    return {{T(1) / s1, T(1) / s2}, frame.axis, T(2 * kPi) * s1 * s2};
  }

  template <typename T> AR_HD static Mat2<T> ellipse(const Shape<T>& g) {
    return scaled_axes(widened_by_pixel(g.inv_sigma), g.axis);
  }

  /// Along one axis -2 ln(F(u)/F(0)) >= u^2 w^2 - w^4/48 - 0.05, w^2 = 1/(sigma^2 + 1/12), wherever F(u)/F(0) > 1/255.
  /// w^4/48 is for the flat top of a narrow Gaussian's window, 0.05 for the logistic's tail.
  template <typename T> AR_HD static T level(const Shape<T>& g, T opacity) {
    const Vec2<T> w = widened_by_pixel(g.inv_sigma);
    const T slack = (w.x * w.x * w.x * w.x + w.y * w.y * w.y * w.y) / T(48) + T(0.1);
    const T peak = alpha(terms(g, opacity), Vec2<T>{T(0), T(0)}, 0);
    return T(2) * std::log(T(1 / kAlphaMin) * peak) + slack;
  }

  template <typename T> AR_HD static Terms<T> terms(const Shape<T>& g, T opacity, Vec2<T> origin = {T(0), T(0)}) {
    const Mat2<T> frame = scaled_axes(g.inv_sigma, g.axis);
    const auto u = LogisticAxis<T>::at(g.inv_sigma.x), v = LogisticAxis<T>::at(g.inv_sigma.y);
    return {
        LogisticSlopes<T>::at(u), LogisticSlopes<T>::at(v), frame, transform(frame, origin), opacity * g.mass, u, v};
  }

  template <typename T, class V> AR_HD static V alpha(const Terms<T>& t, Vec2<V> p, int) {
    const Vec2<V> e = transform(t.frame, p, t.origin);
    const LogisticWindow<V> f(e.x, t.u), g(e.y, t.v);
    return V(t.mass) * (f.numerator * g.numerator) * divide(V(T(1)), f.denominator * g.denominator);
  }

  /// offset: derivatives by u/s1 and v/s2. shape: by log s1, the frame, log s2.
  template <typename T, class V>
  AR_HD static void add_alpha_vjp(const Terms<T>& t, Vec2<V> p, int, AlphaGrad<V> grad, ShapeGrad<V>& sums) {
    const Vec2<V> e = transform(t.frame, p, t.origin);
    const LogisticWindow<V> fw(e.x, t.u), gw(e.y, t.v);
    const V inverse = divide(V(T(1)), fw.denominator * gw.denominator);
    const LogisticValue<V> f(fw, inverse * gw.denominator, e.x, t.u, t.du),
        g(gw, inverse * fw.denominator, e.y, t.v, t.dv);
    const V scale = grad.dL_dalpha * V(t.mass), scaled_f = scale * f.value, scaled_g = scale * g.value;
    sums.offset = {madd(scaled_g, f.by_t, sums.offset.x), madd(scaled_f, g.by_t, sums.offset.y)};
    sums.shape.xx = madd(scaled_g, f.by_sigma, sums.shape.xx);
    sums.shape.yy = madd(scaled_f, g.by_sigma, sums.shape.yy);
    if (kFrame == FrameGradient::kFrozen) {
      // I_u I_v / I: by the covariance of u and v, with a fixed window.
      sums.shape.xy = madd(scale * f.by_t, g.by_t, sums.shape.xy);
    } else {
      const T ratio = t.u.half / t.v.half;  // s2 / s1
      sums.shape.xy = sums.shape.xy + (scaled_g * f.by_t * (V(ratio) * e.y) - scaled_f * g.by_t * (e.x / V(ratio)));
    }
  }

  template <typename T> AR_HD static Mat2<T> mean_map(const Shape<T>& g) {
    return T(-1) * scaled_axes(g.inv_sigma, g.axis);
  }

  template <typename T>
  AR_HD static SplatGrad<T> prepare_vjp(Cov2d<T> cov, const Shape<T>& g, ShapeGrad<T> sums, T, FootprintOptions) {
    const Vec2<T> r = g.inv_sigma;
    // At l1 = l2 the formula has no derivative; zero is finite.
    const T gap = eigenvalue_gap(cov);
    const T turn = kFrame == FrameGradient::kFrozen ? T(1) : (gap > T(0) ? T(1) / (gap * r.x * r.y) : T(0));
    const Sym2<T> white = {T(0.5) * sums.shape.xx, T(0.5) * sums.shape.xy * turn, T(0.5) * sums.shape.yy};
    return {transform_transposed(mean_map(g), sums.offset),
            scaled_axes(g.inv_sigma, g.axis),
            white,
            T(0),
            T(0),
            GradFrame::kAxes};
  }
};

}  // namespace ar
