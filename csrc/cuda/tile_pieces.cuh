// The lists of tiles cut into pieces of equal length, for kernels that have a block for each.
#pragma once

#include "cuda/composite.cuh"

namespace ar::cuda {

/// Number of the first piece of a tile. The pieces of a tile follow each other; the host, which does not know how many
/// there are, makes room for max_pieces.
__device__ inline int64_t first_piece(const TileLists& lists, int length, int tile) {
  return lists.tile_offsets[tile] / length + tile;
}

struct TilePiece {
  int tile, index;  ///< pairs [index length, (index + 1) length) of the tile's list
};

/// The piece of that number, or a tile of -1: there is none, or there were too many pairs. All lanes must call it.
__device__ inline TilePiece find_piece(const TileLists& lists, TileGrid grid, int length, int64_t number) {
  if (lists.counts->pairs > lists.capacity) return {-1, 0};
  // The last tile whose first piece is not behind `number`.
  const auto begins = [&](int tile) { return first_piece(lists, length, tile) <= number; };
  const int tile = partition_point<32>(int(grid.tiles()), begins) - 1;
  const int64_t index = number - first_piece(lists, length, tile);
  const int64_t count = lists.tile_offsets[tile + 1] - lists.tile_offsets[tile];
  return {index * length < count ? tile : -1, int(index)};
}

}  // namespace ar::cuda
