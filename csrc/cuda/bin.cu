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

constexpr int kRangeThreads = 256;

/// Thread k looks at the sorted pairs k - 1 and k: where the tile changes, lists end and begin.
__global__ void __launch_bounds__(kRangeThreads)
    tile_offsets_kernel(const uint32_t* tiles, const Counts* counts, int64_t capacity, int64_t tile_count,
                        int64_t* tile_offsets) {
  const int64_t k = int64_t(blockIdx.x) * kRangeThreads + threadIdx.x, total = counts->pairs;
  if (total > capacity || k > total) return;
  const int64_t before = k > 0 ? int64_t(tiles[k - 1]) : -1, here = k < total ? tiles[k] : tile_count;
  for (int64_t tile = before + 1; tile <= here; ++tile) tile_offsets[tile] = k;
}

constexpr int kPlanThreads = 1024;

struct PlanSums {
  int chunks, checkpoints, rest;
  __device__ friend PlanSums operator+(PlanSums a, PlanSums b) {
    return {a.chunks + b.chunks, a.checkpoints + b.checkpoints, a.rest + b.rest};
  }
};
struct AddPlanSums {
  __device__ PlanSums operator()(PlanSums a, PlanSums b) const { return a + b; }
};

/// One block walks over all tiles, a thread each: three running sums.
__global__ void __launch_bounds__(kPlanThreads)
    plan_kernel(const TileLists lists, int64_t tiles, int length, const ChunkPlan plan, int64_t* feedback) {
  using Scan = cub::BlockScan<PlanSums, kPlanThreads>;
  __shared__ typename Scan::TempStorage storage;
  const int64_t total = lists.counts->pairs;
  const bool overflow = total > lists.capacity;
  PlanSums base = {0, 0, 0};
  for (int64_t first = 0; first < tiles; first += kPlanThreads) {
    const int64_t tile = first + threadIdx.x;
    PlanSums own = {0, 0, 0}, before, all;
    if (tile < tiles) {
      const int64_t n = overflow ? 1 : lists.tile_offsets[tile + 1] - lists.tile_offsets[tile];
      own.chunks = int((n + length - 1) / length);
      own.checkpoints = own.chunks > 1 ? own.chunks : 0;
      own.rest = max(own.chunks - plan.front, 0);
    }
    Scan(storage).ExclusiveScan(own, before, PlanSums{0, 0, 0}, AddPlanSums(), all);
    __syncthreads();
    before = before + base;
    base = base + all;
    if (tile < tiles) {
      plan.chunk_offsets[tile] = before.chunks;
      plan.checkpoint_offsets[tile] = before.checkpoints;
    }
    for (int c = 0; c < own.chunks; ++c) plan.chunk_tiles[before.chunks + c] = int32_t(tile);
    for (int c = 0; c < own.rest; ++c) plan.rest[before.rest + c] = before.chunks + plan.front + c;
  }
  if (threadIdx.x == 0) {
    plan.chunk_offsets[tiles] = base.chunks;
    *plan.rest_count = base.rest;
    if (feedback) *feedback = total;
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
  tile_offsets_kernel<<<blocks_of(task.capacity + 1, kRangeThreads), kRangeThreads, 0, stream>>>(
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
