// The cameras, and the contract of a camera model: the map from the world to pixels, its Jacobian, and the adjoints of
// both. A model is a struct of static functions, listed in models.h. Only core/camera.h, motion.h and defocus.h call
// it. pinhole.h shows the arguments.
//
// `camera` is a Camera or a FullCamera, `mean` a point of the world, `view` the same point in camera space, p a
// ProjectedMean. Lengths in the image are in px. add_..._vjp adds the gradient by a FullCamera.
//
//   kName                               the name of the model in Python
//
// The map, after p.view is set:
//
//   map(camera, mean, p) -> bool        sets p.pixel, and what the adjoint reads. False where the model ends: such a
//                                       Gaussian is culled
//   map_vjp(..., dL_dview) -> Vec3      adds to dL_dview; returns dL/dmean of a map that reads `mean`
//   add_map_vjp
//
// The Jacobian that projects covariances. It may differ from the derivative of the map, as by the clamp of 3DGS.
//
//   jacobian(camera, view) -> Jacobian
//   jacobian_vjp(...) -> Vec3 dL/dview
//   add_jacobian_vjp
//   largest_stretch(camera, view)       an upper bound of its norm in camera space
//
// Motion:
//
//   velocity(camera, p, w) -> Vec2      in the image, of a point with velocity w in camera space: by the derivative of
//                                       the map, without clamps
//   velocity_vjp(...) -> VelocityGrad
//
// In CameraModelDefaults:
//
//   defocus(lens, p)                    signed diameter of the disc of p, over focal length and aperture
//   defocus_vjp
//
//   depth(view)                         orders splats, and is shown; not negative
//   depth_vjp(...) -> Vec3 dL/dview
//
//   ray(camera, mean) -> Vec3           the direction of the harmonics, of any length
//   ray_vjp, add_ray_vjp
#pragma once

#include "core/lens.h"
#include "core/stages.h"

namespace ar {

template <typename T> AR_HD Vec4<T> matrix_row(const T* m, int r) { return {m[r], m[4 + r], m[8 + r], m[12 + r]}; }

template <typename T> AR_HD Vec3<T> xyz(Vec4<T> v) { return {v.x, v.y, v.z}; }
template <typename T> AR_HD T apply_row(Vec4<T> row, Vec3<T> p) { return dot(xyz(row), p) + row.w; }
template <typename T> AR_HD void add_row_vjp(Vec4<T>& to, T dL_dvalue, Vec3<T> p) {
  to = {to.x + dL_dvalue * p.x, to.y + dL_dvalue * p.y, to.z + dL_dvalue * p.z, to.w + dL_dvalue};
}
template <typename T> AR_HD void add_xyz(Vec4<T>& to, Vec3<T> v) { to = {to.x + v.x, to.y + v.y, to.z + v.z, to.w}; }

/// The plain camera, a pinhole.
template <typename Scalar> struct Camera {
  static constexpr bool kFull = false;
  static constexpr int kShDegree = 3;   ///< the largest; coefficients take registers
  Vec4<Scalar> view_x, view_y, view_z;  ///< world to camera
  Vec4<Scalar> clip_x, clip_y, clip_w;  ///< world to clip space
  Vec3<Scalar> position;
  Vec2<Scalar> size;   ///< px
  Vec2<Scalar> focal;  ///< px; of an orthographic camera px per world unit
  Vec2<Scalar> limit;  ///< of |x/z| and |y/z| in a pinhole's Jacobian
  TileGrid grid;
};

template <typename Scalar> struct FullCamera : Camera<Scalar> {
  static constexpr bool kFull = true;
  static constexpr int kShDegree = 4;
  Lens<Scalar> lens;
};

template <typename T> struct CameraGrad {
  Vec4<T> view_x, view_y, view_z, clip_x, clip_y, clip_w;
  Vec3<T> position;
  Lens<T> lens;
};
inline constexpr int kCameraGradWidth = 27 + kLensWidth;
static_assert(sizeof(CameraGrad<float>) == kCameraGradWidth * sizeof(float));

template <typename T> AR_HD bool in_range(const Camera<T>&, T z) { return z > T(kNear); }
template <typename T> AR_HD bool in_range(const FullCamera<T>& camera, T z) {
  return z > camera.lens.near && z < camera.lens.far;
}

template <typename T> struct ProjectedMean {
  Vec3<T> view;  ///< camera space
  Vec2<T> ndc;   ///< of ClipSpaceMap, as clip_w
  T clip_w;
  Vec2<T> pixel;
  bool valid;  ///< map() is true, and numbers are finite
};

/// Rows of A = J W: J in camera space, W the upper left 3x3 of the view.
template <typename T> struct Jacobian {
  Vec3<T> x, y;
  T ratio_x, ratio_y;         ///< of Pinhole: clamped x/z and y/z
  bool clamped_x, clamped_y;  ///< of a lens both alike
};
/// `log_size` = x . j.x + y . j.y: by the logarithm of a factor of J.
template <typename T> struct JacobianGrad {
  Vec3<T> x, y;
  T log_size;
};

template <typename T> struct VelocityGrad {
  Vec3<T> p, w;
};

/// Of a Jacobian proportional to the focal lengths.
template <typename T>
AR_HD void add_focal_vjp(const FullCamera<T>& camera, const Jacobian<T>& j, const JacobianGrad<T>& grad,
                         CameraGrad<T>& to) {
  to.lens.tan_half_fov.x -= dot(grad.x, j.x) / camera.lens.tan_half_fov.x;
  to.lens.tan_half_fov.y -= dot(grad.y, j.y) / camera.lens.tan_half_fov.y;
}

/// Rays meet at the camera's position; the depth is z, also for a thin lens.
struct CameraModelDefaults {
  template <typename T> AR_HD static T depth(Vec3<T> view) { return view.z; }
  template <typename T> AR_HD static Vec3<T> depth_vjp(Vec3<T>, T dL_ddepth) { return {T(0), T(0), dL_ddepth}; }

  /// A thin lens: the disc has the diameter f aperture |1/focus - 1/z|.
  template <typename T> AR_HD static T defocus(const Lens<T>& lens, Vec3<T> p) {
    return T(1) / lens.focus - T(1) / p.z;
  }
  template <typename T>
  AR_HD static void defocus_vjp(const Lens<T>& lens, Vec3<T> p, T dL_ddefocus, Vec3<T>& dL_dp, Lens<T>& dL_dlens) {
    dL_dlens.focus -= dL_ddefocus / (lens.focus * lens.focus);
    dL_dp.z += dL_ddefocus / (p.z * p.z);
  }

  template <typename T> AR_HD static Vec3<T> ray(const Camera<T>& camera, Vec3<T> mean) {
    return mean - camera.position;
  }
  template <typename T> AR_HD static void ray_vjp(Vec3<T> dL_dray, Vec3<T>& dL_dmean) { dL_dmean += dL_dray; }
  template <typename T> AR_HD static void add_ray_vjp(Vec3<T> dL_dray, CameraGrad<T>& to) {
    to.position += T(-1) * dL_dray;
  }
};

}  // namespace ar
