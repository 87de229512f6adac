// Kernel of bin that depends on the footprint: writes the pairs of every splat.
#pragma once

#include "core/bin.h"
#include "cuda/tasks.h"
#include "cuda/warp.cuh"

namespace ar::cuda {

inline constexpr int kEmitThreads = 128;

/// A splat with more pairs than this is written by its whole warp.
inline constexpr int kManyTiles = 32;

__device__ inline void write_pair(const BinTask& task, int64_t place, uint32_t tile, int32_t splat) {
  task.tiles[place] = tile;
  task.values[place] = task.owners ? int32_t(place) : splat;
  if (task.owners) task.owners[place] = splat;
}

/// Pairs in the order of depth, a splat's by rows of tiles.
template <class F> __global__ void __launch_bounds__(kEmitThreads) emit_pairs_kernel(const BinTask task) {
  const int64_t total = task.offsets[task.n];
  if (total > task.capacity) return;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(task.splats);
  const int64_t r = int64_t(blockIdx.x) * kEmitThreads + threadIdx.x;
  // The sort takes all there is room for: what is left over goes to the end.
  for (int64_t k = total + r; k < task.capacity; k += int64_t(gridDim.x) * kEmitThreads) task.tiles[k] = ~0u;
  const int64_t begin = r < task.n ? task.offsets[r] : 0;
  const int count = r < task.n ? int(task.offsets[r + 1] - begin) : 0;
  const int32_t i = count > 0 ? task.order[r] : 0;
  const int columns = task.grid.columns();
  if (count > 0 && task.owners) task.ranges[i].first = int32_t(begin);
  if (count > 0 && count <= kManyTiles) {
    int64_t place = begin;
    for_each_tile(support_of(splats[i]), task.grid, [&](int64_t tile) { write_pair(task, place++, tile, i); });
  }
  for (uint32_t many = __ballot_sync(kAllLanes, count > kManyTiles); many != 0; many &= many - 1) {
    const int source = __ffs(many) - 1;
    const int32_t splat = __shfl_sync(kAllLanes, i, source);
    int64_t place = __shfl_sync(kAllLanes, begin, source);
    const Support<float> support = support_of(splats[splat]);
    const Range rows = clamp_range(rows_of(support), task.grid.height), tile_rows = tiles_of(rows);
    for (int first = tile_rows.first; first <= tile_rows.last; first += 32) {
      const int row = first + lane_id();
      const Range range = row <= tile_rows.last ? tile_columns_of(support, task.grid, rows, row) : Range{0, -1};
      const int width = range.last - range.first + 1;
      int before = width;  // inclusive sum over the lanes
#pragma unroll
      for (int offset = 1; offset < 32; offset *= 2) {
        const int other = __shfl_up_sync(kAllLanes, before, offset);
        if (lane_id() >= offset) before += other;
      }
      int64_t mine = place + before - width;
      for (int c = range.first; c <= range.last; ++c) write_pair(task, mine++, uint32_t(row) * columns + c, splat);
      place += __shfl_sync(kAllLanes, before, 31);
    }
  }
}

template <class F> void emit_pairs(const BinTask& task, cudaStream_t stream) {
  if (task.n == 0) return;
  emit_pairs_kernel<F><<<blocks_of(task.n, kEmitThreads), kEmitThreads, 0, stream>>>(task);
}

}  // namespace ar::cuda
