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

/// A pixel's share of `sums`; not for kNone. `size`: of the image [px].
template <class V, typename T> AR_HD Vec2<V> mean_sums_of(MeanSums sums, Vec2<T> size, Vec2<V> dL_dmean) {
  if (sums == MeanSums::kAbsolute) return {abs(dL_dmean.x), abs(dL_dmean.y)};
  const V x = V(T(0.5) * size.x) * dL_dmean.x, y = V(T(0.5) * size.y) * dL_dmean.y;
  return {sqrt(x * x + y * y), V(T(0))};
}

}  // namespace ar
