// Packs of float lanes, a type V of formulas: vectors of GCC and Clang, with intrinsics for missing operations.
#pragma once

#include "core/constants.h"
#include "core/lanes.h"
#include "cpu/isa.h"

namespace ar::AR_ISA {

using ar::abs;
using ar::erfc;
using ar::exp2;
using ar::madd;
using ar::max;
using ar::min;
using ar::select;
using ar::sqrt;

struct PackIndex {
  typedef int32_t Raw __attribute__((vector_size(4 * kLanes)));
  Raw v;

  PackIndex() = default;
  AR_HD explicit PackIndex(Raw raw) : v(raw) {}
  AR_HD explicit PackIndex(int32_t x) : v(Raw{} + x) {}
  AR_HD static PackIndex load(const int32_t* p) {
    Raw r;
    __builtin_memcpy(&r, p, sizeof r);
    return PackIndex(r);
  }
  AR_HD void store(int32_t* p) const { __builtin_memcpy(p, &v, sizeof v); }
};

/// A lane has all bits set or clear.
struct PackMask {
  PackIndex::Raw v;

  AR_HD PackMask operator&(PackMask o) const { return {v & o.v}; }
  AR_HD PackMask operator!() const { return {~v}; }
};

struct Pack {
  using Scalar = float;
  using Mask = PackMask;
  using Index = PackIndex;
  typedef float Raw __attribute__((vector_size(4 * kLanes)));
  Raw v;

  Pack() = default;
  AR_HD explicit Pack(Raw raw) : v(raw) {}
  AR_HD explicit Pack(float x) : v(x - Raw{}) {}
  AR_HD static Pack load(const float* p) {
    Raw r;
    __builtin_memcpy(&r, p, sizeof r);
    return Pack(r);
  }
  AR_HD void store(float* p) const { __builtin_memcpy(p, &v, sizeof v); }

