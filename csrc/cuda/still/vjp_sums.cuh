// A warp's list of splats in blend_vjp, and PairSums, which adds eight pairs over lanes.
#pragma once

#include "cuda/still/vjp_pixels.cuh"

namespace ar::cuda {

/// Nine values of kPairs pairs together: 17 instructions per pair, where sum_values takes 60. Both add in the same
/// order.
struct PairSums {
  static constexpr int kPairs = 8, kValues = 9;
  struct Pair {
    float4 eight[2][34];  ///< first eight values of each lane; with two more entries no reads meet in a bank
    float4 ninth[8];      ///< ninth values of lanes 0, 4, ... 28, then of 1, 5, ...

    __device__ void put(const float (&values)[kValues]) {
      const int lane = lane_id();
      AR_UNROLL for (int group = 0; group < 2; ++group) {
        const float* v = values + 4 * group;
        eight[group][lane] = {v[0], v[1], v[2], v[3]};
      }
      reinterpret_cast<float*>(ninth)[lane % 4 * 8 + lane / 4] = values[8];
    }
    /// The sum over lanes lane + k offset < 32, in pairs: lanes that are 16 apart first.
    template <int offset> __device__ Values<4> sum_from(int group, int lane) const {
      if constexpr (offset == 32) {
        const float4 v = eight[group][lane];
        return {v.x, v.y, v.z, v.w};
      } else {
        Values<4> sum = sum_from<2 * offset>(group, lane);
        sum += sum_from<2 * offset>(group, lane + offset);
        return sum;
      }
    }
  };
  Pair pairs[kPairs];

  /// Sums of pair lane / 4: the four values of group lane / 2 % 2, and the ninth value.
  __device__ void sum(float (&four)[4], float& ninth) const {
    const int lane = lane_id(), odd = lane / 4 % 2;
    const Pair& pair = pairs[lane / 4];
    const Values<4> half = pair.sum_from<2>(lane / 2 % 2, lane % 2);
    AR_UNROLL for (int v = 0; v < 4; ++v) four[v] = half.v[v] + __shfl_xor_sync(kAllLanes, half.v[v], 1);
    // Of lanes below 16 and of the others, in either order.
    const float4 a = pair.ninth[lane % 4 * 2 + odd], b = pair.ninth[lane % 4 * 2 + 1 - odd];
    ninth = ((a.x + b.x) + (a.z + b.z)) + ((a.y + b.y) + (a.w + b.w));
    AR_UNROLL for (int offset = 2; offset > 0; offset /= 2) ninth += __shfl_xor_sync(kAllLanes, ninth, offset);
  }
};

template <class F, int C> struct alignas(16) ListedSplat {
  typename F::template Terms<float> terms;
  Values<C> channels;
  uint32_t reach_and_index;  ///< bits 0 to 7: subtiles; from bit 27 on: index in the batch
  int32_t row;               ///< of pair_grads
};

/// The batch of a warp in shared memory.
template <class F, int C> struct VjpBatch {
  struct Nothing {};
  alignas(16) int subtile_last[kSubtiles];  ///< pairs up to the last that a pixel of the subtile composited
  ListedSplat<F, C> splats[32];             ///< back to front
  std::conditional_t<kHoldsSamples<C>, PairSums, Nothing> pair_sums;
};

}  // namespace ar::cuda
