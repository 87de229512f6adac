// Kernels that make the lists of tiles. count_depths counts splats, pairs and digits of depths, and gives splats slots
// for gradients. After the sort by depth (sort.cuh), emit_pairs writes a pair for each tile of a splat, emit_long_pairs
// of splats whose tiles are not among 8x8, or of patches where room is short. After the sort by tile, tile_offsets
// finds the first pair of each tile.
#pragma once

#include <type_traits>

#include "core/bin.h"
#include "cuda/bin/policy.h"
#include "cuda/bin/sort.cuh"
#include "cuda/launch.cuh"
#include "cuda/occupancy.h"
#include "cuda/params.h"

namespace ar::cuda {

using DepthScratch = SortScratch<kDepthBits>;
static_assert(kCulledKey == kNoKey);

__device__ inline void set_to_zero(const ZeroedMemory& memory, int64_t thread, int64_t threads) {
  auto* pieces = static_cast<uint4*>(memory.data);
  const int64_t count = memory.bytes / int64_t(sizeof(uint4));
  for (int64_t k = thread; k < count; k += threads) pieces[k] = {0, 0, 0, 0};
}

__device__ inline int64_t add_to_count(int64_t& count, int64_t more) {
  return int64_t(atomicAdd(reinterpret_cast<unsigned long long*>(&count), static_cast<unsigned long long>(more)));
}

/// Hands out slots to kRows x 32 splats of a warp, and counts them. `ranges`: of the lane's first splat, `stride`
/// apart.
template <int kRows>
__device__ void number_slots(const int (&pairs_of)[kRows], PairRange* ranges, int64_t stride, Counts& counts) {
  int64_t before[kRows], all = 0;
  AR_UNROLL for (int k = 0; k < kRows; ++k) {
    const int64_t up_to = warp_inclusive_sum(int64_t(pairs_of[k]));
    before[k] = all + up_to - pairs_of[k];
    all += shuffle(up_to, 31);
  }
  if (all == 0) return;
  int64_t first = 0;
  if (lane_id() == 0) first = add_to_count(counts.pairs, all);
  first = shuffle(first, 0);
  AR_UNROLL for (int k = 0; k < kRows; ++k) {
    if (pairs_of[k] > 0) ranges[k * stride].first = int32_t(first + before[k]);
  }
}

/// keys, ranges: [n]. histograms: [kDepthPasses, 2^kDepthBits]. counts: [1].
__global__ void __launch_bounds__(BinPolicy::kCountThreads)
    count_depths_kernel(const uint32_t* keys, PairRange* ranges, bool with_slots, int64_t n, uint32_t* histograms,
                        Counts* counts, const ZeroedMemory other_scratch, const ZeroedMemory of_tiles) {
  wait_for_earlier_kernels();
  constexpr int kThreads = BinPolicy::kCountThreads, kAtOnce = BinPolicy::kCountAtOnce;
  __shared__ uint32_t local[kDepthHistogramWords];
  for (int b = threadIdx.x; b < kDepthHistogramWords; b += kThreads) local[b] = 0;
  const int64_t thread = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int64_t stride = int64_t(gridDim.x) * kThreads, rounded = (n + 31) / 32 * 32;
  set_to_zero(other_scratch, thread, stride);
  set_to_zero(of_tiles, thread, stride);
  __syncthreads();
  int64_t pairs = 0, splats = 0;
  for (int64_t from = thread; from < rounded; from += kAtOnce * stride) {
    uint32_t key[kAtOnce];
    int pairs_of[kAtOnce];
    AR_UNROLL for (int k = 0; k < kAtOnce; ++k) {
      const int64_t i = from + k * stride;
      key[k] = i < n ? keys[i] : kCulledKey;
    }
    AR_UNROLL for (int k = 0; k < kAtOnce; ++k) pairs_of[k] =
        key[k] != kCulledKey ? ranges[from + k * stride].count : 0;
    AR_UNROLL for (int k = 0; k < kAtOnce; ++k) {
      const bool valid = key[k] != kCulledKey;
      count_digits<kDepthBits, kDepthPasses>(key[k], valid, local);
      if (!with_slots) pairs += pairs_of[k];
      splats += valid;
    }
    if (with_slots) number_slots(pairs_of, ranges + from, stride, *counts);
  }
  __syncthreads();
  for (int b = threadIdx.x; b < kDepthHistogramWords; b += kThreads) {
    if (local[b]) atomicAdd(&histograms[b], local[b]);
  }
  int64_t all_pairs, all_splats;
  sum_before<kThreads / 32>(pairs, int64_t(0), all_pairs);
  sum_before<kThreads / 32>(splats, int64_t(0), all_splats);
  if (threadIdx.x == 0) {
    if (!with_slots) add_to_count(counts->pairs, all_pairs);
    add_to_count(counts->splats, all_splats);
  }
}

template <class Run> void for_each_depth_pass(const DepthSort& p, const DepthScratch& scratch, Run&& run) {
  const int64_t* count = &p.counts->splats;
  run(sort_pass_kernel<kDepthBits, int32_t, true>, scratch, 0, true, count, p.n, p.keys[0], p.keys[1], p.order[0],
      p.order[1]);
  for (int pass = 1; pass < kDepthPasses; ++pass) {
    const bool last = pass == kDepthPasses - 1;
    run(sort_pass_kernel<kDepthBits, int32_t, false>, scratch, pass, true, count, p.n, p.keys[pass % 2],
        last ? nullptr : p.keys[1 - pass % 2], p.order[pass % 2], p.order[1 - pass % 2]);
  }
}

/// Of the sort by tile: as few digits, then as short as the number of tiles allows.
struct TileDigits {
  static constexpr int kMostBits = BinPolicy::kTileDigitBits, kMostPasses = BinPolicy::kTileDigits;
  int passes = 1, bits = kMostBits - 1;

