// The map through clip space, which pinhole.h and orthographic.h inherit: a matrix of the caller's makes x, y and w
// from the mean, and x/w and y/w are the position in the image.
#pragma once

#include "core/camera/contract.h"

namespace ar {

struct ClipSpaceMap {
  template <class Cam, typename T> AR_HD static bool map(const Cam& camera, Vec3<T> mean, ProjectedMean<T>& p) {
    p.clip_w = apply_row(camera.clip_w, mean);
    const T inv_w = quotient(T(1), p.clip_w);
    p.ndc = {inv_w * apply_row(camera.clip_x, mean), inv_w * apply_row(camera.clip_y, mean)};
    p.pixel = {T(0.5) * ((p.ndc.x + T(1)) * camera.size.x - T(1)), T(0.5) * ((p.ndc.y + T(1)) * camera.size.y - T(1))};
    return in_range(camera, p.view.z) && p.clip_w > T(0);
  }

  /// The matrix maps the mean itself: dL_dview gets nothing.
  template <typename T>
  AR_HD static Vec3<T> map_vjp(const Camera<T>& camera, const ProjectedMean<T>& p, Vec2<T> dL_dpixel, Vec3<T>&) {
    const Vec3<T> g = clip_vjp(camera, p, dL_dpixel);
    return g.x * xyz(camera.clip_x) + g.y * xyz(camera.clip_y) + g.z * xyz(camera.clip_w);
  }
  template <typename T>
  AR_HD static void add_map_vjp(const Camera<T>& camera, const ProjectedMean<T>& p, Vec3<T> mean, Vec2<T> dL_dpixel,
                                CameraGrad<T>& to) {
    const Vec3<T> g = clip_vjp(camera, p, dL_dpixel);
    add_row_vjp(to.clip_x, g.x, mean);
    add_row_vjp(to.clip_y, g.y, mean);
    add_row_vjp(to.clip_w, g.z, mean);
  }

 private:
  /// Gradients with respect to clip-space x, y and w.
  template <typename T>
  AR_HD static Vec3<T> clip_vjp(const Camera<T>& camera, const ProjectedMean<T>& p, Vec2<T> dL_dpixel) {
    const T gx = quotient(T(0.5) * camera.size.x * dL_dpixel.x, p.clip_w);
    const T gy = quotient(T(0.5) * camera.size.y * dL_dpixel.y, p.clip_w);
    return {gx, gy, -(gx * p.ndc.x + gy * p.ndc.y)};
  }
};

}  // namespace ar
