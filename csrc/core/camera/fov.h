// The FOV lens [Devernay and Faugeras 2001; COLMAP's FOV]: the distance in the image is atan(2 r tan(w / 2)) / w, r
// that of a pinhole.
#pragma once

#include "core/camera/lens_model.h"

namespace ar {

struct Fov : PerspectiveLens<Fov> {
  static constexpr const char* kName = "fov";

  /// k = {w}, 0 < w < pi.
  template <class N, class S> AR_HD static Vec2<N> image_point(Vec3<N> p, const S* k) {
    const N a = p.x / p.z, b = p.y / p.z;
    const S tangent = S(2) * half_tangent(k[0]);
    // atan(t) / t = (angle / sine) cosine at the angle with tangent t
    const N t2 = (tangent * tangent) * (a * a + b * b), n = root(S(1) + t2), h = t2 / (n * (S(1) + n));
    const N scale = (tangent / k[0]) * (arc(h, S(2) - h) / n);
    return {scale * a, scale * b};
  }

 private:
  template <typename T> AR_HD static T half_tangent(T w) { return std::tan(T(0.5) * w); }
  template <typename T> AR_HD static Line<T> half_tangent(Line<T> w) {
    const T t = half_tangent(w.value);
    return Line<T>(t, T(0.5) * (T(1) + t * t) * w.slope);
  }
};

}  // namespace ar