  explicit TileDigits(TileGrid grid) {
    const int64_t tiles = grid.tiles();
    while (tiles > int64_t(1) << (passes * kMostBits)) ++passes;
    if (tiles > int64_t(1) << (passes * bits)) bits = kMostBits;
  }
  __device__ int bins() const { return 1 << bits; }
  __device__ uint32_t of(uint32_t tile, int pass) const { return tile >> (pass * bits) & (bins() - 1); }
  template <class Run> auto with_bits(Run&& run) const {
    constexpr std::integral_constant<int, kMostBits> most = {};
    constexpr std::integral_constant<int, kMostBits - 1> fewer = {};
    return bits == kMostBits ? run(most) : run(fewer);
  }
};

class PairWriter {
 public:
  static constexpr int kMostCounts = TileDigits::kMostPasses << TileDigits::kMostBits;

  /// counts: [kMostCounts] shared. All threads must call it, and __syncthreads() before write().
  __device__ PairWriter(const EmitParams& params, const TileDigits& digits, uint32_t* counts)
      : params_(params), digits_(digits), counts_(counts) {
    for (int b = threadIdx.x; b < digits.passes * digits.bins(); b += BinPolicy::kEmitThreads) counts[b] = 0;
  }
  __device__ void write(int64_t position, uint32_t tile, int32_t splat, int32_t slot) {
    params_.tiles[position] = tile;
    if (params_.slot_pairs) {
      params_.slot_pairs[position] = {splat, slot};
    } else {
      params_.splat_pairs[position] = splat;
    }
    for (int d = 0; d < digits_.passes; ++d) atomicAdd(&counts_[d * digits_.bins() + digits_.of(tile, d)], 1);
  }
  /// All threads must call it.
  __device__ void finish() {
    __syncthreads();
    for (int b = threadIdx.x; b < digits_.passes * digits_.bins(); b += BinPolicy::kEmitThreads) {
      if (counts_[b]) atomicAdd(&params_.tile_counts[b], counts_[b]);
    }
  }

 private:
  const EmitParams& params_;
  const TileDigits& digits_;
  uint32_t* counts_;
};

/// A lane, and a bit of its splat's mask.
struct MaskedPair {
  static constexpr int kBits = 8 * sizeof(TileMask);
  uint16_t value;

