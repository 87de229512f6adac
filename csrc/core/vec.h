// Small vectors and matrices, without padding: an array of them is an array of numbers.
#pragma once

#include "core/lanes.h"

namespace ar {

template <class V> struct Vec2 {
  V x, y;
};
template <class V> struct Vec3 {
  V x, y, z;
};
template <class V> struct Vec4 {
  V x, y, z, w;
};

/// [xx xy; yx yy], rows first.
template <typename T> struct Mat2 {
  T xx, xy, yx, yy;
};

/// [xx 0; yx yy].
template <typename T> struct Lower2 {
  T xx, yx, yy;
};

/// Symmetric 2x2. A gradient G means dL = tr(G dSigma): the derivative by the number that fills both off-diagonal
/// entries is 2 xy.
template <typename T> struct Sym2 {
  T xx, xy, yy;
};

/// Symmetric 3x3, in 3DGS's storage order.
template <typename T> struct Sym3 {
  T xx, xy, xz, yy, yz, zz;
};

template <typename T> struct Mat3 {
  Vec3<T> row[3];
};

template <class V> AR_HD Vec2<V> operator+(Vec2<V> a, Vec2<V> b) { return {a.x + b.x, a.y + b.y}; }
template <class V> AR_HD Vec4<V> operator+(Vec4<V> a, Vec4<V> b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z, a.w + b.w};
}
template <typename T> AR_HD Sym3<T> operator+(const Sym3<T>& a, const Sym3<T>& b) {
  return {a.xx + b.xx, a.xy + b.xy, a.xz + b.xz, a.yy + b.yy, a.yz + b.yz, a.zz + b.zz};
}
template <class V> AR_HD Sym2<V> operator+(Sym2<V> a, Sym2<V> b) { return {a.xx + b.xx, a.xy + b.xy, a.yy + b.yy}; }

template <typename T> AR_HD Vec3<T> operator+(Vec3<T> a, Vec3<T> b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
template <typename T> AR_HD Vec3<T> operator-(Vec3<T> a, Vec3<T> b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
template <typename T> AR_HD Vec3<T> operator*(T s, Vec3<T> a) { return {s * a.x, s * a.y, s * a.z}; }
template <typename T> AR_HD Vec4<T> operator*(T s, Vec4<T> a) { return {s * a.x, s * a.y, s * a.z, s * a.w}; }
template <typename T> AR_HD Vec3<T>& operator+=(Vec3<T>& a, Vec3<T> b) { return a = a + b; }
template <typename T> AR_HD T dot(Vec3<T> a, Vec3<T> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <typename T> AR_HD T dot(Vec4<T> a, Vec4<T> b) { return a.x * b.x + a.y * b.y + a.z * b.z + a.w * b.w; }
template <typename T> AR_HD Vec3<T> cross(Vec3<T> a, Vec3<T> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <typename T> AR_HD Vec3<T> mul(Vec3<T> a, Vec3<T> b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
/// (a_1 b_2, a_2 b_0, a_0 b_1).
template <typename T> AR_HD Vec3<T> shifted_products(Vec3<T> a, Vec3<T> b) { return {a.y * b.z, a.z * b.x, a.x * b.y}; }

/// v^T m.
template <typename T> AR_HD Vec3<T> combine_rows(Vec3<T> v, const Mat3<T>& m) {
  return v.x * m.row[0] + v.y * m.row[1] + v.z * m.row[2];
}
template <typename T> AR_HD Vec3<T> operator*(const Mat3<T>& m, Vec3<T> v) {
  return {dot(m.row[0], v), dot(m.row[1], v), dot(m.row[2], v)};
}
template <typename T> AR_HD Vec3<T> operator*(const Sym3<T>& m, Vec3<T> v) {
  return {m.xx * v.x + m.xy * v.y + m.xz * v.z, m.xy * v.x + m.yy * v.y + m.yz * v.z,
          m.xz * v.x + m.yz * v.y + m.zz * v.z};
}

template <typename T> AR_HD Mat2<T> operator*(T s, const Mat2<T>& m) {
  return {s * m.xx, s * m.xy, s * m.yx, s * m.yy};
}
template <typename T> AR_HD Lower2<T> operator*(T s, const Lower2<T>& m) { return {s * m.xx, s * m.yx, s * m.yy}; }
template <typename T> AR_HD Mat2<T> all_of(const Mat2<T>& m) { return m; }
template <typename T> AR_HD Mat2<T> all_of(const Lower2<T>& m) { return {m.xx, T(0), m.yx, m.yy}; }
template <typename T, class V> AR_HD Vec2<V> transform(const Mat2<T>& m, Vec2<V> v) {
  return {madd(V(m.xx), v.x, V(m.xy) * v.y), madd(V(m.yx), v.x, V(m.yy) * v.y)};
}
template <typename T, class V> AR_HD Vec2<V> transform(const Lower2<T>& m, Vec2<V> v) {
  return {V(m.xx) * v.x, madd(V(m.yx), v.x, V(m.yy) * v.y)};
}
/// m v + c; scalar m, c of scalars or lanes.
template <typename T, class V, class C> AR_HD Vec2<V> transform(const Mat2<T>& m, Vec2<V> v, Vec2<C> c) {
  return {madd(V(m.xx), v.x, madd(V(m.xy), v.y, V(c.x))), madd(V(m.yx), v.x, madd(V(m.yy), v.y, V(c.y)))};
}
template <typename T, class V, class C> AR_HD Vec2<V> transform(const Lower2<T>& m, Vec2<V> v, Vec2<C> c) {
  return {madd(V(m.xx), v.x, V(c.x)), madd(V(m.yx), v.x, madd(V(m.yy), v.y, V(c.y)))};
}
/// m^T v.
template <typename T, class V> AR_HD Vec2<V> transform_transposed(const Mat2<T>& m, Vec2<V> v) {
  return {madd(V(m.xx), v.x, V(m.yx) * v.y), madd(V(m.xy), v.x, V(m.yy) * v.y)};
}
template <typename T, class V> AR_HD Vec2<V> transform_transposed(const Lower2<T>& m, Vec2<V> v) {
  return {madd(V(m.xx), v.x, V(m.yx) * v.y), V(m.yy) * v.y};
}
/// m^T s m.
template <typename T> AR_HD Sym2<T> congruence_transposed(const Mat2<T>& m, Sym2<T> s) {
  const T ax = s.xx * m.xx + s.xy * m.yx, ay = s.xx * m.xy + s.xy * m.yy;
  const T bx = s.xy * m.xx + s.yy * m.yx, by = s.xy * m.xy + s.yy * m.yy;
  return {m.xx * ax + m.yx * bx, m.xx * ay + m.yx * by, m.xy * ay + m.yy * by};
}
template <typename T> AR_HD Sym2<T> congruence_transposed(const Lower2<T>& m, Sym2<T> s) {
  const T bx = s.xy * m.xx + s.yy * m.yx, by = s.yy * m.yy;
  return {m.xx * (s.xx * m.xx + s.xy * m.yx) + m.yx * bx, m.xx * (s.xy * m.yy) + m.yx * by, m.yy * by};
}

}  // namespace ar
