// A tile's pixels in a warp of blend_vjp, one of each subtile per lane, in registers or shared memory.
#pragma once

#include "cuda/tile/pixels.cuh"

namespace ar::cuda {

/// Whether samples (VjpSample) are in registers. Then shared memory has room for PairSums.
template <int C> inline constexpr bool kHoldsSamples = C == 3;

/// Whether the other numbers of pixels (VjpPixels) are too: worth more than the warps that do not fit then.
template <class F, int C> inline constexpr bool kHoldsPixels = kHoldsSamples<C> && F::kSamples == 1;

/// Whether two subtiles, one below the other, share a branch: independent instructions, against visits in vain.
template <class F, int C> inline constexpr bool kTakesTwo = kHoldsPixels<F, C> && !F::kExpensive;

/// Whether each subtile has its own code, without address computations.
template <class F, int C>
inline constexpr bool kUnrollsSubtiles = kHoldsSamples<C> || (F::kSamples == 1 && !F::kExpensive);

/// Gradients and `last` of kCount pixels with S samples and C channels.
template <int S, int C, int kCount> struct VjpPixels {
  static constexpr int kPacked = C == 3 ? 1 : 0;    ///< 1: g.w is `last` of sample 0, as bits
  float4 g[kCount];                                 ///< gradient of one sample's channels
  int last[S > kPacked ? S - kPacked : 1][kCount];  ///< of the other samples

  __device__ int last_of(int s, int pixel, const float4& g_pixel) const {
    return s < kPacked ? __float_as_int(g_pixel.w) : last[s - kPacked][pixel];
  }
  __device__ void set(int pixel, const Values<C>& values) {
    g[pixel] = {values.v[0], values.v[1], values.v[2], C == 3 ? 0 : values.v[C - 1]};
  }
  __device__ void set_last(int s, int pixel, int value) {
    if (s < kPacked) {
      g[pixel].w = __int_as_float(value);
    } else {
      last[s - kPacked][pixel] = value;
    }
  }
};

/// The state of a sample between splats, as in blend_sample_vjp.
struct VjpSample {
  float transmittance, behind;
};

template <class F, int C> struct SharedPixels {
  VjpPixels<F::kSamples, C, kHoldsPixels<F, C> ? 1 : kTilePixels> pixels;
  VjpSample samples[F::kSamples][kHoldsSamples<C> ? 1 : kTilePixels];
};

/// b: the subtile.
template <class F, int C> class LanePixels {
 public:
  __device__ explicit LanePixels(SharedPixels<F, C>& shared) : shared_(shared) {}

  __device__ __forceinline__ float4 gradient(int b) { return pixels().g[index(b)]; }
  __device__ __forceinline__ void set_gradient(int b, const Values<C>& g) { pixels().set(index(b), g); }
  /// Pairs of the list up to the last splat of sample s. `g`: gradient(b).
  __device__ __forceinline__ int last_of(int s, int b, const float4& g) { return pixels().last_of(s, index(b), g); }
  __device__ __forceinline__ void set_last(int s, int b, int last) { pixels().set_last(s, index(b), last); }
  __device__ __forceinline__ VjpSample& sample(int s, int b) {
    return kHoldsSamples<C> ? samples_[s][b] : shared_.samples[s][b * 32 + lane_];
  }

 private:
  __device__ __forceinline__ int index(int b) const { return kHoldsPixels<F, C> ? b : b * 32 + lane_; }
  __device__ __forceinline__ auto& pixels() {
    if constexpr (kHoldsPixels<F, C>) {
      return pixels_;
    } else {
      return shared_.pixels;
    }
  }

  const int lane_ = lane_id();
  SharedPixels<F, C>& shared_;
  VjpPixels<F::kSamples, C, kSubtiles> pixels_;  ///< if kHoldsPixels
  VjpSample samples_[F::kSamples][kSubtiles];    ///< if kHoldsSamples
};

/// The k-th subtile that lanes visit: one order for all C, so that sums have the same bits.
template <class F> constexpr int visited_subtile(int k) {
  return F::kSamples == 1 && !F::kExpensive ? (k & 4) | (k & 1) << 1 | (k >> 1 & 1) : k;
}

/// visit(b, position_in(b, of_first)) for the subtiles b of a set.
template <class F, int C, class Visit>
__device__ __forceinline__ void visit_subtiles(uint32_t subtiles, Vec2<float> of_first, Visit&& visit) {
  if constexpr (kTakesTwo<F, C>) {
    AR_UNROLL for (int q = 0; q < kSubtiles / 2; ++q) {
      const int upper = visited_subtile<F>(2 * q), lower = visited_subtile<F>(2 * q + 1);
      if (!(subtiles & (1u << upper | 1u << lower))) continue;
      visit(upper, position_in<F>(upper, of_first));
      visit(lower, position_in<F>(lower, of_first));
    }
  } else if constexpr (kUnrollsSubtiles<F, C>) {
    AR_UNROLL for (int k = 0; k < kSubtiles; ++k) {
      const int b = visited_subtile<F>(k);
      if (subtiles >> b & 1) visit(b, position_in<F>(b, of_first));
    }
  } else {
    constexpr int kTwo23 = 0x4b000000;
    for (uint32_t left = subtiles; left != 0; left &= left - 1) {
      const int b = __ffs(left) - 1;
      // position_in(b, of_first) without conversions: the bits of 2^23 with b in the mantissa are the float 2^23 + b
      const float column = __int_as_float(kTwo23 | (b & 1)) - 8388608.0f;
      const float band = __int_as_float(kTwo23 | (b >> 1)) - 8388608.0f;
      visit(b, Vec2<float>{madd(float(kSubtileWide<F>), column, of_first.x),
                           madd(float(kSubtileHigh<F>), band, of_first.y)});
    }
  }
}

template <int C> __device__ float dot(const Values<C>& a, const Values<C>& b) {
  float sum = a.v[0] * b.v[0];
  AR_UNROLL for (int c = 1; c < C; ++c) sum = sum + a.v[c] * b.v[c];
  return sum;
}

}  // namespace ar::cuda
