// Statistics of a pixel: how much it shows of every splat, the splat it shows most of, and its median splat.
// cpu/inspect.h and cuda/inspect.cuh write or add them to the arrays of InspectParams.
#pragma once

#include "core/blend.h"
#include "core/vec.h"

namespace ar {

template <typename T> AR_HD int64_t weight_units(T weight) { return int64_t(double(weight) / kWeightUnit + 0.5); }

template <typename T> struct Shown {
  T weight;       ///< mean of T alpha over the samples
  bool in_front;  ///< weight > 0, and more than half of the light is left after the splat
};

template <typename T, class P> struct PixelSummary {
  static constexpr int S = P::kSamples;
  T transmittance[S];
  SampleState<T, P::kMoves> states[S] = {};
  T largest = T(0);
  int32_t dominant = -1;  ///< the splat of the largest weight, the nearest of equals
  int32_t median = -1;    ///< the first splat after which less than half of the light is left

  AR_HD void start(bool inside) {
    for (int s = 0; s < S; ++s) transmittance[s] = inside ? T(1) : T(-1);
  }
  AR_HD bool open() const {
    bool any = false;
    for (int s = 0; s < S; ++s) any |= transmittance[s] > T(0);
    return any;
  }

  AR_HD Shown<T> add(const typename P::template Terms<T>& terms, Vec2<T> p, int32_t id) {
    T weight = T(0), through = T(0);
    AR_UNROLL
    for (int s = 0; s < S; ++s) {
      weight += blend_sample<P>(terms, p, s, transmittance[s], states[s]).contribution;
      through += abs(transmittance[s]);
    }
    weight *= T(1.0 / S);
    if (weight > largest) {
      largest = weight;
      dominant = id;
    }
    if (median < 0 && weight > T(0) && through < T(0.5 * S)) median = id;
    return {weight, weight > T(0) && through > T(0.5 * S)};
  }
};

}  // namespace ar
