// For footprints whose samples move: which lists are cut into segments that are worked on side by side, and how a
// kernel finds its segment. moving_list_cut() is the rule; route_of() (dispatch.h) calls it on the host, once for a
// pass, and plan_chunks (plan.cuh) applies it and writes the segments into the chunk plan. ListSegment reads one of
// them there.
#pragma once

#include <algorithm>

#include "cuda/chunk_plan.h"

namespace ar::cuda {

/// A segment of a list that is cut.
struct ListSegment {
  int number;  ///< among all segments; the segments of a list are adjacent
  int tile;    ///< -1: there is no segment of that number
  int index;   ///< in its list: it has pairs [index length, (index + 1) length)

  AR_HD ListSegment(const PlanState& plan, const TileChunk* chunk_order, int number)
      : number(number), tile(-1), index(0) {
    if (number >= plan.counts.segments) return;
    tile = chunk_order[number].tile;
    index = chunk_order[number].chunk;
  }
  /// The number of the first segment of its list.
  AR_HD int first() const { return number - index; }
};

/// Pairs of a segment where `samples` samples move, in tiles of side x side pixels.
AR_HD constexpr int moving_segment(int samples, int side) { return segment_length(samples, side < kMovingTile); }

/// Whether all lists are cut: in small images, whose few tiles have long lists, so that the time is that of the
/// longest. Not with tiles of 4x4 pixels, of which there are four times as many, with shorter lists.
inline bool cuts_all_lists(TileGrid grid) { return is_small_image(grid) && grid.tile_bits >= kMovingTileBits; }

/// How lists are cut, where there is room for `capacity` pairs. In large images only lists are cut that a block would
/// still walk when all others have ended.
inline ListCut moving_list_cut(int samples, int64_t capacity, TileGrid grid, int multiprocessors) {
  const int length = moving_segment(samples, grid.side()), tiles = int(grid.tiles());
  const int64_t segments = capacity / length;
  if (cuts_all_lists(grid)) return {true, 0, 1, length, int(segments + tiles), tiles, longest_list(samples)};
  if (capacity < kLongList) return {true};
  ListCut cut = {true, kLongList, kListBlocksPerSm * multiprocessors, length};
  cut.longest_from = longest_list(samples);
  cut.max_segments = int(cut.segment_limit(capacity));
  cut.max_lists = std::min(cut.max_segments / (kLongList / length), tiles);
  return cut;
}

}  // namespace ar::cuda
