// Gauss-Legendre rules, and moments of the normal density over an interval.
#pragma once

#include "core/footprint/contract.h"

namespace ar {

/// Gauss-Legendre rule with N nodes on [-1/2, 1/2]; the weights add up to 1. Its error for exp(-x^2 / (2 s^2)) is at
/// most (N!)^3 / ((2N + 1) ((2N)!)^2 2^N s^(2N)).
template <int N, typename T> struct GaussLegendre {
  AR_HD static constexpr T node(int i) { return i < N / 2 ? -positive(N / 2 - 1 - i).x : positive(i - N / 2).x; }
  AR_HD static constexpr T weight(int i) { return i < N / 2 ? positive(N / 2 - 1 - i).y : positive(i - N / 2).y; }

 private:
  /// Half of the node and weight on [-1, 1], from the centre outwards.
  AR_HD static constexpr Vec2<T> positive(int i) {
    static_assert(N == 4 || N == 6 || N == 8 || N == 12, "rules of 4, 6, 8 and 12 nodes");
    if constexpr (N == 4) {
      constexpr Vec2<T> k[] = {{T(0.3399810435848562648 / 2), T(0.65214515486254614263 / 2)},
                               {T(0.86113631159405257522 / 2), T(0.34785484513745385737 / 2)}};
      return k[i];
    } else if constexpr (N == 6) {
      constexpr Vec2<T> k[] = {{T(0.23861918608319690863 / 2), T(0.46791393457269104739 / 2)},
                               {T(0.66120938646626451366 / 2), T(0.36076157304813860757 / 2)},
                               {T(0.93246951420315202781 / 2), T(0.17132449237917034504 / 2)}};
      return k[i];
    } else if constexpr (N == 8) {
      constexpr Vec2<T> k[] = {{T(0.18343464249564980494 / 2), T(0.36268378337836198297 / 2)},
                               {T(0.52553240991632898582 / 2), T(0.31370664587788728734 / 2)},
                               {T(0.79666647741362673959 / 2), T(0.22238103445337447054 / 2)},
                               {T(0.96028985649753623168 / 2), T(0.10122853629037625915 / 2)}};
      return k[i];
    } else {
      constexpr Vec2<T> k[] = {{T(0.12523340851146891547 / 2), T(0.249147045813402785 / 2)},
                               {T(0.36783149899818019375 / 2), T(0.23349253653835480876 / 2)},
                               {T(0.5873179542866174473 / 2), T(0.20316742672306592175 / 2)},
                               {T(0.76990267419430468704 / 2), T(0.16007832854334622633 / 2)},
                               {T(0.90411725637047485668 / 2), T(0.10693932599531843096 / 2)},
                               {T(0.98156063424671925069 / 2), T(0.047175336386511827195 / 2)}};
      return k[i];
    }
  }
};

/// For at most half a standard deviation (few), or 3.3 (many).
template <typename T> inline constexpr int kFewNodes = sizeof(T) == 4 ? 4 : 6;
template <typename T> inline constexpr int kManyNodes = sizeof(T) == 4 ? 8 : 12;

template <class V> AR_HD V normal(V z) {
  using T = ScalarOf<V>;
  return exp2(V(T(-0.5 * kLog2e)) * z * z);
}

/// Integrals of f = exp(-z^2 / 2), z f and z^2 f over an interval.
template <class V> struct NormalMoments {
  V value, first, second;
};

/// Closed form. The differences lose digits if b - a < 1/2.
template <class V> AR_HD NormalMoments<V> interval_moments(V a, V b) {
  using T = ScalarOf<V>;
  const V zero = V(T(0)), root_half = V(T(0.70710678118654752440)), root_half_pi = V(T(1.2533141373155002512));
  // To the side where both values of erfc are small.
  const MaskOf<V> mirrored = a + b < zero;
  const V lo = select(mirrored, -b, a), hi = select(mirrored, -a, b);
  const V at_lo = normal(lo), at_hi = normal(hi), first = at_lo - at_hi;
  const V value = root_half_pi * max(erfc(lo * root_half) - erfc(hi * root_half), zero);
  return {value, select(mirrored, -first, first), max(madd(lo, at_lo, value - hi * at_hi), zero)};
}

/// By quadrature, for width <= 1/2.
template <class V> AR_HD NormalMoments<V> short_interval_moments(V z, V width) {
  using T = ScalarOf<V>;
  using Rule = GaussLegendre<kFewNodes<T>, T>;
  const V zero = V(T(0));
  NormalMoments<V> m = {zero, zero, zero};
  AR_UNROLL for (int i = 0; i < kFewNodes<T>; ++i) {
    const V x = madd(width, V(Rule::node(i)), z), w = width * V(Rule::weight(i)) * normal(x);
    m = {m.value + w, madd(w, x, m.first), madd(w * x, x, m.second)};
  }
  return m;
}

/// From the sums of g f z and g f z z^T over a pixel, f = exp(-|z|^2 / 2) (docs/internals/numerics.md, "Gradients of
/// the weights").
template <typename T> AR_HD SplatGrad<T> moments_vjp(const Mat2<T>& w, const ShapeGrad<T>& sums, GradFrame frame) {
  const Sym2<T> half = {T(0.5) * sums.shape.xx, T(0.5) * sums.shape.xy, T(0.5) * sums.shape.yy};
  return {transform_transposed(w, sums.offset), w, half, T(0), T(0), frame};
}

/// How much the pixel may raise the level along an axis of the Gaussian with variance 1/t = sigma^2 + 1/12
/// (docs/internals/numerics.md, "Support").
template <typename T> AR_HD constexpr T box_excess(T t) { return t * t / T(61); }

}  // namespace ar
