// `box` with the samples chosen for every tile (core/choose.h).
#pragma once

#include "core/footprint/box.h"

namespace ar {

/// The covariance itself, from which a tile derives what its samples need.
template <typename T> struct AdaptiveShape {
  Cov2d<T> cov;
  T sqrt_det;  ///< product of the standard deviations [px^2]
};

/// How a tile of S samples is blended: as Box<S>, but from splats that carry their covariance, because tiles with other
/// numbers of samples need it too.
template <int S> struct AdaptiveBox : GaussianFootprint<S, true> {
  using Gaussian = GaussianFootprint<S, true>;
  static constexpr double kVariance = kBoxVariance<S>;
  using Spread = void;  // tiles with one and with eight samples are in the same grid, and have 16x16 pixels
  template <typename T> using Shape = AdaptiveShape<T>;

  AR_HD static double radius_variance(FootprintOptions) { return kPixelVariance; }
  AR_HD static double support_variance(FootprintOptions) { return kPixelVariance; }

  template <typename T> AR_HD static Shape<T> prepare(Cov2d<T> cov, FootprintOptions) { return {cov, sqrt(cov.det)}; }

  /// The shape of the same splat for Gaussian.
  template <typename T> AR_HD static GaussianShape<T> gaussian(const Shape<T>& shape) {
    return gaussian_shape(blur(shape.cov, T(kVariance)), amplitude(shape));
  }

  template <typename T> AR_HD static Mat2<T> ellipse(const Shape<T>& shape) { return wide_first(gaussian(shape)); }

  template <typename T> AR_HD static auto terms(const Shape<T>& shape, T opacity, Vec2<T> origin = {T(0), T(0)}) {
    return Gaussian::terms(gaussian(shape), opacity, origin);
  }

  template <typename T> AR_HD static Mat2<T> mean_map(const Shape<T>& shape) {
    return all_of(T(1 / kBase2) * whiten(blur(shape.cov, T(kVariance))));
  }

  template <typename T> AR_HD static T amplitude(const Shape<T>& shape) {
    return shape.sqrt_det / sqrt(blur(shape.cov, T(kVariance)).det);
  }
};

/// The same with gradients. Tiles with different S add to the sums of the same splat, so collect() takes their sums to
/// common coordinates, those of a single sample (docs/numerics.md, "Common coordinates of adaptive").
template <int S> struct AdaptiveBoxVjp : AdaptiveBox<S> {
  using Box = AdaptiveBox<S>;
  template <typename T> using Shape = AdaptiveShape<T>;

  template <typename T> struct Terms : Box::Gaussian::template Terms<T> {
    Lower2<T> from_common;  ///< whitening matrix here times the inverse of the common one
    Sym2<T> log_amp;        ///< gradient of log amp here less that of a single sample, in the common coordinates
  };

  template <typename T> AR_HD static Terms<T> terms(const Shape<T>& shape, T opacity, Vec2<T> origin = {T(0), T(0)}) {
    const Lower2<T> f = from_common(shape.cov);
    return {Box::terms(shape, opacity, origin), f, log_amp_from_common(shape.cov, f)};
  }

  template <typename T> AR_HD static ShapeGrad<T> collect(const Terms<T>& t, const ShapeGrad<T>& sums, T weighted) {
    const Sym2<T> amplitude = {weighted * t.log_amp.xx, weighted * t.log_amp.xy, weighted * t.log_amp.yy};
    return {transform_transposed(t.from_common, sums.offset),
            congruence_transposed(t.from_common, sums.shape) + amplitude};
  }

  /// From sums that collect() has taken to the common coordinates.
  template <typename T>
  AR_HD static SplatGrad<T> prepare_vjp(Cov2d<T> cov, const Shape<T>&, ShapeGrad<T> sums, T weighted,
                                        FootprintOptions) {
    return gaussian_vjp(whiten(blur(cov, T(kPixelVariance))), sums, weighted, T(kPixelVariance));
  }

 private:
  /// w_S w_1^-1, without cancellation: both are Cholesky factors.
  template <typename T> AR_HD static Lower2<T> from_common(Cov2d<T> cov) {
    const Cov2d<T> own = blur(cov, T(Box::kVariance)), common = blur(cov, T(kPixelVariance));
    const T across = sqrt(own.xx / own.det), common_across = sqrt(common.xx / common.det);
    const T slope = -across * cov.xy * T(kPixelVariance - Box::kVariance) / (own.xx * sqrt(common.xx));
    return {sqrt(common.xx / own.xx), slope, across / common_across};
  }
  /// With F = w_S w_1^-1 the difference of the gradients, (C_1 - C_S) / 2 = (v_S - v_1) C_1 C_S / 2, is
  /// (v_S - v_1) w_1 w_1^T F^T F / 2 in coordinates w_1, and there kBase2^2 times what a sum of z z^T is.
  template <typename T> AR_HD static Sym2<T> log_amp_from_common(Cov2d<T> cov, const Lower2<T>& f) {
    const Lower2<T> w = whiten(blur(cov, T(kPixelVariance)));
    const T scale = T(kBase2 * kBase2 * (Box::kVariance - kPixelVariance));
    const T axx = w.xx * w.xx, axy = w.xx * w.yx, ayy = w.yx * w.yx + w.yy * w.yy;
    const Sym2<T> b = congruence_transposed(f, Sym2<T>{T(1), T(0), T(1)});
    return {scale * (axx * b.xx + axy * b.xy), scale * (axx * b.xy + axy * b.yy), scale * (axy * b.xy + ayy * b.yy)};
  }
};

/// What the tiles of `adaptive` are blended with, the longest work first.
using AdaptiveBoxes = FootprintList<AdaptiveBox<16>, AdaptiveBox<8>, AdaptiveBox<4>, AdaptiveBox<1>>;
using AdaptiveBoxesVjp = FootprintList<AdaptiveBoxVjp<16>, AdaptiveBoxVjp<8>, AdaptiveBoxVjp<4>, AdaptiveBoxVjp<1>>;

struct Adaptive : AdaptiveBoxVjp<16> {
  static constexpr const char* kName = "adaptive";
  static constexpr Option kOption = {"tolerance", nullptr, 1.0 / 255};

  /// Ellipse and level reach at least as far as those of every S: one sample has the largest variance,
  /// sixteen have the largest amplitude and reach.
  template <typename T> AR_HD static Mat2<T> ellipse(const Shape<T>& shape) { return AdaptiveBox<1>::ellipse(shape); }
  template <typename T> AR_HD static T level(const Shape<T>& shape, T opacity) {
    return gaussian_level(amplitude(shape), opacity);
  }
};

}  // namespace ar
