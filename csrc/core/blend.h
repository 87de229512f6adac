// Front-to-back compositing of one splat into one sample, and its adjoint (docs/numerics.md, "Blending and its
// adjoint"). The loops over pixels and splats are in cpu/blend.h and cuda/blend*.cuh.
//
// T is the transmittance of a sample: the share of light that the splats so far let through. `raw` is opacity * weight
// of a splat at the sample, before it is capped and thresholded to alpha. V is a scalar or a pack of lanes.
#pragma once

#include <type_traits>

#include "core/constants.h"
#include "core/lanes.h"
#include "core/stages.h"

namespace ar {

// The sign of a sample's transmittance says whether the sample is open, that is, still takes splats. A sample that has
// stopped keeps the value that it stopped at, negated: further splats leave it as it is.

/// Alpha of a splat in a sample: zero below kAlphaMin, and no more than kAlphaMax.
template <class V> AR_HD V effective_alpha(V raw) {
  using T = ScalarOf<V>;
  return select(raw >= V(T(kAlphaMin)), min(raw, V(T(kAlphaMax))), V(T(0)));
}

/// Result of compositing one splat into one sample.
template <class V> struct Blended {
  MaskOf<V> mask;  ///< whether the splat was composited
  V contribution;  ///< T alpha; zero where it was not
  V if_shown;      ///< T alpha where it was; to be read only there
};

/// T <- T (1 - alpha). A splat that would take T below kTransmittanceMin is not composited and stops the sample, as in
/// 3DGS.
template <class V> AR_HD Blended<V> blend_sample(V raw, V& transmittance) {
  using T = ScalarOf<V>;
  const V zero = V(T(0));
  const MaskOf<V> hit = raw >= V(T(kAlphaMin));
  // The same bits in two ways. A thread of a device is quicker where alpha need not be zero without a hit, packs of
  // lanes where the transmittance is selected once.
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

/// What a sample carries from splat to splat besides its transmittance: nothing, unless the footprint's samples move
/// (kMoves of contract.h). Callers set it to zero in front of the first splat; a member initialiser is not possible for
/// packs of lanes.
template <class V, bool kMoves> struct SampleState {};
template <class V> struct SampleState<V, true> {
  Vec2<V> moved;  ///< displacement from the sample's node [px]
};

/// Composites one splat into sample s of the pixel at p, for any footprint; P is what it is blended as (PixelsOf).
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

/// The same for a P whose samples move, in the form in which both devices blend: `place` is where the sample's node is,
/// which stays within `cell`, Bounds or UnitCell; z are its whitened coordinates; `raw` is opacity * weight there.
template <class P, class Terms, class V, class Cell>
AR_HD Blended<V> blend_placed_sample(const Terms& terms, Vec2<V> z, V raw, const Cell& cell, V& transmittance,
                                     Vec2<V>& place) {
  using T = ScalarOf<V>;
  const V alpha = min(raw, V(T(kAlphaMax)));
  const Blended<V> blended = blend_sample(raw, transmittance);
  place = P::move_in(terms, z, alpha, blended.mask, place, cell);
  return blended;
}

/// Repeats blend_placed_sample in the backward pass, which needs the state in front of every splat. `before`: the splat
/// is the last one that the forward pass composited into the sample, or in front of it, so that nothing has to be
/// compared with kTransmittanceMin again. Returns whether the splat was composited.
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

/// Adjoint of compositing one splat into one sample.
template <class V> struct BlendGrad {
  V contribution;         ///< T alpha, zero outside the mask: dL/dcolor is this times the pixel's gradient
  AlphaGrad<V> of_alpha;  ///< zero outside the mask and where alpha is capped
};

/// Adjoint of blend_sample, called from the last splat to the first.
///
/// `mask` says which samples the forward pass composited this splat into. `g_color` is the scalar product of the
/// pixel's gradient and the colour of the splat, and `behind` (B of docs/numerics.md) that of the pixel's gradient and
/// the colour of everything behind the splat, background included, as seen through this splat alone. `transmittance`
/// and `behind` are read as they are behind the splat and left as they are in front of it. This recursion from the back
/// never forms the difference of the total and a prefix, which cancels in deep stacks.
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

/// What compositing one splat into samples that move adds to the sums of the splat.
template <class V> struct MovingBlendGrad {
  V contribution;  ///< as in BlendGrad
  MoveGrad<V> of_splat;
};
/// Sums that nothing has been added to: -0, since the compiler knows that -0 + x is x.
template <class V> AR_HD MovingBlendGrad<V> no_moving_blend_grad() {
  const V zero = V(ScalarOf<V>(-0.0));
  return {zero, {zero, {{zero, zero}, {zero, zero, zero}}}};
}

/// Adjoint of blend_placed_sample, added to `sums`. `raw` is zero where the splat was not composited; `place` is that
/// in front of the splat. `transmittance`, `behind` and dL_dplace, in the unit kMoveGradUnit of P, are read as they are
/// behind the splat and left as they are in front of it.
template <class P, class Terms, class V, class Cell>
AR_HD void add_placed_sample_vjp(const Terms& terms, Vec2<V> z, V raw, const Cell& cell, V g_color, Vec2<V> place,
                                 V& transmittance, V& behind, Vec2<V>& dL_dplace, MovingBlendGrad<V>& sums) {
  using T = ScalarOf<V>;
  const V cap = V(T(kAlphaMax)), alpha = min(raw, cap);
  const V contribution = transmittance * odds(alpha);  // T behind the splat is 1 - alpha times that in front
  transmittance = transmittance + contribution;
  const V difference = g_color - behind;
  behind = madd(alpha, difference, behind);
  sums.contribution = sums.contribution + contribution;
  P::add_alpha_and_move_in_vjp(terms, z, alpha, raw <= cap, contribution * difference, place, cell, dL_dplace,
                               sums.of_splat);
}

/// How `behind` and dL_dplace of add_placed_sample_vjp go through a part of a list. In front of it
///   behind = (color + (transmittance behind it) * (behind it)) / (transmittance in front of it),
///   dL_dplace = of_color + of_behind * (behind it) + of_place (dL_dplace behind it).
template <class V> struct AdjointMap {
  V color;
  Vec2<V> of_color, of_behind;
  Mat2<V> of_place;
};

/// Composites one more splat at the end of the part, as replay_placed_sample does. `mask`: the forward pass has
/// composited it.
template <class P, class Terms, class V, class Cell>
AR_HD void map_placed_sample(const Terms& terms, Vec2<V> z, V raw, MaskOf<V> mask, const Cell& cell, V g_color,
                             V& transmittance, Vec2<V>& place, AdjointMap<V>& map) {
  using T = ScalarOf<V>;
  const V cap = V(T(kAlphaMax)), zero = V(T(0)), alpha = select(mask, min(raw, cap), zero);
  const MoveSlope<V> slope = P::move_in_with_slope(terms, z, alpha, raw <= cap, cell, place);
  // Behind this splat are B and l. What the map gets is B + alpha (g - B) and J^T l + T (g - B) dalpha.
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

/// What a pixel adds to the sums that density control asks for with `sums`, which is not kNone. `size`: of the image
/// [px]; dL_dmean: the pixel's part of the gradient with respect to the splat's mean [1/px].
template <class V, typename T> AR_HD Vec2<V> mean_sums_of(MeanSums sums, Vec2<T> size, Vec2<V> dL_dmean) {
  if (sums == MeanSums::kAbsolute) return {abs(dL_dmean.x), abs(dL_dmean.y)};
  const V x = V(T(0.5) * size.x) * dL_dmean.x, y = V(T(0.5) * size.y) * dL_dmean.y;
  return {sqrt(x * x + y * y), V(T(0))};
}

}  // namespace ar
