// The footprint `box`: the pixel as S equal Gaussians at the nodes of box_node<S>, each with its own transmittance.
#pragma once

#include "core/footprint/gaussian.h"

namespace ar {

/// "box1" ... "box16"; the samples begin at the fourth character.
template <int S> struct BoxKey {
  static constexpr char kText[] = {'b', 'o', 'x', S >= 10 ? '1' : char('0' + S), S >= 10 ? char('0' + S % 10) : '\0',
                                   '\0'};
};

template <int S> struct Box : GaussianFootprint<S, true> {
  static constexpr const char* kName = "box";
  static constexpr const char* kKey = BoxKey<S>::kText;
  static constexpr Option kOption = {"samples", BoxKey<S>::kText + 3, 0, S == 4};

  AR_HD static double radius_variance(FootprintOptions) { return kPixelVariance; }
  AR_HD static double support_variance(FootprintOptions) { return kBoxVariance<S>; }

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
