// Numbers with derivatives, so that a camera model writes its map once. Dual has the gradient by a point in space, Line
// the derivative in one direction, a Dual of Lines the gradient's change in that direction.
#pragma once

#include "core/vec.h"

namespace ar {

template <typename T> struct Line {
  T value, slope;

  Line() = default;
  AR_HD explicit Line(T v, T s = T(0)) : value(v), slope(s) {}
};
template <typename T> AR_HD Line<T> operator+(Line<T> a, Line<T> b) {
  return Line<T>(a.value + b.value, a.slope + b.slope);
}
template <typename T> AR_HD Line<T> operator-(Line<T> a, Line<T> b) {
  return Line<T>(a.value - b.value, a.slope - b.slope);
}
template <typename T> AR_HD Line<T> operator*(Line<T> a, Line<T> b) {
  return Line<T>(a.value * b.value, a.slope * b.value + a.value * b.slope);
}
template <typename T> AR_HD Line<T> operator/(Line<T> a, Line<T> b) {
  const T ratio = quotient(a.value, b.value);
  return Line<T>(ratio, quotient(a.slope - ratio * b.slope, b.value));
}

/// S: float, double or a Line.
template <class S> struct Dual {
  S value;
  Vec3<S> gradient;
};
template <class S> AR_HD Dual<S> operator+(const Dual<S>& a, const Dual<S>& b) {
  return {a.value + b.value, a.gradient + b.gradient};
}
template <class S> AR_HD Dual<S> operator-(const Dual<S>& a, const Dual<S>& b) {
  return {a.value - b.value, a.gradient - b.gradient};
}
template <class S> AR_HD Dual<S> operator*(const Dual<S>& a, const Dual<S>& b) {
  return {a.value * b.value, b.value * a.gradient + a.value * b.gradient};
}
template <class S> AR_HD Dual<S> operator/(const Dual<S>& a, const Dual<S>& b) {
  const S inverse = S(1) / b.value, ratio = a.value * inverse;
  return {ratio, inverse * (a.gradient - ratio * b.gradient)};
}
template <class S> AR_HD Dual<S> operator*(S a, const Dual<S>& b) { return {a * b.value, a * b.gradient}; }
template <class S> AR_HD Dual<S> operator+(S a, const Dual<S>& b) { return {a + b.value, b.gradient}; }
template <class S> AR_HD Dual<S> operator-(S a, const Dual<S>& b) { return {a - b.value, S(-1) * b.gradient}; }

template <typename T> AR_HD T value_of(T v) { return v; }
template <typename T> AR_HD T value_of(Line<T> v) { return v.value; }
template <class S> AR_HD auto value_of(const Dual<S>& v) { return value_of(v.value); }

/// The square root, positive numbers only.
AR_HD float root(float v) { return sqrt(v); }
AR_HD double root(double v) { return sqrt(v); }
template <typename T> AR_HD Line<T> root(Line<T> v) {
  const T r = root(v.value);
  return Line<T>(r, quotient(T(0.5) * v.slope, r));
}
template <class S> AR_HD Dual<S> root(const Dual<S>& v) {
  const S r = root(v.value);
  return {r, (S(0.5) / r) * v.gradient};
}

/// The angle of (x, y) from the axis of x.
AR_HD float arc_tangent(float y, float x) { return std::atan2(y, x); }
AR_HD double arc_tangent(double y, double x) { return std::atan2(y, x); }
template <typename T> AR_HD Line<T> arc_tangent(Line<T> y, Line<T> x) {
  return Line<T>(arc_tangent(y.value, x.value),
                 quotient(x.value * y.slope - y.value * x.slope, x.value * x.value + y.value * y.value));
}
template <class S> AR_HD Dual<S> arc_tangent(const Dual<S>& y, const Dual<S>& x) {
  const S inverse = S(1) / (x.value * x.value + y.value * y.value);
  return {arc_tangent(y.value, x.value), inverse * (x.value * y.gradient - y.value * x.gradient)};
}

/// Angle over sine, by h = 1 - cosine, 0 <= h < 2: sum of n!/(2n + 1)!! h^n, which has no singularity at 0. k = 2 - h
/// is a parameter too, for angles near pi, where the difference would lose digits.
inline constexpr double kArcSeriesEnd = 0.1;
inline constexpr int kArcTerms = 14;  // the next is below 1e-18 of the sum
template <typename T> AR_HD T arc(T h, T k) {
  if (h < T(kArcSeriesEnd)) {
    T sum = T(1);
    for (int n = kArcTerms; n > 0; --n) sum = T(1) + T(n) / T(2 * n + 1) * h * sum;
    return sum;
  }
  const T sine = sqrt(h * k);
  return quotient(T(std::atan2(sine, T(1) - h)), sine);
}
template <class S> AR_HD S arc_slope(S h, S k);
template <typename T> AR_HD Line<T> arc(Line<T> h, Line<T> k) {
  return Line<T>(arc(h.value, k.value), arc_slope(h.value, k.value) * h.slope);
}
template <class S> AR_HD Dual<S> arc(const Dual<S>& h, const Dual<S>& k) {
  return {arc(h.value, k.value), arc_slope(h.value, k.value) * h.gradient};
}

/// d arc / dh. It solves h k arc' = 1 - (1 - h) arc.
template <class S> AR_HD S arc_slope(S h, S k) {
  if (value_of(h) < kArcSeriesEnd) {
    S sum = S(1), slope = S(0);  // Horner's scheme, and its derivative
    for (int n = kArcTerms; n > 0; --n) {
      const S factor = S(n) / S(2 * n + 1);
      slope = factor * (sum + h * slope);
      sum = S(1) + factor * h * sum;
    }
    return slope;
  }
  return (S(1) - (S(1) - h) * arc(h, k)) / (h * k);
}

}  // namespace ar
