// The weight of one splat in one pixel, and its adjoint.
#pragma once

#include "core/footprint/contract.h"

namespace ar {

template <typename T> struct WeightParams {
  int64_t n;
  FootprintOptions options;
  const Vec2<T>* offsets;
  const Sym2<T>* covs;
  const T* dL_dweights;  ///< vjp only
  T* weights;            ///< forward only
  Vec2<T>* dL_doffsets;  ///< vjp only
  Sym2<T>* dL_dcovs;     ///< vjp only; xy doubled, see Sym2
};

template <typename T> AR_HD Cov2d<T> with_det(Sym2<T> c) {
  return {c.xx, c.xy, c.yy, difference_of_products(c.xx, c.yy, c.xy, c.xy)};
}

/// The mean over the samples. `d` = pixel centre - mean [px].
template <class F, typename T> AR_HD T weight(Sym2<T> cov, Vec2<T> d, FootprintOptions options) {
  const auto terms = F::terms(F::prepare(with_det(cov), options), T(1));
  T total = T(0);
  AR_UNROLL for (int s = 0; s < F::kSamples; ++s) total += F::alpha(terms, d, s);
  return total / T(F::kSamples);
}

template <typename T> struct WeightGrad {
  Vec2<T> offset;
  Sym2<T> cov;  ///< xy doubled, see Sym2
};

template <class F, typename T>
AR_HD WeightGrad<T> weight_vjp(Sym2<T> entries, Vec2<T> d, FootprintOptions options, T dL_dweight) {
  const Cov2d<T> cov = with_det(entries);
  const auto shape = F::prepare(cov, options);
  const auto terms = F::terms(shape, T(1));
  const T g = dL_dweight / T(F::kSamples);
  ShapeGrad<T> sums = {};
  T weighted = T(0);
  AR_UNROLL for (int s = 0; s < F::kSamples; ++s) {
    const T w = F::alpha(terms, d, s);
    F::add_alpha_vjp(terms, d, s, AlphaGrad<T>{g, g * w}, sums);
    weighted += g * w;
  }
  const SplatGrad<T> grad = F::prepare_vjp(cov, shape, sums, weighted, options);
  const Sym2<T> dL_dcov = cov_grad(cov, grad);
  return {{-grad.dL_dmean.x, -grad.dL_dmean.y}, {dL_dcov.xx, T(2) * dL_dcov.xy, dL_dcov.yy}};
}

}  // namespace ar
