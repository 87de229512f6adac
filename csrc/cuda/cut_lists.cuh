// The lists of tiles that are cut into segments, which kernels work on side by side.
#pragma once

#include <algorithm>

#include "cuda/composite.cuh"

namespace ar::cuda {

/// A segment of a list that is cut.
struct ListSegment {
  int number;  ///< among all segments; those of a list follow each other
  int tile;    ///< -1: there is no segment of that number
  int index;   ///< pairs [index length, (index + 1) length) of the tile's list

  __device__ ListSegment(const PlanState& plan, const TileChunk* chunk_order, int number)
      : number(number), tile(-1), index(0) {
    if (number >= plan.counts.segments) return;
    tile = chunk_order[number].tile;
    index = chunk_order[number].chunk;
  }
  /// The number of the first segment of its list.
  __device__ int first() const { return number - index; }
};

/// Pairs of a segment where `samples` samples move, in tiles of side x side pixels. Longer ones need fewer maps, which
/// count where there are many samples; shorter ones fill a device with smaller scenes.
AR_HD constexpr int moving_segment(int samples, int side) {
  if (samples == 1 || side < kMovingTile) return 256;
  return samples <= 4 ? 512 : 1024;
}

/// In small images all lists are cut: their few tiles have long ones, and the time is that of the longest. Not so with
/// tiles of 4x4 pixels, of which there are four times as many, with shorter lists: of these only long ones are cut.
inline bool cuts_all_lists(TileGrid grid) { return is_small_image(grid) && grid.tile_bits >= kMovingTileBits; }

/// Elsewhere many tiles keep a device busy, and to cut a list takes more work than to walk it. There only those are cut
/// that a block would still walk when all others have ended. A large device holds 528 blocks of 256 threads at once,
/// four on each of 132 multiprocessors, and each of them walks 1/528 of the pairs. So the limit is kLongList, doubled
/// until it is at least pairs / kBlocksAtOnce.
inline constexpr int kLongList = 4096;
inline constexpr int kBlocksAtOnce = 528;
/// Lists of so many pairs or more would outlast all others in the forward pass if a warp took several of their pixels.
/// So it takes one, or some samples of one, each of which has many lanes. With more than four samples that is so for
/// all lists that are cut.
AR_HD constexpr int longest_list(int samples) { return samples <= 4 ? 16384 : 0; }

inline ListCut moving_list_cut(int samples, int64_t capacity, TileGrid grid) {
  const int length = moving_segment(samples, grid.side()), tiles = int(grid.tiles());
  const int64_t segments = capacity / length;
  if (cuts_all_lists(grid)) return {true, 0, 1, length, int(segments + tiles), tiles, longest_list(samples)};
  if (capacity < kLongList) return {true};
  ListCut cut = {true, kLongList, kBlocksAtOnce, length};
  cut.longest_from = longest_list(samples);
  cut.max_segments = int(cut.segment_limit(capacity));
  cut.max_lists = std::min(cut.max_segments / (kLongList / length), tiles);
  return cut;
}

}  // namespace ar::cuda
