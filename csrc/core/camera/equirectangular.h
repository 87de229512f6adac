// The equirectangular picture: columns are longitudes, rows are latitudes; the whole sphere has a focal length of w /
// (2 pi), h / pi px.
//
// Towards a pole the longitude's derivative grows without bound. `reach` is the largest 1 / cos(latitude): nearer to a
// pole derivatives are those there (docs/internals/numerics.md, "Equirectangular pictures").
#pragma once

#include "core/camera/lens_model.h"

namespace ar {

struct Equirectangular : DistanceLens<Equirectangular> {
  static constexpr const char* kName = "equirectangular";
  static constexpr bool kDistorts = false;

  template <class N, class S> AR_HD static Vec2<N> image_point(Vec3<N> p, const S*) {
    return {arc_tangent(p.x, p.z), arc_tangent(p.y, root(p.x * p.x + p.z * p.z))};
  }

  /// Less than half a turn from the middle of the picture, which a crop may have on the seam. If this copy of a splat
  /// shows nothing, none a turn away does.
  template <typename T> AR_HD static bool map(const FullCamera<T>& camera, Vec3<T> mean, ProjectedMean<T>& p) {
    const bool seen = LensModel<Equirectangular>::map(camera, mean, p);
    const T turn = T(2 * kPi) * camera.focal.x, from_middle = p.pixel.x - T(0.5) * (camera.size.x - T(1));
    p.pixel.x -= turn * std::floor(quotient(from_middle, turn) + T(0.5));
    return seen;
  }

  template <typename T> AR_HD static bool inside(const FullCamera<T>& camera, Vec3<T> p) {
    return in_range(camera, length(p));
  }
  template <typename T> AR_HD_CALL static Vec3<T> turned_back(const Lens<T>& lens, Vec3<T> p) {
    const T n = length(p);
    if (!(sqrt(p.x * p.x + p.z * p.z) * lens.reach < n)) return p;
    const Vec3<T> edge = at_reach(lens, p);
    return {n * edge.x, n * edge.y, n * edge.z};
  }
  /// Nearer to a pole than `reach`: of the longitude the derivative at `reach`.
  template <typename T> AR_HD_CALL static Vec3<T> turned_back_vjp(const Lens<T>& lens, Vec3<T> p, Vec3<T> g) {
    const T n = length(p);
    if (!(sqrt(p.x * p.x + p.z * p.z) * lens.reach < n)) return g;
    const Vec3<T> edge = at_reach(lens, p);
    const T ex = edge.x * lens.reach, ez = edge.z * lens.reach;
    const T across = g.x * ez - g.z * ex, out = dot(g, edge) / n;
    return {out * p.x + across * ez, out * p.y, out * p.z - across * ex};
  }
  template <typename T> AR_HD static Vec3<T> regular(const Lens<T>& lens, Vec3<T> p) { return turned_back(lens, p); }
  template <typename T> AR_HD static Vec3<T> regular_vjp(const Lens<T>& lens, Vec3<T> p, Vec3<T> g) {
    return turned_back_vjp(lens, p, g);
  }

 private:
  /// The unit vector at the longitude of p, which is 0 at a pole, and at the latitude that `reach` stands for.
  template <typename T> AR_HD static Vec3<T> at_reach(const Lens<T>& lens, Vec3<T> p) {
    const T longitude = std::atan2(p.x, p.z), across = quotient(T(1), lens.reach);
    const T up = sqrt(max((T(1) - across) * (T(1) + across), T(0)));
    return {across * std::sin(longitude), p.y < T(0) ? -up : up, across * std::cos(longitude)};
  }
};

}  // namespace ar
