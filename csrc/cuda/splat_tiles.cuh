// The tiles of a splat: project finds them, and emit_pairs writes a pair for each.
#pragma once

#include "core/bin.h"
#include "cuda/stages.h"

namespace ar::cuda {

/// The tiles that a splat touches.
__device__ inline SplatTiles find_tiles(const Support<float>& support, TileGrid grid) {
  // A mask has room for 8x8 tiles, from the first of those that the support's bounding box touches.
  const Range rows = tiles_of(clamp_range(rows_of(support), grid.height), grid);
  const float half = support.half_width + support.reach;
  const Span<float> columns = {support.mean.x - half, support.mean.x + half};
  const int left = tiles_of(clamp_range(columns, grid.width), grid).first;
  SplatTiles found = {0, rows.first * grid.columns() + left, 0};
  int begin = 0, end = 0;  // of all columns, from `left`; rounding may put one in front of the bounding box
  for_each_tile_row(support, grid, [&](int, Range range) {
    const int first = range.first - left, width = range.last - range.first + 1;
    uint32_t bits = 0;
    if (width > 0) {
      found.count += width;
      begin = min(begin, first), end = max(end, first + width);
      bits = ((1u << width % 32) - 1) << first % 32u;
    }
    found.mask = found.mask >> 8 | TileMask(bits) << 56;
  });
  const int count = rows.last - rows.first + 1;
  const bool fits = begin == 0 && end <= 8 && count <= 8 && found.count <= kManyTiles;
  found.mask = fits && count > 0 ? found.mask >> 8 * (8 - count) : 0;
  return found;
}

}  // namespace ar::cuda
