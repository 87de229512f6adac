// The parts of bin that no footprint changes: sorts, scans, and the plan of the blending work.
#include <thrust/iterator/counting_iterator.h>
#include <thrust/iterator/transform_iterator.h>

#include <algorithm>
#include <cub/cub.cuh>

#include "cuda/tasks.h"
#include "cuda/warp.cuh"

namespace ar::cuda {
namespace {

/// Pairs of the r-th splat in the order of depth.
struct CountAt {
  const int32_t* order;
  const PairRange* ranges;
  __host__ __device__ int64_t operator()(int64_t r) const { return ranges[order[r]].count; }
};
auto counts_by_depth(const int32_t* order, const PairRange* ranges) {
  return thrust::make_transform_iterator(thrust::make_counting_iterator(int64_t(0)), CountAt{order, ranges});
}

constexpr int kDepthBits = 31;  // depths are positive

int tile_bits(TileGrid grid) {
  int bits = 1;
  while ((int64_t(1) << bits) < grid.tiles()) ++bits;
  return bits;
}

constexpr int kRangeThreads = 256;

/// Thread k looks at the sorted pairs k - 1 and k: where the tile changes, lists end and begin.
__global__ void __launch_bounds__(kRangeThreads) tile_ranges_kernel(const SortTask task) {
  const int64_t k = int64_t(blockIdx.x) * kRangeThreads + threadIdx.x, total = *task.pair_count;
  if (total > task.capacity || k > total) return;
  const int64_t tiles = task.grid.tiles();
  const int64_t before = k > 0 ? int64_t(task.sorted_tiles[k - 1]) : -1, here = k < total ? task.sorted_tiles[k] : tiles;
  for (int64_t tile = before + 1; tile <= here; ++tile) task.tile_offsets[tile] = k;
  if (k < total && task.owners) {
    const int32_t pair = task.sorted_values[k];
    task.pairs[k] = task.owners[pair];
    task.positions[pair] = int32_t(k);
  }
}

constexpr int kPlanThreads = 1024;

/// One block walks over all tiles, a thread each: three running sums.
__global__ void __launch_bounds__(kPlanThreads)
    plan_kernel(const TileLists lists, int64_t tiles, int length, const ChunkPlan plan, int64_t* feedback) {
  using Scan = cub::BlockScan<int, kPlanThreads>;
  __shared__ typename Scan::TempStorage storage;
  const int64_t total = *lists.pair_count;
  const bool overflow = total > lists.capacity;
  int chunk_base = 0, checkpoint_base = 0, rest_base = 0;
  const auto scan = [&](int value, int& base) {
    int before, sum;
    Scan(storage).ExclusiveSum(value, before, sum);
    __syncthreads();
    before += base;
    base += sum;
    return before;
  };
  for (int64_t first = 0; first < tiles; first += kPlanThreads) {
    const int64_t tile = first + threadIdx.x;
    int chunks = 0;
    if (tile < tiles) {
      const int64_t n = overflow ? 1 : lists.tile_offsets[tile + 1] - lists.tile_offsets[tile];
      chunks = int((n + length - 1) / length);
    }
    const int rest = max(chunks - kFrontChunks, 0);
    const int chunk = scan(chunks, chunk_base), checkpoint = scan(chunks > 1 ? chunks : 0, checkpoint_base),
              place = scan(rest, rest_base);
    if (tile < tiles) {
      plan.chunk_offsets[tile] = chunk;
      plan.checkpoint_offsets[tile] = checkpoint;
    }
    for (int c = 0; c < chunks; ++c) plan.chunk_tiles[chunk + c] = int32_t(tile);
    for (int c = 0; c < rest; ++c) plan.rest[place + c] = chunk + kFrontChunks + c;
  }
  if (threadIdx.x == 0) {
    plan.chunk_offsets[tiles] = chunk_base;
    *plan.rest_count = rest_base;
    if (feedback) *feedback = total;
  }
}

}  // namespace

size_t workspace_size(int64_t n, int64_t capacity, TileGrid grid) {
  const uint32_t* keys = nullptr;
  const int32_t* values = nullptr;
  size_t depth = 0, scan = 0, tile = 0;
  cub::DeviceRadixSort::SortPairs(nullptr, depth, keys, const_cast<uint32_t*>(keys), values,
                                  const_cast<int32_t*>(values), int(n), 0, kDepthBits);
  cub::DeviceScan::InclusiveSum(nullptr, scan, counts_by_depth(nullptr, nullptr), static_cast<int64_t*>(nullptr), int(n));
  cub::DeviceRadixSort::SortPairs(nullptr, tile, keys, const_cast<uint32_t*>(keys), values,
                                  const_cast<int32_t*>(values), int(capacity), 0, tile_bits(grid));
  return std::max({depth, scan, tile});
}

void sort_by_depth(const uint32_t* keys, const int32_t* ids, const PairRange* ranges, int64_t n, uint32_t* sorted_keys,
                   int32_t* order, int64_t* offsets, void* workspace, size_t bytes, cudaStream_t stream) {
  cudaMemsetAsync(offsets, 0, sizeof *offsets, stream);
  if (n == 0) return;
  cub::DeviceRadixSort::SortPairs(workspace, bytes, keys, sorted_keys, ids, order, int(n), 0, kDepthBits, stream);
  cub::DeviceScan::InclusiveSum(workspace, bytes, counts_by_depth(order, ranges), offsets + 1, int(n), stream);
}

void sort_by_tile(const SortTask& task, void* workspace, size_t bytes, cudaStream_t stream) {
  cub::DeviceRadixSort::SortPairs(workspace, bytes, task.tiles, task.sorted_tiles, task.values, task.sorted_values,
                                  int(task.capacity), 0, tile_bits(task.grid), stream);
  tile_ranges_kernel<<<blocks_of(task.capacity + 1, kRangeThreads), kRangeThreads, 0, stream>>>(task);
}

void plan_chunks(const TileLists& lists, TileGrid grid, int samples, const ChunkPlan& plan, int64_t* feedback,
                 cudaStream_t stream) {
  plan_kernel<<<1, kPlanThreads, 0, stream>>>(lists, grid.tiles(), chunk_length(samples), plan, feedback);
}

}  // namespace ar::cuda
