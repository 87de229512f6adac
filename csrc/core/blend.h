// Front-to-back compositing of one splat into one sample, and back.
#pragma once

#include "core/constants.h"
#include "core/lanes.h"
#include "core/stages.h"

namespace ar {

// A sample's transmittance is positive while the sample is open. A sample that has stopped keeps the
// value it stopped at, negated: it then fails every test for being open, and loses nothing.

/// Alpha of a splat in a sample: none below the minimum, no more than the cap. `raw` = opacity * weight.
template <class V> AR_HD V effective_alpha(V raw) {
  using T = ScalarOf<V>;
  return select(raw >= V(T(kAlphaMin)), min(raw, V(T(kAlphaMax))), V(T(0)));
}

/// Result of compositing one splat into one sample.
template <class V> struct Blended {
  MaskOf<V> mask;  ///< the splat was composited
  V contribution;  ///< T alpha, zero outside mask
};

/// T <- T (1 - alpha); `raw` is alpha before the cap. A splat that would take T below the minimum is
/// not composited and stops the sample, as in 3DGS.
template <class V> AR_HD Blended<V> blend_sample(V raw, V& transmittance) {
  using T = ScalarOf<V>;
  const V zero = V(T(0));
  const MaskOf<V> hit = raw >= V(T(kAlphaMin));
  const V contribution = transmittance * effective_alpha(raw);
  const V next = transmittance - contribution;
  const MaskOf<V> open = next >= V(T(kTransmittanceMin));
  transmittance = select(open, next, -abs(transmittance));
  return {MaskOf<V>(hit & open), select(open, contribution, zero)};
}

/// What a sample carries from splat to splat besides its transmittance: nothing, unless it moves. Zero in front of the
/// first one. (Without an initialiser, which a pack of lanes could not have: its constructor is the compiler's own.)
template <class V, bool kMoves> struct SampleState {};
template <class V> struct SampleState<V, true> {
  Vec2<V> moved;
};

/// Composites one splat into sample s of the pixel at p.
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

/// Composites one splat into a sample of a P that moves: `place` is its node's, which stays within `bounds`, z its
/// whitened coordinates, and `raw` opacity * I there.
template <class P, class Terms, class V>
AR_HD Blended<V> blend_placed_sample(const Terms& terms, Vec2<V> z, V raw, const Bounds<V>& bounds, V& transmittance,
                                     Vec2<V>& place) {
  using T = ScalarOf<V>;
  const Blended<V> blended = blend_sample(raw, transmittance);
  const V alpha = select(blended.mask, min(raw, V(T(kAlphaMax))), V(T(0)));
  place = P::move_in(terms, z, alpha, place, bounds);
  return blended;
}

/// The same once more, where it is known whether the forward pass composited the splat if the sample's node was near
/// enough: `before`, it is not behind the last one of the sample. Returns whether it was.
template <class P, class Terms, class V>
AR_HD MaskOf<V> replay_placed_sample(const Terms& terms, Vec2<V> z, V raw, MaskOf<V> before, const Bounds<V>& bounds,
                                     V& transmittance, Vec2<V>& place) {
  using T = ScalarOf<V>;
  const MaskOf<V> mask = (raw >= V(T(kAlphaMin))) & before;
  const V alpha = select(mask, min(raw, V(T(kAlphaMax))), V(T(0)));
  transmittance = transmittance - transmittance * alpha;
  place = P::move_in(terms, z, alpha, place, bounds);
  return mask;
}

/// Adjoint of one step, walked from the last splat to the first.
template <class V> struct BlendGrad {
  V contribution;  ///< T alpha, zero outside the mask: dL/dcolor is this times the pixel's gradient
  V dL_dalpha;     ///< zero outside the mask and where alpha is capped
};

/// `mask` says which samples the forward pass composited this splat into. On entry `transmittance`
/// is the value behind the splat, on exit the value in front of it. `behind` is the gradient-weighted
/// colour of everything behind the splat as seen through it alone, dL_dpixel . (colour of the rest,
/// background included); `g_color` = dL_dpixel . colour of the splat. This recursion from the back
/// never forms the difference of total and prefix, which cancels in deep stacks.
template <class V> AR_HD BlendGrad<V> blend_sample_vjp(MaskOf<V> mask, V raw, V g_color, V& transmittance, V& behind) {
  using T = ScalarOf<V>;
  const V zero = V(T(0)), cap = V(T(kAlphaMax));
  const V alpha = select(mask, min(raw, cap), zero);
  transmittance = divide(transmittance, V(T(1)) - alpha);
  const V difference = g_color - behind;
  behind = madd(alpha, difference, behind);
  const MaskOf<V> free = mask & (raw <= cap);
  return {transmittance * alpha, select(free, transmittance * difference, zero)};
}

/// Adjoint of one step of a sample that moves.
template <class V> struct MovingBlendGrad {
  V contribution;  ///< as in BlendGrad
  MoveGrad<V> of_splat;
};

/// Adjoint of blend_placed_sample. `raw` is zero where the splat was not composited, `place` that in front of the
/// splat. `transmittance`, `behind` and `dL_dplace` go from behind the splat to in front of it.
template <class P, class Terms, class V>
AR_HD MovingBlendGrad<V> blend_placed_sample_vjp(const Terms& terms, Vec2<V> z, V raw, const Bounds<V>& bounds,
                                                 V g_color, Vec2<V> place, V& transmittance, V& behind,
                                                 Vec2<V>& dL_dplace) {
  using T = ScalarOf<V>;
  const V cap = V(T(kAlphaMax)), alpha = min(raw, cap);
  const MaskOf<V> free = (raw > V(T(0))) & (raw <= cap);
  transmittance = madd(transmittance, odds(alpha), transmittance);  // 1 / (1 - alpha) = 1 + odds
  const V difference = g_color - behind;
  behind = madd(alpha, difference, behind);
  return {transmittance * alpha,
          P::alpha_and_move_in_vjp(terms, z, raw, alpha, free, transmittance * difference, place, bounds, dL_dplace)};
}

/// A pixel's share of `sums`; not for kNone. `size`: of the image [px].
template <class V, typename T> AR_HD Vec2<V> mean_sums_of(MeanSums sums, Vec2<T> size, Vec2<V> dL_dmean) {
  if (sums == MeanSums::kAbsolute) return {abs(dL_dmean.x), abs(dL_dmean.y)};
  const V x = V(T(0.5) * size.x) * dL_dmean.x, y = V(T(0.5) * size.y) * dL_dmean.y;
  return {sqrt(x * x + y * y), V(T(0))};
}

}  // namespace ar
