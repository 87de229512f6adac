// The pixels of a tile in blend_vjp for up to four channels, and what blending carries through them from splat to
// splat.
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

/// What blending carries through a sample from splat to splat: `transmittance` and `behind` of blend_sample_vjp.
struct VjpSample {
  float transmittance, behind;
};
/// Those of kCount pixels.
template <int S, int kCount> struct VjpSamples {
  VjpSample of[S][kCount];
};

/// What of a warp's pixels is in shared memory.
template <class F, int C, Sums kSums> struct SharedPixels {
  static constexpr int kOwn = kVjpSamples<F, kSums>;
  VjpPixels<kOwn, C, kHoldsPixels<F, C> ? 1 : kTilePixels> pixels;
  VjpSamples<kOwn, kHoldsSamples<F, C> ? 1 : kTilePixels> samples;
};

/// A lane's pixels, one of each subtile, and their samples: in registers, or the lane's own in shared memory.
template <class F, int C, Sums kSums> class LanePixels {
 public:
  static constexpr bool kHolds = kHoldsPixels<F, C>, kHoldsState = kHoldsSamples<F, C>;
  static constexpr int kOwn = kVjpSamples<F, kSums>;
  using Shared = SharedPixels<F, C, kSums>;

  __device__ explicit LanePixels(Shared& shared) : shared_(shared) {}

  /// The gradient with respect to the channels of a sample of subtile b's pixel. last_of() takes it too, as its fourth
  /// number may be the `last` of a sample.
  __device__ __forceinline__ float4 gradient(int b) { return pixels().g[place(b)]; }
  __device__ __forceinline__ void set_gradient(int b, const Values<C>& g) { pixels().set(place(b), g); }
  /// The place behind the last splat that was composited into sample s. `g`: gradient(b).
  __device__ __forceinline__ int last_of(int s, int b, const float4& g) { return pixels().last_of(s, place(b), g); }
  __device__ __forceinline__ void set_last(int s, int b, int last) { pixels().set_last(s, place(b), last); }
  __device__ __forceinline__ VjpSample& sample(int s, int b) {
    return samples().of[s][kHoldsState ? b : b * 32 + lane_];
  }

 private:
  __device__ __forceinline__ int place(int b) const { return kHolds ? b : b * 32 + lane_; }
  __device__ __forceinline__ auto& pixels() {
    if constexpr (kHolds) {
      return pixels_;
    } else {
      return shared_.pixels;
    }
  }
  __device__ __forceinline__ auto& samples() {
    if constexpr (kHoldsState) {
      return samples_;
    } else {
      return shared_.samples;
    }
  }

  const int lane_ = lane_id();
  Shared& shared_;
  std::conditional_t<kHolds, VjpPixels<kOwn, C, kSubtiles>, int> pixels_;
  std::conditional_t<kHoldsState, VjpSamples<kOwn, kSubtiles>, int> samples_;
};

/// Calls visit(b, p) for the subtiles b of a set, p being what place_of(b) gives for this lane; `of_first`: what it
/// gives for subtile 0.
template <class F, int C, class Visit>
__device__ __forceinline__ void visit_subtiles(uint32_t subtiles, Vec2<float> of_first, Visit&& visit) {
  if constexpr (kTakesTwo<F, C>) {
#pragma unroll
    for (int q = 0; q < kSubtiles / 2; ++q) {
      const int upper = q % 2 + q / 2 * 4, lower = upper + 2;
      if (!(subtiles & (1u << upper | 1u << lower))) continue;
      visit(upper, place_in<F>(upper, of_first));
      visit(lower, place_in<F>(lower, of_first));
    }
  } else if constexpr (kUnrollsSubtiles<F, C>) {
#pragma unroll
    for (int b = 0; b < kSubtiles; ++b) {
      if (subtiles >> b & 1) visit(b, place_in<F>(b, of_first));
    }
  } else {
    constexpr int kTwo23 = 0x4b000000;
    for (uint32_t left = subtiles; left != 0; left &= left - 1) {
      const int b = __ffs(left) - 1;
      // place_in(b, of_first); an integer below 2^23 set into the mantissa of 2^23 is that float, plus 2^23
      const float column = __int_as_float(kTwo23 | (b & 1)) - 8388608.0f;
      const float band = __int_as_float(kTwo23 | (b >> 1)) - 8388608.0f;
      visit(b, Vec2<float>{madd(float(kSubtileWide<F>), column, of_first.x),
                           madd(float(kSubtileHigh<F>), band, of_first.y)});
    }
  }
}

template <int C> __device__ float dot(const Values<C>& a, const Values<C>& b) {
  float sum = a.v[0] * b.v[0];
#pragma unroll
  for (int c = 1; c < C; ++c) sum = sum + a.v[c] * b.v[c];
  return sum;
}

}  // namespace ar::cuda
