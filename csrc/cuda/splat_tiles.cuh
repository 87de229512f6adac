// The tiles of a splat: project finds them, and emit_pairs writes a pair for each.
#pragma once

#include "core/bin.h"
#include "cuda/stages.h"

namespace ar::cuda {

/// The tiles that a splat touches.
__device__ inline SplatTiles splat_tiles_of(const Support<float>& support, TileGrid grid) {
  const TileBox box = find_tiles(support, grid);
  return {box.mask, box.row * grid.columns() + box.column, box.count};
}

}  // namespace ar::cuda
