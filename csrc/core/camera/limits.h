// `fold` and `reach` of core/lens.h: how far a lens is a map, and a picture sees through it, by rays at many angles. In
// double: near a fold derivatives cancel.
#pragma once

#include <limits>

#include "core/camera.h"

namespace ar {

inline constexpr int kLimitDirections = 64, kLimitAngles = 512;
inline constexpr double kWidestPerspective = 89.5 / 180 * kPi, kWidestMeasured = 1.57;  ///< rad

/// By what `reach` and `fold` are measured.
enum class LimitKind : int32_t {
  kNone,
  kTangent,   ///< of an angle from the axis
  kAngle,     ///< from the axis
  kLatitude,  ///< `reach` is 1 / cos of one; there is no fold
};
template <class Model> constexpr LimitKind limit_kind_of() {
  if (std::is_same_v<Model, Equirectangular>) return LimitKind::kLatitude;
  if (std::is_base_of_v<WideLens<Model>, Model>) return LimitKind::kAngle;
  return std::is_base_of_v<CameraModelDefaults, Model> && std::is_base_of_v<LensModel<Model>, Model>
             ? LimitKind::kTangent
             : LimitKind::kNone;
}
template <typename T> AR_HD LimitKind limit_kind(const Lens<T>& lens) {
  return visit_model_at(lens.model, CameraModels(),
                        [](auto model) AR_HD_LAMBDA { return limit_kind_of<decltype(model)>(); });
}
/// Where the model has coefficients.
AR_HD bool may_fold(LimitKind kind) { return kind == LimitKind::kTangent || kind == LimitKind::kAngle; }
AR_HD double widest_angle(LimitKind kind) { return kind == LimitKind::kAngle ? kPi - 1e-3 : kWidestPerspective; }
AR_HD double measured(LimitKind kind, double angle) {
  if (kind == LimitKind::kLatitude) return 1 / std::cos(angle);
  return kind == LimitKind::kAngle ? angle : std::tan(min(angle, kWidestMeasured));
}

/// At the origin, without limits; the picture is in focal lengths from the principal point.
AR_HD FullCamera<double> bare_camera(const Lens<double>& lens) {
  const double inf = std::numeric_limits<double>::infinity();
  FullCamera<double> camera = {};
  camera.view_x.x = camera.view_y.y = camera.view_z.z = 1;
  camera.size = camera.focal = {1, 1};  // the middle of such a picture is pixel 0
  for (int k = 0; k < kDistortion; ++k) camera.lens.distortion[k] = lens.distortion[k];
  camera.lens.near = -inf;
  camera.lens.far = camera.lens.reach = camera.lens.fold = inf;
  camera.lens.model = lens.model;
  return camera;
}

/// Whether the map keeps the orientation there, and goes outwards.
template <typename T> AR_HD_CALL bool is_map_at(const FullCamera<T>& camera, double angle, int direction) {
  const double turn = direction * (2 * kPi / kLimitDirections), s = std::sin(angle), c = std::cos(angle);
  const double x = std::cos(turn), y = std::sin(turn);
  const Jacobian<double> j = make_jacobian(camera, Vec3<double>{s * x, s * y, c});
  const Vec3<double> along = {c * x, c * y, -s}, across = {-y, x, 0};
  const Vec2<double> u = {dot(j.x, along), dot(j.y, along)}, v = {dot(j.x, across), dot(j.y, across)};
  const double area = u.x * v.y - u.y * v.x, outwards = u.x * x + u.y * y;
  return area > 0 && within(area, 1e300) && outwards > 0;
}
template <typename T> AR_HD_CALL double distance_seen(const FullCamera<T>& camera, double angle, int direction) {
  const double turn = direction * (2 * kPi / kLimitDirections), s = std::sin(angle);
  const Vec2<double> u =
      project_mean(camera, Vec3<double>{s * std::cos(turn), s * std::sin(turn), std::cos(angle)}).pixel;
  return sqrt(u.x * u.x + u.y * u.y);
}
AR_HD double limit_angle(double first, double last, int k) {
  return k == kLimitAngles ? last : first + (last - first) * k / kLimitAngles;
}

/// The angle before which the lens is a map in one direction, or 0. find(first, last): the first of these angles where
/// it is none, else kLimitAngles + 1.
template <class Find> AR_HD double fold_in_direction(LimitKind kind, const Find& find) {
  double first = 0, last = widest_angle(kind);
  for (int pass = 0; pass < 2; ++pass) {  // the second between two neighbours of the first
    const int k = find(first, last);
    if (k > kLimitAngles) return last;
    const double before = limit_angle(first, last, max(k - 1, 0));
    last = limit_angle(first, last, k);
    first = before;
  }
  return first;
}

/// `seen`: the last of the angles up to `fold` that is nearer to the axis than the farthest corner, in any direction,
/// since a strip of a picture may lie between the rays; -1: none.
AR_HD double reach_of(LimitKind kind, const Lens<double>& lens, double fold, int seen, int height) {
  if (kind == LimitKind::kLatitude)  // a pixel is 2 tan_half_fov.y / height radians high: half a pixel from the poles
    return kPi / 2 - min(lens.tan_half_fov.y / height, 1.5);
  const double largest = seen < 0 ? fold : limit_angle(0, fold, min(seen + 1, kLimitAngles));
  const double wider = kind == LimitKind::kAngle ? kFrustumClamp * largest
                                                 : std::atan(kFrustumClamp * std::tan(min(largest, kWidestMeasured)));
  return min(fold, wider);
}
AR_HD double corner_distance(const Lens<double>& lens) {
  const double x = abs(lens.center.x) + lens.tan_half_fov.x, y = abs(lens.center.y) + lens.tan_half_fov.y;
  return sqrt(x * x + y * y);
}

}  // namespace ar
