// Functions that formulas call on a type V: float (a CUDA thread) and double (tests) here, packs of pixels in
// cpu/pack.h. ScalarOf<V> is the type of an element, MaskOf<V> of a comparison.
#pragma once

#include <cfloat>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <type_traits>

#include "core/constants.h"
#include "core/platform.h"

namespace ar {

template <class V> struct LaneTraits {
  using Scalar = typename V::Scalar;
  using Mask = typename V::Mask;
  using Index = typename V::Index;
};
template <> struct LaneTraits<float> {
  using Scalar = float;
  using Mask = bool;
  using Index = int32_t;
};
template <> struct LaneTraits<double> {
  using Scalar = double;
  using Mask = bool;
  using Index = int32_t;
};
template <class V> using ScalarOf = typename LaneTraits<V>::Scalar;
template <class V> using MaskOf = typename LaneTraits<V>::Mask;
template <class V> using IndexOf = typename LaneTraits<V>::Index;

AR_HD float select(bool m, float a, float b) { return m ? a : b; }
AR_HD double select(bool m, double a, double b) { return m ? a : b; }
AR_HD int32_t select(bool m, int32_t a, int32_t b) { return m ? a : b; }

template <typename T> AR_HD T min(T a, T b) { return b < a ? b : a; }
template <typename T> AR_HD T max(T a, T b) { return a < b ? b : a; }
/// One instruction where one keeps NaN.
AR_HD float min(float a, float b) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  float y;
  asm("min.NaN.f32 %0, %1, %2;" : "=f"(y) : "f"(a), "f"(b));
  return y;
#else
  return b < a ? b : a;
#endif
}
AR_HD float max(float a, float b) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  float y;
  asm("max.NaN.f32 %0, %1, %2;" : "=f"(y) : "f"(a), "f"(b));
  return y;
#else
  return a < b ? b : a;
#endif
}

/// a * b + c, contracted where there is an instruction. The build contracts nothing else: both passes round alike.
AR_HD float madd(float a, float b, float c) {
#if defined(__CUDA_ARCH__) || defined(__FMA__)
  return std::fma(a, b, c);
#else
  return a * b + c;
#endif
}
AR_HD double madd(double a, double b, double c) {
#if defined(__CUDA_ARCH__) || defined(__FMA__)
  return std::fma(a, b, c);
#else
  return a * b + c;
#endif
}

/// Clamped to [0, 1]. On a device NaN becomes 0.
AR_HD float saturated_madd(float a, float b, float c) {
#if defined(__CUDA_ARCH__)
  float y;
  asm("fma.rn.sat.f32 %0, %1, %2, %3;" : "=f"(y) : "f"(a), "f"(b), "f"(c));
  return y;
#else
  return min(max(madd(a, b, c), 0.0f), 1.0f);
#endif
}
AR_HD double saturated_madd(double a, double b, double c) { return min(max(madd(a, b, c), 0.0), 1.0); }

/// On a device one comparison: numbers outside [0, 1], and -0, have larger bits.
AR_HD bool in_unit_interval(float x) {
#if defined(__CUDA_ARCH__)
  return __float_as_uint(x) <= __float_as_uint(1.0f);
#else
  return x >= 0 && x <= 1;
#endif
}
AR_HD bool in_unit_interval(double x) { return x >= 0 && x <= 1; }

AR_HD float abs(float x) { return std::fabs(x); }
AR_HD double abs(double x) { return std::fabs(x); }
AR_HD float minus_abs(float x) { return -std::fabs(x); }
AR_HD double minus_abs(double x) { return -std::fabs(x); }
AR_HD float log2(float x) { return std::log2(x); }
AR_HD double log2(double x) { return std::log2(x); }
/// On a device within 2 ulp; results below 2^-126 are zero.
AR_HD float exp2(float x) {
#if defined(__CUDA_ARCH__)
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
#else
  return std::exp2(x);
#endif
}
AR_HD double exp2(double x) { return std::exp2(x); }
/// Within 4 ulp for normal results.
AR_HD float erfc(float x) { return std::erfc(x); }
AR_HD double erfc(double x) { return std::erfc(x); }
// On a device sqrt and quotient lack the compiler's branch for extreme numbers, around which no instruction moves.

/// Rounded correctly where x is not below 2^-100.
AR_HD float sqrt(float x) {
#if defined(__CUDA_ARCH__)
  float inverse;
  asm("rsqrt.approx.f32 %0, %1;" : "=f"(inverse) : "f"(x));
  const float root = x * inverse, half = 0.5f * inverse;
  const float improved = __fmaf_rn(__fmaf_rn(-root, root, x), half, root);
  return x == 0 || x > FLT_MAX ? x : improved;
#else
  return std::sqrt(x);
#endif
}
AR_HD double sqrt(double x) { return std::sqrt(x); }

