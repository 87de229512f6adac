// The parts of bin that no footprint changes: sorts, and the plan of the blending work.
#include <algorithm>
#include <cub/block/block_reduce.cuh>
#include <cub/block/block_scan.cuh>

#include "cuda/sort.cuh"
#include "cuda/tasks.h"
#include "cuda/warp.cuh"

namespace ar::cuda {
namespace {

constexpr int kDepthPasses = 4;

int tile_passes(TileGrid grid) {
  int passes = 1;
  while (grid.tiles() > int64_t(1) << (passes * kDigitBits)) ++passes;
  return passes;
}

constexpr int kCountThreads = 512, kCountBlocks = 132 * 2;

/// Histograms of all digits of the depth keys of splats with pairs; how many of these there are, and
/// how many pairs.
__global__ void __launch_bounds__(kCountThreads)
    count_depths_kernel(const uint32_t* keys, const PairRange* ranges, int64_t n, uint32_t* histograms, Counts* counts) {
  __shared__ uint32_t local[kDepthPasses][kBins];
  for (int b = threadIdx.x; b < kDepthPasses * kBins; b += kCountThreads) local[0][b] = 0;
  __syncthreads();
  unsigned long long pairs = 0, splats = 0;
  const int64_t stride = int64_t(gridDim.x) * kCountThreads, rounded = (n + 31) / 32 * 32;
  for (int64_t i = int64_t(blockIdx.x) * kCountThreads + threadIdx.x; i < rounded; i += stride) {
    const uint32_t key = i < n ? keys[i] : kCulledKey;
    const bool valid = key != kCulledKey;
    count_digits<kDepthPasses>(key, valid, local);
    if (valid) pairs += ranges[i].count;
    splats += valid;
  }
  __syncthreads();
  for (int b = threadIdx.x; b < kDepthPasses * kBins; b += kCountThreads) {
    if (local[0][b]) atomicAdd(&histograms[b], local[0][b]);
  }
  using Reduce = cub::BlockReduce<unsigned long long, kCountThreads>;
  __shared__ typename Reduce::TempStorage storage;
  pairs = Reduce(storage).Sum(pairs);
  __syncthreads();
  splats = Reduce(storage).Sum(splats);
  if (threadIdx.x == 0) {
    atomicAdd(reinterpret_cast<unsigned long long*>(&counts->pairs), pairs);
    atomicAdd(reinterpret_cast<unsigned long long*>(&counts->splats), splats);
  }
}

template <int kPasses>
__global__ void __launch_bounds__(kCountThreads)
    count_tiles_kernel(const uint32_t* tiles, const Counts* counts, int64_t capacity, uint32_t* histograms) {
  const int64_t n = counts->pairs;
  if (n > capacity) return;
  __shared__ uint32_t local[kPasses][kBins];
  for (int b = threadIdx.x; b < kPasses * kBins; b += kCountThreads) local[0][b] = 0;
  __syncthreads();
  const int64_t stride = int64_t(gridDim.x) * kCountThreads, rounded = (n + 31) / 32 * 32;
  for (int64_t k = int64_t(blockIdx.x) * kCountThreads + threadIdx.x; k < rounded; k += stride)
    count_digits<kPasses>(k < n ? tiles[k] : 0, k < n, local);
  __syncthreads();
  for (int b = threadIdx.x; b < kPasses * kBins; b += kCountThreads) {
    if (local[0][b]) atomicAdd(&histograms[b], local[0][b]);
  }
}

constexpr int kRangeThreads = 128;

/// Each tile finds its first pair.
__global__ void __launch_bounds__(kRangeThreads)
    tile_offsets_kernel(const uint32_t* tiles, const Counts* counts, int64_t capacity, int64_t tile_count,
                        int64_t* tile_offsets) {
  const int64_t tile = int64_t(blockIdx.x) * kRangeThreads + threadIdx.x;
  if (counts->pairs > capacity || tile > tile_count) return;
  int64_t low = 0, high = counts->pairs;
  while (low < high) {
    const int64_t middle = (low + high) / 2;
    if (tiles[middle] < tile) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  tile_offsets[tile] = low;
}

constexpr int kPlanThreads = 1024, kPlanTiles = 8;  // tiles per thread and round

struct PlanSums {
  int chunks, checkpoints, rest;
  __device__ friend PlanSums operator+(PlanSums a, PlanSums b) {
    return {a.chunks + b.chunks, a.checkpoints + b.checkpoints, a.rest + b.rest};
  }
};
struct AddPlanSums {
  __device__ PlanSums operator()(PlanSums a, PlanSums b) const { return a + b; }
};

/// Work is handed out longest first, so that no block starts on a long piece when the others are
/// done. Sizes are classed by powers of two; within a class the order does not matter.
struct WorkClasses {
  static constexpr int kCount = 33;
  int next[kCount];  ///< sizes, then places

  __device__ static int of(int length) { return __clz(length); }  // longer first
  /// Takes a place for a piece of this length; counts pieces before finish(). Lanes of one class go
  /// together: atomics to one place are slow.
  __device__ int take(int length) {
    const uint32_t peers = __match_any_sync(__activemask(), of(length));
    const int leader = __ffs(peers) - 1;
    int first = 0;
    if (lane_id() == leader) first = atomicAdd(&next[of(length)], __popc(peers));
    return __shfl_sync(peers, first, leader) + __popc(peers & ((1u << lane_id()) - 1));
  }
  __device__ int take_many(int length, int pieces) { return atomicAdd(&next[of(length)], pieces); }
  __device__ void finish() {
    for (int c = 0, sum = 0; c < kCount; ++c) {
      const int n = next[c];
      next[c] = sum;
      sum += n;
    }
  }
};

/// One block walks over all tiles: three running sums, and two orders of work.
__global__ void __launch_bounds__(kPlanThreads)
    plan_kernel(const TileLists lists, int64_t tiles, int length, const ChunkPlan plan, int64_t* feedback) {
  using Scan = cub::BlockScan<PlanSums, kPlanThreads>;
  __shared__ typename Scan::TempStorage storage;
  __shared__ WorkClasses tile_classes, chunk_classes;
  const int64_t total = lists.counts->pairs;
  const bool overflow = total > lists.capacity;
  for (int c = threadIdx.x; c < WorkClasses::kCount; c += kPlanThreads) tile_classes.next[c] = chunk_classes.next[c] = 0;
  __syncthreads();
  const auto count_of = [&](int64_t tile) {
    if (tile >= tiles) return 0;
    return overflow ? 1 : int(lists.tile_offsets[tile + 1] - lists.tile_offsets[tile]);
  };
  PlanSums base = {0, 0, 0};
  for (int64_t round = 0; round < tiles; round += kPlanThreads * kPlanTiles) {
    const int64_t first = round + threadIdx.x * kPlanTiles;
    PlanSums own[kPlanTiles], sum = {0, 0, 0}, before, all;
#pragma unroll
    for (int t = 0; t < kPlanTiles; ++t) {
      const int n = count_of(first + t), chunks = (n + length - 1) / length;
      own[t] = {chunks, chunks > 1 ? chunks : 0, max(chunks - plan.front, 0)};
      sum = sum + own[t];
      if (first + t < tiles) tile_classes.take(n);
      if (n >= length) chunk_classes.take_many(length, n / length);
      if (n % length) chunk_classes.take(n % length);
    }
    Scan(storage).ExclusiveScan(sum, before, PlanSums{0, 0, 0}, AddPlanSums(), all);
    __syncthreads();
    before = before + base;
    base = base + all;
#pragma unroll
    for (int t = 0; t < kPlanTiles; ++t) {
      if (first + t < tiles) {
        plan.chunk_offsets[first + t] = before.chunks;
        plan.checkpoint_offsets[first + t] = before.checkpoints;
      }
      for (int c = 0; c < own[t].rest; ++c) {
        plan.rest[before.rest + c] = {int32_t(first + t), plan.front + c};
      }
      before = before + own[t];
    }
  }
  if (threadIdx.x == 0) {
    plan.chunk_offsets[tiles] = base.chunks;
    *plan.rest_count = base.rest;
    if (feedback) *feedback = total;
    tile_classes.finish();
    chunk_classes.finish();
  }
  __syncthreads();
  for (int64_t tile = threadIdx.x; tile < tiles; tile += kPlanThreads) {
    const int n = count_of(tile);
    const int whole = n / length;
    plan.tile_order[tile_classes.take(n)] = int32_t(tile);
    const int place = whole > 0 ? chunk_classes.take_many(length, whole) : 0;
    for (int c = 0; c < whole; ++c) plan.chunk_order[place + c] = {int32_t(tile), c};
    if (n % length) plan.chunk_order[chunk_classes.take(n % length)] = {int32_t(tile), whole};
  }
}

template <class Value>
void sort_values(const TileSort<Value>& task, TileGrid grid, uint32_t* memory, cudaStream_t stream) {
  const int passes = tile_passes(grid);
  const SortScratch scratch(memory, task.capacity, passes);
  cudaMemsetAsync(memory, 0, SortScratch::words(task.capacity, passes) * sizeof *memory, stream);
  const auto count = [&](auto kernel) {
    kernel<<<kCountBlocks, kCountThreads, 0, stream>>>(task.tiles[0], task.counts, task.capacity, scratch.histograms);
  };
  switch (passes) {
    case 1: count(count_tiles_kernel<1>); break;
    case 2: count(count_tiles_kernel<2>); break;
    case 3: count(count_tiles_kernel<3>); break;
    default: count(count_tiles_kernel<4>); break;
  }
  for (int pass = 0; pass < passes; ++pass) {
    // After an overflow the histograms are empty, and with them the sort.
    sort_pass_kernel<Value, false><<<unsigned(scratch.blocks), kSortThreads, 0, stream>>>(
        scratch, pass, 0, 0, task.tiles[pass % 2], task.tiles[1 - pass % 2], task.values[pass % 2],
        task.values[1 - pass % 2]);
  }
  tile_offsets_kernel<<<blocks_of(grid.tiles() + 1, kRangeThreads), kRangeThreads, 0, stream>>>(
      task.tiles[passes % 2], task.counts, task.capacity, grid.tiles(), task.tile_offsets);
}

}  // namespace

int64_t max_pairs() { return kMaxSortItems; }

int64_t depth_sort_scratch(int64_t n) { return SortScratch::words(n, kDepthPasses) * sizeof(uint32_t); }

int64_t tile_sort_scratch(int64_t capacity, TileGrid grid) {
  return SortScratch::words(capacity, tile_passes(grid)) * sizeof(uint32_t);
}

int tile_sort_result(TileGrid grid) { return tile_passes(grid) % 2; }

void count_depths(const DepthSort& task, void* memory, cudaStream_t stream) {
  const SortScratch scratch(static_cast<uint32_t*>(memory), task.n, kDepthPasses);
  cudaMemsetAsync(memory, 0, depth_sort_scratch(task.n), stream);
  cudaMemsetAsync(task.counts, 0, sizeof *task.counts, stream);
  if (task.n == 0) return;
  count_depths_kernel<<<kCountBlocks, kCountThreads, 0, stream>>>(task.keys[0], task.ranges, task.n,
                                                                   scratch.histograms, task.counts);
}

void sort_by_depth(const DepthSort& task, void* memory, cudaStream_t stream) {
  if (task.n == 0) return;
  const SortScratch scratch(static_cast<uint32_t*>(memory), task.n, kDepthPasses);
  const auto blocks = unsigned(scratch.blocks);
  sort_pass_kernel<int32_t, true><<<blocks, kSortThreads, 0, stream>>>(
      scratch, 0, task.n, kCulledKey, task.keys[0], task.keys[1], nullptr, task.order[1]);
  for (int pass = 1; pass < kDepthPasses; ++pass) {
    sort_pass_kernel<int32_t, false><<<blocks, kSortThreads, 0, stream>>>(
        scratch, pass, 0, 0, task.keys[pass % 2], task.keys[1 - pass % 2], task.order[pass % 2],
        task.order[1 - pass % 2]);
  }
}

void sort_by_tile(const TileSort<int32_t>& task, TileGrid grid, void* scratch, cudaStream_t stream) {
  sort_values(task, grid, static_cast<uint32_t*>(scratch), stream);
}
void sort_by_tile(const TileSort<SlotPair>& task, TileGrid grid, void* scratch, cudaStream_t stream) {
  sort_values(task, grid, static_cast<uint32_t*>(scratch), stream);
}

void plan_chunks(const TileLists& lists, TileGrid grid, int samples, const ChunkPlan& plan, int64_t* feedback,
                 cudaStream_t stream) {
  plan_kernel<<<1, kPlanThreads, 0, stream>>>(lists, grid.tiles(), chunk_length(samples), plan, feedback);
}

}  // namespace ar::cuda
