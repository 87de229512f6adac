// The projection of a mean, from the world to camera space to pixels; its Jacobian at the mean; and the adjoints of
// both.
//
// Camera is the pinhole camera of 3DGS and no more. FullCamera has everything that effects may ask for besides. The
// same functions are compiled for both, so that a plain rendering neither reads nor computes anything for effects.
// There is one full camera, not one for every combination of effects: projecting takes a small part of a frame, and all
// threads take the same branches.
#pragma once

#include "core/defocus.h"
#include "core/motion.h"
#include "core/stages.h"

namespace ar {

/// Row r of a matrix stored transposed.
template <typename T> AR_HD Vec4<T> matrix_row(const T* m, int r) { return {m[r], m[4 + r], m[8 + r], m[12 + r]}; }

template <typename T> AR_HD Vec3<T> xyz(Vec4<T> v) { return {v.x, v.y, v.z}; }
template <typename T> AR_HD T apply_row(Vec4<T> row, Vec3<T> p) { return dot(xyz(row), p) + row.w; }
/// Adds to `to` the gradient with respect to a row, from that with respect to its value at p.
template <typename T> AR_HD void add_row_vjp(Vec4<T>& to, T dL_dvalue, Vec3<T> p) {
  to = {to.x + dL_dvalue * p.x, to.y + dL_dvalue * p.y, to.z + dL_dvalue * p.z, to.w + dL_dvalue};
}
template <typename T> AR_HD void add_xyz(Vec4<T>& to, Vec3<T> v) { to = {to.x + v.x, to.y + v.y, to.z + v.z, to.w}; }

/// A camera by value: rows of its matrices, loaded once per thread.
template <typename Scalar> struct Camera {
  static constexpr bool kFull = false;
  static constexpr int kShDegree = 3;   ///< the largest it can use: the coefficients of more take registers
  Vec4<Scalar> view_x, view_y, view_z;  ///< world to camera
  Vec4<Scalar> clip_x, clip_y, clip_w;  ///< world to clip space
  Vec3<Scalar> position;
  Vec2<Scalar> size;   ///< px
  Vec2<Scalar> focal;  ///< px; of an orthographic camera px per world unit
  Vec2<Scalar> limit;  ///< of |x/z| and |y/z| in the Jacobian
  TileGrid grid;
};

template <typename Scalar> struct FullCamera : Camera<Scalar> {
  static constexpr bool kFull = true;
  static constexpr int kShDegree = 4;
  Lens<Scalar> lens;
};

/// Gradient of a camera. An aggregate of kCameraGradWidth scalars.
template <typename T> struct CameraGrad {
  Vec4<T> view_x, view_y, view_z, clip_x, clip_y, clip_w;
  Vec3<T> position;
  Lens<T> lens;
};
inline constexpr int kCameraGradWidth = 27 + kLensWidth;
static_assert(sizeof(CameraGrad<float>) == kCameraGradWidth * sizeof(float));

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
/// The one or the other, by type.
template <class Cam, typename T> AR_HD Cam load_camera_as(const CameraView<T>& c) {
  if constexpr (Cam::kFull) {
    return load_full_camera(c);
  } else {
    return load_camera(c);
  }
}

template <typename T> AR_HD bool in_range(const Camera<T>&, T z) { return z > T(kNear); }
template <typename T> AR_HD bool in_range(const FullCamera<T>& camera, T z) {
  return z > camera.lens.near && z < camera.lens.far;
}

/// The mean in the image, and what the chain rule needs of the way there.
template <typename T> struct ProjectedMean {
  Vec3<T> view;  ///< camera space; z is the depth
  Vec2<T> ndc;
  T clip_w;
  Vec2<T> pixel;
  bool valid;  ///< between the near and the far plane, and finite
};

template <class Cam, typename T> AR_HD ProjectedMean<T> project_mean(const Cam& camera, Vec3<T> mean) {
  ProjectedMean<T> p;
  p.view = {apply_row(camera.view_x, mean), apply_row(camera.view_y, mean), apply_row(camera.view_z, mean)};
  p.clip_w = apply_row(camera.clip_w, mean);
  const T inv_w = quotient(T(1), p.clip_w);
  p.ndc = {inv_w * apply_row(camera.clip_x, mean), inv_w * apply_row(camera.clip_y, mean)};
  p.pixel = {T(0.5) * ((p.ndc.x + T(1)) * camera.size.x - T(1)), T(0.5) * ((p.ndc.y + T(1)) * camera.size.y - T(1))};
  p.valid = in_range(camera, p.view.z) && p.clip_w > T(0) && within(p.view.x, 1e18) && within(p.view.y, 1e18) &&
            within(p.view.z, 1e18) && within(p.pixel.x, 1e9) && within(p.pixel.y, 1e9);
  return p;
}

/// Gradients with respect to clip-space x, y and w of a mean.
template <typename T> AR_HD Vec3<T> clip_vjp(const Camera<T>& camera, const ProjectedMean<T>& p, Vec2<T> dL_dpixel) {
  const T gx = quotient(T(0.5) * camera.size.x * dL_dpixel.x, p.clip_w);
  const T gy = quotient(T(0.5) * camera.size.y * dL_dpixel.y, p.clip_w);
  return {gx, gy, -(gx * p.ndc.x + gy * p.ndc.y)};
}

template <typename T>
AR_HD Vec3<T> project_mean_vjp(const Camera<T>& camera, const ProjectedMean<T>& p, Vec2<T> dL_dpixel,
                               Vec3<T> dL_dview) {
  const Vec3<T> g = clip_vjp(camera, p, dL_dpixel);
  return g.x * xyz(camera.clip_x) + g.y * xyz(camera.clip_y) + g.z * xyz(camera.clip_w) +
         dL_dview.x * xyz(camera.view_x) + dL_dview.y * xyz(camera.view_y) + dL_dview.z * xyz(camera.view_z);
}
/// Adds the gradient with respect to the matrices.
template <typename T>
AR_HD void add_project_mean_vjp(const Camera<T>& camera, const ProjectedMean<T>& p, Vec3<T> mean, Vec2<T> dL_dpixel,
                                Vec3<T> dL_dview, CameraGrad<T>& to) {
  const Vec3<T> g = clip_vjp(camera, p, dL_dpixel);
  add_row_vjp(to.clip_x, g.x, mean);
  add_row_vjp(to.clip_y, g.y, mean);
  add_row_vjp(to.clip_w, g.z, mean);
  add_row_vjp(to.view_x, dL_dview.x, mean);
  add_row_vjp(to.view_y, dL_dview.y, mean);
  add_row_vjp(to.view_z, dL_dview.z, mean);
}

/// The linear part of the projection at a mean: rows of A = J W, world units to px.
template <typename T> struct Jacobian {
  Vec3<T> x, y;
  T ratio_x, ratio_y;  ///< x/z and y/z, clamped
  bool clamped_x, clamped_y;
};
/// `log_size` = x . j.x + y . j.y, the gradient with respect to the logarithm of a factor on all of J.
template <typename T> struct JacobianGrad {
  Vec3<T> x, y;
  T log_size;
};

/// With x/z and y/z clamped to `center` -+ the camera's limit.
template <typename T> AR_HD Jacobian<T> perspective_jacobian(const Camera<T>& camera, Vec3<T> view, Vec2<T> center) {
  Jacobian<T> j;
  const T rx = quotient(view.x, view.z), ry = quotient(view.y, view.z);
  j.ratio_x = min(max(rx, center.x - camera.limit.x), center.x + camera.limit.x);
  j.ratio_y = min(max(ry, center.y - camera.limit.y), center.y + camera.limit.y);
  j.clamped_x = j.ratio_x != rx;
  j.clamped_y = j.ratio_y != ry;
  const Vec3<T> depth = xyz(camera.view_z);
  j.x = quotient(camera.focal.x, view.z) * (xyz(camera.view_x) - j.ratio_x * depth);
  j.y = quotient(camera.focal.y, view.z) * (xyz(camera.view_y) - j.ratio_y * depth);
  return j;
}
template <typename T> AR_HD Jacobian<T> make_jacobian(const Camera<T>& camera, Vec3<T> view) {
  return perspective_jacobian(camera, view, {T(0), T(0)});
}
template <typename T> AR_HD Jacobian<T> make_jacobian(const FullCamera<T>& camera, Vec3<T> view) {
  if (!camera.lens.orthographic()) return perspective_jacobian(camera, view, camera.lens.center);
  return {camera.focal.x * xyz(camera.view_x), camera.focal.y * xyz(camera.view_y), T(0), T(0), true, true};
}

/// Gradients with respect to the clamped ratios.
template <typename T> AR_HD Vec2<T> ratio_vjp(const Camera<T>& camera, Vec3<T> view, const JacobianGrad<T>& grad) {
  const Vec3<T> depth = xyz(camera.view_z);
  return {-quotient(camera.focal.x, view.z) * dot(grad.x, depth),
          -quotient(camera.focal.y, view.z) * dot(grad.y, depth)};
}

/// Gradient with respect to the camera-space mean.
template <typename T>
AR_HD Vec3<T> jacobian_vjp(const Camera<T>& camera, const Jacobian<T>& j, Vec3<T> view, const JacobianGrad<T>& grad) {
  const Vec2<T> by_ratio = ratio_vjp(camera, view, grad);
  Vec3<T> g = {T(0), T(0), -quotient(grad.log_size, view.z)};
  // Where the ratio is clamped it is constant: its gradient is zero, in z too.
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
AR_HD Vec3<T> jacobian_vjp(const FullCamera<T>& camera, const Jacobian<T>& j, Vec3<T> view,
                           const JacobianGrad<T>& grad) {
  if (camera.lens.orthographic()) return {T(0), T(0), T(0)};
  return jacobian_vjp(static_cast<const Camera<T>&>(camera), j, view, grad);
}
/// Adds the gradient with respect to the camera.
template <typename T>
AR_HD void add_jacobian_vjp(const FullCamera<T>& camera, const Jacobian<T>& j, Vec3<T> view,
                            const JacobianGrad<T>& grad, CameraGrad<T>& to) {
  const Vec2<T>& tangent = camera.lens.tan_half_fov;
  const T depth = camera.lens.orthographic() ? T(1) : view.z, sx = camera.focal.x / depth, sy = camera.focal.y / depth;
  add_xyz(to.view_x, sx * grad.x);
  add_xyz(to.view_y, sy * grad.y);
  to.lens.tan_half_fov.x -= dot(grad.x, j.x) / tangent.x;
  to.lens.tan_half_fov.y -= dot(grad.y, j.y) / tangent.y;
  if (camera.lens.orthographic()) return;
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

/// No smaller than |W|^2, W the upper left 3x3 of the view: no eigenvalue of W W^T is larger than the largest sum of a
/// row of its absolute values. 1 for a rotation, but for rounding.
template <typename T> AR_HD T largest_zoom2(const Camera<T>& camera) {
  const Vec3<T> x = xyz(camera.view_x), y = xyz(camera.view_y), z = xyz(camera.view_z);
  const T xy = abs(dot(x, y)), xz = abs(dot(x, z)), yz = abs(dot(y, z));
  return max(dot(x, x) + xy + xz, max(xy + dot(y, y) + yz, xz + yz + dot(z, z)));
}

/// No smaller than |J| at any mean of this depth, camera units to px: |J| <= f/z |(1, 0, -x/z; 0, 1, -y/z)|
/// <= f/z sqrt(1 + (x/z)^2 + (y/z)^2), with x/z and y/z clamped. But for rounding.
template <typename T> AR_HD T largest_stretch(const Camera<T>& camera, T z) {
  return divide(max(camera.focal.x, camera.focal.y), z) *
         approx_sqrt(T(1) + camera.limit.x * camera.limit.x + camera.limit.y * camera.limit.y);
}
template <typename T> AR_HD T largest_stretch(const FullCamera<T>& camera, T z) {
  if (camera.lens.orthographic()) return max(camera.focal.x, camera.focal.y);
  const T x = camera.limit.x + abs(camera.lens.center.x), y = camera.limit.y + abs(camera.lens.center.y);
  return divide(max(camera.focal.x, camera.focal.y), z) * approx_sqrt(T(1) + x * x + y * y);
}

/// From where a Gaussian is seen, and 1 / the length of what was normalised: the way from the camera to the mean.
template <typename T> struct Direction {
  Vec3<T> unit;
  T inv_length;
};
template <typename T> AR_HD Direction<T> normalize_direction(Vec3<T> d) {
  const T inv = quotient(T(1), sqrt(dot(d, d)));
  return {inv * d, inv};
}
template <typename T> AR_HD Direction<T> view_direction(const Camera<T>& camera, Vec3<T> mean) {
  return normalize_direction(mean - camera.position);
}
/// Orthographic: all alike, along the camera's axis.
template <typename T> AR_HD Direction<T> view_direction(const FullCamera<T>& camera, Vec3<T> mean) {
  return normalize_direction(camera.lens.orthographic() ? xyz(camera.view_z) : mean - camera.position);
}

/// What the lens and the shutter add to the covariance of what is at `view`.
template <typename T> AR_HD Blur<T> blur_of(const FullCamera<T>& camera, Vec3<T> view) {
  const Lens<T>& lens = camera.lens;
  Blur<T> blur = {lens.moves() ? motion_streak(lens, camera.focal, view) : Vec2<T>{T(0), T(0)},
                  lens.aperture != T(0) ? defocus_variance(lens, camera.focal, view.z) : T(0)};
  return blur;
}

/// Gradient of blur_of with respect to `view`; adds the one with respect to the camera to `to`, if not null.
template <typename T>
AR_HD Vec3<T> blur_vjp(const FullCamera<T>& camera, Vec3<T> view, const Blur<T>& dL_dblur, CameraGrad<T>* to) {
  Vec3<T> by_view = {T(0), T(0), T(0)};
  Lens<T> by_lens = {};
  Vec2<T> by_focal = {T(0), T(0)};
  if (camera.lens.aperture != T(0))  // a pinhole's focus may be anything
    defocus_variance_vjp(camera.lens, camera.focal, view.z, dL_dblur.variance, by_view.z, by_lens, by_focal);
  motion_streak_vjp(camera.lens, camera.focal, view, dL_dblur.streak, by_view, by_lens, by_focal);
  if (to) {
    to->lens.aperture += by_lens.aperture;
    to->lens.focus += by_lens.focus;
    to->lens.shift += by_lens.shift;
    to->lens.turn += by_lens.turn;
    to->lens.screen = to->lens.screen + by_lens.screen;
    to->lens.tan_half_fov.x -= by_focal.x * camera.focal.x / camera.lens.tan_half_fov.x;
    to->lens.tan_half_fov.y -= by_focal.y * camera.focal.y / camera.lens.tan_half_fov.y;
  }
  return by_view;
}

}  // namespace ar
