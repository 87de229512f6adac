// How the lists of tiles are cut into chunks, and in which order the work is begun: what plan_chunks makes (plan.cuh)
// and the kernels of blending read.
#pragma once

#include <cstdint>

#include "core/stages.h"
#include "cuda/tuning.h"

namespace ar::cuda {

/// Pairs of a chunk: what blend_vjp works on as one piece, and between which blend stores checkpoints.
inline constexpr int kChunkLength = 256;
/// Length of a chunk that holds any list.
inline constexpr int kWholeList = 1 << 30;
/// More pairs than a list has.
inline constexpr int kNoList = 1 << 30;

/// Chunks of a tile that blend goes through one after the other, which reads no pair after the point where all pixels
/// have stopped. The remaining chunks are blended side by side, which takes more work. Few tiles cannot fill the device
/// (`blocks_at_once`: the blocks that it works on at once), so that their front is short. Else the front is so long
/// that fewer than blocks_at_once tiles have a tail: only a tile whose list is longer than a block's share of all
/// pairs, which would keep its block busy when the others have ended. `pairs`: of the whole image.
AR_HD int front_chunks(TileGrid grid, int64_t pairs, int blocks_at_once) {
  constexpr int64_t kMost = 1 << 30;  // with more, tiles share lists, which have no chunks
  if (2 * grid.tiles() <= blocks_at_once) return kShortFront;
  const int share = int(pairs < kMost ? pairs : kMost) / blocks_at_once;
  int front = kLongFront * kChunkLength;
  while (front < share) front *= 2;
  return front / kChunkLength;
}

/// How plan_chunks cuts the lists of tiles into chunks.
struct ListCut {
  bool whole;  ///< a chunk is a whole list, unless that is long; else it has kChunkLength pairs, and no list is long
  /// Long lists are cut into chunks of `segment` pairs, called segments, that are worked on side by side. Lists are
  /// long from long_from() pairs on, which `at_least` and `shares` decide; with at_least 0 all are.
  int at_least = 0, shares = 1, segment = 0;
  /// Segments and lists for which there is memory: for all that may be cut. Without any no list is.
  int max_segments = 0, max_lists = 0;
  /// Lists of so many pairs, a power of two, or more are counted among the longest; 0: all that are long.
  int longest_from = kNoList;

  /// The most segments that are made where all lists together have so many pairs. If the long lists need more, only the
  /// longest of them are cut. It does not depend on how much memory there is, so that the same lists are always cut in
  /// the same way.
  AR_HD int64_t segment_limit(int64_t pairs) const {
    if (at_least == 0) return max_segments;
    const int64_t all = pairs / segment + pairs / at_least, few = kSegments + pairs / segment / kPairsPerSegmented;
    return all < few ? all : few;
  }
  /// The number of pairs from which on a list is long, where there are `pairs` in all: at_least, doubled until it is no
  /// smaller than pairs / shares. So it is a power of two, or 0.
  AR_HD int long_from(int64_t pairs) const {
    int64_t from = at_least;
    while (from > 0 && from < pairs / shares) from *= 2;
    return int(from);
  }
};

/// What plan_chunks and blend count.
struct PlanCounts {
  int32_t planes;  ///< of checkpoints
  int32_t chunks;  ///< in ChunkPlan::chunk_order
  int32_t tail;    ///< chunks after the front ones
  /// Lists that are cut, which are the first of ChunkPlan::tile_order, and their segments, the first of chunk_order.
  int32_t cut_lists, segments;
  int32_t longest_lists;  ///< the first of those that are cut: of ListCut::longest_from pairs or more
  int32_t open_tiles;     ///< tiles that have an open sample and more pairs after their front chunks
};

/// Tiles and chunks by the class of their length, a power of two.
inline constexpr int kLengthClasses = 33;
struct WorkSizes {
  int32_t tiles[kLengthClasses], chunks[kLengthClasses];
};
/// The counts stay for blend_vjp, the rest is scratch of plan_chunks.
struct PlanState {
  static constexpr int kCounters = 8;  ///< blocks that count work
  PlanCounts counts;
  WorkSizes counted[kCounters];  ///< by each of these blocks
  WorkSizes placed;              ///< so far
};

struct TileChunk {
  int32_t tile, chunk;
  int32_t plane;  ///< first plane of its checkpoints, if the tile has any
};

/// A list that is cut into segments (ListCut).
struct CutList {
  int32_t tile;
  int32_t first, segments;  ///< the place of the first of its segments, which follow each other, and how many there are
};
static_assert(sizeof(CutList) == sizeof(TileChunk), "they are rows of one array");

/// How the state of a tile's pixels between chunks lies in memory: planes of kTile^2 floats. For a backward pass a
/// chunk's planes hold, for each sample and pixel, its channels and its transmittance. Without one they are the
/// transmittance of each sample and a single set of channels, and only the last front chunk and those behind have any.
struct CheckpointLayout {
  int channels;
  bool keep;

  AR_HD int planes(int samples) const { return keep ? samples * (channels + 1) : samples + channels; }
  /// The first chunk with planes, where there are `front` chunks in front of the tail.
  AR_HD int first_chunk(int front) const { return keep ? 0 : front - 1; }
  /// Planes of a tile with so many chunks. The last chunk needs none where no sample is left open in front of it.
  AR_HD int tile_planes(int front, int samples, int chunks) const {
    const int used = chunks > front ? chunks - first_chunk(front) : keep ? chunks - 1 : 0;
    return (used > 0 ? used : 0) * planes(samples);
  }
  /// No fewer planes than plan_chunks makes of `pairs` pairs, or of fewer, where no tile has more than `samples`. A
  /// tile of x chunks of pairs, rounded up to less than x + 1, has no more than that many planes where it has a tail,
  /// as no more than blocks_at_once tiles do; and no more than x where it has none.
  int64_t max_planes(TileGrid grid, int samples, int64_t pairs, int blocks_at_once) const {
    const int64_t full = (pairs / kChunkLength + 2) * planes(samples);
    const int64_t with_tail = grid.tiles() < blocks_at_once ? grid.tiles() : blocks_at_once;
    const int64_t rounding = with_tail * planes(samples);
    return full + (rounding < full ? rounding : full);
  }
};

/// How the lists are cut into chunks, and in which order work is begun; made by plan_chunks.
struct ChunkPlan {
  PlanState* state;
  TileChunk* chunk_order;  ///< [chunks] longest first
  int32_t* tile_order;     ///< [tiles] longest list first
  int32_t* tile_planes;    ///< [tiles] first plane of a tile's checkpoints, if it has any
  TileChunk* tail;         ///< [counts.tail] chunks behind the front ones, or null where chunks are whole lists
  CutList* cut_lists;      ///< [counts.cut_lists] in the order of their tiles in tile_order, or null
  int blocks_at_once;      ///< kBlocksPerSm for each multiprocessor of the device
};

}  // namespace ar::cuda
