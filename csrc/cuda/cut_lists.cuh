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

/// Pairs of a segment where `samples` samples move. Longer ones need fewer maps, which count where there are many
/// samples; shorter ones fill a device with smaller scenes.
AR_HD constexpr int moving_segment(int samples) { return samples == 1 ? 256 : samples <= 4 ? 512 : 1024; }

/// In small images all lists are cut: their few tiles have long ones, and the time is that of the longest. Large ones
/// have many tiles that keep a device busy, and to cut a list takes more work than to walk it. There only those are cut
/// that a block would still walk when all others have ended. A large device holds 528 blocks of 256 threads at once,
/// four on each of 132 multiprocessors, and each of them walks 1/528 of the pairs. So the limit is kLongList, doubled
/// until it is at least pairs / kBlocksAtOnce.
inline constexpr int kLongList = 4096;
inline constexpr int kBlocksAtOnce = 528;
/// Lists of so many pairs would outlast all others in the forward pass if a warp took several of their pixels. So it
/// takes one, each of whose samples has several lanes.
inline constexpr int kLongestList = 16384;

inline ListCut moving_list_cut(int samples, int64_t capacity, TileGrid grid) {
  const int length = moving_segment(samples);
  const int64_t segments = capacity / length, lists = capacity / kLongList;
  if (is_small_image(grid)) return {true, 0, 1, length, int(segments + grid.tiles()), int(grid.tiles()), kLongestList};
  if (lists == 0) return {true};
  ListCut cut = {true, kLongList, kBlocksAtOnce, length};
  cut.longest_from = kLongestList;
  cut.max_segments = int(cut.segment_limit(capacity));
  cut.max_lists = int(std::min<int64_t>(cut.max_segments / (kLongList / length), grid.tiles()));
  return cut;
}

}  // namespace ar::cuda
