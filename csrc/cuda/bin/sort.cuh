// A pass of a stable radix sort of a number of items that only the device knows: "Onesweep" [Adinets and Merrill 2022],
// where a block adds up what earlier ones have published.
#pragma once

#include "cuda/bin/policy.h"
#include "cuda/launch.cuh"
#include "cuda/occupancy.h"
#include "cuda/warp.cuh"

namespace ar::cuda {

template <int kBits> struct Digits : SortPolicy<kBits> {
  using SortPolicy<kBits>::kThreads;
  static constexpr int kBins = 1 << kBits, kWarps = kThreads / 32;
  static constexpr int kTile = kThreads * SortPolicy<kBits>::kItems;  ///< items of a block
  static_assert(kThreads >= kBins && kTile < 1 << 16);

  __device__ static uint32_t of(uint32_t key, int pass) { return key >> (pass * kBits) & (kBins - 1); }
};

/// The key of no item.
inline constexpr uint32_t kNoKey = 0xffffffff;

// A count, and whether it includes all earlier blocks. Zero: not yet.
inline constexpr uint32_t kOfBlock = 1u << 30, kUpToBlock = 2u << 30, kCountMask = kOfBlock - 1;
inline constexpr int64_t kMaxSortItems = kCountMask;

__device__ inline uint32_t read_status(const uint32_t* status) {
#if defined(__CUDA_ARCH__)
  uint32_t value;
  asm volatile("ld.relaxed.gpu.global.u32 %0, [%1];" : "=r"(value) : "l"(status) : "memory");
  return value;
#else
  return *status;
#endif
}
__device__ inline void write_status(uint32_t* status, uint32_t value) {
#if defined(__CUDA_ARCH__)
  asm volatile("st.relaxed.gpu.global.u32 [%0], %1;" ::"l"(status), "r"(value) : "memory");
#else
  *status = value;
#endif
}

/// Zero before use.
template <int kBits> struct SortScratch {
  static constexpr int kBins = Digits<kBits>::kBins;
  int passes;
  uint32_t* histograms;  ///< [passes, kBins]
  uint32_t* tickets;     ///< [passes] blocks that have begun
  uint32_t* status;      ///< [passes, blocks, kBins]
  int64_t blocks;

  static int64_t blocks_of(int64_t capacity) { return (capacity + Digits<kBits>::kTile - 1) / Digits<kBits>::kTile; }
  static int64_t words(int64_t capacity, int passes) { return passes * (kBins * (1 + blocks_of(capacity)) + 1); }
  SortScratch(uint32_t* memory, int64_t capacity, int passes)
      : passes(passes),
        histograms(memory),
        tickets(memory + passes * kBins),
        status(memory + passes * (kBins + 1)),
        blocks(blocks_of(capacity)) {}
};

/// histograms: [kPasses, kBins]. All lanes must call it.
template <int kBits, int kPasses> __device__ void count_digits(uint32_t key, bool valid, uint32_t* histograms) {
  constexpr int kBins = Digits<kBits>::kBins;
  if (!__any_sync(kAllLanes, valid)) return;
  AR_UNROLL for (int pass = 0; pass < kPasses; ++pass) {
    const uint32_t digit = Digits<kBits>::of(key, pass);
    // Neighbours often agree; atomics to one address are slow.
    int agree = 0;
    __match_all_sync(kAllLanes, valid ? digit : kBins, &agree);
    if (agree) {
      if (lane_id() == 0) atomicAdd(&histograms[pass * kBins + digit], 32);
    } else if (valid) {
      atomicAdd(&histograms[pass * kBins + digit], 1);
    }
  }
}

/// `status`: of this block; that of the block before is `width` words before.
__device__ inline uint32_t sum_of_earlier(const uint32_t* status, int64_t block, int width) {
  if (block == 0) return 0;
  uint32_t sum = 0;
  for (int64_t back = 1;;) {
    uint32_t words[BinPolicy::kLookBackAtOnce];
    AR_UNROLL for (int k = 0; k < BinPolicy::kLookBackAtOnce; ++k) words[k] =
        read_status(status - min(back + k, block) * width);
    AR_UNROLL for (int k = 0; k < BinPolicy::kLookBackAtOnce; ++k) {
      if (words[k] == 0) break;
      sum += words[k] & kCountMask;
      if (words[k] & kUpToBlock) return sum;
      ++back;
    }
  }
}

template <int kBits, class Value> struct SortShared {
  using D = Digits<kBits>;
  struct Sorted {
    uint32_t keys[D::kTile];
    Value values[D::kTile];
  };
  union {
    uint32_t counts[D::kWarps][D::kBins];  ///< at first
    Sorted sorted;                         ///< then, in the order of this pass
  };
  uint16_t next[D::kWarps][D::kBins];  ///< position in the block of a warp's next item
  uint32_t to_global[D::kBins];        ///< from position in the block
  uint32_t block;
};

/// By digit `pass`. Value: int32_t or SlotPair. kFirst: values are indices, and kNoKey is left out. Arrays: [*count];
/// with kFirst keys_in: [capacity]. keys_out may be null. may_skip: the last pass ends at once if all items have one
/// digit; earlier passes exchange values_in and values_out for it.
template <int kBits, class Value, bool kFirst>
__global__ void __launch_bounds__(Digits<kBits>::kThreads,
                                  blocks_per_sm(Digits<kBits>::kBlocks, Digits<kBits>::kThreads))
    sort_pass_kernel(const SortScratch<kBits> scratch, int pass, bool may_skip, const int64_t* count, int64_t capacity,
                     const uint32_t* keys_in, uint32_t* keys_out, Value* values_in, Value* values_out) {
  wait_for_earlier_kernels();
  using D = Digits<kBits>;
  constexpr int kBins = D::kBins, kItems = D::kItems;
  auto& shared = *reinterpret_cast<SortShared<kBits, Value>*>(dynamic_shared());
  const int t = threadIdx.x, lane = lane_id(), warp = t / 32;
  const bool has_digit = t < kBins;
  if (t == 0) shared.block = atomicAdd(&scratch.tickets[pass], 1);
  const uint32_t of_all = has_digit ? scratch.histograms[pass * kBins + t] : 0;
  const int64_t items = *count, n = kFirst ? capacity : items;
  uint32_t* counts = shared.counts[warp];
  for (int digit = lane; digit < kBins; digit += 32) counts[digit] = 0;
  const uint32_t* last = scratch.histograms + (scratch.passes - 1) * kBins;
  if (__syncthreads_or(may_skip && has_digit && last[t] == items)) {
    if (pass == scratch.passes - 1) return;
    Value* other = values_in;
    values_in = values_out;
    values_out = other;
  }
  const int64_t block = shared.block, begin = block * D::kTile;
  if (begin >= n) return;

  // A warp's items are consecutive: equal digits keep their order.
  const int64_t first = begin + warp * 32 * kItems + lane;
  const bool whole = begin + D::kTile <= n;
  uint32_t keys[kItems];
  AR_UNROLL for (int i = 0; i < kItems; ++i) keys[i] = whole || first + 32 * i < n ? keys_in[first + 32 * i] : kNoKey;
  AR_UNROLL for (int i = 0; i < kItems; ++i) {
    // Later passes count keys past the end, which come last.
    if (!kFirst || keys[i] != kNoKey) atomicAdd(&counts[D::of(keys[i], pass)], 1);
  }
  Value values[kItems];
  AR_UNROLL for (int i = 0; i < kItems; ++i) {
    if constexpr (kFirst) {
      values[i] = Value(first + 32 * i);
    } else if (whole || first + 32 * i < n) {
      values[i] = values_in[first + 32 * i];
    }
  }
  __syncthreads();

  // Early, because later blocks wait.
  uint32_t mine = 0;
  uint32_t* status = scratch.status + (pass * scratch.blocks + block) * kBins + t;
  if (has_digit) {
    AR_UNROLL for (int w = 0; w < D::kWarps; ++w) mine += shared.counts[w][t];
    write_status(status, (block == 0 ? kUpToBlock : kOfBlock) | mine);
  }
  uint64_t all;
  const uint64_t before = sum_before<D::kWarps>(uint64_t(of_all) << 32 | mine, uint64_t(0), all);
  const auto in_block = uint32_t(before), in_all = uint32_t(before >> 32);
  if (has_digit) {
    uint32_t position = in_block;
    AR_UNROLL for (int w = 0; w < D::kWarps; ++w) {
      shared.next[w][t] = uint16_t(position);
      position += shared.counts[w][t];
    }
  }
  __syncthreads();

  const uint32_t lanes_before = (1u << lane) - 1, lanes_after = ~lanes_before << 1;
  AR_UNROLL for (int i = 0; i < kItems; ++i) {
    const bool valid = !kFirst || keys[i] != kNoKey;
    uint32_t peers = kFirst ? __ballot_sync(kAllLanes, valid) : kAllLanes;
    if (kFirst && peers == 0) continue;
    const uint32_t digit = D::of(keys[i], pass);
    peers &= lanes_alike<kBits>(digit);
    uint16_t& next = shared.next[warp][digit];
    const uint32_t position = next + __popc(peers & lanes_before);
    __syncwarp();
    if (valid) {
      if ((peers & lanes_after) == 0) next = uint16_t(position + 1);
      shared.sorted.keys[position] = keys[i];
      shared.sorted.values[position] = values[i];
    }
    __syncwarp();
  }
  if (has_digit) {
    const uint32_t earlier = sum_of_earlier(status, block, kBins);
    if (block > 0) write_status(status, kUpToBlock | (earlier + mine));
    shared.to_global[t] = in_all + earlier - in_block;
  }
  __syncthreads();

  const uint32_t here = kFirst ? uint32_t(all) : uint32_t(min(n - begin, int64_t(D::kTile)));
  AR_UNROLL for (int i = 0; i < kItems; ++i) {
    const uint32_t k = i * D::kThreads + t;
    if (k >= here) break;
    const uint32_t key = shared.sorted.keys[k], position = shared.to_global[D::of(key, pass)] + k;
    if (keys_out) keys_out[position] = key;
    values_out[position] = shared.sorted.values[k];
  }
}

}  // namespace ar::cuda
