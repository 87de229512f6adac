// Packs of float lanes: the value type V of the per-pixel formulas on the CPU.
//
// Built on the vector extensions of GCC and Clang, with intrinsics where those lack an operation.
// The width is that of the instruction set this translation unit is compiled for; the type lives in
// that instruction set's namespace, so two widths never meet.
#pragma once

#include "core/constants.h"
#include "core/lanes.h"
#include "cpu/isa.h"

namespace ar::AR_ISA {

// The scalar forms stay visible beside the packs'.
using ar::abs;
using ar::erfc;
using ar::exp2;
using ar::madd;
using ar::max;
using ar::min;
using ar::select;
using ar::sqrt;

/// kLanes 32-bit integers.
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

/// All bits of a lane set or clear.
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

/// 2^n times 1 + f p(f); `shifted` holds the integer n in its low bits.
AR_HD Pack scale_by_power(Pack p, Pack shifted) {
  return Pack((Pack::Raw)((PackIndex::Raw)p.v + ((PackIndex::Raw)shifted.v << 23)));
}

/// Adding 1.5 * 2^23 rounds to an integer, which then sits in the low bits of the sum.
inline constexpr float kRound = 12582912.0f;

/// 2^x to 3e-7 relative for x in [-126, 127]; clamped below, so that it never underflows
/// (tests/cpp/pack_test.cpp). x = n + f, |f| <= 1/2; minimax polynomial of relative error 1.1e-7.
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

/// Complement of the error function. For |x| <= 9 within 1e-6 + 1.5e-7 x^2 relative (tests/cpp/pack_test.cpp);
/// beyond, where it is below 1e-36, positive. For x >= 0 exp(-x^2) t p(t), t = 1 / (1 + 0.4 x), with a
/// polynomial fitted to 1.3e-7 relative.
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
/// The upper lanes added to the lower.
AR_HD __m256 eight_lanes(Pack a) { return _mm256_add_ps(_mm512_castps512_ps256(a.v), _mm512_extractf32x8_ps(a.v, 1)); }
#elif AR_LANES == 8
AR_HD __m256 eight_lanes(Pack a) { return a.v; }
#endif

/// Sum of the lanes, in a fixed order.
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

/// sum() of eight, with the same bits: where packs are wide the sums share their instructions.
AR_HD void sum_lanes(const Pack (&packs)[8], float (&sums)[8]) {
#if AR_LANES >= 8
  // As in sum(): first the halves of a pack, then what is two lanes away, then neighbours. Every step halves the
  // number of registers.
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

/// The lanes a scalar type is processed in: packs of floats, doubles one by one (they serve tests
/// and gradcheck, where speed does not matter).
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
/// How many numbers store_lanes takes for the lanes whose bit is set: none for none; else as many, where there is an
/// instruction that puts them one behind the other, or all.
AR_HD int lanes_stored(uint32_t lanes, Pack) {
#if AR_LANES == 16
  return __builtin_popcount(lanes);
#else
  return lanes != 0 ? kLanes : 0;
#endif
}
/// Stores the lanes whose bit is set; writes kLanes numbers, whatever it takes.
AR_HD void store_lanes(float* p, [[maybe_unused]] uint32_t lanes, Pack v) {
#if AR_LANES == 16
  store(p, Pack((Pack::Raw)_mm512_maskz_compress_ps(__mmask16(lanes), v.v)));
#else
  store(p, v);
#endif
}
/// The same lanes, of which there is one or more, and those that were left out as in `otherwise`; reads kLanes numbers.
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
