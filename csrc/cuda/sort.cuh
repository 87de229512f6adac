// A stable radix sort whose number of items is known to the device alone.
//
// The sorts of libraries take the number of items from the host. With them the host would have to wait for that number,
// or sort all items that there is room for: twice as many, on frames with half the pairs of an earlier one. The method
// is Adinets and Merrill, "Onesweep" (2022): one histogram for all digits, then a pass per digit in which blocks find
// their place by looking back at the blocks before them.
#pragma once

#include "cuda/launch.cuh"
#include "cuda/warp.cuh"

namespace ar::cuda {

/// A sort by digits of kBits bits. A block has at least a thread for each value of a digit.
template <int kBits> struct Digits {
  static constexpr int kBins = 1 << kBits, kThreads = kBits > 8 ? 512 : 256, kWarps = kThreads / 32;
  static constexpr int kItems = kBits > 8 ? 10 : 12;  ///< of a thread
  static constexpr int kTile = kThreads * kItems;     ///< items of a block
  /// Blocks that a streaming multiprocessor should hold at once. It limits the registers of a thread.
  static constexpr int kBlocks = kBits > 8 ? 2 : 3;

  __device__ static uint32_t of(uint32_t key, int pass) { return key >> (pass * kBits) & (kBins - 1); }
};

/// What stands for no item: in the first pass it is left out.
inline constexpr uint32_t kNoKey = 0xffffffff;

// What a block publishes: a count, and what it counts. One word, so that both arrive together.
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

/// Scratch of a sort of `capacity` items by `passes` digits. Zero before use.
template <int kBits> struct SortScratch {
  static constexpr int kBins = Digits<kBits>::kBins;
  int passes;
  uint32_t* histograms;  ///< [passes, kBins]
  uint32_t* tickets;     ///< [passes]
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

/// Adds the digits of a warp's keys to histograms in shared memory.
template <int kBits, int kPasses> __device__ void count_digits(uint32_t key, bool valid, uint32_t* histograms) {
  constexpr int kBins = Digits<kBits>::kBins;
  if (!__any_sync(kAllLanes, valid)) return;  // culled splats are often neighbours
#pragma unroll
  for (int pass = 0; pass < kPasses; ++pass) {
    const uint32_t digit = Digits<kBits>::of(key, pass);
    // Neighbours often agree, above all in the high digits of depths. Atomics to one place are slow.
    int agree = 0;
    __match_all_sync(kAllLanes, valid ? digit : kBins, &agree);
    if (agree) {
      if (lane_id() == 0) atomicAdd(&histograms[pass * kBins + digit], 32);
    } else if (valid) {
      atomicAdd(&histograms[pass * kBins + digit], 1);
    }
  }
}

/// The sum of what the blocks before this one published, each in a row of `width` words: their own counts, up to the
/// nearest one that knows the sum up to itself. `status`: this block's word. Waits for those that have not got so far.
__device__ inline uint32_t sum_of_earlier(const uint32_t* status, int64_t block, int width) {
  constexpr int kAtOnce = 8;  // rows whose loads wait together
  if (block == 0) return 0;
  uint32_t sum = 0;
  for (int64_t back = 1;;) {
    uint32_t row[kAtOnce];
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) row[k] = read_status(status - min(back + k, block) * width);
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) {
      if (row[k] == 0) break;
      sum += row[k] & kCountMask;
      if (row[k] & kUpToBlock) return sum;
      ++back;
    }
  }
}

/// Shared memory of a block.
template <int kBits, class Value> struct SortShared {
  using D = Digits<kBits>;
  static_assert(D::kTile < 1 << 16);
  struct Sorted {  ///< in the order of this pass
    uint32_t keys[D::kTile];
    Value values[D::kTile];
  };
  union {
    uint32_t counts[D::kWarps][D::kBins];  ///< of the digits of each warp's items, until their places are known; then
    Sorted sorted;
  };
  uint16_t next[D::kWarps][D::kBins];  ///< place in the block of a warp's next item with each digit
  uint32_t to_global[D::kBins];        ///< place in the output - place in the block
  uint32_t block;
};

