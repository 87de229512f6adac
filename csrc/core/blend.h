// One splat in one sample, and the adjoint (docs/internals/numerics.md, "Blending and its adjoint").
//
// T is the transmittance of a sample. `raw` is opacity * weight, before the cap and the threshold that make it alpha.
// `mask`: the splat is composited. V is a scalar or a pack of lanes.
#pragma once

#include <type_traits>

#include "core/constants.h"
#include "core/lanes.h"
#include "core/stages.h"

namespace ar {

// A sample that stops negates T, and no later splat changes it.

template <class V> AR_HD V effective_alpha(V raw) {
  using T = ScalarOf<V>;
  return select(raw >= V(T(kAlphaMin)), min(raw, V(T(kAlphaMax))), V(T(0)));
}

template <class V> struct Blended {
  MaskOf<V> mask;
  V contribution;  ///< T alpha; zero outside the mask
  V if_shown;      ///< T alpha; undefined outside the mask
};

/// T <- T (1 - alpha). As in 3DGS, a splat that would lower T below kTransmittanceMin stops the sample instead.
template <class V> AR_HD Blended<V> blend_sample(V raw, V& transmittance) {
  using T = ScalarOf<V>;
  const V zero = V(T(0));
  const MaskOf<V> hit = raw >= V(T(kAlphaMin));
  // The same bits: the first is quicker for a GPU thread, the second for packs.
  if constexpr (std::is_same_v<MaskOf<V>, bool>) {
    const V if_shown = transmittance * min(raw, V(T(kAlphaMax))), next = transmittance - if_shown;
    const bool mask = hit & (next >= V(T(kTransmittanceMin)));
    transmittance = select(hit, select(mask, next, minus_abs(transmittance)), transmittance);
    return {mask, select(mask, if_shown, zero), if_shown};
  } else {
    const V contribution = select(hit, transmittance * min(raw, V(T(kAlphaMax))), zero);
    const V next = transmittance - contribution;
    const MaskOf<V> open = next >= V(T(kTransmittanceMin));
    transmittance = select(open, next, minus_abs(transmittance));
    return {MaskOf<V>(hit & open), select(open, contribution, zero), contribution};
  }
}

/// What a sample that moves (kMoves) carries besides T. Zero before the first splat.
template <class V, bool kMoves> struct SampleState {};
template <class V> struct SampleState<V, true> {
  Vec2<V> moved;  ///< displacement from the sample's node [px]
};

/// For sample s of the pixel at p. P is PixelsOf the footprint.
template <class P, class Terms, class V>
AR_HD Blended<V> blend_sample(const Terms& terms, Vec2<V> p, int s, V& transmittance,
                              SampleState<V, P::kMoves>& state) {
  if constexpr (P::kMoves) {
    using T = ScalarOf<V>;
    const Vec2<V> at = p + state.moved;
    const V raw = P::alpha(terms, at, s);
    const Blended<V> blended = blend_sample(raw, transmittance);
    const V alpha = select(blended.mask, min(raw, V(T(kAlphaMax))), V(T(0)));
    state.moved = P::move(terms, at, s, alpha, state.moved);
    return blended;
  } else {
    return blend_sample(P::alpha(terms, p, s), transmittance);
  }
}

/// Of a sample that moves, at `place` in `cell` (Bounds or UnitCell), with whitened coordinates z.
template <class P, class Terms, class V, class Cell>
AR_HD Blended<V> blend_placed_sample(const Terms& terms, Vec2<V> z, V raw, const Cell& cell, V& transmittance,
                                     Vec2<V>& place) {
  using T = ScalarOf<V>;
  const V alpha = min(raw, V(T(kAlphaMax)));
  const Blended<V> blended = blend_sample(raw, transmittance);
  place = P::move_in(terms, z, alpha, blended.mask, place, cell);
  return blended;
}

/// Repeats blend_placed_sample in the backward pass. `before`: up to the last splat composited, so kTransmittanceMin
/// need not be tested.
template <class P, class Terms, class V, class Cell>
AR_HD MaskOf<V> replay_placed_sample(const Terms& terms, Vec2<V> z, V raw, MaskOf<V> before, const Cell& cell,
                                     V& transmittance, Vec2<V>& place) {
  using T = ScalarOf<V>;
  const MaskOf<V> mask = (raw >= V(T(kAlphaMin))) & before;
  const V alpha = min(raw, V(T(kAlphaMax)));
  transmittance = select(mask, transmittance - transmittance * alpha, transmittance);
  place = P::move_in(terms, z, alpha, mask, place, cell);
  return mask;
}

template <class V> struct BlendGrad {
  V contribution;         ///< T alpha
  AlphaGrad<V> of_alpha;  ///< zero where alpha is capped
};

/// Adjoint of blend_sample, last splat first.
///
/// `g_color`: the pixel's gradient times the splat's colour. `behind` (B of docs/internals/numerics.md) is that product
/// for all later splats and the background, seen through this splat alone. It and `transmittance` are read as after the
/// splat, written as before it.
template <class V> AR_HD BlendGrad<V> blend_sample_vjp(MaskOf<V> mask, V raw, V g_color, V& transmittance, V& behind) {
  using T = ScalarOf<V>;
  const V zero = V(T(0)), cap = V(T(kAlphaMax));
  const V alpha = select(mask, min(raw, cap), zero);
  transmittance = divide(transmittance, V(T(1)) - alpha);
  const V difference = g_color - behind;
  behind = madd(alpha, difference, behind);
  const V contribution = transmittance * alpha;
  const MaskOf<V> free = mask & (raw <= cap);
  return {contribution,
          {select(free, transmittance * difference, zero), select(free, contribution * difference, zero)}};
}

template <class V> struct MovingBlendGrad {
  V contribution;
  MoveGrad<V> of_splat;
};
/// Zeros are -0: the compiler knows that -0 + x is x.
template <class V> AR_HD MovingBlendGrad<V> no_moving_blend_grad() {
  const V zero = V(ScalarOf<V>(-0.0));
  return {zero, {zero, {{zero, zero}, {zero, zero, zero}}}};
}

/// Adjoint of blend_placed_sample. `raw` is zero outside the mask, `place` is before the splat, dL_dplace in the unit
/// kMoveGradUnit.
template <class P, class Terms, class V, class Cell>
AR_HD void add_placed_sample_vjp(const Terms& terms, Vec2<V> z, V raw, const Cell& cell, V g_color, Vec2<V> place,
                                 V& transmittance, V& behind, Vec2<V>& dL_dplace, MovingBlendGrad<V>& sums) {
  using T = ScalarOf<V>;
  const V cap = V(T(kAlphaMax)), alpha = min(raw, cap);
  const V contribution = transmittance * odds(alpha);
  transmittance = transmittance + contribution;
  const V difference = g_color - behind;
  behind = madd(alpha, difference, behind);
  sums.contribution = sums.contribution + contribution;
  P::add_alpha_and_move_in_vjp(terms, z, alpha, raw <= cap, contribution * difference, place, cell, dL_dplace,
                               sums.of_splat);
}

/// How a segment of a list changes `behind` and dL_dplace (docs/internals/numerics.md, "Adjoint of moving nodes").
///
///   behind before = (color + T after * behind after) / T before,
///   dL_dplace before = of_color + of_behind * behind after + of_place * dL_dplace after.
template <class V> struct AdjointMap {
  V color;
  Vec2<V> of_color, of_behind;
  Mat2<V> of_place;
};

template <class P, class Terms, class V, class Cell>
AR_HD void map_placed_sample(const Terms& terms, Vec2<V> z, V raw, MaskOf<V> mask, const Cell& cell, V g_color,
                             V& transmittance, Vec2<V>& place, AdjointMap<V>& map) {
  using T = ScalarOf<V>;
  const V cap = V(T(kAlphaMax)), zero = V(T(0)), alpha = select(mask, min(raw, cap), zero);
  const MoveSlope<V> slope = P::move_in_with_slope(terms, z, alpha, raw <= cap, cell, place);
  // of_difference: the `s` of docs/internals/numerics.md.
  const Vec2<V> of_alpha = {transmittance * slope.alpha.x, transmittance * slope.alpha.y};
  Mat2<V>& m = map.of_place;
  const Vec2<V> of_difference = {madd(m.xx, of_alpha.x, madd(m.xy, of_alpha.y, alpha * map.of_behind.x)),
                                 madd(m.yx, of_alpha.x, madd(m.yy, of_alpha.y, alpha * map.of_behind.y))};
  map.of_color = {madd(g_color, of_difference.x, map.of_color.x), madd(g_color, of_difference.y, map.of_color.y)};
  map.of_behind = {map.of_behind.x - of_difference.x, map.of_behind.y - of_difference.y};
  const V contribution = transmittance * alpha;
  map.color = madd(g_color, contribution, map.color);
  transmittance = transmittance - contribution;
  const Sym2<V>& q = slope.step;
  const V xx = madd(m.xx, q.xx, madd(m.xy, q.xy, m.xx)), xy = madd(m.xx, q.xy, madd(m.xy, q.yy, m.xy));
  const V yx = madd(m.yx, q.xx, madd(m.yy, q.xy, m.yx)), yy = madd(m.yx, q.xy, madd(m.yy, q.yy, m.yy));
  m = {select(slope.free_x, xx, zero), select(slope.free_y, xy, zero), select(slope.free_x, yx, zero),
       select(slope.free_y, yy, zero)};
}

/// dL_dmean: the pixel's share of the gradient [1/px].
template <class V, typename T> AR_HD Vec2<V> mean_sums_of(MeanSums sums, Vec2<T> size, Vec2<V> dL_dmean) {
  if (sums == MeanSums::kAbsolute) return {abs(dL_dmean.x), abs(dL_dmean.y)};
  const V x = V(T(0.5) * size.x) * dL_dmean.x, y = V(T(0.5) * size.y) * dL_dmean.y;
  return {sqrt(x * x + y * y), V(T(0))};
}

}  // namespace ar
