// Lens: what a FullCamera has beyond a Camera; Python fills it by the names in kLensMembers. Blur: of lens and shutter.
#pragma once

#include "core/footprint/contract.h"

namespace ar {

inline constexpr int kDistortion = 12;

template <typename T> struct Lens {
  Vec2<T> tan_half_fov;       ///< orthographic: half the width and height, world units
  Vec2<T> center;             ///< x/z and y/z at the middle of the picture
  T aperture, focus;          ///< world units
  Vec3<T> shift, turn;        ///< of the camera during the exposure, along its axes [world units, radians]
  Vec2<T> screen;             ///< of the picture during the exposure [px]
  T distortion[kDistortion];  ///< coefficients of the model
  // Without gradient:
  T near, far;    ///< of the depth
  T reach, fold;  ///< lens_model.h: from where the Jacobian is clamped, and where the model ends
  T model;        ///< index in CameraModels

  AR_HD bool moves() const {
    return shift.x != T(0) || shift.y != T(0) || shift.z != T(0) || turn.x != T(0) || turn.y != T(0) ||
           turn.z != T(0) || screen.x != T(0) || screen.y != T(0);
  }
};
/// What Python does not set is zero.
struct LensMember {
  const char* name;
  int size;
};
inline constexpr LensMember kLensMembers[] = {
    {"tan_half_fov", 2}, {"center", 2}, {"aperture", 1}, {"focus", 1},
    {"shift", 3},        {"turn", 3},   {"screen", 2},   {"distortion", kDistortion},
    {"near", 1},         {"far", 1},    {"reach", 1},    {"fold", 1},
    {"model", 1},
};
inline constexpr int kLensWidth = [] {
  int width = 0;
  for (const LensMember& member : kLensMembers) width += member.size;
  return width;
}();
inline constexpr int kLensFixed = 5;  ///< that many at the end have no gradient
static_assert(sizeof(Lens<float>) == kLensWidth * sizeof(float));

/// With a smaller det Sigma [px^4] a blurred Gaussian has no mass: nothing derived overflows a float.
inline constexpr double kMinBlurredDet = 1e-30;

/// Adds streak streak^T + variance I to a covariance.
template <typename T> struct Blur {
  Vec2<T> streak;  ///< [px]
  T variance;      ///< [px^2]

  AR_HD bool any() const { return streak.x != T(0) || streak.y != T(0) || variance != T(0); }
};
struct NoBlur {};

}  // namespace ar