/// One pass. There are *count items, at most `capacity`. `kFirst`: their keys are among `capacity` ones, the others of
/// which are kNoKey, and their values are the places of their keys.
///
/// `may_skip`: where all items have the same last digit, the last pass ends at once, and those before it have their two
/// arrays of values in turn the other way round, so that the result is where the last pass would leave it.
/// `keys_out` may be null: then nobody reads them.
template <int kBits, class Value, bool kFirst>
__global__ void __launch_bounds__(Digits<kBits>::kThreads, Digits<kBits>::kBlocks)
    sort_pass_kernel(const SortScratch<kBits> scratch, int pass, bool may_skip, const int64_t* count, int64_t capacity,
                     const uint32_t* keys_in, uint32_t* keys_out, Value* values_in, Value* values_out) {
  wait_for_earlier_kernels();
  using D = Digits<kBits>;
  constexpr int kBins = D::kBins, kItems = D::kItems;
  auto& shared = *reinterpret_cast<SortShared<kBits, Value>*>(dynamic_shared());
  const int t = threadIdx.x, lane = lane_id(), warp = t / 32;
  const bool has_digit = t < kBins;  // digit t
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

  // A warp's items are consecutive, row after row of 32: the order of places is the order of items.
  const int64_t first = begin + warp * 32 * kItems + lane;
  const bool whole = begin + D::kTile <= n;
  uint32_t keys[kItems];
#pragma unroll
  for (int i = 0; i < kItems; ++i) keys[i] = whole || first + 32 * i < n ? keys_in[first + 32 * i] : kNoKey;
#pragma unroll
  for (int i = 0; i < kItems; ++i) {
    // Behind the last item there may be others that stand for none. They get the last places of the last block.
    if (!kFirst || keys[i] != kNoKey) atomicAdd(&counts[D::of(keys[i], pass)], 1);
  }
  [[maybe_unused]] Value values[kItems];
  if constexpr (!kFirst) {
#pragma unroll
    for (int i = 0; i < kItems; ++i) {
      if (whole || first + 32 * i < n) values[i] = values_in[first + 32 * i];
    }
  }
  __syncthreads();

  // Counts are published early: other blocks wait for them.
  uint32_t mine = 0;  // of digit t, in this block
  uint32_t* status = scratch.status + (pass * scratch.blocks + block) * kBins + t;
  if (has_digit) {
#pragma unroll
    for (int w = 0; w < D::kWarps; ++w) mine += shared.counts[w][t];
    write_status(status, (block == 0 ? kUpToBlock : kOfBlock) | mine);
  }
  // Both sums at once.
  uint64_t all;
  const uint64_t before = sum_before<D::kWarps>(uint64_t(of_all) << 32 | mine, uint64_t(0), all);
  const auto in_block = uint32_t(before), in_all = uint32_t(before >> 32);
  if (has_digit) {
    uint32_t place = in_block;
#pragma unroll
    for (int w = 0; w < D::kWarps; ++w) {
      shared.next[w][t] = uint16_t(place);
      place += shared.counts[w][t];
    }
  }
  __syncthreads();

  const uint32_t lanes_before = (1u << lane) - 1, lanes_behind = ~lanes_before << 1;
#pragma unroll
  for (int i = 0; i < kItems; ++i) {
    const bool valid = !kFirst || keys[i] != kNoKey;
    uint32_t peers = kFirst ? __ballot_sync(kAllLanes, valid) : kAllLanes;
    if (kFirst && peers == 0) continue;  // culled splats are often neighbours
    const uint32_t digit = D::of(keys[i], pass);
    peers &= lanes_alike<kBits>(digit);
    uint16_t& next = shared.next[warp][digit];
    const uint32_t place = next + __popc(peers & lanes_before);
    __syncwarp();
    if (valid) {
      if ((peers & lanes_behind) == 0) next = uint16_t(place + 1);
      shared.sorted.keys[place] = keys[i];
      if constexpr (kFirst) {
        shared.sorted.values[place] = Value(first + 32 * i);
      } else {
        shared.sorted.values[place] = values[i];
      }
    }
    __syncwarp();
  }
  if (has_digit) {
    const uint32_t earlier = sum_of_earlier(status, block, kBins);
    if (block > 0) write_status(status, kUpToBlock | (earlier + mine));
    shared.to_global[t] = in_all + earlier - in_block;
  }
  __syncthreads();

  // From shared memory, so that neighbouring threads write to neighbouring places.
  const uint32_t here = kFirst ? uint32_t(all) : uint32_t(min(n - begin, int64_t(D::kTile)));
#pragma unroll
  for (int i = 0; i < kItems; ++i) {
    const uint32_t k = i * D::kThreads + t;
    if (k >= here) break;
    const uint32_t key = shared.sorted.keys[k], place = shared.to_global[D::of(key, pass)] + k;
    if (keys_out) keys_out[place] = key;
    values_out[place] = shared.sorted.values[k];
  }
}

}  // namespace ar::cuda
