// The parameters of a camera that is more than a pinhole open for an instant, and the blur that its lens and shutter
// make.
#pragma once

#include "core/footprint/contract.h"

namespace ar {

/// What a full camera has beyond a plain one: an aggregate of kLensWidth scalars. What Python knows of it is
/// kLensMembers.
template <typename T> struct Lens {
  Vec2<T> tan_half_fov;  ///< of an orthographic camera half the width and height, world units
  Vec2<T> center;        ///< x/z and y/z at the middle of the picture, around which they are clamped
  T aperture, focus;     ///< world units
  Vec3<T> shift, turn;   ///< of the camera while the shutter is open: world units and radians along its axes
  Vec2<T> screen;        ///< of the picture meanwhile [px]
  T near, far;           ///< camera-space z between which Gaussians are drawn; without gradient
  T model;               ///< index in CameraModels (core/camera/models.h); without gradient

  AR_HD bool moves() const {
    return shift.x != T(0) || shift.y != T(0) || shift.z != T(0) || turn.x != T(0) || turn.y != T(0) ||
           turn.z != T(0) || screen.x != T(0) || screen.y != T(0);
  }
};
/// The members of Lens, in order: Python fills the op's argument `lens` by these names, with zeros where it has none.
struct LensMember {
  const char* name;
  int size;
};
inline constexpr LensMember kLensMembers[] = {
    {"tan_half_fov", 2}, {"center", 2}, {"aperture", 1}, {"focus", 1}, {"shift", 3},
    {"turn", 3},         {"screen", 2}, {"near", 1},     {"far", 1},   {"model", 1},
};
inline constexpr int kLensWidth = [] {
  int width = 0;
  for (const LensMember& member : kLensMembers) width += member.size;
  return width;
}();
static_assert(sizeof(Lens<float>) == kLensWidth * sizeof(float));

/// A blurred Gaussian whose det Sigma [px^4] is below this, of standard deviations of 3e-8 px, counts as one without
/// mass, so that nothing derived from it overflows a float.
inline constexpr double kMinBlurredDet = 1e-30;

/// What is added to a projected covariance: streak streak^T + variance I [px^2]. Gaussians stay Gaussians, with the
/// amplitude that keeps their mass.
template <typename T> struct Blur {
  Vec2<T> streak;  ///< [px]
  T variance;      ///< [px^2]

  AR_HD bool any() const { return streak.x != T(0) || streak.y != T(0) || variance != T(0); }
};
/// Of a plain camera.
struct NoBlur {};

}  // namespace ar
