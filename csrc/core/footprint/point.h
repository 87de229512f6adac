// The footprint `point`, that of 3DGS (2023): the value of the Gaussian, widened by `dilation`, at the pixel centre.
#pragma once

#include "core/footprint/gaussian.h"

namespace ar {

/// I = exp(-d^T (Sigma + dilation I)^-1 d / 2). Without a compensating amplitude, small splats gain mass.
struct Point : GaussianFootprint<1, false> {
  static constexpr const char* kName = "point";
  static constexpr Option kOption = {"dilation", nullptr, 0.3};

  AR_HD static double radius_variance(FootprintOptions options) { return options.number; }
  AR_HD static double support_variance(FootprintOptions options) { return options.number; }

  template <typename T> AR_HD static Shape<T> prepare(Cov2d<T> cov, FootprintOptions options) {
    return prepare_with(cov, T(options.number));
  }

  template <typename T>
  AR_HD static SplatGrad<T> prepare_vjp(Cov2d<T>, const Shape<T>& shape, ShapeGrad<T> sums, T weighted,
                                        FootprintOptions options) {
    return prepare_vjp_with(shape, sums, weighted, T(options.number));
  }
};

}  // namespace ar