  __device__ int lane() const { return value / kBits; }
  __device__ int row() const { return value % kBits / 8; }
  __device__ int column() const { return value % 8; }
};

__device__ inline TileMask few_tiles(const SplatTiles& tiles) { return tiles.count <= kManyTiles ? tiles.mask : 0; }

/// Pairs of earlier blocks. status: [blocks] as in sort.cuh.
__device__ inline uint32_t look_back(const uint32_t* status, int block) {
  uint32_t sum = 0;
  for (int last = block - 1; last >= 0; last -= 32) {
    const int other = last - lane_id();
    uint32_t s = kUpToBlock;
    if (other >= 0) {
      while ((s = read_status(status + other)) == 0) {}
    }
    const uint32_t complete = __ballot_sync(kAllLanes, s & kUpToBlock);
    const int nearest = complete ? __ffs(complete) - 1 : 31;
    sum += warp_sum(lane_id() <= nearest ? s & kCountMask : 0u);
    if (complete) break;
  }
  return sum;
}

/// EmitParams::status: blocks that have begun; long splats; counts of blocks.
inline constexpr int kTickets = 0, kLongSplats = 1, kOfBlocks = 2;

/// In order of depth, then rows of tiles. Long splats are only listed.
__global__ void __launch_bounds__(BinPolicy::kEmitThreads,
                                  blocks_per_sm(BinPolicy::kEmitBlocks, BinPolicy::kEmitThreads))
    emit_pairs_kernel(const EmitParams params, const TileDigits digits) {
  wait_for_earlier_kernels();
  constexpr int kThreads = BinPolicy::kEmitThreads, kRows = BinPolicy::kEmitRows, kWarps = kThreads / 32;
  __shared__ uint32_t digit_counts[PairWriter::kMostCounts];
  __shared__ uint32_t block_id, before_block;
  __shared__ MaskedPair stages[kRows][kWarps][32 * kManyTiles];
  const int64_t n = params.counts->splats;
  if (params.counts->in_patches(params.capacity) || int64_t(blockIdx.x) * BinPolicy::kEmitSplats >= n) return;
  uint32_t* published = params.status + kOfBlocks;
  if (threadIdx.x == 0) block_id = atomicAdd(&params.status[kTickets], 1);
  PairWriter writer(params, digits, digit_counts);
  __syncthreads();
  int32_t ids[kRows];
  SplatTiles touched[kRows] = {};
  int32_t slots[kRows] = {};
  AR_UNROLL for (int row = 0; row < kRows; ++row) {
    const int64_t r = int64_t(block_id) * BinPolicy::kEmitSplats + row * kThreads + threadIdx.x;
    ids[row] = r < n ? params.order[r] : -1;
  }
  AR_UNROLL for (int row = 0; row < kRows; ++row) {
    if (ids[row] >= 0) {
      touched[row] = params.splat_tiles[ids[row]];
      if (params.slot_pairs) slots[row] = params.ranges[ids[row]].first;
    }
  }
  uint32_t before[kRows], sum = 0;
  AR_UNROLL for (int row = 0; row < kRows; ++row) {
    uint32_t of_row;
    before[row] = sum + sum_before<kWarps>(uint32_t(touched[row].count), 0u, of_row);
    sum += of_row;
  }
  if (threadIdx.x == 0) write_status(published + block_id, (block_id == 0 ? kUpToBlock : kOfBlock) | sum);

  // While earlier blocks count: tiles in shared memory, for neighbouring lanes to write.
  const int warp = threadIdx.x / 32;
  int up_to[kRows];  // listed, up to this lane
  AR_UNROLL for (int row = 0; row < kRows; ++row) {
    const TileMask mask = few_tiles(touched[row]);
    const int own = mask ? touched[row].count : 0;
    up_to[row] = warp_inclusive_sum(own);
    MaskedPair* next = stages[row][warp] + up_to[row] - own;
    AR_UNROLL for (int from = 0; from < MaskedPair::kBits; from += 32) {
      for (uint32_t left = __brev(uint32_t(mask >> from)); left != 0;)
        *next++ = {uint16_t(MaskedPair::kBits * lane_id() + from + take_first(left))};
    }
  }
  __syncwarp();

  if (threadIdx.x < 32) {
    const uint32_t earlier = look_back(published, int(block_id));
    if (threadIdx.x == 0) {
      if (block_id > 0) write_status(published + block_id, kUpToBlock | (earlier + sum));
      before_block = earlier;
    }
  }
  __syncthreads();
  const int columns = params.grid.columns();
  AR_UNROLL for (int row = 0; row < kRows; ++row) {
    const SplatTiles& of_splat = touched[row];
    const int own = few_tiles(of_splat) ? of_splat.count : 0, first = up_to[row] - own, all = shuffle(up_to[row], 31);
    const auto begin = int32_t(before_block + before[row]);
    const int32_t to_slot = slots[row] - begin;
    if (of_splat.count > 0 && of_splat.mask == 0) {
      const uint32_t at = atomicAdd(&params.status[kLongSplats], 1);
      params.long_splats[at] = ids[row];
      params.long_places[at] = begin;
    }
    for (int from = 0; from < all; from += 32) {
      const int k = from + lane_id();
      const MaskedPair pair = k < all ? stages[row][warp][k] : MaskedPair{};
      const int32_t position = shuffle(begin - first, pair.lane()) + k, id = shuffle(ids[row], pair.lane());
      const int32_t tile = shuffle(of_splat.first, pair.lane()) + pair.row() * columns + pair.column();
      const int32_t slot = position + shuffle(to_slot, pair.lane());
      if (k < all) writer.write(position, uint32_t(tile), id, slot);
    }
    for (uint32_t many = __brev(__ballot_sync(kAllLanes, of_splat.count > own && of_splat.mask != 0)); many != 0;) {
      const int source = take_first(many);
      const int32_t id = shuffle(ids[row], source), slot_from = shuffle(to_slot, source);
      const int32_t tile = shuffle(of_splat.first, source) + lane_id() / 8 * columns + lane_id() % 8;
      const TileMask mask = shuffle(of_splat.mask, source);
      int32_t next = shuffle(begin, source);
      AR_UNROLL for (int from = 0; from < MaskedPair::kBits; from += 32) {
        const auto bits = uint32_t(mask >> from), lane = 1u << lane_id();
        const int32_t position = next + __popc(bits & (lane - 1));
        if (bits & lane) writer.write(position, uint32_t(tile + from / 8 * columns), id, position + slot_from);
        next += __popc(bits);
      }
    }
  }
  writer.finish();
}

struct BoxOfTiles {
  Range rows, columns;

