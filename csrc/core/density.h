// Adds one picture to the statistics of density control, per Gaussian: the length of the gradient by means2D, and a
// view where the radius is above 0. cpu/activations.cpp and cuda/activations.cu call it.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/platform.h"

namespace ar {

template <typename T> struct ObserveParams {
  int64_t n;
  const T* gradients;    ///< [n, stride] by means2D
  int stride, first;     ///< columns of `gradients`, and the first of the two that count
  const int32_t* radii;  ///< [n]
  T* gradient_sums;      ///< [n] of the lengths of gradients
  int32_t* views;        ///< [n] pictures that show it
};

/// Adds one picture. A Gaussian that it does not show has the gradient zero.
template <typename T> AR_HD void observe(const ObserveParams<T>& p, int64_t i) {
  const T x = p.gradients[i * p.stride + p.first], y = p.gradients[i * p.stride + p.first + 1];
  p.gradient_sums[i] += std::sqrt(x * x + y * y);
  p.views[i] += p.radii[i] > 0;
}

}  // namespace ar
