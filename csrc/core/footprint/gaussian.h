// Shared by point, mip, box and moment, and in part by others. Stored is a whitening matrix w, w^T w = (Sigma + v
// I)^-1: the exponent -|w d|^2 / 2 is never positive, and does not cancel for long needles as the conic form does
// (docs/internals/numerics.md, "Whitening").
#pragma once

#include "core/footprint/contract.h"

namespace ar {

template <typename T> struct GaussianShape {
  Lower2<T> w;  ///< whitening matrix [1/px]
  T amp;        ///< peak: sqrt(det Sigma / det Sigma'), 1 without compensation
  T x_given_y;  ///< if y is the wide axis, standard deviation of x given y [px], else zero; for wide_first()
};

/// A Cholesky factor of c^-1, x first.
template <typename T> AR_HD Lower2<T> whiten(Cov2d<T> c) {
  const T across = sqrt(quotient(c.xx, c.det));  // 1 / standard deviation of y given x
  return {quotient(T(1), sqrt(c.xx)), -across * quotient(c.xy, c.xx), across};
}
/// With the wide axis first.
template <typename T> AR_HD Mat2<T> whiten_wide_first(Cov2d<T> c) {
  if (c.xx >= c.yy) return all_of(whiten(c));
  const Lower2<T> w = whiten(Cov2d<T>{c.yy, c.xy, c.xx, c.det});
  return {T(0), w.xx, w.yy, w.yx};
}

/// An approximate x_given_y scales the ellipse, within kLevelSlack, and does not turn it.
template <typename T> AR_HD GaussianShape<T> gaussian_shape(Cov2d<T> c, T amp) {
  return {whiten(c), amp, c.xx >= c.yy ? T(0) : approx_sqrt(divide(c.det, c.yy))};
}

/// Makes the boxes of BoxReach (bin.h) smaller.
template <typename T> AR_HD Mat2<T> wide_first(const GaussianShape<T>& shape) {
  const Lower2<T>& w = shape.w;
  const bool wide_x = shape.x_given_y == T(0);
  const T across = w.yy * shape.x_given_y;
  return {wide_x ? w.xx : T(0), wide_x ? T(0) : w.xx * across,
          wide_x ? w.yx : madd(w.xx, w.xx, w.yx * w.yx) * shape.x_given_y, wide_x ? w.yy : w.yx * across};
}

/// kBase2^2 = log2(e) / 2 turns |w d|^2 into -log2 of the Gaussian.
inline constexpr double kBase2 = 0.84932180028801904272;

/// Beyond it amp * opacity * exp(-|w d|^2 / 2) < 1/255.
template <typename T> AR_HD T gaussian_level(T amp, T opacity) {
  return T(2) * std::log(T(1 / kAlphaMin) * opacity * amp);
}

/// From sums in whitened coordinates z = kBase2 w d: `offset` = sum g I z, `shape` = sum g I z z^T. `weighted` is zero
/// if the amplitude does not depend on Sigma. `variance` was added to Sigma.
template <typename T> AR_HD SplatGrad<T> gaussian_vjp(const Lower2<T>& w, ShapeGrad<T> sums, T weighted, T variance) {
  const T half = T(0.5 / (kBase2 * kBase2));
  const Sym2<T> white = {half * sums.shape.xx, half * sums.shape.xy, half * sums.shape.yy};
  return {transform_transposed(T(1 / kBase2) * w, sums.offset),
          all_of(w),
          white,
          weighted,
          variance,
          GradFrame::kTriangular};
}

/// Of each of the S Gaussians of `box` [px^2].
template <int S> inline constexpr double kBoxVariance = S == 1 ? kPixelVariance : 1.0 / (24 * S);

/// Node s of `box` [px]. The mixture has the mean and covariance of the pixel (docs/internals/numerics.md, "Nodes").
template <int S> AR_HD constexpr Vec2<double> box_node(int s) {
  constexpr Vec2<double> kNodes4[] = {{-0.12083, -0.36226}, {0.36226, -0.12083}};
  constexpr Vec2<double> kNodes16[] = {{0.26975, -0.14597}, {0.14427, -0.43939}, {0.06200, -0.14646},
                                       {0.18749, 0.14720},  {0.43551, -0.31294}, {0.39499, 0.06396},
                                       {0.10473, 0.35640},  {0.39573, 0.39912}};
  static_assert(S == 1 || S == 4 || S == 16, "box has 1, 4 or 16 samples");
  if (S == 1) return {0, 0};
  const Vec2<double> n = S == 4 ? kNodes4[s % 2] : kNodes16[s % 8];
  return s < S / 2 ? n : Vec2<double>{-n.x, -n.y};
}

template <int S> constexpr double box_reach() {
  double reach = 0;
  for (int s = 0; s < S; ++s) {
    const Vec2<double> n = box_node<S>(s);
    for (const double x : {n.x, -n.x, n.y, -n.y}) reach = x > reach ? x : reach;
  }
  return reach;
}

template <int S> struct GaussianSample;

/// Blending of all footprints that are S Gaussians, with any variance.
template <int S> struct GaussianPixels : FootprintDefaults {
  static constexpr int kSamples = S;
  static constexpr bool kAlongRays = S <= 4;
  static constexpr double kReach = box_reach<S>();
  using Spread = std::conditional_t<S == 1, void, GaussianSample<S>>;
  template <typename T> using Shape = GaussianShape<T>;

  template <typename T> struct Terms {
    Lower2<T> w;      ///< whitening matrix times kBase2
    T log_peak;       ///< log2(opacity * amp)
    Vec2<T> node[S];  ///< whitened, relative to the mean
  };

  template <typename T> AR_HD static Mat2<T> ellipse(const Shape<T>& shape) { return wide_first(shape); }

  template <typename T> AR_HD static T level(const Shape<T>& shape, T opacity) {
    return gaussian_level(shape.amp, opacity);
  }

  template <typename T> AR_HD static Terms<T> terms(const Shape<T>& shape, T opacity, Vec2<T> origin = {T(0), T(0)}) {
    const Lower2<T> w = T(kBase2) * shape.w;
    Terms<T> t{w, log2(opacity * shape.amp), {}};
    AR_UNROLL for (int s = 0; s < S; ++s) {
      const Vec2<double> n = box_node<S>(s);
      t.node[s] = transform(w, Vec2<T>{origin.x + T(n.x), origin.y + T(n.y)});
    }
    return t;
  }

  template <typename T, class V> AR_HD static Vec2<V> whitened(const Terms<T>& t, Vec2<V> p, int s) {
    if (S == 1) return transform(t.w, p, t.node[0]);
    const Vec2<V> z = transform(t.w, p);
    return {z.x + V(t.node[s].x), z.y + V(t.node[s].y)};
  }

  /// z.y takes longer to compute.
  template <typename T, class V> AR_HD static V log_alpha(const Terms<T>& t, Vec2<V> z) {
    return madd(-z.y, z.y, madd(-z.x, z.x, V(t.log_peak)));
  }

  template <typename T, class V> AR_HD static V alpha(const Terms<T>& t, Vec2<V> p, int s) {
    return exp2(log_alpha(t, whitened(t, p, s)));
  }

  template <typename T, class V>
  AR_HD static void add_alpha_vjp(const Terms<T>& t, Vec2<V> p, int s, AlphaGrad<V> grad, ShapeGrad<V>& sums) {
    const Vec2<V> z = whitened(t, p, s);
    const V gx = grad.weighted * z.x, gy = grad.weighted * z.y;
    sums.offset = sums.offset + Vec2<V>{gx, gy};
    sums.shape = {madd(gx, z.x, sums.shape.xx), madd(gx, z.y, sums.shape.xy), madd(gy, z.y, sums.shape.yy)};
  }

  template <typename T> AR_HD static Mat2<T> mean_map(const Shape<T>& shape) { return all_of(T(1 / kBase2) * shape.w); }
};

template <int S> struct GaussianSample : GaussianPixels<1> {
  static constexpr int kLanes = S;
  static constexpr double kReach = box_reach<S>();
  AR_HD static constexpr Vec2<double> node(int s) { return box_node<S>(s); }
};

/// kCompensated: the amplitude keeps the mass of the splat.
template <int S, bool kCompensated> struct GaussianFootprint : GaussianPixels<S> {
  using Pixels = GaussianPixels<S>;
  static constexpr const char* kPage = kCompensated ? "compensated" : "gaussian";
  template <typename T> using Shape = GaussianShape<T>;

  template <typename T> AR_HD static Shape<T> prepare_with(Cov2d<T> cov, T variance) {
    const Cov2d<T> blurred = blur(cov, variance);
    return gaussian_shape(blurred, kCompensated ? sqrt(quotient(cov.det, blurred.det)) : T(1));
  }

  template <typename T>
  AR_HD static SplatGrad<T> prepare_vjp_with(const Shape<T>& shape, ShapeGrad<T> sums, T weighted, T variance) {
    return gaussian_vjp(shape.w, sums, kCompensated ? weighted : T(0), variance);
  }
};

}  // namespace ar
