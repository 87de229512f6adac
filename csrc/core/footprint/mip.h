// The footprint `mip`, the 2D filter of Mip-Splatting: the Gaussian convolved with a Gaussian pixel.
#pragma once

#include "core/footprint/gaussian.h"

namespace ar {

/// I = sqrt(det Sigma / det Sigma') exp(-d^T Sigma'^-1 d / 2), Sigma' = Sigma + variance I.
struct Mip : GaussianFootprint<1, true> {
  static constexpr const char* kName = "mip";
  static constexpr Option kOption = {"variance", nullptr, 0.1};

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
