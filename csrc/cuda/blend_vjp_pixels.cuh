// The pixels of a tile in blend_vjp for up to four channels, and what blending carries through them from splat to splat.
#pragma once

#include "cuda/blend_vjp_layout.cuh"

namespace ar::cuda {

/// kCount pixels in blend_vjp, S samples of each: those of a warp in shared memory, or those that a lane holds.
template <int S, int C, int kCount> struct VjpPixels {
  static constexpr bool kPacked = C == 3;  // the fourth number of g is sample 0's `last`, as bits
  static constexpr int kLasts = kPacked ? S - 1 : S;
  float4 g[kCount];  // gradient with respect to one sample's channels
  int last[kLasts > 0 ? kLasts : 1][kLasts > 0 ? kCount : 1];

  __device__ int last_of(int s, int pixel, const float4& g_pixel) const {
    if (kPacked) return s == 0 ? __float_as_int(g_pixel.w) : last[s > 0 ? s - 1 : 0][pixel];
    return last[kPacked ? 0 : s][pixel];
  }
  __device__ void set(int pixel, const Values<C>& values) {
    g[pixel] = {values.v[0], values.v[1], values.v[2], kPacked ? 0 : values.v[C - 1]};
  }
  __device__ void set_last(int s, int pixel, int value) {
    if (!kPacked) {
      last[kPacked ? 0 : s][pixel] = value;
    } else if (s == 0) {
      g[pixel].w = __int_as_float(value);
    } else {
      last[s > 0 ? s - 1 : 0][pixel] = value;
    }
  }
};

/// What blending carries through them from splat to splat.
template <int S, int kCount> struct VjpSamples {
  struct Sample {
    float transmittance, behind;
  };
  Sample of[S][kCount];
};

/// What of a warp's pixels is in shared memory.
template <class F, int C, Sums kSums> struct SharedPixels {
  static constexpr int kOwn = kVjpSamples<F, kSums>;
  VjpPixels<kOwn, C, kHoldsPixels<F, C> ? 1 : kTilePixels> pixels;
  VjpSamples<kOwn, kHoldsSamples<F, C> ? 1 : kTilePixels> samples;
};

template <int C> __device__ float dot(const Values<C>& a, const Values<C>& b) {
  float sum = a.v[0] * b.v[0];
#pragma unroll
  for (int c = 1; c < C; ++c) sum = sum + a.v[c] * b.v[c];
  return sum;
}

}  // namespace ar::cuda
