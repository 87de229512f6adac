// `box` with the samples chosen for every tile (core/choose.h).
#pragma once

#include "core/footprint/box.h"

namespace ar {

/// The covariance itself, from which a tile derives what its samples need.
template <typename T> struct AdaptiveShape {
  Cov2d<T> cov;
  T deviations;  ///< sqrt(det): product of the standard deviations [px^2]
};

/// A tile of S samples: Box<S> of splats that keep their covariance.
template <int S> struct AdaptiveBox : GaussianFootprint<S, true> {
  using Gaussian = GaussianFootprint<S, true>;
  static constexpr double kVariance = kBoxVariance<S>;
  template <typename T> using Shape = AdaptiveShape<T>;

  AR_HD static double radius_variance(FootprintOptions) { return kPixelVariance; }

  template <typename T> AR_HD static Shape<T> prepare(Cov2d<T> cov, FootprintOptions) { return {cov, sqrt(cov.det)}; }

  template <typename T> AR_HD static Mat2<T> ellipse(const Shape<T>& shape) {
    return whitening(shape.cov, T(kVariance));
  }

  template <typename T> AR_HD static auto terms(const Shape<T>& shape, T opacity, Vec2<T> origin = {T(0), T(0)}) {
    return Gaussian::terms(GaussianShape<T>{ellipse(shape), amplitude(shape)}, opacity, origin);
  }

  template <typename T> AR_HD static Mat2<T> mean_map(const Shape<T>& shape) { return T(1 / kBase2) * ellipse(shape); }

  template <typename T> AR_HD static T amplitude(const Shape<T>& shape) {
    return shape.deviations / sqrt(blur(shape.cov, T(kVariance)).det);
  }

 protected:
  /// The axis that comes first is that of Sigma, whatever rounding makes of the sum.
  template <typename T> AR_HD static Mat2<T> whitening(Cov2d<T> cov, T variance) {
    return whiten(blur(cov, variance), cov.xx >= cov.yy);
  }
};

/// The same with gradients. Tiles of different S sum into the same splat, so collect() takes their sums to
/// common coordinates, those of a single sample.
template <int S> struct AdaptiveBoxVjp : AdaptiveBox<S> {
  using Box = AdaptiveBox<S>;
  template <typename T> using Shape = AdaptiveShape<T>;

  template <typename T> struct Terms : Box::Gaussian::template Terms<T> {
    Mat2<T> from_common;  ///< whitening matrix here times the inverse of the common one
  };

  template <typename T> AR_HD static Terms<T> terms(const Shape<T>& shape, T opacity, Vec2<T> origin = {T(0), T(0)}) {
    return {Box::terms(shape, opacity, origin), from_common(shape.cov)};
  }

  template <typename T> AR_HD static ShapeGrad<T> collect(const Terms<T>& t, const ShapeGrad<T>& sums, T weighted) {
    const T square = T(1 / (kBase2 * kBase2));
    const Sym2<T> s = {square * sums.shape.xx - weighted, square * sums.shape.xy, square * sums.shape.yy - weighted};
    return {transform_transposed(t.from_common, sums.offset), congruence_transposed(t.from_common, s)};
  }

  /// From sums that collect() has taken to the common coordinates.
  template <typename T>
  AR_HD static SplatGrad<T> prepare_vjp(Cov2d<T> cov, const Shape<T>&, ShapeGrad<T> sums, T weighted) {
    const Mat2<T> w = Box::whitening(cov, T(kPixelVariance));
    const Sym2<T> half = {T(0.5) * sums.shape.xx, T(0.5) * sums.shape.xy, T(0.5) * sums.shape.yy};
    return {transform_transposed(T(1 / kBase2) * w, sums.offset), congruence_transposed(w, half), T(0.5) * weighted};
  }

 private:
  /// w_S w_1^-1, without cancellation: both are Cholesky factors, the same axis first.
  template <typename T> AR_HD static Mat2<T> from_common(Cov2d<T> cov) {
    const Cov2d<T> own = blur(cov, T(Box::kVariance)), common = blur(cov, T(kPixelVariance));
    const bool wide_x = cov.xx >= cov.yy;
    const T wide = wide_x ? own.xx : own.yy, common_wide = wide_x ? common.xx : common.yy;
    const T across = sqrt(wide / own.det), common_across = sqrt(common_wide / common.det);
    const T turn = -across * cov.xy * T(kPixelVariance - Box::kVariance) / (wide * sqrt(common_wide));
    return {sqrt(common_wide / wide), T(0), turn, across / common_across};
  }
};

/// What the tiles of `adaptive` are blended with, the longest work first.
using AdaptiveBoxes = FootprintList<AdaptiveBox<16>, AdaptiveBox<8>, AdaptiveBox<4>, AdaptiveBox<1>>;
using AdaptiveBoxesVjp = FootprintList<AdaptiveBoxVjp<16>, AdaptiveBoxVjp<8>, AdaptiveBoxVjp<4>, AdaptiveBoxVjp<1>>;

struct Adaptive : AdaptiveBoxVjp<16> {
  static constexpr const char* kName = "adaptive";

  /// Ellipse and level reach at least as far as those of every S: one sample has the largest variance,
  /// sixteen have the largest amplitude and reach.
  template <typename T> AR_HD static Mat2<T> ellipse(const Shape<T>& shape) { return AdaptiveBox<1>::ellipse(shape); }
  template <typename T> AR_HD static T level(const Shape<T>& shape, T opacity) {
    return gaussian_level(amplitude(shape), opacity);
  }
};

}  // namespace ar
