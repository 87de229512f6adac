// A library for project.cuh: finds the SplatTiles (mask, first tile, count) of a support. bin writes a
// pair for each of these tiles.
#pragma once

#include "core/bin.h"
#include "cuda/params.h"

namespace ar::cuda {

__device__ inline SplatTiles splat_tiles_of(const Support<float>& support, TileGrid grid) {
  const TileBox box = find_tiles(support, grid);
  return {box.mask, box.row * grid.columns() + box.column, box.count};
}

}  // namespace ar::cuda
