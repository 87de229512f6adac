// From the parameters that a training optimises to the rasterizer's: exp of scales, quaternions divided by their
// length, the logistic function of opacities; and the adjoint, which computes the values again. cpu/activations.cpp and
// cuda/activations.cu run both over the Gaussians.
#pragma once

#include <cmath>

#include "core/vec.h"

namespace ar {

/// The least divisor of a quaternion, as in torch.nn.functional.normalize.
inline constexpr double kMinQuaternionLength = 1e-12;

template <typename T> struct ActivateParams {
  int64_t n;
  const Vec3<T>* log_scales;
  const Vec4<T>* quats;
  const T* logit_opacities;
  Vec3<T>* scales;
  Vec4<T>* rotations;
  T* opacities;
};

/// A gradient that is null is zero if it is read, and not wanted if it is written.
template <typename T> struct ActivateVjpParams {
  int64_t n;
  const Vec3<T>* log_scales;
  const Vec4<T>* quats;
  const T* logit_opacities;
  const Vec3<T>* dL_dscales;
  const Vec4<T>* dL_drotations;
  const T* dL_dopacities;
  Vec3<T>* dL_dlog_scales;
  Vec4<T>* dL_dquats;
  T* dL_dlogit_opacities;
};

template <typename T> AR_HD Vec3<T> scale_of(Vec3<T> logs) {
  return {std::exp(logs.x), std::exp(logs.y), std::exp(logs.z)};
}

template <typename T> AR_HD T opacity_of(T logit) { return T(1) / (T(1) + std::exp(-logit)); }

template <typename T> AR_HD T dot(Vec4<T> a, Vec4<T> b) { return a.x * b.x + a.y * b.y + a.z * b.z + a.w * b.w; }

template <typename T> AR_HD Vec4<T> rotation_of(Vec4<T> q) {
  const T length = max(sqrt(dot(q, q)), T(kMinQuaternionLength));
  return {q.x / length, q.y / length, q.z / length, q.w / length};
}

template <typename T> AR_HD Vec4<T> rotation_of_vjp(Vec4<T> q, Vec4<T> g) {
  const T norm = sqrt(dot(q, q)), length = max(norm, T(kMinQuaternionLength));
  const Vec4<T> r = {q.x / length, q.y / length, q.z / length, q.w / length};
  // A shorter quaternion is divided by a constant.
  const T along = norm < T(kMinQuaternionLength) ? T(0) : dot(r, g);
  return {(g.x - along * r.x) / length, (g.y - along * r.y) / length, (g.z - along * r.z) / length,
          (g.w - along * r.w) / length};
}

template <typename T> AR_HD void activate(const ActivateParams<T>& p, int64_t i) {
  p.scales[i] = scale_of(p.log_scales[i]);
  p.rotations[i] = rotation_of(p.quats[i]);
  p.opacities[i] = opacity_of(p.logit_opacities[i]);
}

template <typename T> AR_HD void activate_vjp(const ActivateVjpParams<T>& p, int64_t i) {
  if (p.dL_dlog_scales)
    p.dL_dlog_scales[i] = p.dL_dscales ? mul(p.dL_dscales[i], scale_of(p.log_scales[i])) : Vec3<T>{};
  if (p.dL_dquats) p.dL_dquats[i] = p.dL_drotations ? rotation_of_vjp(p.quats[i], p.dL_drotations[i]) : Vec4<T>{};
  if (p.dL_dlogit_opacities) {
    const T opacity = opacity_of(p.logit_opacities[i]);
    p.dL_dlogit_opacities[i] = p.dL_dopacities ? p.dL_dopacities[i] * opacity * (T(1) - opacity) : T(0);
  }
}

}  // namespace ar
