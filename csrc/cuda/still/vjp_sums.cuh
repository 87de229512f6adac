// A library for the kernel of blend_vjp of footprints whose samples stay (still/vjp.cuh): the splats of a batch that a
// warp walks, and how their sums over all lanes are made in shared memory.
#pragma once

#include "cuda/still/vjp_pixels.cuh"

namespace ar::cuda {

/// Nine values of each lane for kPairs pairs in shared memory, which are added up over the lanes together. For a pair
/// that takes 17 instructions, where sum_values takes 60. Lanes are added in the order of sum_values, so that the sums
/// are the same to the bit.
struct PairSums {
  static constexpr int kPairs = 8, kValues = 9;
  struct Pair {
    /// The first eight values of every lane, in two groups of four. Two more places keep the groups, and eight[] and
    /// ninth[] together the pairs, apart in such a way that no reads meet in a bank.
    float4 eight[2][34];
    float4 ninth[8];  ///< the ninth value of lanes 0, 4, ... 28, then of lanes 1, 5, ...

    __device__ void put(const float (&values)[kValues]) {
      const int lane = lane_id();
#pragma unroll
      for (int group = 0; group < 2; ++group) {
        const float* v = values + 4 * group;
        eight[group][lane] = {v[0], v[1], v[2], v[3]};
      }
      reinterpret_cast<float*>(ninth)[lane % 4 * 8 + lane / 4] = values[8];
    }
    /// Of the lanes that differ from `lane` in `offset` or in twice it and so on up to 16, added in pairs, those that
    /// are 16 apart first.
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

  /// The sums of pair lane / 4: `four` of a group, that of number lane / 2 % 2, and that of the ninth value.
  __device__ void sum(float (&four)[4], float& ninth) const {
    const int lane = lane_id(), odd = lane / 4 % 2;
    const Pair& pair = pairs[lane / 4];
    const Values<4> half = pair.sum_from<2>(lane / 2 % 2, lane % 2);
#pragma unroll
    for (int v = 0; v < 4; ++v) four[v] = half.v[v] + __shfl_xor_sync(kAllLanes, half.v[v], 1);
    // The four numbers of lanes below 16 and the four of the others, in either order.
    const float4 a = pair.ninth[lane % 4 * 2 + odd], b = pair.ninth[lane % 4 * 2 + 1 - odd];
    ninth = ((a.x + b.x) + (a.z + b.z)) + ((a.y + b.y) + (a.w + b.w));
#pragma unroll
    for (int offset = 2; offset > 0; offset /= 2) ninth += __shfl_xor_sync(kAllLanes, ninth, offset);
  }
};

/// A splat of a batch of 32 that reaches pixels of its tile.
template <class F, int C> struct alignas(16) ListedSplat {
  typename F::template Terms<float> terms;
  Values<C> channels;
  uint32_t reach_and_index;  ///< bits 0 to 7: the subtiles; from bit 27 on: its index in the batch
  int32_t row;               ///< of its sums
};

/// What a warp keeps in shared memory of a batch: its splats, back to front, and their sums.
template <class F, int C> struct VjpBatch {
  struct Nothing {};
  alignas(16) int subtile_last[kSubtiles];  ///< pairs up to the last that was composited into a pixel of each subtile
  ListedSplat<F, C> splats[32];
  std::conditional_t<kHoldsSamples<C>, PairSums, Nothing> pair_sums;
};

}  // namespace ar::cuda
