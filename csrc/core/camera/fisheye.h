// Fisheye lenses: equidistant, the angle from the axis being the distance in the image, then distorted. COLMAP's
// SIMPLE_FISHEYE to THIN_PRISM_FISHEYE and OpenCV's fisheye are special cases of Fisheye. RadTanFisheye is COLMAP's
// RAD_TAN_THIN_PRISM_FISHEYE.
#pragma once

#include "core/camera/lens_model.h"

namespace ar {

/// The angle from the axis, in the direction of (x, y).
template <class N> AR_HD Vec2<N> equidistant(Vec3<N> p) {
  using S = decltype(value_of(p.x));
  const N rho2 = p.x * p.x + p.y * p.y, n = root(rho2 + p.z * p.z);
  // 1 minus and 1 plus the cosine, without cancellation
  const bool ahead = value_of(p.z) > S(0);
  const N near = ahead ? rho2 / (n * (n + p.z)) : (n - p.z) / n, far = ahead ? (n + p.z) / n : rho2 / (n * (n - p.z));
  const N scale = arc(near, far) / n;
  return {scale * p.x, scale * p.y};
}

struct Fisheye : WideLens<Fisheye> {
  static constexpr const char* kName = "fisheye";

  /// k = {k1, ..., k4, 0, 0, p1, p2, s1, ..., s4}.
  template <class N, class S> AR_HD static Vec2<N> image_point(Vec3<N> p, const S* k) {
    const Vec2<N> a = equidistant(p);
    const N t2 = a.x * a.x + a.y * a.y;
    const N scale = S(1) + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + k[3] * t2)));
    return decentered({scale * a.x, scale * a.y}, a.x, a.y, k + 6);
  }
};

struct RadTanFisheye : WideLens<RadTanFisheye> {
  static constexpr const char* kName = "rad_tan_fisheye";

  /// k = {k0, ..., k5, p0, p1, s0, ..., s3}. Tangential and thin prism terms are of the point after the radial terms.
  template <class N, class S> AR_HD static Vec2<N> image_point(Vec3<N> p, const S* k) {
    const Vec2<N> a = equidistant(p);
    const N t2 = a.x * a.x + a.y * a.y;
    const N scale = S(1) + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * (k[3] + t2 * (k[4] + k[5] * t2)))));
    const N u = scale * a.x, v = scale * a.y, r2 = u * u + v * v, r4 = r2 * r2;
    const N tangential = S(2) * (k[6] * u + k[7] * v);
    return {u + tangential * u + k[6] * r2 + k[8] * r2 + k[9] * r4,
            v + tangential * v + k[7] * r2 + k[10] * r2 + k[11] * r4};
  }
};

}  // namespace ar
