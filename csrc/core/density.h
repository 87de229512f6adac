// Density control of a Gaussian in every step: `observe` adds a picture to its statistics, `add_noise` moves its mean
// at random.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/activations.h"
#include "core/covariance.h"

namespace ar {

template <typename T> struct ObserveParams {
  int64_t n;
  const T* gradients;    ///< [n, stride] by means2D
  int stride, first;     ///< columns of `gradients`, and the first of the two that count
  const int32_t* radii;  ///< [n]
  T* gradient_sums;      ///< [n] of the lengths of gradients
  int32_t* views;        ///< [n] pictures that show it
};

/// Noise fades out around this opacity [MCMC, Eq. 8].
inline constexpr double kNoiseSharpness = 100, kNoiseOpacity = 0.005;

template <typename T> struct NoiseParams {
  int64_t n;
  Vec3<T>* means;
  const Vec3<T>* log_scales;
  const Vec4<T>* quats;
  const T* logit_opacities;
  const Vec3<T>* normals;  ///< of a standard normal distribution
  T strength;              ///< of a transparent Gaussian
};

/// Adds the length of the gradient by means2D, and a view where the radius is above 0.
template <typename T> AR_HD void observe(const ObserveParams<T>& p, int64_t i) {
  const T x = p.gradients[i * p.stride + p.first], y = p.gradients[i * p.stride + p.first + 1];
  p.gradient_sums[i] += std::sqrt(x * x + y * y);
  p.views[i] += p.radii[i] > 0;
}

template <typename T> AR_HD void add_noise(const NoiseParams<T>& p, int64_t i) {
  const T opacity = opacity_of(p.logit_opacities[i]);
  const T strength = p.strength * opacity_of(T(kNoiseSharpness) * (T(kNoiseOpacity) - opacity));
  const Mat3<T> axes = rotation_matrix(normalize_quaternion(p.quats[i]));
  const Vec3<T> along = combine_rows(strength * p.normals[i], axes);  // In the Gaussian's frame.
  p.means[i] += axes * mul(scale_of(T(2) * p.log_scales[i]), along);
}

}  // namespace ar
