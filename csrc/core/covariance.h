// From scale and rotation, or a 3D covariance, to the covariance in the image: EWA projection [EWA, Eq. 29-31].
#pragma once

#include "core/camera.h"

namespace ar {

template <typename T> struct UnitQuaternion {
  T w, x, y, z;
  T inv_norm;  ///< of the quaternion as given, at most kMaxQuaternionGrad; 0 for zero, the identity without gradient
};

/// Deviates: 3DGS expects unit quaternions.
template <typename T> AR_HD UnitQuaternion<T> normalize_quaternion(Vec4<T> q) {
  // q.x is the w of the quaternion. Dividing by the largest keeps squares in range, the power of two the division.
  const T largest = max(max(abs(q.x), abs(q.y)), max(abs(q.z), abs(q.w)));
  // max() may drop a NaN; the sum does not.
  if (abs(q.x) + abs(q.y) + abs(q.z) + abs(q.w) == T(0)) return {T(1), T(0), T(0), T(0), T(0)};
  const T power = inverse_power_of_two(largest), scaled = power * largest;
  const T w = quotient(power * q.x, scaled), x = quotient(power * q.y, scaled), y = quotient(power * q.z, scaled),
          z = quotient(power * q.w, scaled);
  const T inv = quotient(T(1), sqrt(w * w + x * x + y * y + z * z));
  return {w * inv, x * inv, y * inv, z * inv, min(power * quotient(inv, scaled), T(kMaxQuaternionGrad))};
}

template <typename T> AR_HD Mat3<T> rotation_matrix(UnitQuaternion<T> q) {
  const T two = T(2), one = T(1);
  return {{{one - two * (q.y * q.y + q.z * q.z), two * (q.x * q.y - q.w * q.z), two * (q.x * q.z + q.w * q.y)},
           {two * (q.x * q.y + q.w * q.z), one - two * (q.x * q.x + q.z * q.z), two * (q.y * q.z - q.w * q.x)},
           {two * (q.x * q.z - q.w * q.y), two * (q.y * q.z + q.w * q.x), one - two * (q.x * q.x + q.y * q.y)}}};
}

/// Gradient by the stored quaternion, from that by a turn R <- R exp([turn]x).
template <typename T> AR_HD Vec4<T> rotation_vjp(UnitQuaternion<T> q, Vec3<T> dL_dturn) {
  const Vec3<T> raw = (T(2) * q.inv_norm) * dL_dturn;
  const T limit = T(kMaxQuaternionGrad);
  const Vec3<T> t = {max(min(raw.x, limit), -limit), max(min(raw.y, limit), -limit), max(min(raw.z, limit), -limit)};
  return {-q.x * t.x - q.y * t.y - q.z * t.z, q.w * t.x + q.y * t.z - q.z * t.y, q.w * t.y + q.z * t.x - q.x * t.z,
          q.w * t.z + q.x * t.y - q.y * t.x};
}

/// Sigma = V V^T, V = A R S. Of a 3D covariance A cov3d A^T, without `quaternion` to `normal`.
template <typename T> struct Factors {
  Jacobian<T> jacobian;
  UnitQuaternion<T> quaternion;
  Mat3<T> rotation;
  Vec3<T> scale;               ///< with the scale modifier
  Vec3<T> turned_x, turned_y;  ///< rows of A R
  Vec3<T> row_x, row_y;        ///< rows of V
  Vec3<T> normal;              ///< row_x x row_y: det Sigma = |normal|^2, without cancellation
  Cov2d<T> cov;
};

template <typename T> AR_HD Vec3<T> adjugate_times(const Sym3<T>& m, Vec3<T> v) {
  const Sym3<T> adj = {difference_of_products(m.yy, m.zz, m.yz, m.yz), difference_of_products(m.xz, m.yz, m.xy, m.zz),
                       difference_of_products(m.xy, m.yz, m.xz, m.yy), difference_of_products(m.xx, m.zz, m.xz, m.xz),
                       difference_of_products(m.xy, m.xz, m.xx, m.yz), difference_of_products(m.xx, m.yy, m.xy, m.xy)};
  return adj * v;
}

template <class Cam, typename T>
AR_HD Factors<T> project_covariance(const Cam& camera, const Gaussians<T>& g, int64_t i, Vec3<T> view) {
  Factors<T> f;
  f.jacobian = make_jacobian(camera, view);
  const Vec3<T>&ax = f.jacobian.x, &ay = f.jacobian.y;
  if (g.cov3ds) {
    const Sym3<T>& c = g.cov3ds[i];
    const Vec3<T> cx = c * ax, cy = c * ay, n = cross(ax, ay);
    f.cov = {dot(ax, cx), dot(ax, cy), dot(ay, cy), dot(n, adjugate_times(c, n))};
    // A rounded needle.
    if (f.cov.det < T(0) && f.cov.det >= T(-kSingular) * f.cov.xx * f.cov.yy) f.cov.det = T(0);
  } else {
    f.quaternion = normalize_quaternion(g.rotations[i]);
    f.rotation = rotation_matrix(f.quaternion);
    f.scale = g.scale_modifier * g.scales[i];
    f.turned_x = combine_rows(ax, f.rotation);
    f.turned_y = combine_rows(ay, f.rotation);
    f.row_x = mul(f.turned_x, f.scale);
    f.row_y = mul(f.turned_y, f.scale);
    f.normal = cross(f.row_x, f.row_y);
    f.cov = {dot(f.row_x, f.row_x), dot(f.row_x, f.row_y), dot(f.row_y, f.row_y), dot(f.normal, f.normal)};
  }
  return f;
}

}  // namespace ar
