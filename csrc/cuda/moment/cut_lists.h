// Which lists of moment/ are cut into segments, worked on side by side, by the image's size and the room for pairs.
// ListSegment finds a segment in the chunk plan.
#pragma once

#include <algorithm>

#include "cuda/bin/chunk_plan.h"
#include "cuda/moment/policy.h"

namespace ar::cuda {

/// Of a list that is cut.
struct ListSegment {
  int number;  ///< among all segments
  int tile;    ///< -1: there is no segment of that number
  int index;   ///< in its list, from pair index * length on

  AR_HD ListSegment(const PlanState& plan, const TileChunk* chunk_order, int number)
      : number(number), tile(-1), index(0) {
    if (number >= plan.counts.segments) return;
    tile = chunk_order[number].tile;
    index = chunk_order[number].chunk;
  }
  /// Number of the first segment of its list.
  AR_HD int first() const { return number - index; }
};

/// Pairs of a segment.
AR_HD constexpr int moving_segment(int samples, int side) {
  return MomentPolicy::segment_length(samples, side < kMovingTile);
}

/// In small images the longest list sets the time. Tiles of 4x4 pixels have short lists.
inline bool cuts_all_lists(TileGrid grid) { return is_small_image(grid) && grid.tile_bits >= kMovingTileBits; }

/// `capacity`: room for pairs. In large images lists are cut whose blocks would outlast all others.
inline ListCut moving_list_cut(int samples, int64_t capacity, TileGrid grid, int multiprocessors) {
  const int length = moving_segment(samples, grid.side()), tiles = int(grid.tiles());
  const int64_t segments = capacity / length;
  if (cuts_all_lists(grid))
    return {true, 0, 1, length, int(segments + tiles), tiles, MomentPolicy::longest_list(samples)};
  if (capacity < MomentPolicy::kLongList) return {true};
  ListCut cut = {true, MomentPolicy::kLongList, MomentPolicy::kListBlocksPerSm * multiprocessors, length};
  cut.longest_from = MomentPolicy::longest_list(samples);
  cut.max_segments = int(cut.segment_limit(capacity));
  cut.max_lists = std::min(cut.max_segments / (MomentPolicy::kLongList / length), tiles);
  return cut;
}

}  // namespace ar::cuda
