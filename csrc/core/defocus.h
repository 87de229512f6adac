// Defocus. Through a thin lens of aperture a, a point at depth z appears as a disc of diameter f a |1/focus - 1/z|
// [px]; under an orthographic camera of diameter f a |z - focus|. A disc of diameter D has the variance D^2 / 16 along
// every axis (docs/numerics.md, "Lens and shutter").
#pragma once

#include "core/lens.h"

namespace ar {

/// dD / (f a), signed.
template <typename T> AR_HD T defocus_of(const Lens<T>& lens, T z) {
  return lens.orthographic() ? z - lens.focus : T(1) / lens.focus - T(1) / z;
}

template <typename T> AR_HD T defocus_variance(const Lens<T>& lens, Vec2<T> focal, T z) {
  const T q = lens.aperture * defocus_of(lens, z);
  return T(1.0 / 16) * focal.x * focal.y * q * q;
}

template <typename T>
AR_HD void defocus_variance_vjp(const Lens<T>& lens, Vec2<T> focal, T z, T dL_dvariance, T& dL_dz, Lens<T>& dL_dlens,
                                Vec2<T>& dL_dfocal) {
  const T q = defocus_of(lens, z), a = lens.aperture, g = T(1.0 / 16) * dL_dvariance;
  const T by_q = T(2) * g * focal.x * focal.y * a * a * q;
  dL_dlens.aperture += T(2) * g * focal.x * focal.y * a * q * q;
  dL_dlens.focus -= lens.orthographic() ? by_q : by_q / (lens.focus * lens.focus);
  dL_dz += lens.orthographic() ? by_q : by_q / (z * z);
  dL_dfocal.x += g * focal.y * a * a * q * q;
  dL_dfocal.y += g * focal.x * a * a * q * q;
}

}  // namespace ar