  __device__ BoxOfTiles in_patches(int bits) const {
    return {{rows.first >> bits, rows.last >> bits}, {columns.first >> bits, columns.last >> bits}};
  }
  __device__ int64_t count() const { return int64_t(rows.last - rows.first + 1) * (columns.last - columns.first + 1); }
};

/// With a pixel more for rounding.
__device__ inline BoxOfTiles box_of_tiles(const Support<float>& support, TileGrid grid) {
  const auto range = [&](float middle, float half, int size) {
    return tiles_of(clamp_range(Span<float>{middle - half - 1, middle + half + 1}, size), grid);
  };
  return {range(support.mean.y, support.half_height + support.reach, grid.height),
          range(support.mean.x, support.half_width + support.reach, grid.width)};
}

/// Pairs of patches. One block: slow but rare.
__device__ inline void emit_patch_pairs(const EmitParams& params, PairWriter& writer) {
  constexpr int kThreads = BinPolicy::kEmitThreads, kWarps = kThreads / 32;
  const TileGrid grid = params.grid;
  const auto* splats = reinterpret_cast<const SplatRow<float>*>(params.splats);
  const int64_t n = params.counts->splats, n_rounded = (n + kThreads - 1) / kThreads * kThreads;
  const auto tiles_of_splat = [&](int32_t id) { return box_of_tiles(support_of(splats[id], params.footprint), grid); };
  // The smallest patches that fit, of 2^1 to 2^kSizes tiles a side, or one for all.
  constexpr int kSizes = 8;
  int64_t of_sizes[kSizes] = {};
#pragma unroll 4
  for (int64_t r = threadIdx.x; r < n; r += kThreads) {
    const BoxOfTiles tiles = tiles_of_splat(params.order[r]);
    AR_UNROLL for (int k = 0; k < kSizes; ++k) of_sizes[k] += tiles.in_patches(k + 1).count();
  }
  int bits = 0;
  while (1 << bits < max(grid.columns(), grid.rows())) ++bits;
  AR_UNROLL for (int k = kSizes - 1; k >= 0; --k) {
    int64_t all;
    sum_before<kWarps>(of_sizes[k], int64_t(0), all);
    if (all <= params.capacity) bits = k + 1;
  }

  const int64_t columns = grid.columns();
  int64_t before = 0;
  for (int64_t r = threadIdx.x; r < n_rounded; r += kThreads) {
    const int32_t id = r < n ? params.order[r] : -1;
    const BoxOfTiles patches = id >= 0 ? tiles_of_splat(id).in_patches(bits) : BoxOfTiles{{0, -1}, {0, -1}};
    int64_t all;
    int64_t position = before + sum_before<kWarps>(patches.count(), int64_t(0), all);
    before += all;
    for (int64_t row = patches.rows.first; row <= patches.rows.last; ++row) {
      for (int64_t column = patches.columns.first; column <= patches.columns.last; ++column, ++position)
        writer.write(position, uint32_t((row << bits) * columns + (column << bits)), id, id);
    }
  }
  if (threadIdx.x == 0) {
    params.counts->listed = before;
    params.counts->patch_bits = bits;
  }
}

/// A warp per long splat, or one block for patches.
__global__ void __launch_bounds__(BinPolicy::kEmitThreads)
    emit_long_pairs_kernel(const EmitParams params, const TileDigits digits) {
  wait_for_earlier_kernels();
  constexpr int kWarps = BinPolicy::kEmitThreads / 32;
  __shared__ uint32_t digit_counts[PairWriter::kMostCounts];
  const bool in_patches = params.counts->in_patches(params.capacity);
  if (blockIdx.x == 0 && threadIdx.x == 0 && !in_patches) params.counts->listed = params.counts->pairs;
  const int count = in_patches ? 1 : int(params.status[kLongSplats]);
  const int first = int(blockIdx.x) * kWarps;
  if (first >= count) return;
  PairWriter writer(params, digits, digit_counts);
  __syncthreads();
  if (in_patches) {
    emit_patch_pairs(params, writer);
    return writer.finish();
  }
  const auto* splats = reinterpret_cast<const SplatRow<float>*>(params.splats);
  for (int k = first + threadIdx.x / 32; k < count; k += int(gridDim.x) * kWarps) {
    const int32_t id = params.long_splats[k];
    int32_t next = params.long_places[k];
    const int32_t to_slot = params.slot_pairs ? params.ranges[id].first - next : 0;
    const Support<float> support = support_of(splats[id], params.footprint);
    const Range rows = clamp_range(rows_of(support), params.grid.height), tile_rows = tiles_of(rows, params.grid);
    for (int top = tile_rows.first; top <= tile_rows.last; top += 32) {
      const int y = top + lane_id();
      const Range tiles = y <= tile_rows.last ? tile_columns_of(support, params.grid, rows, y) : Range{0, -1};
      const int width = tiles.last - tiles.first + 1;
      const int widths = warp_inclusive_sum(width);
      int32_t position = next + widths - width;
      const int row = y * int(params.grid.columns());
      for (int column = tiles.first; column <= tiles.last; ++column, ++position)
        writer.write(position, uint32_t(row + column), id, position + to_slot);
      next += shuffle(widths, 31);
    }
  }
  writer.finish();
}

/// Reports the pairs to the host. tiles: [counts->listed]. counts: [1]. tile_offsets: [tile_count + 1].
__global__ void __launch_bounds__(BinPolicy::kOffsetTiles* BinPolicy::kOffsetLanes)
    tile_offsets_kernel(const uint32_t* tiles, const Counts* counts, int64_t tile_count, int64_t* tile_offsets,
                        PairFeedback feedback) {
  wait_for_earlier_kernels();
  if (blockIdx.x == 0 && threadIdx.x == 0 && feedback.word)
    *feedback.word = uint64_t(feedback.frame) << 32 | min(uint64_t(counts->pairs), uint64_t(0xffffffff));
  const int64_t tile = int64_t(blockIdx.x) * BinPolicy::kOffsetTiles + threadIdx.x / BinPolicy::kOffsetLanes;
  const int first =
      partition_point<BinPolicy::kOffsetLanes>(int(counts->listed), [&](int k) { return tiles[k] < tile; });
  if (tile <= tile_count && threadIdx.x % BinPolicy::kOffsetLanes == 0) tile_offsets[tile] = first;
}

}  // namespace ar::cuda
