// All rays are parallel to the camera's axis, and the Jacobian is the same everywhere. w of clip space must be 1.
#pragma once

#include "core/camera/clip_space.h"

namespace ar {

struct Orthographic : ClipSpaceMap, CameraModelDefaults {
  static constexpr const char* kName = "orthographic";

  template <typename T> AR_HD static Jacobian<T> jacobian(const Camera<T>& camera, Vec3<T>) {
    return {camera.focal.x * xyz(camera.view_x), camera.focal.y * xyz(camera.view_y), T(0), T(0), true, true};
  }
  template <typename T>
  AR_HD static Vec3<T> jacobian_vjp(const Camera<T>&, const Jacobian<T>&, Vec3<T>, const JacobianGrad<T>&) {
    return {T(0), T(0), T(0)};
  }
  template <typename T>
  AR_HD static void add_jacobian_vjp(const FullCamera<T>& camera, const Jacobian<T>& j, Vec3<T>,
                                     const JacobianGrad<T>& grad, CameraGrad<T>& to) {
    add_xyz(to.view_x, camera.focal.x * grad.x);
    add_xyz(to.view_y, camera.focal.y * grad.y);
    add_focal_vjp(camera, j, grad, to);
  }
  template <typename T> AR_HD static T largest_stretch(const Camera<T>& camera, Vec3<T>) {
    return max(camera.focal.x, camera.focal.y);
  }

  template <typename T> AR_HD static Vec2<T> velocity(const Camera<T>& camera, Vec3<T>, Vec3<T> w) {
    return {camera.focal.x * w.x, camera.focal.y * w.y};
  }
  template <typename T>
  AR_HD static VelocityGrad<T> velocity_vjp(const Camera<T>& camera, Vec3<T>, Vec3<T> w, Vec2<T> g, Lens<T>&,
                                            Vec2<T>& dL_dfocal) {
    dL_dfocal.x += g.x * w.x;
    dL_dfocal.y += g.y * w.y;
    return {{T(0), T(0), T(0)}, {g.x * camera.focal.x, g.y * camera.focal.y, T(0)}};
  }

  /// The disc has the diameter f aperture |z - focus|: `aperture` is the opening of a cone.
  template <typename T> AR_HD static T defocus(const Lens<T>& lens, Vec3<T> p) { return p.z - lens.focus; }
  template <typename T>
  AR_HD static void defocus_vjp(const Lens<T>&, Vec3<T>, T dL_ddefocus, Vec3<T>& dL_dp, Lens<T>& dL_dlens) {
    dL_dlens.focus -= dL_ddefocus;
    dL_dp.z += dL_ddefocus;
  }

  template <typename T> AR_HD static Vec3<T> ray(const Camera<T>& camera, Vec3<T>) { return xyz(camera.view_z); }
  template <typename T> AR_HD static void ray_vjp(Vec3<T>, Vec3<T>&) {}
  template <typename T> AR_HD static void add_ray_vjp(Vec3<T> dL_dray, CameraGrad<T>& to) {
    add_xyz(to.view_z, dL_dray);
  }
};

}  // namespace ar
