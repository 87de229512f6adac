// A library for the kernel of blend_vjp of footprints whose samples stay (still/vjp.cuh): the pixels of a tile, what
// blending carries through them from splat to splat, and whether a lane keeps them in registers or in shared memory.
// A warp has all pixels of a tile, a lane one pixel of each subtile. still/vjp_walk.cuh takes them through the splats.
#pragma once

#include "cuda/tile.cuh"

namespace ar::cuda {

/// Whether each lane keeps the state of all samples of its eight pixels (VjpSample) in registers. Then each subtile has
/// its own code, and shared memory has room to add up the sums of several pairs together (PairSums).
template <int C> inline constexpr bool kHoldsSamples = C == 3;

/// Whether each lane keeps the other numbers of its pixels (VjpPixels) in registers too. A visit of a subtile then
/// neither waits for shared memory nor spends instructions on it, which is worth more than the warps that fit on a
/// multiprocessor less.
template <class F, int C> inline constexpr bool kHoldsPixels = kHoldsSamples<C> && F::kSamples == 1;

/// Whether two subtiles, one below the other, are visited under one branch. Two pixels of a lane then have independent
/// instructions, and there are half as many branches. Not where weights are expensive: more subtiles are visited in
/// vain.
template <class F, int C> inline constexpr bool kTakesTwo = kHoldsPixels<F, C> && !F::kExpensive;

/// Whether each subtile has its own code: where the code is short, or samples are in registers. Otherwise 11 of 58
/// instructions compute where a subtile's pixels are.
template <class F, int C>
inline constexpr bool kUnrollsSubtiles = kHoldsSamples<C> || (F::kSamples == 1 && !F::kExpensive);

/// kCount pixels with S samples and C channels: those of a warp in shared memory, or those of a lane in registers.
template <int S, int C, int kCount> struct VjpPixels {
  static constexpr int kPacked = C == 3 ? 1 : 0;    ///< with 1 the fourth number of g is `last` of sample 0, as bits
  float4 g[kCount];                                 ///< gradient with respect to the channels of one sample
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

/// What blending carries through a sample from splat to splat: `transmittance` and `behind` of blend_sample_vjp.
struct VjpSample {
  float transmittance, behind;
};

/// The part of a warp's pixels that is in shared memory.
template <class F, int C> struct SharedPixels {
  VjpPixels<F::kSamples, C, kHoldsPixels<F, C> ? 1 : kTilePixels> pixels;
  VjpSample samples[F::kSamples][kHoldsSamples<C> ? 1 : kTilePixels];
};

/// A lane's pixels, one of each subtile, and their samples: in registers or in shared memory.
template <class F, int C> class LanePixels {
 public:
  __device__ explicit LanePixels(SharedPixels<F, C>& shared) : shared_(shared) {}

  /// The gradient with respect to the channels of a sample of subtile b's pixel. last_of() needs it, because its fourth
  /// number may be the `last` of a sample.
  __device__ __forceinline__ float4 gradient(int b) { return pixels().g[index(b)]; }
  __device__ __forceinline__ void set_gradient(int b, const Values<C>& g) { pixels().set(index(b), g); }
  /// The number of pairs of the list up to the last splat that was composited into sample s. `g`: gradient(b).
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

/// Calls visit(b, p) for the subtiles b of a set, p being what position_of(b) gives for this lane; `of_first`: what it
/// gives for subtile 0.
template <class F, int C, class Visit>
__device__ __forceinline__ void visit_subtiles(uint32_t subtiles, Vec2<float> of_first, Visit&& visit) {
  if constexpr (kTakesTwo<F, C>) {
#pragma unroll
    for (int q = 0; q < kSubtiles / 2; ++q) {
      const int upper = q % 2 + q / 2 * 4, lower = upper + 2;
      if (!(subtiles & (1u << upper | 1u << lower))) continue;
      visit(upper, position_in<F>(upper, of_first));
      visit(lower, position_in<F>(lower, of_first));
    }
  } else if constexpr (kUnrollsSubtiles<F, C>) {
#pragma unroll
    for (int b = 0; b < kSubtiles; ++b) {
      if (subtiles >> b & 1) visit(b, position_in<F>(b, of_first));
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
