// A stable radix sort whose number of items is known to the device alone.
//
// The sorts of libraries take the number of items from the host. With them the host would have to wait for that number,
// or sort all items that there is room for: twice as many, on frames with half the pairs of an earlier one. The method
// is Adinets and Merrill, "Onesweep" (2022): one histogram for all digits, then a pass per digit in which blocks find
// their place by looking back at the blocks before them.
#pragma once

#include "cuda/warp.cuh"

namespace ar::cuda {

inline constexpr int kSortTile = 3072;  // items of a block

/// A sort by digits of kBits bits. A block has a thread for each value of a digit.
template <int kBits> struct Digits {
  static constexpr int kBins = 1 << kBits, kThreads = kBins, kWarps = kThreads / 32;
  static constexpr int kItems = kSortTile / kThreads;  ///< of a thread
  /// Blocks that a streaming multiprocessor should hold at once. It limits the registers of a thread, which for more
  /// blocks at once may spill a few.
  static constexpr int kBlocks = kBits > 8 ? 3 : 4;

  __device__ static uint32_t of(uint32_t key, int pass) { return key >> (pass * kBits) & (kBins - 1); }
};

// What a block publishes: a count, and what it counts. One word, so that both arrive together.
inline constexpr uint32_t kOfBlock = 1u << 30, kUpToBlock = 2u << 30, kCountMask = kOfBlock - 1;
inline constexpr int64_t kMaxSortItems = kCountMask;

__device__ inline uint32_t read_status(const uint32_t* status) {
  return *static_cast<const volatile uint32_t*>(status);
}
__device__ inline void write_status(uint32_t* status, uint32_t value) {
  *static_cast<volatile uint32_t*>(status) = value;
}

inline int64_t sort_blocks(int64_t capacity) { return (capacity + kSortTile - 1) / kSortTile; }

/// Scratch of a sort of `capacity` items by `passes` digits. Zero before use.
template <int kBits> struct SortScratch {
  static constexpr int kBins = Digits<kBits>::kBins;
  int passes;
  uint32_t* histograms;  ///< [passes, kBins]
  uint32_t* tickets;     ///< [passes]
  uint32_t* status;      ///< [passes, blocks, kBins]
  int64_t blocks;

  static int64_t words(int64_t capacity, int passes) { return passes * (kBins * (1 + sort_blocks(capacity)) + 1); }
  SortScratch(uint32_t* memory, int64_t capacity, int passes)
      : passes(passes),
        histograms(memory),
        tickets(memory + passes * kBins),
        status(memory + passes * (kBins + 1)),
        blocks(sort_blocks(capacity)) {}
};

/// Adds the digits of a warp's keys to histograms in shared memory.
template <int kBits, int kPasses> __device__ void count_digits(uint32_t key, bool valid, uint32_t* histograms) {
  constexpr int kBins = Digits<kBits>::kBins;
#pragma unroll
  for (int pass = 0; pass < kPasses; ++pass) {
    const uint32_t digit = Digits<kBits>::of(key, pass);
    // Neighbours often agree, above all in the high digits of depths. Atomics to one place are slow.
    int agree = 0;
    __match_all_sync(kAllLanes, valid ? digit : kBins, &agree);
    if (agree) {
      if (valid && lane_id() == 0) atomicAdd(&histograms[pass * kBins + digit], 32);
    } else if (valid) {
      atomicAdd(&histograms[pass * kBins + digit], 1);
    }
  }
}

/// One pass. `kFirst`: there are first_count keys, those equal to `skip` are left out, and the values are
/// the places of the others. The number of items of later passes is the histogram's.
///
/// `may_skip`: where all items have the same last digit, the last pass ends at once, and those before it have their two
/// arrays of values in turn the other way round, so that the result is where the last pass would leave it. Keys, which
/// nobody reads afterwards, are where they would be.
template <int kBits, class Value, bool kFirst>
__global__ void __launch_bounds__(Digits<kBits>::kThreads, Digits<kBits>::kBlocks)
    sort_pass_kernel(const SortScratch<kBits> scratch, int pass, bool may_skip, int64_t first_count, uint32_t skip,
                     const uint32_t* keys_in, uint32_t* keys_out, Value* values_in, Value* values_out) {
  using D = Digits<kBits>;
  constexpr int kBins = D::kBins, kSortThreads = D::kThreads, kSortWarps = D::kWarps, kSortItems = D::kItems;
  __shared__ uint16_t counts[kSortWarps][kBins];  // of a warp's digits, then their first places in the block
  __shared__ uint32_t to_global[kBins];           // place in the output - place in the block
  __shared__ Value staged[kSortTile];
  __shared__ uint32_t block_id;
  const int t = threadIdx.x, warp = t / 32, lane = lane_id();
  if (t == 0) block_id = atomicAdd(&scratch.tickets[pass], 1);
  uint32_t items;
  const uint32_t base = sum_before<kSortWarps>(scratch.histograms[pass * kBins + t], 0u, items);
#pragma unroll
  for (int w = 0; w < kSortWarps; ++w) counts[w][t] = 0;
  if (may_skip) {
    if (__syncthreads_or(scratch.histograms[(scratch.passes - 1) * kBins + t] == items)) {
      if (pass == scratch.passes - 1) return;
      Value* other = values_in;
      values_in = values_out;
      values_out = other;
    }
  } else {
    __syncthreads();
  }
  const int64_t n = kFirst ? first_count : items, begin = int64_t(block_id) * kSortTile;
  if (begin >= n) return;

  // A warp's items are consecutive, row after row of 32: the order of ranks is the order of items.
  uint32_t keys[kSortItems], ranks[kSortItems];
  bool valid[kSortItems];
  const int64_t first = begin + warp * 32 * kSortItems + lane;
#pragma unroll
  for (int i = 0; i < kSortItems; ++i) {
    valid[i] = first + 32 * i < n;
    keys[i] = valid[i] ? keys_in[first + 32 * i] : 0;
    if (kFirst) valid[i] = valid[i] && keys[i] != skip;
  }
  const uint32_t before = (1u << lane) - 1;
#pragma unroll
  for (int i = 0; i < kSortItems; ++i) {
    const uint32_t digit = D::of(keys[i], pass);
    uint32_t peers = __ballot_sync(kAllLanes, valid[i]);
    if (kFirst && peers == 0) continue;  // culled splats are often neighbours
#pragma unroll
    for (int b = 0; b < kBits; ++b) {
      const bool bit = digit >> b & 1;
      const uint32_t with = __ballot_sync(kAllLanes, bit);
      peers &= bit ? with : ~with;
    }
    const int leader = valid[i] ? __ffs(peers) - 1 : lane;
    uint32_t start = 0;
    if (valid[i] && lane == leader) {
      start = counts[warp][digit];
      counts[warp][digit] = uint16_t(start + __popc(peers));
    }
    ranks[i] = __shfl_sync(kAllLanes, start, leader) + __popc(peers & before);
    __syncwarp();
  }
  __syncthreads();

  uint32_t mine = 0;  // of digit t, in this block
#pragma unroll
  for (int w = 0; w < kSortWarps; ++w) {
    const uint32_t c = counts[w][t];
    counts[w][t] = uint16_t(mine);
    mine += c;
  }
  uint32_t* status = scratch.status + (int64_t(pass) * scratch.blocks + block_id) * kBins + t;
  write_status(status, (block_id == 0 ? kUpToBlock : kOfBlock) | mine);
  uint32_t total;  // items of this block
  const uint32_t local = sum_before<kSortWarps>(mine, 0u, total);
  uint32_t earlier = 0;  // of digit t, in the blocks before
  if (block_id > 0) {
    for (const uint32_t* other = status - kBins;; other -= kBins) {
      uint32_t s;
      while ((s = read_status(other)) == 0) {}
      earlier += s & kCountMask;
      if (s & kUpToBlock) break;
    }
    write_status(status, kUpToBlock | (earlier + mine));
  }
  to_global[t] = base + earlier - local;
#pragma unroll
  for (int w = 0; w < kSortWarps; ++w) counts[w][t] = uint16_t(counts[w][t] + local);
  __syncthreads();

  // Through shared memory, so that neighbouring threads write to neighbouring places.
  auto* staged_keys = reinterpret_cast<uint32_t*>(staged);
#pragma unroll
  for (int i = 0; i < kSortItems; ++i) {
    if (!valid[i]) continue;
    ranks[i] += counts[warp][D::of(keys[i], pass)];
    staged_keys[ranks[i]] = keys[i];
  }
  __syncthreads();
  uint32_t places[kSortItems];
#pragma unroll
  for (int i = 0; i < kSortItems; ++i) {
    const uint32_t k = i * kSortThreads + t;
    if (k >= total) continue;
    const uint32_t key = staged_keys[k];
    places[i] = to_global[D::of(key, pass)] + k;
    keys_out[places[i]] = key;
  }
  __syncthreads();
#pragma unroll
  for (int i = 0; i < kSortItems; ++i) {
    if (!valid[i]) continue;
    if constexpr (kFirst) {
      staged[ranks[i]] = Value(first + 32 * i);
    } else {
      staged[ranks[i]] = values_in[first + 32 * i];
    }
  }
  __syncthreads();
#pragma unroll
  for (int i = 0; i < kSortItems; ++i) {
    const uint32_t k = i * kSortThreads + t;
    if (k < total) values_out[places[i]] = staged[k];
  }
}

}  // namespace ar::cuda