/// Rounded correctly where |b| is in [2^-126, 2^126] and neither a nor the quotient is below 2^-100.
AR_HD float quotient(float a, float b) {
#if defined(__CUDA_ARCH__)
  float approximate;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(approximate) : "f"(b));
  const float inverse = __fmaf_rn(__fmaf_rn(-b, approximate, 1.0f), approximate, approximate);
  float q = a * inverse;
  q = __fmaf_rn(__fmaf_rn(-b, q, a), inverse, q);
  q = __fmaf_rn(__fmaf_rn(-b, q, a), inverse, q);
  return q == q ? q : a * approximate;  // of NaN: infinite, zero, or NaN
#else
  return a / b;
#endif
}
AR_HD double quotient(double a, double b) { return a / b; }

/// Its product with |x| is in [1, 2), but for the tiniest and largest x.
template <typename T> AR_HD T inverse_power_of_two(T x) {
  using Bits = std::conditional_t<sizeof(T) == sizeof(uint32_t), uint32_t, uint64_t>;
  static_assert(std::numeric_limits<T>::is_iec559 && sizeof(T) == sizeof(Bits));
  // The exponent's lowest bit, and its highest finite value.
  constexpr Bits lowest = Bits(1) << (std::numeric_limits<T>::digits - 1);
  constexpr Bits field = (~Bits(0) >> 1) & ~(lowest - 1), highest = field - lowest;
  Bits bits;
  memcpy(&bits, &x, sizeof bits);
  const Bits exponent = bits & field;
  bits = exponent < highest ? highest - exponent : lowest;
  memcpy(&x, &bits, sizeof x);
  return x;
}

/// On a device within 2 ulp, for |b| in [2^-126, 2^126].
AR_HD float divide(float a, float b) {
#if defined(__CUDA_ARCH__)
  float reciprocal;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(reciprocal) : "f"(b));
  return a * reciprocal;
#else
  return a / b;
#endif
}
AR_HD double divide(double a, double b) { return a / b; }

/// On a device within 1 ulp, and zero below 2^-126.
AR_HD float approx_sqrt(float x) {
#if defined(__CUDA_ARCH__)
  float y;
  asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
#else
  return std::sqrt(x);
#endif
}
AR_HD double approx_sqrt(double x) { return std::sqrt(x); }

/// a b - c d within 1.5 ulp, where nothing under- or overflows (Kahan).
template <typename T> AR_HD T difference_of_products(T a, T b, T c, T d) {
  const T cd = c * d;
  return std::fma(a, b, -cd) + std::fma(-c, d, cd);
}

template <class V> AR_HD V odds(V alpha) { return divide(alpha, V(ScalarOf<V>(1)) - alpha); }

/// False for NaN.
template <typename T> AR_HD bool within(T x, double bound) { return abs(x) <= T(bound); }

/// (1 - exp(-x)) / x on [0, 1/2], to 8e-8 relative in float and 5e-17 in double.
template <class V> AR_HD V one_minus_exp_ratio(V x) {
  using T = ScalarOf<V>;
  constexpr double kMinimax[] = {0.9999999227245566, -0.4999924984750279, 0.16654815152216923, -0.041001278881188354,
                                 0.006771038053309816};
  // (-1)^k / (k + 1)!
  constexpr double kTaylor[] = {1.0,
                                -1.0 / 2,
                                1.0 / 6,
                                -1.0 / 24,
                                1.0 / 120,
                                -1.0 / 720,
                                1.0 / 5040,
                                -1.0 / 40320,
                                1.0 / 362880,
                                -1.0 / 3628800,
                                1.0 / 39916800,
                                -1.0 / 479001600,
                                1.0 / 6227020800,
                                -1.0 / 87178291200,
                                1.0 / 1307674368000};
  if constexpr (sizeof(T) == 4) {
    V sum = V(T(kMinimax[4]));
    AR_UNROLL for (int k = 3; k >= 0; --k) sum = madd(sum, x, V(T(kMinimax[k])));
    return sum;
  } else {
    V sum = V(T(kTaylor[14]));
    AR_UNROLL for (int k = 13; k >= 0; --k) sum = madd(sum, x, V(T(kTaylor[k])));
    return sum;
  }
}

/// 1 - exp(-x) without cancellation, for x >= 0 and e = exp(-x).
template <class V> AR_HD V one_minus_exp(V x, V e) {
  using T = ScalarOf<V>;
  return select(x < V(T(0.5)), x * one_minus_exp_ratio(x), V(T(1)) - e);
}

}  // namespace ar
