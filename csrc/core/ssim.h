// The loss of 3DGS, and its adjoint: structural similarity of two images [SSIM, Eq. 13] and their mean absolute error.
// The window is a Gaussian of 11 x 11 pixels, standard deviation 1.5 px. Images are in [0, 1], with zeros outside.
//
// [SSIM] Wang et al., Image Quality Assessment: From Error Visibility to Structural Similarity, 2004.
#pragma once

#include "core/lanes.h"

namespace ar {

inline constexpr int kSsimRadius = 5, kSsimWindow = 2 * kSsimRadius + 1;

/// Against 0 / 0.
inline constexpr double kSsimC1 = 0.01 * 0.01, kSsimC2 = 0.03 * 0.03;

/// Along one axis; at(k) is k pixels from the centre. Its own adjoint.
template <typename T, class At> AR_HD T window_sum(const At& at) {
  // exp(-k^2 / (2 * 1.5^2)), normalised
  constexpr double kWeights[] = {0.26601172486179434341, 0.21300553771125369989, 0.10936068950970001069,
                                 0.03600077212843082365, 0.00759875813523918418, 0.00102838008447910988};
  T sum = T(kWeights[0]) * at(0);
  AR_UNROLL for (int k = 1; k <= kSsimRadius; ++k) sum = madd(T(kWeights[k]), at(-k) + at(k), sum);
  return sum;
}

/// Window sums of image x and target y.
inline constexpr int kSsimMoments = 5;
enum SsimMoment { kMomentX, kMomentY, kMomentXX, kMomentYY, kMomentXY };

/// The similarity at a pixel, and its derivatives by window sums of the image.
inline constexpr int kSsimPartials = 3;
enum SsimPartial { kPartialX, kPartialXX, kPartialXY };
template <typename T> struct Ssim {
  T value;
  T partials[kSsimPartials];
};

template <typename T> AR_HD Ssim<T> ssim(const T (&moments)[kSsimMoments]) {
  const T x = moments[kMomentX], y = moments[kMomentY];
  const T variances = (moments[kMomentXX] - x * x) + (moments[kMomentYY] - y * y);
  const T a = T(2) * x * y + T(kSsimC1), b = T(2) * (moments[kMomentXY] - x * y) + T(kSsimC2);
  const T inv_c = T(1) / (x * x + y * y + T(kSsimC1)), inv_d = T(1) / (variances + T(kSsimC2));
  Ssim<T> s;
  s.value = (a * inv_c) * (b * inv_d);
  s.partials[kPartialX] = T(2) * (y * (b - a) * (inv_c * inv_d) + x * s.value * (inv_d - inv_c));
  s.partials[kPartialXX] = -s.value * inv_d;
  s.partials[kPartialXY] = T(2) * a * (inv_c * inv_d);
  return s;
}

template <typename T> AR_HD T pixel_value(T value) { return value; }
template <typename T> AR_HD T pixel_value(uint8_t value) { return T(value) / T(255); }

/// loss = l1 * (mean of |x - y|) + ssim * (mean of the similarity) + constant.
template <typename T> struct LossWeights {
  T l1, ssim, constant;
};

template <typename T, typename Target> struct SsimParams {
  int64_t planes;
  int height, width;
  const T* image;        ///< [planes, height, width]
  const Target* target;  ///< [planes, height, width]
  LossWeights<T> weights;
  T* map;       ///< [planes, height, width] or null
  T* loss;      ///< [1] or null
  T* partials;  ///< [kSsimPartials, planes, height, width] or null

  AR_HD int64_t pixels() const { return planes * height * width; }
};

template <typename T, typename Target>
AR_HD T combined_loss(const SsimParams<T, Target>& p, double l1_sum, double ssim_sum) {
  const double n = double(p.pixels());
  return T(double(p.weights.l1) * (l1_sum / n) + double(p.weights.ssim) * (ssim_sum / n) + double(p.weights.constant));
}

/// One of dL_dmap and dL_dloss is null.
template <typename T, typename Target> struct SsimVjpParams {
  int64_t planes;
  int height, width;
  const T* image;
  const Target* target;
  LossWeights<T> weights;
  const T* partials;
  const T* dL_dmap;   ///< [planes, height, width]
  const T* dL_dloss;  ///< [1]
  T* dL_dimage;       ///< [planes, height, width]

  AR_HD int64_t pixels() const { return planes * height * width; }
};

/// Gradients by |x - y| and the similarity, equal in all pixels. Partials include dL_dmap.
template <typename T, typename Target> AR_HD LossWeights<T> pixel_weights(const SsimVjpParams<T, Target>& p) {
  if (p.dL_dmap) return {T(0), T(1), T(0)};
  const T share = *p.dL_dloss / T(p.pixels());
  return {share * p.weights.l1, share * p.weights.ssim, T(0)};
}

/// Gradient by pixel x. `partials`: their window sums.
template <typename T> AR_HD T ssim_vjp(T x, T y, const T (&partials)[kSsimPartials], LossWeights<T> weights) {
  const T similarity = partials[kPartialX] + T(2) * x * partials[kPartialXX] + y * partials[kPartialXY];
  const T d = x - y;
  const T sign = d > T(0) ? T(1) : d < T(0) ? T(-1) : d;  // d: 0 or NaN
  return weights.ssim * similarity + weights.l1 * sign;
}

}  // namespace ar
