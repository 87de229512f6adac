// What all kernels use of a warp.
#pragma once

#include <cstdint>

namespace ar::cuda {

inline constexpr uint32_t kAllLanes = 0xffffffff;

__device__ inline int lane_id() { return threadIdx.x % 32; }

inline unsigned blocks_of(int64_t n, int threads) { return unsigned((n + threads - 1) / threads); }

/// Sum over the lanes, in every lane, in a fixed order.
template <typename T> __device__ T warp_sum(T v) {
#pragma unroll
  for (int offset = 16; offset > 0; offset /= 2) v += __shfl_xor_sync(kAllLanes, v, offset);
  return v;
}

__device__ inline int warp_max(int v) {
#if __CUDA_ARCH__ >= 800
  return __reduce_max_sync(kAllLanes, v);
#else
  for (int offset = 16; offset > 0; offset /= 2) v = max(v, __shfl_xor_sync(kAllLanes, v, offset));
  return v;
#endif
}

/// Sums N values over the lanes with N + 4 shuffles instead of 5 N: lanes trade the halves that the
/// other will sum. Returns the sum of value l / 4 in lanes with l % 4 == 0, for the first 8 values;
/// of value 8 in lanes with l % 4 == 2.
__device__ inline float sum_nine(const float (&v)[9]) {
  const int lane = lane_id();
  float a[8], last = v[8];
#pragma unroll
  for (int i = 0; i < 8; ++i) a[i] = v[i];
#pragma unroll
  for (int half = 4, offset = 16; half > 0; half /= 2, offset /= 2) {
    const bool upper = lane & offset;
#pragma unroll
    for (int i = 0; i < half; ++i) {
      const float keep = upper ? a[i + half] : a[i], give = upper ? a[i] : a[i + half];
      a[i] = keep + __shfl_xor_sync(kAllLanes, give, offset);
    }
    last += __shfl_xor_sync(kAllLanes, last, offset);
  }
  const bool upper = lane & 2;
  const float keep = upper ? last : a[0], give = upper ? a[0] : last;
  const float sum = keep + __shfl_xor_sync(kAllLanes, give, 2);
  return sum + __shfl_xor_sync(kAllLanes, sum, 1);
}

}  // namespace ar::cuda
