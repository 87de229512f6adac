// Sums, votes and searches, which all lanes of a warp must call; sums over a block; loads, stores and copies.
#pragma once

#include <cstdint>

#include "core/platform.h"

namespace ar::cuda {

inline constexpr uint32_t kAllLanes = 0xffffffff;

__device__ inline int lane_id() { return threadIdx.x % 32; }

/// In every lane, in a fixed order.
template <typename T> __device__ T warp_sum(T v) {
  AR_UNROLL for (int offset = 16; offset > 0; offset /= 2) v += __shfl_xor_sync(kAllLanes, v, offset);
  return v;
}

/// Sums over a block, in a fixed order, for its first thread. Once in a kernel.
template <int kWarps, int kCount, typename T> __device__ void sum_block(T (&sums)[kCount]) {
  __shared__ T of_warps[kWarps][kCount];
  AR_UNROLL for (int k = 0; k < kCount; ++k) {
    sums[k] = warp_sum(sums[k]);
    if (lane_id() == 0) of_warps[threadIdx.x / 32][k] = sums[k];
  }
  __syncthreads();
  if (threadIdx.x > 0) return;
  for (int w = 1; w < kWarps; ++w) {
    AR_UNROLL for (int k = 0; k < kCount; ++k) sums[k] += of_warps[w][k];
  }
}

template <typename T> __device__ T shuffle(T v, int lane) { return __shfl_sync(kAllLanes, v, lane); }
template <typename T> __device__ T shuffle_up(T v, int offset) { return __shfl_up_sync(kAllLanes, v, offset); }

/// Over this lane and lane_id() ^ offset: the sum of y in the upper lane, of x in the lower.
__device__ inline float sum_of_pair(const float& x, const float& y, bool upper, int offset) {
  const float keep = upper ? y : x, give = upper ? x : y;
  return keep + __shfl_xor_sync(kAllLanes, give, offset);
}

/// Lanes below 16 get the warp_sum of x, the others of y.
__device__ inline float warp_sum_of_two(float x, float y) {
  float sum = sum_of_pair(x, y, lane_id() & 16, 16);
  AR_UNROLL for (int offset = 8; offset > 0; offset /= 2) sum += __shfl_xor_sync(kAllLanes, sum, offset);
  return sum;
}

/// T has shuffle(), shuffle_up() and a +, which need not commute.
template <typename T> __device__ T warp_inclusive_sum(T v) {
  AR_UNROLL for (int offset = 1; offset < 32; offset *= 2) {
    const T before = shuffle_up(v, offset);
    if (lane_id() >= offset) v = before + v;
  }
  return v;
}

/// Over the threads before this one, of a block of kWarps warps or of a warp (1). `all`: over all threads.
template <int kWarps, typename T> __device__ T sum_before(T own, T zero, T& all) {
  const T up_to = warp_inclusive_sum(own);
  T before = shuffle_up(up_to, 1);
  if (lane_id() == 0) before = zero;
  if constexpr (kWarps == 1) {
    all = shuffle(up_to, 31);
    return before;
  } else {
    __shared__ T warps[kWarps];
    const int warp = threadIdx.x / 32;
    __syncthreads();  // an earlier call may still read
    if (lane_id() == 31) warps[warp] = up_to;
    __syncthreads();
    T front = zero;
    all = zero;
    AR_UNROLL for (int w = 0; w < kWarps; ++w) {
      if (w == warp) front = all;
      all = all + warps[w];
    }
    return front + before;
  }
}

__device__ inline int warp_max(int v) {
#if __CUDA_ARCH__ >= 800
  return __reduce_max_sync(kAllLanes, v);
#else
  for (int offset = 16; offset > 0; offset /= 2) v = max(v, __shfl_xor_sync(kAllLanes, v, offset));
  return v;
#endif
}

__device__ inline uint32_t warp_or(uint32_t bits) {
#if __CUDA_ARCH__ >= 800
  return __reduce_or_sync(kAllLanes, bits);
#else
  for (int offset = 16; offset > 0; offset /= 2) bits |= __shfl_xor_sync(kAllLanes, bits, offset);
  return bits;
#endif
}

/// Lanes with the same bit `mask` of `bits`.
__device__ inline uint32_t lanes_that_agree(uint32_t bits, uint32_t mask) {
#if defined(__CUDA_ARCH__)
  uint32_t lanes;
  asm volatile(
      "{\n\t"
      ".reg .pred is_set;\n\t"
      "and.b32 %0, %1, %2;\n\t"
      "setp.ne.u32 is_set, %0, 0;\n\t"
      "vote.sync.ballot.b32 %0, is_set, 0xffffffff;\n\t"
      "@!is_set not.b32 %0, %0;\n\t"
      "}"
      : "=r"(lanes)
      : "r"(bits), "r"(mask));
  return lanes;
#else
  const uint32_t set = __ballot_sync(kAllLanes, (bits & mask) != 0);
  return bits & mask ? set : ~set;
#endif
}
/// Lanes with the same number < 2^kBits.
template <int kBits> __device__ uint32_t lanes_alike(uint32_t number) {
  uint32_t lanes = kAllLanes;
  AR_UNROLL for (int b = 0; b < kBits; ++b) lanes &= lanes_that_agree(number, 1u << b);
  return lanes;
}

/// The first k in [0, n) from which on before(k) is false, per kLanes lanes.
template <int kLanes, class Before> __device__ int partition_point(int n, Before&& before) {
  const int lane = lane_id() % kLanes, group = lane_id() - lane;
  int found = 0;
  for (int left = n; __any_sync(kAllLanes, left > 0);) {
    const int step = left / (kLanes + 1) + 1, ahead = (lane + 1) * step - 1;
    const uint32_t votes = __ballot_sync(kAllLanes, ahead < left && before(found + ahead));
    const int passed = __popc(votes >> group & kAllLanes >> (32 - kLanes)) * step;
    found += passed;
    left = min(step - 1, left - passed);
  }
  return found;
}

/// LaunchShape::shared_bytes.
#if defined(__CUDACC__)
__device__ inline float4* dynamic_shared() {
  extern __shared__ float4 memory[];
  return memory;
}
#else
float4* dynamic_shared();  // in tests on the host
#endif

/// Removes the first number of a set. Number j is bit 31 - j, which is found faster.
__device__ inline int take_first(uint32_t& set) {
  const int first = __clz(int(set));
  set ^= 1u << (31 - first);
  return first;
}

__device__ inline void store_streaming(float4* to, const float4& value) {
#if defined(__CUDA_ARCH__)
  __stcs(to, value);
#else
  *to = value;
#endif
}

__device__ inline void prefetch([[maybe_unused]] const void* address) {
#if defined(__CUDA_ARCH__)
  asm volatile("prefetch.global.L1 [%0];" ::"l"(address));
#endif
}

/// To shared memory, to be read after wait_for_copies(). T: float or float4.
template <class T> __device__ void copy_async(T* to, const T* from) {
#if __CUDA_ARCH__ >= 800
  const auto address = uint32_t(__cvta_generic_to_shared(to));
  if constexpr (sizeof(T) == 16) {
    asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(address), "l"(from) : "memory");
  } else {
    asm volatile("cp.async.ca.shared.global [%0], [%1], 4;" ::"r"(address), "l"(from) : "memory");
  }
#else
  *to = *from;
#endif
}
/// Rows [32, kWidth] of `lanes`.
template <int kWidth> __device__ void copy_rows_async(float* to, const float* from, uint32_t lanes) {
  AR_UNROLL for (int k = 0; k < kWidth; ++k) {
    const int e = 32 * k + lane_id();
    if (lanes >> e / kWidth & 1) copy_async(to + e, from + e);
  }
}
__device__ inline void wait_for_copies() {
#if __CUDA_ARCH__ >= 800
  asm volatile("cp.async.wait_all;" ::: "memory");
#endif
  __syncwarp();
}

