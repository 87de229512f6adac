// The eigenframe of a covariance, for analytic.h and erf.h, which differentiate it themselves.
#pragma once

#include "core/footprint/contract.h"

namespace ar {

/// Standard deviations along both axes, and (cos, sin) of the major one.
template <typename T> struct Eigenframe {
  Vec2<T> sigma;
  Vec2<T> axis;
};

/// Without 0/0 for diagonal covariances and a difference of eigenvalues (docs/internals/numerics.md, "Eigenframe").
template <typename T> AR_HD Eigenframe<T> eigenframe(Cov2d<T> cov) {
  const T dx = cov.xx - cov.yy, dy = T(2) * cov.xy;
  const T gap = eigenvalue_gap(cov);
  const T major = T(0.5) * (cov.xx + cov.yy + gap);
  Vec2<T> axis = {T(1), T(0)};
  if (dx > T(0)) {
    axis.x = sqrt(T(0.5) * (T(1) + dx / gap));
    axis.y = dy / (T(2) * gap * axis.x);
  } else if (gap > T(0)) {
    const T sine = sqrt(T(0.5) * (T(1) - dx / gap));
    axis = {abs(dy) / (T(2) * gap * sine), dy < T(0) ? -sine : sine};
  }
  return {{sqrt(major), sqrt(max(cov.det / major, T(0)))}, axis};
}

/// Rows: the axes, the major one first, times `scale`.
template <typename T> AR_HD Mat2<T> scaled_axes(Vec2<T> scale, Vec2<T> axis) {
  return {scale.x * axis.x, scale.x * axis.y, -scale.y * axis.y, scale.y * axis.x};
}

/// 1 / sqrt(sigma^2 + 1/12) from 1 / sigma, along both axes.
template <typename T> AR_HD Vec2<T> widened_by_pixel(Vec2<T> inv_sigma) {
  const auto widened = [](T r) { return r / sqrt(T(1) + T(kPixelVariance) * r * r); };
  return {widened(inv_sigma.x), widened(inv_sigma.y)};
}

}  // namespace ar
