// Kernel of bin that depends on the footprint: writes the pairs of every splat.
#pragma once

#include <cub/block/block_scan.cuh>

#include "core/bin.h"
#include "cuda/sort.cuh"
#include "cuda/tasks.h"

namespace ar::cuda {

/// A splat with more pairs than this is written by its whole warp.
inline constexpr int kManyTiles = 16;

__device__ inline void write_pair(const EmitTask& task, int64_t place, uint32_t tile, int32_t splat) {
  task.tiles[place] = tile;
  if (task.slot_pairs) {
    task.slot_pairs[place] = {splat, int32_t(place)};
  } else {
    task.splat_pairs[place] = splat;
  }
}

/// Sum of what the blocks before this one published, for all lanes of a warp.
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

/// Pairs in the order of depth, a splat's by rows of tiles.
template <class F> __global__ void __launch_bounds__(kEmitThreads) emit_pairs_kernel(const EmitTask task) {
  using Scan = cub::BlockScan<uint32_t, kEmitThreads>;
  __shared__ typename Scan::TempStorage storage;
  __shared__ uint32_t block_id, before_block;
  if (task.counts->pairs > task.capacity) return;
  if (threadIdx.x == 0) block_id = atomicAdd(&task.status[0], 1);
  __syncthreads();
  const int64_t r = int64_t(block_id) * kEmitThreads + threadIdx.x, n = task.counts->splats;
  if (int64_t(block_id) * kEmitThreads >= n) return;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(task.splats);
  const int32_t i = r < n ? task.order[r] : 0;
  const int count = r < n ? task.ranges[i].count : 0;
  const Splat<F, float> splat = splats[i];
  uint32_t before, sum;
  Scan(storage).ExclusiveSum(uint32_t(count), before, sum);
  uint32_t* status = task.status + 1;
  if (threadIdx.x < 32) {
    if (threadIdx.x == 0) write_status(status + block_id, (block_id == 0 ? kUpToBlock : kOfBlock) | sum);
    const uint32_t earlier = look_back(status, int(block_id));
    if (threadIdx.x == 0) {
      if (block_id > 0) write_status(status + block_id, kUpToBlock | (earlier + sum));
      before_block = earlier;
    }
  }
  __syncthreads();
  const int64_t begin = int64_t(before_block) + before;
  const int columns = task.grid.columns();
  if (count > 0 && task.slot_pairs) task.ranges[i].first = int32_t(begin);
  if (count > 0 && count <= kManyTiles) {
    int64_t place = begin;
    for_each_tile(support_of(splat), task.grid, [&](int64_t tile) { write_pair(task, place++, tile, i); });
  }
  for (uint32_t many = __ballot_sync(kAllLanes, count > kManyTiles); many != 0; many &= many - 1) {
    const int source = __ffs(many) - 1;
    const int32_t id = __shfl_sync(kAllLanes, i, source);
    int64_t place = __shfl_sync(kAllLanes, begin, source);
    const Support<float> support = support_of(splats[id]);
    const Range rows = clamp_range(rows_of(support), task.grid.height), tile_rows = tiles_of(rows);
    for (int first = tile_rows.first; first <= tile_rows.last; first += 32) {
      const int row = first + lane_id();
      const Range range = row <= tile_rows.last ? tile_columns_of(support, task.grid, rows, row) : Range{0, -1};
      const int width = range.last - range.first + 1;
      int up_to = width;  // inclusive sum over the lanes
#pragma unroll
      for (int offset = 1; offset < 32; offset *= 2) {
        const int other = __shfl_up_sync(kAllLanes, up_to, offset);
        if (lane_id() >= offset) up_to += other;
      }
      int64_t mine = place + up_to - width;
      for (int c = range.first; c <= range.last; ++c) write_pair(task, mine++, uint32_t(row) * columns + c, id);
      place += __shfl_sync(kAllLanes, up_to, 31);
    }
  }
}

template <class F> void emit_pairs(const EmitTask& task, cudaStream_t stream) {
  if (task.n == 0) return;
  emit_pairs_kernel<F><<<blocks_of(task.n, kEmitThreads), kEmitThreads, 0, stream>>>(task);
}

}  // namespace ar::cuda
