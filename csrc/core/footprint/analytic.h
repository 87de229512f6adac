// Analytic-Splatting: the Gaussian integrated over a unit pixel turned into its eigenframe, with a
// logistic approximation of the Gaussian's CDF [AS, Eq. 2-9].
#pragma once

#include "core/footprint/contract.h"

namespace ar {

/// [AS, Eq. 5]: S(z) = 1 / (1 + exp(-f(z))), f(z) = 1.6 z + 0.07 z^3.
inline constexpr double kLogistic1 = 1.6;
inline constexpr double kLogistic3 = 0.07;

/// Standard deviations below this [px] are raised to it, where r^3 still fits a float. The weight
/// of so thin a splat is below 2.6e-6, far under the threshold of 1/255.
inline constexpr double kMinSigma = 1e-6;

/// One axis: F = S((u + 1/2) r) - S((u - 1/2) r), r = 1/sigma, without the cancellation of the
/// difference: F = (1 - exp(-2 y)) / ((1 + exp(f(a))) (1 + exp(-f(b)))), a, b = (|u| -+ 1/2) r,
/// 2 y = f(b) - f(a) factored by r. (The sinh form of docs/numerics.md, scaled to stay finite.)
template <class V> struct LogisticWindow {
  using T = ScalarOf<V>;
  V side;          // +-1: sign of u
  V t, r;          // |u| r and 1/sigma
  V lower, upper;  // exp(f(a)), exp(-f(b))
  V value;         // F
  V inverse;       // 1 / ((1 + lower) (1 + upper))

  AR_HD LogisticWindow(V u, T inv_sigma) {
    const V zero = V(T(0)), one = V(T(1)), half = V(T(0.5));
    side = select(u < zero, V(T(-1)), one);
    r = V(inv_sigma);
    const V distance = abs(u), half_r = half * r;
    t = distance * r;
    // The clamp keeps products of two such factors finite; F is then below 1e-17.
    lower = exp2(min(logistic_base2(madd(distance, r, -half_r)), V(T(40 * kLog2e))));
    upper = exp2(-logistic_base2(madd(distance, r, half_r)));
    const V y2 = r * madd(V(T(kLogistic3)), madd(V(T(3)) * t, t, half_r * half_r), V(T(kLogistic1)));
    inverse = divide(one, (one + lower) * (one + upper));
    value = one_minus_exp(y2, lower * upper) * inverse;
  }

  /// dF/dx and dF/dy of F = sinh y / (cosh x + cosh y), x and y the half sum and half difference of
  /// f(b) and f(a); both without cancellation.
  AR_HD V by_half_sum() const { return -value * (lower - upper) * inverse; }
  AR_HD V by_half_difference() const {
    const V product = lower * upper;
    return madd(V(T(4)), product, (lower + upper) * (V(T(1)) + product)) * inverse * inverse;
  }

  /// dF/du.
  AR_HD V by_u() const {
    const V rr = r * r, tt = t * t;
    const V dx = r * madd(V(T(3 * kLogistic3)), madd(V(T(0.25)), rr, tt), V(T(kLogistic1)));
    const V dy = V(T(3 * kLogistic3)) * t * rr;
    return side * madd(by_half_sum(), dx, by_half_difference() * dy);
  }

  /// d(sigma F)/dsigma / sigma.
  AR_HD V by_sigma() const {
    const V rr = r * r, tt = t * t;
    const V dx = t * madd(V(T(3 * kLogistic3)), madd(V(T(0.75)), rr, tt), V(T(kLogistic1)));
    const V dy = r * madd(V(T(1.5 * kLogistic3)), madd(V(T(3)), tt, V(T(0.25)) * rr), V(T(0.5 * kLogistic1)));
    return r * (value - by_half_sum() * dx - by_half_difference() * dy);
  }

 private:
  /// f(z) log2(e)
  AR_HD static V logistic_base2(V z) { return z * madd(V(T(kLogistic3 * kLog2e)) * z, z, V(T(kLogistic1 * kLog2e))); }
};

/// Which derivative of the frame the adjoint takes.
enum class FrameGradient {
  kFrozen,  ///< the pixel's frame is held fixed: finite everywhere (docs/numerics.md, "Near l1 = l2")
  kPaper,   ///< the derivative of the formula [AS, Eq. 10-16]: grows like 1/(l1 - l2)
};

/// I = 2 pi s1 s2 F(u / s1) F(v / s2), (u, v) = d in the eigenframe of Sigma. |S - CDF| < 4e-4.
template <FrameGradient kFrame> struct Analytic {
  static constexpr const char* kName = kFrame == FrameGradient::kFrozen ? "analytic" : "analytic_paper";
  static constexpr int kSamples = 1;
  static constexpr double kReach = 0;

  template <typename T> struct Shape {
    Vec2<T> inv_sigma;  ///< 1 / standard deviations along the major and the minor axis [1/px]
    Vec2<T> axis;       ///< (cos, sin) of the major axis
    T mass;             ///< 2 pi s1 s2 [px^2]
  };
  template <typename T> struct Terms {
    Shape<T> shape;
    Vec2<T> origin;  ///< in the frame
    T mass;          ///< opacity * 2 pi s1 s2
  };

  AR_HD static double radius_variance(FootprintOptions) { return 0; }

  /// Deviates: [AS, Eq. 2] takes eigenvectors that are 0/0 for a diagonal Sigma with S11 > S22, and
  /// the smaller eigenvalue as a difference. Here the half angle and l2 = det / l1.
  template <typename T> AR_HD static Shape<T> prepare(Cov2d<T> cov, FootprintOptions) {
    const T dx = cov.xx - cov.yy, dy = T(2) * cov.xy;
    const T gap = eigenvalue_gap(cov);
    const T major = T(0.5) * (cov.xx + cov.yy + gap);
    const T s1 = max(sqrt(major), T(kMinSigma)), s2 = max(sqrt(max(cov.det / major, T(0))), T(kMinSigma));
    Vec2<T> axis = {T(1), T(0)};
    if (dx > T(0)) {
      axis.x = sqrt(T(0.5) * (T(1) + dx / gap));
      axis.y = dy / (T(2) * gap * axis.x);
    } else if (gap > T(0)) {
      const T sine = sqrt(T(0.5) * (T(1) - dx / gap));
      axis = {abs(dy) / (T(2) * gap * sine), dy < T(0) ? -sine : sine};
    }
    return {{T(1) / s1, T(1) / s2}, axis, T(2 * kPi) * s1 * s2};
  }

  /// Ellipse of Sigma + I/12.
  template <typename T> AR_HD static Mat2<T> ellipse(const Shape<T>& g) {
    const T w1 = widened(g.inv_sigma.x), w2 = widened(g.inv_sigma.y);
    return {w1 * g.axis.x, w1 * g.axis.y, -w2 * g.axis.y, w2 * g.axis.x};
  }

  /// Along one axis -2 ln(F(u)/F(0)) >= u^2/(sigma^2 + 1/12) - w^4/48 - 0.05, w^2 = 1/(sigma^2 + 1/12),
  /// wherever F(u)/F(0) > 1/255 (checked numerically in the tests). The first term is the flat top
  /// of a narrow Gaussian's window, the second the logistic's tail.
  template <typename T> AR_HD static T level(const Shape<T>& g, T opacity) {
    const T w1 = widened(g.inv_sigma.x), w2 = widened(g.inv_sigma.y);
    const T slack = (w1 * w1 * w1 * w1 + w2 * w2 * w2 * w2) / T(48) + T(0.1);
    const T peak = alpha(terms(g, opacity), Vec2<T>{T(0), T(0)}, 0);
    return T(2) * std::log(T(1 / kAlphaMin) * peak) + slack;
  }

  template <typename T> AR_HD static Terms<T> terms(const Shape<T>& g, T opacity, Vec2<T> origin = {T(0), T(0)}) {
    return {g, transform(frame(g), origin), opacity * g.mass};
  }

  template <typename T, class V> AR_HD static V alpha(const Terms<T>& t, Vec2<V> p, int) {
    const Vec2<V> e = transform(frame(t.shape), p, t.origin);
    return V(t.mass) * LogisticWindow<V>(e.x, t.shape.inv_sigma.x).value *
           LogisticWindow<V>(e.y, t.shape.inv_sigma.y).value;
  }

  /// offset = (g_u, g_v); shape = (g_s1, the frame term, g_s2).
  template <typename T, class V>
  AR_HD static void add_alpha_vjp(const Terms<T>& t, Vec2<V> p, int, V, V dL_dalpha, ShapeGrad<V>& sums) {
    const Vec2<V> e = transform(frame(t.shape), p, t.origin);
    const LogisticWindow<V> f(e.x, t.shape.inv_sigma.x), g(e.y, t.shape.inv_sigma.y);
    const V scale = dL_dalpha * V(t.mass);
    const V f_u = f.by_u(), g_v = g.by_u();
    const V by_u = scale * f_u * g.value, by_v = scale * f.value * g_v;
    // Frozen: I_u I_v / I, the pull of the covariance between u and v at a window that stays put.
    const V frame = kFrame == FrameGradient::kFrozen ? scale * f_u * g_v : by_u * e.y - by_v * e.x;
    sums.offset = sums.offset + Vec2<V>{by_u, by_v};
    sums.shape = {madd(scale * g.value, f.by_sigma(), sums.shape.xx), sums.shape.xy + frame,
                  madd(scale * f.value, g.by_sigma(), sums.shape.yy)};
  }

  template <typename T> AR_HD static Mat2<T> mean_map(const Shape<T>& g) {
    return {-g.axis.x, -g.axis.y, g.axis.y, -g.axis.x};
  }

  template <typename T> AR_HD static SplatGrad<T> prepare_vjp(Cov2d<T> cov, const Shape<T>& g, ShapeGrad<T> sums, T) {
    // Rotation of the frame per off-diagonal of Sigma is 1/(l1 - l2). At l1 = l2 the frame is
    // arbitrary and the formula has no derivative; zero is as good as any and finite.
    const T gap = eigenvalue_gap(cov);
    const T turn = kFrame == FrameGradient::kFrozen ? T(1) : (gap > T(0) ? T(1) / gap : T(0));
    const Sym2<T> along_axes = {T(0.5) * sums.shape.xx * g.inv_sigma.x, T(0.5) * sums.shape.xy * turn,
                                T(0.5) * sums.shape.yy * g.inv_sigma.y};
    return {transform_transposed(mean_map(g), sums.offset), congruence_transposed(frame(g), along_axes), T(0)};
  }

 private:
  /// Rows: the axes.
  template <typename T> AR_HD static Mat2<T> frame(const Shape<T>& g) {
    return {g.axis.x, g.axis.y, -g.axis.y, g.axis.x};
  }
  /// 1 / sqrt(sigma^2 + 1/12).
  template <typename T> AR_HD static T widened(T inv_sigma) {
    return inv_sigma / sqrt(T(1) + T(kPixelVariance) * inv_sigma * inv_sigma);
  }
};

}  // namespace ar
