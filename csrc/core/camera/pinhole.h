// The pinhole, the model of a plain camera. As in 3DGS the Jacobian clamps x/z and y/z: splats beside the image do not
// grow without bound.
#pragma once

#include "core/camera/clip_space.h"

namespace ar {

struct Pinhole : ClipSpaceMap, CameraModelDefaults {
  static constexpr const char* kName = "pinhole";

  template <class Cam, typename T> AR_HD static Jacobian<T> jacobian(const Cam& camera, Vec3<T> view) {
    Jacobian<T> j;
    const Vec2<T> center = clamp_center(camera);
    const T rx = quotient(view.x, view.z), ry = quotient(view.y, view.z);
    j.ratio_x = min(max(rx, center.x - camera.limit.x), center.x + camera.limit.x);
    j.ratio_y = min(max(ry, center.y - camera.limit.y), center.y + camera.limit.y);
    j.clamped_x = j.ratio_x != rx;
    j.clamped_y = j.ratio_y != ry;
    const Vec3<T> axis = xyz(camera.view_z);
    j.x = quotient(camera.focal.x, view.z) * (xyz(camera.view_x) - j.ratio_x * axis);
    j.y = quotient(camera.focal.y, view.z) * (xyz(camera.view_y) - j.ratio_y * axis);
    return j;
  }
  template <typename T>
  AR_HD static Vec3<T> jacobian_vjp(const Camera<T>& camera, const Jacobian<T>& j, Vec3<T> view,
                                    const JacobianGrad<T>& grad) {
    const Vec2<T> by_ratio = ratio_vjp(camera, view, grad);
    Vec3<T> g = {T(0), T(0), -quotient(grad.log_size, view.z)};
    // A clamped ratio is constant, in z too.
    if (!j.clamped_x) {
      g.x += quotient(by_ratio.x, view.z);
      g.z -= quotient(by_ratio.x * j.ratio_x, view.z);
    }
    if (!j.clamped_y) {
      g.y += quotient(by_ratio.y, view.z);
      g.z -= quotient(by_ratio.y * j.ratio_y, view.z);
    }
    return g;
  }
  template <typename T>
  AR_HD static void add_jacobian_vjp(const FullCamera<T>& camera, const Jacobian<T>& j, Vec3<T> view,
                                     const JacobianGrad<T>& grad, CameraGrad<T>& to) {
    const T sx = camera.focal.x / view.z, sy = camera.focal.y / view.z;
    add_xyz(to.view_x, sx * grad.x);
    add_xyz(to.view_y, sy * grad.y);
    add_focal_vjp(camera, j, grad, to);
    add_xyz(to.view_z, (-sx * j.ratio_x) * grad.x + (-sy * j.ratio_y) * grad.y);
    const Vec2<T> by_ratio = ratio_vjp(camera, view, grad);
    const T clamp = T(kFrustumClamp);
    if (j.clamped_x) {
      to.lens.center.x += by_ratio.x;
      to.lens.tan_half_fov.x += j.ratio_x > camera.lens.center.x ? clamp * by_ratio.x : -clamp * by_ratio.x;
    }
    if (j.clamped_y) {
      to.lens.center.y += by_ratio.y;
      to.lens.tan_half_fov.y += j.ratio_y > camera.lens.center.y ? clamp * by_ratio.y : -clamp * by_ratio.y;
    }
  }
  /// docs/internals/numerics.md, "Culling bound".
  template <class Cam, typename T> AR_HD static T largest_stretch(const Cam& camera, Vec3<T> view) {
    const Vec2<T> r = largest_ratio(camera);
    return divide(max(camera.focal.x, camera.focal.y), view.z) * approx_sqrt(T(1) + r.x * r.x + r.y * r.y);
  }

  template <typename T> AR_HD static Vec2<T> velocity(const Camera<T>& camera, Vec3<T> p, Vec3<T> w) {
    return {camera.focal.x / p.z * (w.x - p.x / p.z * w.z), camera.focal.y / p.z * (w.y - p.y / p.z * w.z)};
  }
  template <typename T>
  AR_HD static VelocityGrad<T> velocity_vjp(const Camera<T>& camera, Vec3<T> p, Vec3<T> w, Vec2<T> g, Lens<T>&,
                                            Vec2<T>& dL_dfocal) {
    const T iz = T(1) / p.z, gx = g.x * camera.focal.x * iz, gy = g.y * camera.focal.y * iz;
    const T rx = p.x * iz, ry = p.y * iz, ux = w.x - rx * w.z, uy = w.y - ry * w.z, along = gx * rx + gy * ry;
    dL_dfocal.x += g.x * iz * ux;
    dL_dfocal.y += g.y * iz * uy;
    return {{-(gx * w.z * iz), -(gy * w.z * iz), iz * w.z * along - iz * (gx * ux + gy * uy)}, {gx, gy, -along}};
  }

 private:
  template <typename T> AR_HD static Vec2<T> clamp_center(const Camera<T>&) { return {T(0), T(0)}; }
  template <typename T> AR_HD static Vec2<T> clamp_center(const FullCamera<T>& camera) { return camera.lens.center; }
  /// The largest |x/z| and |y/z| after the clamp.
  template <typename T> AR_HD static Vec2<T> largest_ratio(const Camera<T>& camera) { return camera.limit; }
  template <typename T> AR_HD static Vec2<T> largest_ratio(const FullCamera<T>& camera) {
    return {camera.limit.x + abs(camera.lens.center.x), camera.limit.y + abs(camera.lens.center.y)};
  }
  template <typename T>
  AR_HD static Vec2<T> ratio_vjp(const Camera<T>& camera, Vec3<T> view, const JacobianGrad<T>& grad) {
    const Vec3<T> axis = xyz(camera.view_z);
    return {-quotient(camera.focal.x, view.z) * dot(grad.x, axis),
            -quotient(camera.focal.y, view.z) * dot(grad.y, axis)};
  }
};

}  // namespace ar
