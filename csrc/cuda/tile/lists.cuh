// The list of a tile: its pairs in TileLists, and their rows of pair_grads. The tiles of a patch share one (params.h).
#pragma once

#include "cuda/params.h"

namespace ar::cuda {

/// A tile and its list, front to back.
struct TileList {
  int x0, y0;            ///< first pixel
  const int32_t* pairs;  ///< [count, stride] splats (and slots)
  int stride, count;
  bool of_patch;  ///< some splats do not reach this tile

  __device__ int32_t splat(int k) const { return pairs[int64_t(k) * stride]; }
  __device__ int32_t slot(int k) const { return pairs[int64_t(k) * stride + 1]; }
};

/// A tile among the tiles of its patch.
struct TileInPatch {
  int first_tile;  ///< of the patch
  int tiles;       ///< of the patch
  int index;       ///< of the tile

  __device__ TileInPatch(const TileLists& lists, TileGrid grid, int tile) {
    const int bits = int(lists.counts->patch_bits), side = 1 << bits, columns = grid.columns();
    const int row = tile / columns, column = tile % columns;
    const int first_row = row >> bits << bits, first_column = column >> bits << bits;
    const int width = min(side, columns - first_column);
    first_tile = first_row * columns + first_column;
    tiles = width * min(side, grid.rows() - first_row);
    index = (row - first_row) * width + column - first_column;
  }
};

__device__ inline TileList list_of(const TileLists& lists, TileGrid grid, int tile) {
  TileList list;
  list.x0 = tile % grid.columns() << grid.tile_bits;
  list.y0 = tile / grid.columns() << grid.tile_bits;
  list.of_patch = lists.counts->in_patches(lists.capacity);
  list.stride = lists.stride;
  const int64_t* offsets = lists.tile_offsets + (list.of_patch ? TileInPatch(lists, grid, tile).first_tile : tile);
  list.pairs = lists.pairs + offsets[0] * lists.stride;
  list.count = int(offsets[1] - offsets[0]);
  return list;
}

/// The tile of a chunk that is a whole list; -1: no such chunk. Segments of cut lists have the first numbers.
__device__ inline int listed_tile(const BlendVjpParams& params, int chunk) {
  return chunk < params.plan->counts.chunks ? params.chunk_order[chunk].tile : -1;
}

/// Zeros in `row` of pair_grads, for a pair that no sample composites.
__device__ inline void clear_pair(const BlendVjpParams& params, int64_t row) {
  auto* numbers = reinterpret_cast<float4*>(params.pair_grads + row * kPairGradWidth);
  AR_UNROLL for (int q = 0; q < kPairGradWidth / 4; ++q) numbers[q] = {0, 0, 0, 0};
}

inline constexpr int kClearThreads = kChannelGroup / 4;

/// The same by kClearThreads neighbouring threads, also in channel_sums [rows, kWidth]. `shapes`: in pair_grads.
template <int kWidth> __device__ void clear_pair_together(const BlendVjpParams& params, int64_t row, bool shapes) {
  const int q = threadIdx.x % kClearThreads;
  const float4 zero = {0, 0, 0, 0};
  if (shapes && q < kPairGradWidth / 4) reinterpret_cast<float4*>(params.pair_grads + row * kPairGradWidth)[q] = zero;
  if (params.channel_sums && q < kWidth / 4) reinterpret_cast<float4*>(params.channel_sums + row * kWidth)[q] = zero;
}

/// Writes to rows [, width]. Lists of patches add, as other tiles add too.
__device__ inline void put_sum(float* rows, int width, bool of_patch, int32_t row, int column, float x) {
  float* place = rows + int64_t(row) * width + column;
  if (of_patch) {
    atomicAdd(place, x);
  } else {
    *place = x;
  }
}

}  // namespace ar::cuda
