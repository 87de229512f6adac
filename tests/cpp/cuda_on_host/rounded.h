// A number as float32 makes it, with a bound of its error: for tolerances of what a kernel computes.
//
// The formulas of csrc/core run on it as on any scalar. `value` is the result in float64. `error` bounds how far
// float32 may be off it (running error analysis; Higham, Accuracy and Stability of Numerical Algorithms, 3.3): every
// operation adds what the errors of its operands make of its result, and half an ulp of the largest result that float32
// can have. No rounding is left out and none is guessed; what float64 rounds is 2^-29 of it.
#pragma once

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "core/vec.h"

namespace ar {

/// Result of a comparison. `sure`: float32 cannot find the opposite.
struct RoundedMask {
  bool value, sure = true;

  /// For a branch, which a test can only follow where it is sure.
  operator bool() const {
    EXPECT_TRUE(sure) << "float32 may take another branch";
    return value;
  }
};
inline RoundedMask operator&(RoundedMask a, RoundedMask b) {
  return {a.value && b.value, (a.sure && b.sure) || (a.sure && !a.value) || (b.sure && !b.value)};
}

struct Rounded {
  using Scalar = Rounded;
  using Mask = RoundedMask;
  using Index = int32_t;

  static constexpr double kUnit = 0x1p-24;       ///< half an ulp of 1
  static constexpr double kSmallest = 0x1p-150;  ///< half of the smallest float
  double value = 0, error = 0;

  Rounded() = default;
  Rounded(double x) : value(x), error(std::abs(double(float(x)) - x)) {}  // a constant, or a float, without error
  Rounded(double value, double error) : value(value), error(error) {}

  double most() const { return std::abs(value) + error; }
  /// An operation's result, of which `error` is due to the operands, rounded `units` times.
  static Rounded of(double value, double error, double units = 1) {
    return {value, error + units * (kUnit * (std::abs(value) + error) + kSmallest)};
  }
  /// What it adds to the error of a sum that it becomes part of, by at most `additions` additions one after the other:
  /// in whatever order they are made, each changes the numbers in it by a factor of 1 + kUnit at most.
  Rounded summed(int additions) const {
    const double growth = additions * kUnit / (1 - additions * kUnit);
    return {value, error + growth * most()};
  }
};

inline Rounded operator-(Rounded a) { return {-a.value, a.error}; }
inline Rounded operator+(Rounded a, Rounded b) { return Rounded::of(a.value + b.value, a.error + b.error); }
inline Rounded operator-(Rounded a, Rounded b) { return a + -b; }
inline Rounded operator*(Rounded a, Rounded b) {
  return Rounded::of(a.value * b.value, std::abs(a.value) * b.error + a.error * b.most());
}
inline Rounded operator/(Rounded a, Rounded b) {
  const double quotient = a.value / b.value, least = std::abs(b.value) - b.error;
  return Rounded::of(quotient, least > 0 ? (a.error + std::abs(quotient) * b.error) / least : INFINITY);
}
inline Rounded divide(Rounded a, Rounded b) { return a / b; }
inline Rounded quotient(Rounded a, Rounded b) { return a / b; }
inline Rounded madd(Rounded a, Rounded b, Rounded c) { return a * b + c; }  // with one rounding or, on a host, two

inline RoundedMask compared(bool value, Rounded a, Rounded b) {
  const double error = a.error + b.error;
  return {value, error == 0 || std::abs(a.value - b.value) > error};
}
inline RoundedMask operator<(Rounded a, Rounded b) { return compared(a.value < b.value, a, b); }
inline RoundedMask operator<=(Rounded a, Rounded b) { return compared(a.value <= b.value, a, b); }
inline RoundedMask operator>(Rounded a, Rounded b) { return b < a; }
inline RoundedMask operator>=(Rounded a, Rounded b) { return b <= a; }
inline Rounded select(RoundedMask mask, Rounded a, Rounded b) {
  const Rounded chosen = mask.value ? a : b;
  if (mask.sure) return chosen;
  return {chosen.value, std::max(a.error, b.error) + std::abs(a.value - b.value)};
}
inline Rounded abs(Rounded x) { return {std::abs(x.value), x.error}; }
/// The first or the second of the two, both near it where float32 may choose the other.
inline Rounded chosen_of(Rounded a, Rounded b, bool first) {
  const Rounded chosen = first ? a : b;
  return {chosen.value, (a < b).sure ? chosen.error : std::max(a.error, b.error)};
}
inline Rounded min(Rounded a, Rounded b) { return chosen_of(a, b, a.value < b.value); }
inline Rounded max(Rounded a, Rounded b) { return chosen_of(a, b, b.value < a.value); }

inline Rounded sqrt(Rounded x) {
  const double root = std::sqrt(x.value);  // flatter above than below
  return Rounded::of(root, root - std::sqrt(std::max(x.value - x.error, 0.0)));
}
inline Rounded approx_sqrt(Rounded x) { return sqrt(x); }  // on a host the same
// Those of a C library are within an ulp.
inline Rounded exp2(Rounded x) {
  const double y = std::exp2(x.value);
  return Rounded::of(y, y * std::expm1(x.error * std::log(2.0)), 2);
}
inline Rounded log2(Rounded x) {
  return Rounded::of(std::log2(x.value), -std::log1p(-x.error / std::abs(x.value)) / std::log(2.0), 2);
}
/// lanes.h has a polynomial for float32 that errs by 8e-8, besides the four roundings of Horner's scheme that matter.
inline Rounded one_minus_exp_ratio(Rounded x) {
  const double ratio = x.value == 0 ? 1 : -std::expm1(-x.value) / x.value;  // its slope is 1/2 at most
  return Rounded::of(ratio, x.error / 2 + 8e-8 * std::abs(ratio), 4);
}

}  // namespace ar
