// The pixel as S small Gaussians, each composited with a transmittance of its own.
#pragma once

#include "core/footprint/gaussian.h"

namespace ar {

template <int S> inline constexpr const char* kBoxName = nullptr;
template <> inline constexpr const char* kBoxName<1> = "box1";
template <> inline constexpr const char* kBoxName<2> = "box2";
template <> inline constexpr const char* kBoxName<4> = "box4";
template <> inline constexpr const char* kBoxName<8> = "box8";
template <> inline constexpr const char* kBoxName<16> = "box16";

/// S equal Gaussians at the nodes of box_node<S>. The pixel's colour is the mean over the samples.
template <int S> struct Box : GaussianFootprint<S, true> {
  static constexpr const char* kName = kBoxName<S>;

  AR_HD static double radius_variance(FootprintOptions) { return kPixelVariance; }

  template <typename T> AR_HD static GaussianShape<T> prepare(Cov2d<T> cov, FootprintOptions) {
    return GaussianFootprint<S, true>::prepare_with(cov, T(kBoxVariance<S>));
  }

  template <typename T>
  AR_HD static SplatGrad<T> prepare_vjp(Cov2d<T>, const GaussianShape<T>& shape, ShapeGrad<T> sums, T weighted,
                                        FootprintOptions) {
    return GaussianFootprint<S, true>::prepare_vjp_with(shape, sums, weighted, T(kBoxVariance<S>));
  }
};

}  // namespace ar
