// Defocus: a point becomes a disc of diameter D, which has the variance D^2 / 16 along every axis
// (docs/internals/numerics.md, "Lens and shutter").
#pragma once

#include "core/camera/models.h"

namespace ar {

/// D / (f aperture), signed.
template <typename T> AR_HD T defocus_of(const FullCamera<T>& camera, Vec3<T> p) {
  return visit_model(camera, [&](auto model) AR_HD_LAMBDA { return model.defocus(camera.lens, p); });
}

template <typename T> AR_HD T defocus_variance(const FullCamera<T>& camera, Vec3<T> p) {
  const T q = camera.lens.aperture * defocus_of(camera, p);
  return T(1.0 / 16) * camera.focal.x * camera.focal.y * q * q;
}

template <typename T>
AR_HD void defocus_variance_vjp(const FullCamera<T>& camera, Vec3<T> p, T dL_dvariance, Vec3<T>& dL_dp,
                                Lens<T>& dL_dlens, Vec2<T>& dL_dfocal) {
  const Vec2<T> focal = camera.focal;
  const T q = defocus_of(camera, p), a = camera.lens.aperture, g = T(1.0 / 16) * dL_dvariance;
  const T by_q = T(2) * g * focal.x * focal.y * a * a * q;
  dL_dlens.aperture += T(2) * g * focal.x * focal.y * a * q * q;
  visit_model(camera, [&](auto model) AR_HD_LAMBDA { model.defocus_vjp(camera.lens, p, by_q, dL_dp, dL_dlens); });
  dL_dfocal.x += g * focal.y * a * a * q * q;
  dL_dfocal.y += g * focal.x * a * a * q * q;
}

}  // namespace ar