  AR_HD Pack operator+(Pack o) const { return Pack(v + o.v); }
  AR_HD Pack operator-(Pack o) const { return Pack(v - o.v); }
  AR_HD Pack operator*(Pack o) const { return Pack(v * o.v); }
  AR_HD Pack operator/(Pack o) const { return Pack(v / o.v); }
  AR_HD Pack operator-() const { return Pack(-v); }
  AR_HD PackMask operator<(Pack o) const { return {v < o.v}; }
  AR_HD PackMask operator>(Pack o) const { return {v > o.v}; }
  AR_HD PackMask operator<=(Pack o) const { return {v <= o.v}; }
  AR_HD PackMask operator>=(Pack o) const { return {v >= o.v}; }
};

AR_HD PackMask operator<(PackIndex a, PackIndex b) { return {a.v < b.v}; }
AR_HD Pack select(PackMask m, Pack a, Pack b) { return Pack(m.v ? a.v : b.v); }
AR_HD PackIndex select(PackMask m, PackIndex a, PackIndex b) { return PackIndex(m.v ? a.v : b.v); }

#if AR_LANES == 16
AR_HD uint32_t bits(PackMask m) { return _mm512_movepi32_mask((__m512i)m.v); }
AR_HD Pack madd(Pack a, Pack b, Pack c) { return Pack((Pack::Raw)_mm512_fmadd_ps(a.v, b.v, c.v)); }
AR_HD Pack min(Pack a, Pack b) { return Pack((Pack::Raw)_mm512_min_ps(a.v, b.v)); }
AR_HD Pack max(Pack a, Pack b) { return Pack((Pack::Raw)_mm512_max_ps(a.v, b.v)); }
AR_HD Pack sqrt(Pack a) { return Pack((Pack::Raw)_mm512_sqrt_ps(a.v)); }
#elif AR_LANES == 8
AR_HD uint32_t bits(PackMask m) { return _mm256_movemask_ps((__m256)m.v); }
AR_HD Pack madd(Pack a, Pack b, Pack c) { return Pack((Pack::Raw)_mm256_fmadd_ps(a.v, b.v, c.v)); }
AR_HD Pack min(Pack a, Pack b) { return Pack((Pack::Raw)_mm256_min_ps(a.v, b.v)); }
AR_HD Pack max(Pack a, Pack b) { return Pack((Pack::Raw)_mm256_max_ps(a.v, b.v)); }
AR_HD Pack sqrt(Pack a) { return Pack((Pack::Raw)_mm256_sqrt_ps(a.v)); }
#else
AR_HD uint32_t bits(PackMask m) { return (m.v[0] & 1) | (m.v[1] & 2) | (m.v[2] & 4) | (m.v[3] & 8); }
AR_HD Pack madd(Pack a, Pack b, Pack c) { return Pack(a.v * b.v + c.v); }
AR_HD Pack min(Pack a, Pack b) { return Pack(b.v < a.v ? b.v : a.v); }
AR_HD Pack max(Pack a, Pack b) { return Pack(a.v < b.v ? b.v : a.v); }
AR_HD Pack sqrt(Pack a) {
  Pack r;
  for (int i = 0; i < kLanes; ++i) r.v[i] = std::sqrt(a.v[i]);
  return r;
}
#endif

AR_HD Pack divide(Pack a, Pack b) { return a / b; }

/// Lane i in bit i.
AR_HD uint32_t bits(bool m) { return m; }

AR_HD Pack abs(Pack a) { return Pack((Pack::Raw)((PackIndex::Raw)a.v & 0x7fffffff)); }
AR_HD Pack minus_abs(Pack a) { return Pack((Pack::Raw)((PackIndex::Raw)a.v | INT32_MIN)); }

/// p * 2^n, with n in the low bits of `shifted`.
AR_HD Pack scale_by_power(Pack p, Pack shifted) {
  return Pack((Pack::Raw)((PackIndex::Raw)p.v + ((PackIndex::Raw)shifted.v << 23)));
}

/// 1.5 * 2^23. Adding it leaves a rounded integer in the low bits.
inline constexpr float kRound = 12582912.0f;

/// 2^x to 3e-7 relative (tests/cpp/pack_test.cpp) for x in [-126, 127], clamped below. x = n + f with |f| <= 1/2. The
/// minimax polynomial has an error of 1.1e-7.
AR_HD Pack exp2(Pack x) {
  const Pack clamped = max(x, Pack(-126.0f)), shifted = clamped + Pack(kRound);
  const Pack f = clamped - (shifted - Pack(kRound));
  Pack p(1.3264717e-3f);
  p = madd(p, f, Pack(9.67151802e-3f));
  p = madd(p, f, Pack(5.55073382e-2f));
  p = madd(p, f, Pack(2.4022242e-1f));
  p = madd(p, f, Pack(6.93146978e-1f));
  p = madd(p, f, Pack(1.0f));
  return scale_by_power(p, shifted);
}

/// Complement of the error function. |x| <= 9: error of 1e-6 + 1.5e-7 x^2 relative (tests/cpp/pack_test.cpp). Beyond it
/// is only positive. x >= 0: exp(-x^2) t p(t), t = 1 / (1 + 0.4 x). The polynomial has an error of 1.3e-7.
AR_HD Pack erfc(Pack x) {
  const Pack one(1.0f), distance = abs(x), t = one / madd(Pack(0.4f), distance, one);
  Pack p(5.0272588e-2f);
  p = madd(p, t, Pack(-1.82943583e-1f));
  p = madd(p, t, Pack(1.69154778e-1f));
  p = madd(p, t, Pack(-5.66763897e-3f));
  p = madd(p, t, Pack(1.41460821e-1f));
  p = madd(p, t, Pack(1.68533921e-1f));
  p = madd(p, t, Pack(2.07843855e-1f));
  p = madd(p, t, Pack(2.25669518e-1f));
  p = madd(p, t, Pack(2.25675866e-1f));
  const Pack tail = exp2(Pack(float(-kLog2e)) * distance * distance) * t * p;
  return select(x < Pack(0.0f), Pack(2.0f) - tail, tail);
}

#if AR_LANES == 16
AR_HD __m256 eight_lanes(Pack a) { return _mm256_add_ps(_mm512_castps512_ps256(a.v), _mm512_extractf32x8_ps(a.v, 1)); }
#elif AR_LANES == 8
AR_HD __m256 eight_lanes(Pack a) { return a.v; }
#endif

/// In a fixed order.
AR_HD float sum(Pack a) {
#if AR_LANES >= 8
  const __m256 half = eight_lanes(a);
  __m128 q = _mm_add_ps(_mm256_castps256_ps128(half), _mm256_extractf128_ps(half, 1));
  q = _mm_add_ps(q, _mm_movehl_ps(q, q));
  return _mm_cvtss_f32(_mm_add_ss(q, _mm_movehdup_ps(q)));
#else
  return (a.v[0] + a.v[2]) + (a.v[1] + a.v[3]);
#endif
}
AR_HD float sum(float a) { return a; }
AR_HD double sum(double a) { return a; }

/// sum() of eight packs, to the bit.
AR_HD void sum_lanes(const Pack (&packs)[8], float (&sums)[8]) {
#if AR_LANES >= 8
  __m256 halves[4], pairs[2];
  for (int i = 0; i < 4; ++i) {
    const __m256 a = eight_lanes(packs[i]), b = eight_lanes(packs[i + 4]);
    halves[i] = _mm256_add_ps(_mm256_permute2f128_ps(a, b, 0x20), _mm256_permute2f128_ps(a, b, 0x31));
  }
  for (int i = 0; i < 2; ++i) {
    const __m256 a = halves[2 * i], b = halves[2 * i + 1];
    pairs[i] = _mm256_add_ps(_mm256_shuffle_ps(a, b, 0x44), _mm256_shuffle_ps(a, b, 0xee));
  }
  const __m256 even = _mm256_shuffle_ps(pairs[0], pairs[1], 0x88), odd = _mm256_shuffle_ps(pairs[0], pairs[1], 0xdd);
  _mm256_storeu_ps(sums, _mm256_add_ps(even, odd));
#else
  for (int i = 0; i < 8; ++i) sums[i] = sum(packs[i]);
#endif
}
AR_HD void sum_lanes(const double (&packs)[8], double (&sums)[8]) {
  for (int i = 0; i < 8; ++i) sums[i] = packs[i];
}

template <typename T> struct LanesOf;
template <> struct LanesOf<float> {
  using Type = Pack;
  static constexpr int kCount = kLanes;
};
template <> struct LanesOf<double> {
  using Type = double;
  static constexpr int kCount = 1;
};

AR_HD Pack load(const float* p, Pack) { return Pack::load(p); }
AR_HD double load(const double* p, double) { return *p; }
AR_HD void store(float* p, Pack v) { v.store(p); }
AR_HD void store(double* p, double v) { *p = v; }
/// AVX-512 compresses lanes, others store all or none.
AR_HD int lanes_stored(uint32_t lanes, Pack) {
#if AR_LANES == 16
  return __builtin_popcount(lanes);
#else
  return lanes != 0 ? kLanes : 0;
#endif
}
/// Stores lanes whose bit is set. Writes kLanes numbers.
AR_HD void store_lanes(float* p, [[maybe_unused]] uint32_t lanes, Pack v) {
#if AR_LANES == 16
  store(p, Pack((Pack::Raw)_mm512_maskz_compress_ps(__mmask16(lanes), v.v)));
#else
  store(p, v);
#endif
}
/// Loads such lanes, and others from memory or `otherwise`. Reads kLanes numbers.
AR_HD Pack load_lanes(const float* p, [[maybe_unused]] uint32_t lanes, [[maybe_unused]] Pack otherwise) {
#if AR_LANES == 16
  return Pack((Pack::Raw)_mm512_mask_expand_ps(otherwise.v, __mmask16(lanes), load(p, Pack()).v));
#else
  return load(p, Pack());
#endif
}
AR_HD int lanes_stored(uint32_t lanes, double) { return int(lanes); }
AR_HD void store_lanes(double* p, uint32_t, double v) { *p = v; }
AR_HD double load_lanes(const double* p, uint32_t, double) { return *p; }

AR_HD PackIndex load_index(const int32_t* p, Pack) { return PackIndex::load(p); }
AR_HD int32_t load_index(const int32_t* p, double) { return *p; }
AR_HD void store_index(int32_t* p, PackIndex v) { v.store(p); }
AR_HD void store_index(int32_t* p, int32_t v) { *p = v; }

}  // namespace ar::AR_ISA