/// What was loaded before is loaded again.
__device__ inline void forget_loads() { asm volatile("" ::: "memory"); }

/// With 9 or 12 shuffles instead of 5 N, as lanes exchange halves of their values. Lane l gets the sum of value
/// summed_value<N>(l).
template <int N> __device__ float sum_values(const float (&v)[N]) {
  static_assert(N >= 8 && N <= 10);
  const int lane = lane_id();
  float a[8], last = N > 8 ? v[N > 8 ? 8 : 0] : 0;
  AR_UNROLL for (int i = 0; i < 8; ++i) a[i] = v[i];
  AR_UNROLL for (int half = 4, offset = 16; half > 0; half /= 2, offset /= 2) {
    const bool upper = lane & offset;
    AR_UNROLL for (int i = 0; i < half; ++i) a[i] = sum_of_pair(a[i], a[i + half], upper, offset);
    if (N == 10 && half == 4) {
      last = sum_of_pair(last, v[N - 1], upper, offset);
    } else if (N > 8) {
      last += __shfl_xor_sync(kAllLanes, last, offset);
    }
  }
  const float sum = sum_of_pair(a[0], N > 8 ? last : a[0], lane & 2, 2);
  return sum + __shfl_xor_sync(kAllLanes, sum, 1);
}

template <int N> __device__ int summed_value(int lane) {
  return N > 8 && lane & 2 ? (N > 9 && lane & 16 ? 9 : 8) : lane / 4;
}
template <int N> __device__ bool has_value_first(int lane) {
  return lane % 4 == 0 || (N > 8 && lane == 2) || (N > 9 && lane == 18);
}

}  // namespace ar::cuda
