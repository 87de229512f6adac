// Motion blur. What moves by u px in the image while the shutter is open becomes a streak: a segment of length |u|,
// which has the variance |u|^2 / 12 along u. In camera space a point p moves by w = -shift - turn x p, shift and turn
// being those of the camera (docs/numerics.md, "Lens and shutter").
#pragma once

#include "core/lens.h"

namespace ar {

inline constexpr double kStreak = 0.28867513459481288225;  // 1 / sqrt(12)

template <typename T> AR_HD Vec2<T> motion_streak(const Lens<T>& lens, Vec2<T> focal, Vec3<T> p) {
  const Vec3<T> w = T(-1) * (lens.shift + cross(lens.turn, p));
  if (lens.orthographic())
    return {T(kStreak) * (focal.x * w.x + lens.screen.x), T(kStreak) * (focal.y * w.y + lens.screen.y)};
  return {T(kStreak) * (focal.x / p.z * (w.x - p.x / p.z * w.z) + lens.screen.x),
          T(kStreak) * (focal.y / p.z * (w.y - p.y / p.z * w.z) + lens.screen.y)};
}

template <typename T>
AR_HD void motion_streak_vjp(const Lens<T>& lens, Vec2<T> focal, Vec3<T> p, Vec2<T> dL_dstreak, Vec3<T>& dL_dp,
                             Lens<T>& dL_dlens, Vec2<T>& dL_dfocal) {
  const Vec3<T> w = T(-1) * (lens.shift + cross(lens.turn, p));
  const Vec2<T> g = {T(kStreak) * dL_dstreak.x, T(kStreak) * dL_dstreak.y};
  dL_dlens.screen = dL_dlens.screen + g;
  const T iz = lens.orthographic() ? T(1) : T(1) / p.z, gx = g.x * focal.x * iz, gy = g.y * focal.y * iz;
  const T rx = lens.orthographic() ? T(0) : p.x * iz, ry = lens.orthographic() ? T(0) : p.y * iz;
  const Vec3<T> by_w = {gx, gy, -(gx * rx + gy * ry)};
  const T ux = w.x - rx * w.z, uy = w.y - ry * w.z;
  dL_dfocal.x += g.x * iz * ux;
  dL_dfocal.y += g.y * iz * uy;
  dL_dlens.shift += T(-1) * by_w;
  dL_dlens.turn += cross(by_w, p);  // w = p x turn - shift
  dL_dp += cross(lens.turn, by_w);
  if (lens.orthographic()) return;
  dL_dp.x -= gx * w.z * iz;
  dL_dp.y -= gy * w.z * iz;
  dL_dp.z -= iz * (gx * ux + gy * uy) - iz * w.z * (gx * rx + gy * ry);
}

}  // namespace ar
