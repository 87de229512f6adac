// Motion blur: a point that moves by u px during the exposure has the variance |u|^2 / 12 along u
// (docs/internals/numerics.md, "Lens and shutter").
#pragma once

#include "core/camera/models.h"

namespace ar {

inline constexpr double kStreak = 0.28867513459481288225;  // 1 / sqrt(12)

template <typename T> AR_HD Vec3<T> motion_of(const Lens<T>& lens, Vec3<T> p) {
  return T(-1) * (lens.shift + cross(lens.turn, p));
}

template <typename T> AR_HD Vec2<T> motion_streak(const FullCamera<T>& camera, Vec3<T> p) {
  const Lens<T>& lens = camera.lens;
  const Vec2<T> v =
      visit_model(camera, [&](auto model) AR_HD_LAMBDA { return model.velocity(camera, p, motion_of(lens, p)); });
  return {T(kStreak) * (v.x + lens.screen.x), T(kStreak) * (v.y + lens.screen.y)};
}

template <typename T>
AR_HD void motion_streak_vjp(const FullCamera<T>& camera, Vec3<T> p, Vec2<T> dL_dstreak, Vec3<T>& dL_dp,
                             Lens<T>& dL_dlens, Vec2<T>& dL_dfocal) {
  const Vec2<T> g = {T(kStreak) * dL_dstreak.x, T(kStreak) * dL_dstreak.y};
  dL_dlens.screen = dL_dlens.screen + g;
  const VelocityGrad<T> by = visit_model(camera, [&](auto model) AR_HD_LAMBDA {
    return model.velocity_vjp(camera, p, motion_of(camera.lens, p), g, dL_dlens, dL_dfocal);
  });
  dL_dlens.shift += T(-1) * by.w;
  dL_dlens.turn += cross(by.w, p);  // w = p x turn - shift
  dL_dp += cross(camera.lens.turn, by.w);
  dL_dp += by.p;
}

}  // namespace ar
