// What density control sums up for every Gaussian over the pictures of a training. cpu/activations.cpp and
// cuda/activations.cu run it.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/platform.h"

namespace ar {

template <typename T> struct ObserveParams {
  int64_t n;
  const T* gradients;    ///< [n][stride] with respect to means2D
  int stride, first;     ///< columns of `gradients`, and the first of the two columns that count
  const int32_t* radii;  ///< [n]
  T* gradient_sums;      ///< [n] sums of the lengths of gradients
  int32_t* views;        ///< [n] pictures that show a Gaussian
};

/// Adds one picture. A Gaussian that it does not show has the gradient zero.
template <typename T> AR_HD void observe(const ObserveParams<T>& p, int64_t i) {
  const T x = p.gradients[i * p.stride + p.first], y = p.gradients[i * p.stride + p.first + 1];
  p.gradient_sums[i] += std::sqrt(x * x + y * y);
  p.views[i] += p.radii[i] > 0;
}

}  // namespace ar
