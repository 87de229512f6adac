// The activations of 3DGS: exp of scales, unit quaternions, sigmoid of opacities. Also their penalty in the loss, and
// the 3D filter.
#pragma once

#include <cmath>
#include <limits>

#include "core/vec.h"

namespace ar {

/// As in torch.nn.functional.normalize.
inline constexpr double kMinQuaternionLength = 1e-12;

/// Of a penalty: weighted sums over all Gaussians and their axes.
template <typename T> struct PenaltyWeights {
  T opacity, scale;
};

template <typename T> struct ActivateParams {
  int64_t n;
  const Vec3<T>* log_scales;
  const Vec4<T>* quats;
  const T* logit_opacities;
  Vec3<T>* scales;
  Vec4<T>* rotations;
  T* opacities;
  PenaltyWeights<T> weights;
  T* penalty;  ///< null: not wanted
};

/// Null: zero if it is read, not wanted if it is written.
template <typename T> struct ActivateVjpParams {
  int64_t n;
  const Vec3<T>* log_scales;
  const Vec4<T>* quats;
  const T* logit_opacities;
  const Vec3<T>* dL_dscales;
  const Vec4<T>* dL_drotations;
  const T* dL_dopacities;
  PenaltyWeights<T> weights;
  const T* dL_dpenalty;
  Vec3<T>* dL_dlog_scales;
  Vec4<T>* dL_dquats;
  T* dL_dlogit_opacities;
};

/// Opacities are [n], as all others.
template <typename T> struct FilterParams {
  int64_t n;
  const Vec3<T>* scales;
  const T* opacities;
  const T* widths;  ///< standard deviations of the filters
  Vec3<T>* filtered_scales;
  T* filtered_opacities;
};

/// Null: zero if it is read, not wanted if it is written.
template <typename T> struct FilterVjpParams {
  int64_t n;
  const Vec3<T>* scales;
  const T* opacities;
  const T* widths;
  const Vec3<T>* dL_dfiltered_scales;
  const T* dL_dfiltered_opacities;
  Vec3<T>* dL_dscales;
  T* dL_dopacities;
  T* dL_dwidths;
};

template <typename T> AR_HD Vec3<T> scale_of(Vec3<T> logs) {
  return {std::exp(logs.x), std::exp(logs.y), std::exp(logs.z)};
}

template <typename T> AR_HD T opacity_of(T logit) { return T(1) / (T(1) + std::exp(-logit)); }

template <typename T> AR_HD Vec4<T> rotation_of(Vec4<T> q) {
  const T length = max(sqrt(dot(q, q)), T(kMinQuaternionLength));
  return {q.x / length, q.y / length, q.z / length, q.w / length};
}

template <typename T> AR_HD Vec4<T> rotation_of_vjp(Vec4<T> q, Vec4<T> g) {
  const T norm = sqrt(dot(q, q)), length = max(norm, T(kMinQuaternionLength));
  const Vec4<T> r = {q.x / length, q.y / length, q.z / length, q.w / length};
  // A shorter quaternion has a constant divisor.
  const T along = norm < T(kMinQuaternionLength) ? T(0) : dot(r, g);
  return {(g.x - along * r.x) / length, (g.y - along * r.y) / length, (g.z - along * r.z) / length,
          (g.w - along * r.w) / length};
}

template <typename T> AR_HD T activate(const ActivateParams<T>& p, int64_t i) {
  const Vec3<T> s = p.scales[i] = scale_of(p.log_scales[i]);
  p.rotations[i] = rotation_of(p.quats[i]);
  const T opacity = p.opacities[i] = opacity_of(p.logit_opacities[i]);
  return p.weights.opacity * opacity + p.weights.scale * (s.x + s.y + s.z);
}

template <typename T> AR_HD void activate_vjp(const ActivateVjpParams<T>& p, int64_t i) {
  Vec3<T> by_scales = p.dL_dscales ? p.dL_dscales[i] : Vec3<T>{};
  T by_opacity = p.dL_dopacities ? p.dL_dopacities[i] : T(0);
  if (p.dL_dpenalty) {
    const T by_scale = *p.dL_dpenalty * p.weights.scale;
    by_scales += {by_scale, by_scale, by_scale};
    by_opacity += *p.dL_dpenalty * p.weights.opacity;
  }
  // Zero without a gradient, also where the value is infinite.
  if (p.dL_dlog_scales) {
    const bool given = p.dL_dscales || p.dL_dpenalty;
    p.dL_dlog_scales[i] = given ? mul(by_scales, scale_of(p.log_scales[i])) : Vec3<T>{};
  }
  if (p.dL_dquats) p.dL_dquats[i] = p.dL_drotations ? rotation_of_vjp(p.quats[i], p.dL_drotations[i]) : Vec4<T>{};
  if (p.dL_dlogit_opacities) {
    const T opacity = opacity_of(p.logit_opacities[i]);
    const bool given = p.dL_dopacities || p.dL_dpenalty;
    p.dL_dlogit_opacities[i] = given ? by_opacity * opacity * (T(1) - opacity) : T(0);
  }
}

template <typename T> struct FilteredAxis {
  T scale;               ///< sqrt(s^2 + w^2) of scale s and width w
  T by_scale, by_width;  ///< its derivatives s / scale, w / scale; the first is also what is left of the peak
};

/// A negative width makes NaN.
template <typename T> AR_HD FilteredAxis<T> filter_axis(T s, T width) {
  if (width == T(0)) return {s, T(1), T(0)};
  // hypot neither overflows nor loses small scales.
  const T scale = std::hypot(s, width < T(0) ? std::numeric_limits<T>::quiet_NaN() : width);
  return {scale, s / scale, width / scale};
}

/// The covariance gains width^2; the opacity falls with the peak, which keeps the mass [Mip-Splatting, Eq. 9].
template <typename T> AR_HD void apply_filter(const FilterParams<T>& p, int64_t i) {
  const Vec3<T> s = p.scales[i];
  const T width = p.widths[i];
  const FilteredAxis<T> x = filter_axis(s.x, width), y = filter_axis(s.y, width), z = filter_axis(s.z, width);
  p.filtered_scales[i] = {x.scale, y.scale, z.scale};
  p.filtered_opacities[i] = p.opacities[i] * (x.by_scale * y.by_scale * z.by_scale);
}

template <typename T> AR_HD void apply_filter_vjp(const FilterVjpParams<T>& p, int64_t i) {
  const Vec3<T> s = p.scales[i], by_scales = p.dL_dfiltered_scales ? p.dL_dfiltered_scales[i] : Vec3<T>{};
  const T width = p.widths[i], by_opacity = p.dL_dfiltered_opacities ? p.dL_dfiltered_opacities[i] : T(0);
  const FilteredAxis<T> x = filter_axis(s.x, width), y = filter_axis(s.y, width), z = filter_axis(s.z, width);
  const Vec3<T> shares = {x.by_scale, y.by_scale, z.by_scale}, by_width = {x.by_width, y.by_width, z.by_width};
  const Vec3<T> others = {y.by_scale * z.by_scale, z.by_scale * x.by_scale, x.by_scale * y.by_scale};
  // The share s / scale has the derivative by_width^2 / scale by s, and -share by_width / scale by the width.
  const Vec3<T> over_scales =
      width == T(0) ? Vec3<T>{} : Vec3<T>{others.x / x.scale, others.y / y.scale, others.z / z.scale};
  const Vec3<T> by_shares = (by_opacity * p.opacities[i]) * over_scales;
  if (p.dL_dscales) p.dL_dscales[i] = mul(by_scales, shares) + mul(by_shares, mul(by_width, by_width));
  if (p.dL_dopacities) p.dL_dopacities[i] = by_opacity * (x.by_scale * y.by_scale * z.by_scale);
  if (p.dL_dwidths) p.dL_dwidths[i] = dot(by_scales, by_width) - dot(by_shares, mul(shares, by_width));
}

}  // namespace ar
