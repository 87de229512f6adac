// A lens of OpenCV: a pinhole with radial (rational), tangential and thin prism terms. COLMAP's SIMPLE_RADIAL, RADIAL,
// OPENCV and FULL_OPENCV are special cases.
#pragma once

#include "core/camera/lens_model.h"

namespace ar {

struct Perspective : PerspectiveLens<Perspective> {
  static constexpr const char* kName = "perspective";

  /// k = {k1, ..., k6, p1, p2, s1, ..., s4}, in OpenCV's names.
  template <class N, class S> AR_HD static Vec2<N> image_point(Vec3<N> p, const S* k) {
    const N a = p.x / p.z, b = p.y / p.z, r2 = a * a + b * b;
    const N above = S(1) + r2 * (k[0] + r2 * (k[1] + k[2] * r2));
    const N below = S(1) + r2 * (k[3] + r2 * (k[4] + k[5] * r2));
    const N scale = above / below;
    return decentered({scale * a, scale * b}, a, b, k + 6);
  }
};

}  // namespace ar
