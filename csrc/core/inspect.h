// Of a pixel: how much it shows of every splat, which it shows most, and its median splat.
#pragma once

#include "core/blend.h"
#include "core/vec.h"

namespace ar {

template <typename T> AR_HD int64_t weight_units(T weight) { return int64_t(double(weight) / kWeightUnit + 0.5); }

template <typename T> struct Shown {
  T weight;       ///< mean of T alpha over the samples
  bool in_front;  ///< weight > 0, and more than half of the light is left after the splat
};

/// Without statistics a pixel is closed as soon as nothing behind can change the answer.
enum class Look {
  kMedian,      ///< `median` alone
  kImages,      ///< and `dominant`
  kStatistics,  ///< and what add() returns
};

template <typename T, class P, Look kLook = Look::kStatistics> struct PixelSummary {
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
    if constexpr (kLook == Look::kStatistics) {
      return any;
    } else if constexpr (kLook == Look::kMedian) {
      return any && median < 0;
    } else {  // A weight is at most the light that is left, also when both are rounded.
      return any && (median < 0 || mean_through() > largest);
    }
  }

  AR_HD Shown<T> add(const typename P::template Terms<T>& terms, Vec2<T> p, int32_t id) {
    T weight = T(0);
    AR_UNROLL for (int s = 0; s < S; ++s) weight +=
        blend_sample<P>(terms, p, s, transmittance[s], states[s]).contribution;
    weight *= T(1.0 / S);
    if constexpr (kLook != Look::kMedian) {
      if (weight > largest) {
        largest = weight;
        dominant = id;
      }
    }
    const T through = mean_through();
    if (median < 0 && weight > T(0) && through < T(0.5)) median = id;
    return {weight, weight > T(0) && through > T(0.5)};
  }

 private:
  AR_HD T mean_through() const {
    T through = T(0);
    AR_UNROLL for (int s = 0; s < S; ++s) through += abs(transmittance[s]);
    return through * T(1.0 / S);
  }
};

}  // namespace ar
