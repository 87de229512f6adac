// A camera of any model: a mean's pixel, the Jacobian there, the blur, and the adjoints. Most functions are compiled
// for Camera, the pinhole of 3DGS, and FullCamera, all models and effects as branches, which threads take alike.
#pragma once

#include "core/defocus.h"
#include "core/motion.h"

namespace ar {

template <typename T> AR_HD Camera<T> load_camera(const CameraView<T>& c, Vec2<T> tan_half_fov) {
  const T two = T(2), clamp = T(kFrustumClamp);
  return {matrix_row(c.view, 0),
          matrix_row(c.view, 1),
          matrix_row(c.view, 2),
          matrix_row(c.proj, 0),
          matrix_row(c.proj, 1),
          matrix_row(c.proj, 3),
          {c.position[0], c.position[1], c.position[2]},
          {T(c.width), T(c.height)},
          {quotient(T(c.width), two * tan_half_fov.x), quotient(T(c.height), two * tan_half_fov.y)},
          {clamp * tan_half_fov.x, clamp * tan_half_fov.y},
          {c.width, c.height}};
}
template <typename T> AR_HD Camera<T> load_camera(const CameraView<T>& c) {
  return load_camera(c, {c.tan_half_fov_x, c.tan_half_fov_y});
}
template <typename T> AR_HD FullCamera<T> load_full_camera(const CameraView<T>& c) {
  const Lens<T> lens = *reinterpret_cast<const Lens<T>*>(c.lens);
  return {load_camera(c, lens.tan_half_fov), lens};
}
template <class Cam, typename T> AR_HD Cam load_camera_as(const CameraView<T>& c) {
  if constexpr (Cam::kFull) {
    return load_full_camera(c);
  } else {
    return load_camera(c);
  }
}

template <class Cam, typename T> AR_HD ProjectedMean<T> project_mean(const Cam& camera, Vec3<T> mean) {
  ProjectedMean<T> p;
  p.view = {apply_row(camera.view_x, mean), apply_row(camera.view_y, mean), apply_row(camera.view_z, mean)};
  p.valid = visit_model(camera, [&](auto model) AR_HD_LAMBDA { return model.map(camera, mean, p); }) &&
            within(p.view.x, 1e18) && within(p.view.y, 1e18) && within(p.view.z, 1e18) && within(p.pixel.x, 1e9) &&
            within(p.pixel.y, 1e9);
  return p;
}

/// Returns dL/dmean. Adds to dL_dview the share of the model's map.
template <class Cam, typename T>
AR_HD Vec3<T> project_mean_vjp(const Cam& camera, const ProjectedMean<T>& p, Vec2<T> dL_dpixel, Vec3<T>& dL_dview) {
  const Vec3<T> by_map =
      visit_model(camera, [&](auto model) AR_HD_LAMBDA { return model.map_vjp(camera, p, dL_dpixel, dL_dview); });
  return by_map + dL_dview.x * xyz(camera.view_x) + dL_dview.y * xyz(camera.view_y) + dL_dview.z * xyz(camera.view_z);
}
template <class Cam, typename T> AR_HD Jacobian<T> make_jacobian(const Cam& camera, Vec3<T> view) {
  return visit_model(camera, [&](auto model) AR_HD_LAMBDA { return model.jacobian(camera, view); });
}
template <class Cam, typename T>
AR_HD Vec3<T> jacobian_vjp(const Cam& camera, const Jacobian<T>& j, Vec3<T> view, const JacobianGrad<T>& grad) {
  return visit_model(camera, [&](auto model) AR_HD_LAMBDA { return model.jacobian_vjp(camera, j, view, grad); });
}

/// An upper bound of |W|^2 (docs/internals/numerics.md, "Culling bound").
template <typename T> AR_HD T largest_zoom2(const Camera<T>& camera) {
  const Vec3<T> x = xyz(camera.view_x), y = xyz(camera.view_y), z = xyz(camera.view_z);
  const T xy = abs(dot(x, y)), xz = abs(dot(x, z)), yz = abs(dot(y, z));
  return max(dot(x, x) + xy + xz, max(xy + dot(y, y) + yz, xz + yz + dot(z, z)));
}

/// An upper bound, but for rounding.
template <class Cam, typename T> AR_HD T largest_stretch(const Cam& camera, Vec3<T> view) {
  return visit_model(camera, [&](auto model) AR_HD_LAMBDA { return model.largest_stretch(camera, view); });
}

template <class Cam, typename T> AR_HD T depth_at(const Cam& camera, Vec3<T> view) {
  return visit_model(camera, [&](auto model) AR_HD_LAMBDA { return model.depth(view); });
}
template <class Cam, typename T> AR_HD Vec3<T> depth_vjp(const Cam& camera, Vec3<T> view, T dL_ddepth) {
  return visit_model(camera, [&](auto model) AR_HD_LAMBDA { return model.depth_vjp(view, dL_ddepth); });
}
template <class Cam, typename T> AR_HD T depth_of(const Cam& camera, Vec3<T> mean) {
  return depth_at(
      camera, Vec3<T>{apply_row(camera.view_x, mean), apply_row(camera.view_y, mean), apply_row(camera.view_z, mean)});
}

/// A unit vector, and 1 / its length before.
template <typename T> struct Direction {
  Vec3<T> unit;
  T inv_length;
};
template <class Cam, typename T> AR_HD Direction<T> view_direction(const Cam& camera, Vec3<T> mean) {
  const Vec3<T> d = visit_model(camera, [&](auto model) AR_HD_LAMBDA { return model.ray(camera, mean); });
  const T inv = quotient(T(1), sqrt(dot(d, d)));
  return {inv * d, inv};
}
/// `dL_dray`: before the ray was normalised.
template <class Cam, typename T> AR_HD void ray_vjp(const Cam& camera, Vec3<T> dL_dray, Vec3<T>& dL_dmean) {
  visit_model(camera, [&](auto model) AR_HD_LAMBDA { model.ray_vjp(dL_dray, dL_dmean); });
}

/// Adds the gradient of project_mean, make_jacobian and view_direction. dL_dview: after project_mean_vjp.
template <typename T>
AR_HD void add_camera_vjp(const FullCamera<T>& camera, Vec3<T> mean, const ProjectedMean<T>& p, Vec2<T> dL_dpixel,
                          Vec3<T> dL_dview, const Jacobian<T>& j, const JacobianGrad<T>& dL_djacobian, Vec3<T> dL_dray,
                          CameraGrad<T>& to) {
  add_row_vjp(to.view_x, dL_dview.x, mean);
  add_row_vjp(to.view_y, dL_dview.y, mean);
  add_row_vjp(to.view_z, dL_dview.z, mean);
  visit_model(camera, [&](auto model) AR_HD_LAMBDA {
    model.add_map_vjp(camera, p, mean, dL_dpixel, to);
    model.add_jacobian_vjp(camera, j, p.view, dL_djacobian, to);
    model.add_ray_vjp(dL_dray, to);
  });
}

template <typename T> AR_HD Blur<T> blur_of(const FullCamera<T>& camera, Vec3<T> view) {
  const Lens<T>& lens = camera.lens;
  return {lens.moves() ? motion_streak(camera, view) : Vec2<T>{T(0), T(0)},
          lens.aperture != T(0) ? defocus_variance(camera, view) : T(0)};
}

/// Returns the gradient by `view`; adds that by the camera to `to`, if not null.
template <typename T>
AR_HD Vec3<T> blur_vjp(const FullCamera<T>& camera, Vec3<T> view, const Blur<T>& dL_dblur, CameraGrad<T>* to) {
  Vec3<T> by_view = {T(0), T(0), T(0)};
  Lens<T> by_lens = {};
  Vec2<T> by_focal = {T(0), T(0)};
  if (camera.lens.aperture != T(0))  // else the focus may be any number
    defocus_variance_vjp(camera, view, dL_dblur.variance, by_view, by_lens, by_focal);
  motion_streak_vjp(camera, view, dL_dblur.streak, by_view, by_lens, by_focal);
  if (to) {
    to->lens.aperture += by_lens.aperture;
    to->lens.focus += by_lens.focus;
    to->lens.shift += by_lens.shift;
    to->lens.turn += by_lens.turn;
    to->lens.screen = to->lens.screen + by_lens.screen;
    for (int k = 0; k < kDistortion; ++k) to->lens.distortion[k] += by_lens.distortion[k];
    to->lens.tan_half_fov.x -= by_focal.x * camera.focal.x / camera.lens.tan_half_fov.x;
    to->lens.tan_half_fov.y -= by_focal.y * camera.focal.y / camera.lens.tan_half_fov.y;
  }
  return by_view;
}

/// From CameraGrads of parts of the Gaussians.
template <typename T> struct CameraGradSums {
  const T* parts;  ///< [n, kCameraGradWidth]
  int64_t n;
  T *view, *proj, *position, *lens;  ///< [16] transposed, [16] transposed, [3], [kLensWidth]; or null
};
inline constexpr int kCameraNumbers = 16 + 16 + 3 + kLensWidth;

/// Of view, proj, position and lens in a row: where to write a number, and its column of CameraGrad; -1: zero.
template <typename T> struct CameraNumber {
  T* to;
  int column;
};
template <typename T> AR_HD CameraNumber<T> camera_number(const CameraGradSums<T>& sums, int k) {
  const auto at = [](T* first, int i) { return first ? first + i : nullptr; };
  const int row = k % 4, column = k % 16 / 4;
  if (k < 16) return {at(sums.view, k), row < 3 ? 4 * row + column : -1};
  if (k < 32) return {at(sums.proj, k - 16), row < 2 ? 12 + 4 * row + column : row == 2 ? -1 : 20 + column};
  if (k < 35) return {at(sums.position, k - 32), 24 + k - 32};
  return {at(sums.lens, k - 35), 27 + k - 35};
}

}  // namespace ar
