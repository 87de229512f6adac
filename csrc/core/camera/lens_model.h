// Makes a model (contract.h) from the map of a lens. The Jacobian is the exact derivative of the map, but for one
// clamp: beyond `reach` it is that of a ray turned back to `reach`, as 3DGS does with pinholes. Second derivatives come
// from numbers of derivatives.h.
//
// A model inherits PerspectiveLens, DistanceLens or WideLens, and defines, for S float, double or a Line, and N an S or
// a Dual<S>:
//
//   image_point(Vec3<N> p, const S* k)   where p is seen, in focal lengths from the principal point; k: distortion
//   turned_back(lens, p)                 p, or if beyond lens.reach a point there
//   turned_back_vjp(lens, p, g)          its adjoint
//   inside(camera, p)                    whether the model sees p
//
// and may define, because the map has no derivative somewhere, or no coefficients:
//
//   regular(lens, p), regular_vjp        p, or for derivatives of the map another point
//   kDistorts
#pragma once

#include "core/camera/contract.h"
#include "core/camera/derivatives.h"

namespace ar {

template <class Model> struct LensModel : CameraModelDefaults {
  static constexpr bool kDistorts = true;
  template <typename T> AR_HD static Vec3<T> regular(const Lens<T>&, Vec3<T> p) { return p; }
  template <typename T> AR_HD static Vec3<T> regular_vjp(const Lens<T>&, Vec3<T>, Vec3<T> g) { return g; }

  template <typename T> AR_HD static bool map(const FullCamera<T>& camera, Vec3<T>, ProjectedMean<T>& p) {
    p.ndc = {T(0), T(0)};
    p.clip_w = T(1);
    p.pixel = {T(0), T(0)};
    if (!Model::inside(camera, p.view)) return false;
    const Vec2<T> u = point_of(p.view, camera.lens.distortion);
    p.pixel = {camera.focal.x * (u.x - camera.lens.center.x) + T(0.5) * (camera.size.x - T(1)),
               camera.focal.y * (u.y - camera.lens.center.y) + T(0.5) * (camera.size.y - T(1))};
    return true;
  }
  template <typename T>
  AR_HD static Vec3<T> map_vjp(const FullCamera<T>& camera, const ProjectedMean<T>& p, Vec2<T> dL_dpixel,
                               Vec3<T>& dL_dview) {
    const Rows<T> j = derivative(camera, Model::regular(camera.lens, p.view));
    dL_dview += dL_dpixel.x * j.x + dL_dpixel.y * j.y;
    return {T(0), T(0), T(0)};
  }
  template <typename T>
  AR_HD static void add_map_vjp(const FullCamera<T>& camera, const ProjectedMean<T>& p, Vec3<T>, Vec2<T> dL_dpixel,
                                CameraGrad<T>& to) {
    const Vec2<T> by_u = {dL_dpixel.x * camera.focal.x, dL_dpixel.y * camera.focal.y};
    const Vec2<T> middle = {T(0.5) * (camera.size.x - T(1)), T(0.5) * (camera.size.y - T(1))};
    to.lens.tan_half_fov.x -= dL_dpixel.x * (p.pixel.x - middle.x) / camera.lens.tan_half_fov.x;
    to.lens.tan_half_fov.y -= dL_dpixel.y * (p.pixel.y - middle.y) / camera.lens.tan_half_fov.y;
    to.lens.center.x -= by_u.x;
    to.lens.center.y -= by_u.y;
    const Vec3<T> none = {T(0), T(0), T(0)};
    add_by_distortion(p.view, by_u, {none, none}, camera.lens.distortion, to.lens.distortion);
  }

  template <typename T> AR_HD static Jacobian<T> jacobian(const FullCamera<T>& camera, Vec3<T> view) {
    const Vec3<T> q = Model::turned_back(camera.lens, view);
    const Rows<T> j = derivative(camera, q);
    const bool clamped = q.x != view.x || q.y != view.y;
    return {in_world(camera, j.x), in_world(camera, j.y), T(0), T(0), clamped, clamped};
  }
  template <typename T>
  AR_HD static Vec3<T> jacobian_vjp(const FullCamera<T>& camera, const Jacobian<T>&, Vec3<T> view,
                                    const JacobianGrad<T>& grad) {
    const Vec3<T> q = Model::turned_back(camera.lens, view);
    const Vec3<T> g = slope_vjp(camera, q, {in_camera(camera, grad.x), in_camera(camera, grad.y)});
    return Model::turned_back_vjp(camera.lens, view, g);
  }
  template <typename T>
  AR_HD static void add_jacobian_vjp(const FullCamera<T>& camera, const Jacobian<T>& j, Vec3<T> view,
                                     const JacobianGrad<T>& grad, CameraGrad<T>& to) {
    const Vec3<T> q = Model::turned_back(camera.lens, view);
    const Rows<T> d = derivative(camera, q);
    add_xyz(to.view_x, d.x.x * grad.x + d.y.x * grad.y);
    add_xyz(to.view_y, d.x.y * grad.x + d.y.y * grad.y);
    add_xyz(to.view_z, d.x.z * grad.x + d.y.z * grad.y);
    add_focal_vjp(camera, j, grad, to);
    add_slope_vjp(camera, q, {in_camera(camera, grad.x), in_camera(camera, grad.y)}, to.lens);
  }
  template <typename T> AR_HD static T largest_stretch(const FullCamera<T>& camera, Vec3<T> view) {
    const Rows<T> j = derivative(camera, Model::turned_back(camera.lens, view));
    return sqrt(dot(j.x, j.x) + dot(j.y, j.y));
  }

  template <typename T> AR_HD static Vec2<T> velocity(const FullCamera<T>& camera, Vec3<T> p, Vec3<T> w) {
    const Rows<T> j = derivative(camera, Model::regular(camera.lens, p));
    return {dot(j.x, w), dot(j.y, w)};
  }
  template <typename T>
  AR_HD static VelocityGrad<T> velocity_vjp(const FullCamera<T>& camera, Vec3<T> p, Vec3<T> w, Vec2<T> g,
                                            Lens<T>& dL_dlens, Vec2<T>& dL_dfocal) {
    const Vec3<T> q = Model::regular(camera.lens, p);
    const Rows<T> j = derivative(camera, q), by_j = {g.x * w, g.y * w};
    dL_dfocal.x += g.x * dot(j.x, w) / camera.focal.x;
    dL_dfocal.y += g.y * dot(j.y, w) / camera.focal.y;
    add_slope_vjp(camera, q, by_j, dL_dlens);
    return {Model::regular_vjp(camera.lens, p, slope_vjp(camera, q, by_j)), g.x * j.x + g.y * j.y};
  }

 private:
  /// Of a 2x3 matrix: px by camera space.
  template <typename T> struct Rows {
    Vec3<T> x, y;
  };
  template <typename T> AR_HD static Vec3<T> in_world(const Camera<T>& c, Vec3<T> v) {
    return v.x * xyz(c.view_x) + v.y * xyz(c.view_y) + v.z * xyz(c.view_z);
  }
  template <typename T> AR_HD static Vec3<T> in_camera(const Camera<T>& c, Vec3<T> v) {
    return {dot(xyz(c.view_x), v), dot(xyz(c.view_y), v), dot(xyz(c.view_z), v)};
  }

  template <class S> AR_HD static Vec3<Dual<S>> variables(S x, S y, S z) {
    const S one = S(1), zero = S(0);
    return {{x, {one, zero, zero}}, {y, {zero, one, zero}}, {z, {zero, zero, one}}};
  }
  template <typename T> AR_HD_CALL static Vec2<T> point_of(Vec3<T> p, const T* k) { return Model::image_point(p, k); }
  template <typename T> AR_HD static Rows<T> derivative(const FullCamera<T>& camera, Vec3<T> p) {
    const Rows<T> j = derivative_of_point(p, camera.lens.distortion);
    return {camera.focal.x * j.x, camera.focal.y * j.y};
  }
  template <typename T> AR_HD_CALL static Rows<T> derivative_of_point(Vec3<T> p, const T* k) {
    const Vec2<Dual<T>> u = Model::image_point(variables(p.x, p.y, p.z), k);
    return {u.x.gradient, u.y.gradient};
  }

  /// The adjoint of derivative(), by p.
  template <typename T>
  AR_HD static Vec3<T> slope_vjp(const FullCamera<T>& camera, Vec3<T> p, const Rows<T>& dL_djacobian) {
    return along(p, camera.focal.x * dL_djacobian.x, camera.lens.distortion).x +
           along(p, camera.focal.y * dL_djacobian.y, camera.lens.distortion).y;
  }
  /// The derivatives along d of the gradients of image_point.
  template <typename T> AR_HD_CALL static Rows<T> along(Vec3<T> p, Vec3<T> d, const T* distortion) {
    Line<T> k[kDistortion];
    for (int i = 0; i < kDistortion; ++i) k[i] = Line<T>(distortion[i]);
    const auto u = Model::image_point(variables(Line<T>(p.x, d.x), Line<T>(p.y, d.y), Line<T>(p.z, d.z)), k);
    return {slopes(u.x.gradient), slopes(u.y.gradient)};
  }
  template <typename T> AR_HD static Vec3<T> slopes(const Vec3<Line<T>>& v) {
    return {v.x.slope, v.y.slope, v.z.slope};
  }

  /// The adjoint of derivative(), by the distortion.
  template <typename T>
  AR_HD static void add_slope_vjp(const FullCamera<T>& camera, Vec3<T> p, const Rows<T>& dL_djacobian, Lens<T>& to) {
    add_by_distortion(p, {T(0), T(0)}, {camera.focal.x * dL_djacobian.x, camera.focal.y * dL_djacobian.y},
                      camera.lens.distortion, to.distortion);
  }
  /// Adds the gradient of g . image_point + G . its derivative by p.
  template <typename T>
  AR_HD static void add_by_distortion(Vec3<T> p, Vec2<T> g, Rows<T> G, const T* distortion, T* to) {
    if constexpr (Model::kDistorts) add_by_coefficients(p, g, G, distortion, to);
  }
  template <typename T>
  AR_HD_CALL static void add_by_coefficients(Vec3<T> p, Vec2<T> g, Rows<T> G, const T* distortion, T* to) {
    Line<T> k[kDistortion];
    for (int i = 0; i < kDistortion; ++i) k[i] = Line<T>(distortion[i]);
    AR_NO_UNROLL for (int i = 0; i < kDistortion; ++i) {
      k[i].slope = T(1);
      const auto u = Model::image_point(variables(Line<T>(p.x), Line<T>(p.y), Line<T>(p.z)), k);
      to[i] += g.x * u.x.value.slope + g.y * u.y.value.slope + dot(G.x, slopes(u.x.gradient)) +
               dot(G.y, slopes(u.y.gradient));
      k[i].slope = T(0);
    }
  }
};

/// For less than a half space: rays by x/z and y/z; `reach` and `fold` are the tangents of angles from the axis. The
/// depth is z.
template <class Model> struct PerspectiveLens : LensModel<Model> {
  template <typename T> AR_HD static bool inside(const FullCamera<T>& camera, Vec3<T> p) {
    const T r = camera.lens.fold;
    return in_range(camera, p.z) && p.z > T(0) && !(sqrt(p.x * p.x + p.y * p.y) > r * p.z);
  }
  template <typename T> AR_HD static Vec3<T> turned_back(const Lens<T>& lens, Vec3<T> p) {
    const T rho = sqrt(p.x * p.x + p.y * p.y), limit = lens.reach * p.z;
    if (!(rho > limit)) return p;
    const T scale = quotient(limit, rho);
    return {scale * p.x, scale * p.y, p.z};
  }
  template <typename T> AR_HD static Vec3<T> turned_back_vjp(const Lens<T>& lens, Vec3<T> p, Vec3<T> g) {
    const T rho = sqrt(p.x * p.x + p.y * p.y), limit = lens.reach * p.z;
    if (!(rho > limit)) return g;
    const T ex = quotient(p.x, rho), ey = quotient(p.y, rho), along = g.x * ex + g.y * ey, scale = quotient(limit, rho);
    return {scale * (g.x - along * ex), scale * (g.y - along * ey), g.z + lens.reach * along};
  }
};

/// For more than a half space: the depth is the distance.
template <class Model> struct DistanceLens : LensModel<Model> {
  template <typename T> AR_HD static T length(Vec3<T> p) { return sqrt(dot(p, p)); }

  template <typename T> AR_HD static T depth(Vec3<T> view) { return length(view); }
  template <typename T> AR_HD static Vec3<T> depth_vjp(Vec3<T> view, T dL_ddepth) {
    return (dL_ddepth / length(view)) * view;
  }

  template <typename T> AR_HD static T defocus(const Lens<T>& lens, Vec3<T> p) {
    return T(1) / lens.focus - T(1) / length(p);
  }
  template <typename T>
  AR_HD static void defocus_vjp(const Lens<T>& lens, Vec3<T> p, T dL_ddefocus, Vec3<T>& dL_dp, Lens<T>& dL_dlens) {
    const T n = length(p);
    dL_dlens.focus -= dL_ddefocus / (lens.focus * lens.focus);
    dL_dp += (dL_ddefocus / (n * n * n)) * p;
  }
};

/// `reach` and `fold` are angles from the axis.
template <class Model> struct WideLens : DistanceLens<Model> {
  using DistanceLens<Model>::length;

  template <typename T> AR_HD static bool inside(const FullCamera<T>& camera, Vec3<T> p) {
    return in_range(camera, length(p)) && !(angle(p) > camera.lens.fold);
  }
  template <typename T> AR_HD static Vec3<T> turned_back(const Lens<T>& lens, Vec3<T> p) {
    return turned_to(p, lens.reach);
  }
  template <typename T> AR_HD static Vec3<T> turned_back_vjp(const Lens<T>& lens, Vec3<T> p, Vec3<T> g) {
    return turned_to_vjp(p, lens.reach, g);
  }

 private:
  template <typename T> AR_HD_CALL static Vec3<T> turned_to(Vec3<T> p, T reach) {
    if (!(angle(p) > reach)) return p;
    const T n = length(p), across = n * std::sin(reach) / sqrt(p.x * p.x + p.y * p.y);
    return {across * p.x, across * p.y, n * std::cos(reach)};
  }
  template <typename T> AR_HD_CALL static Vec3<T> turned_to_vjp(Vec3<T> p, T reach, Vec3<T> g) {
    if (!(angle(p) > reach)) return g;
    const T n = length(p), rho = sqrt(p.x * p.x + p.y * p.y), ex = p.x / rho, ey = p.y / rho;
    const T s = std::sin(reach), along = g.x * ex + g.y * ey, out = (s * along + std::cos(reach) * g.z) / n;
    const T across = n * s / rho;
    return {out * p.x + across * (g.x - along * ex), out * p.y + across * (g.y - along * ey), out * p.z};
  }
  template <typename T> AR_HD_CALL static T angle(Vec3<T> p) { return std::atan2(sqrt(p.x * p.x + p.y * p.y), p.z); }
};

/// Tangential and thin prism terms of OpenCV, k = {p1, p2, s1, s2, s3, s4}, added to the point (x, y) of the
/// undistorted (a, b).
template <class N, class S> AR_HD Vec2<N> decentered(Vec2<N> to, N a, N b, const S* k) {
  const N r2 = a * a + b * b, r4 = r2 * r2, ab = a * b;
  const S two = S(2);
  return {to.x + (two * k[0]) * ab + k[1] * (r2 + two * (a * a)) + k[2] * r2 + k[3] * r4,
          to.y + k[0] * (r2 + two * (b * b)) + (two * k[1]) * ab + k[4] * r2 + k[5] * r4};
}

}  // namespace ar
