// Structs of the chunk plan: how the lists of tiles are cut into chunks, and in which order work begins. plan_chunks
// (plan.cuh) writes the plan. The kernels of blending read it.
#pragma once

#include <cstdint>

#include "core/stages.h"
#include "cuda/tuning.h"

namespace ar::cuda {

/// Pairs of a chunk of still/: a piece of work of blend_vjp. blend stores checkpoints between chunks.
inline constexpr int kChunkLength = 256;
/// Length of a chunk that holds any list.
inline constexpr int kWholeList = 1 << 30;
/// More pairs than a list has.
inline constexpr int kNoList = 1 << 30;

/// Chunks in the front of a tile: blended one after the other, up to the pair where all pixels have stopped. The chunks
/// of the tail are blended side by side, which takes more work. The front is short if there are too few tiles to fill
/// the device, which works on `blocks_at_once` blocks. Else it is at least the share of a block of all `pairs`. So
/// fewer than blocks_at_once tiles have a tail: those that would keep a block busy when all others have ended.
AR_HD int front_chunks(TileGrid grid, int64_t pairs, int blocks_at_once) {
  constexpr int64_t kMost = 1 << 30;  // with more pairs there are patches, whose lists have no chunks
  if (2 * grid.tiles() <= blocks_at_once) return kShortFront;
  const int share = int(pairs < kMost ? pairs : kMost) / blocks_at_once;
  int front = kLongFront * kChunkLength;
  while (front < share) front *= 2;
  return front / kChunkLength;
}

/// How plan_chunks cuts the lists of tiles into chunks.
struct ListCut {
  bool whole;  ///< moment/, channels/: a chunk is a list that is not long, or a segment of a long list

  // Segments have `segment` pairs and are worked on side by side.
  int at_least = 0, shares = 1, segment = 0;  ///< see long_from().
  int max_segments = 0, max_lists = 0;        ///< Room for segments and their lists; 0: no list is long.
  int longest_from = kNoList;                 ///< The longest lists have so many pairs (a power of two; 0: all)

  /// Most segments where all lists together have so many pairs; only the longest lists are cut then. Room does not
  /// count, so that the same lists are always cut alike.
  AR_HD int64_t segment_limit(int64_t pairs) const {
    if (at_least == 0) return max_segments;
    const int64_t all = pairs / segment + pairs / at_least, few = kSegments + pairs / segment / kPairsPerSegmented;
    return all < few ? all : few;
  }
  /// A list is long from so many pairs on, where all lists have `pairs`: at_least, doubled until it is no smaller than
  /// pairs / shares. A power of two, or 0.
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
  int32_t tail;    ///< chunks of tails

  int32_t cut_lists, segments;  ///< first in ChunkPlan::tile_order, and first in chunk_order
  int32_t longest_lists;        ///< first among the cut lists
  int32_t open_tiles;           ///< tiles with an open sample and more pairs after the front
};

/// Numbers of tiles and of chunks by class of their length (work_class() of plan.cuh).
inline constexpr int kLengthClasses = 33;
struct WorkSizes {
  int32_t tiles[kLengthClasses], chunks[kLengthClasses];
};
/// `counts` for blend and blend_vjp, and scratch of plan_chunks.
struct PlanState {
  static constexpr int kCounters = 8;  ///< blocks of count_work
  PlanCounts counts;
  WorkSizes counted[kCounters];  ///< by each block
  WorkSizes placed;              ///< so far
};

struct TileChunk {
  int32_t tile, chunk;
  int32_t plane;  ///< first plane of the chunk's checkpoints, if the tile has any
};

/// A list that is cut into segments.
struct CutList {
  int32_t tile;
  int32_t first, segments;  ///< chunk_order[first, first + segments)
};
static_assert(sizeof(CutList) == sizeof(TileChunk), "they are rows of one array");

/// Checkpoints of still/: planes of kTile^2 floats per tile, a number of every lane. With `keep`, for a backward pass,
/// a chunk has for every sample its channels and its transmittance. Else a chunk has the transmittance of every sample
/// and one set of channels, and there are only the chunks from the last front chunk on.
struct CheckpointLayout {
  int channels;
  bool keep;

  AR_HD int planes(int samples) const { return keep ? samples * (channels + 1) : samples + channels; }
  /// The first chunk with planes, if the front has `front` chunks.
  AR_HD int first_chunk(int front) const { return keep ? 0 : front - 1; }
  /// Planes of a tile with so many chunks. Without a tail the last chunk needs none.
  AR_HD int tile_planes(int front, int samples, int chunks) const {
    const int used = chunks > front ? chunks - first_chunk(front) : keep ? chunks - 1 : 0;
    return (used > 0 ? used : 0) * planes(samples);
  }
  /// Room for the planes of up to `pairs` pairs. A tile with a tail has at most one plane set more than its pairs fill,
  /// and at most blocks_at_once tiles have a tail. A tile without a tail has no more than its pairs fill.
  int64_t max_planes(TileGrid grid, int samples, int64_t pairs, int blocks_at_once) const {
    const int64_t full = (pairs / kChunkLength + 2) * planes(samples);
    const int64_t with_tail = grid.tiles() < blocks_at_once ? grid.tiles() : blocks_at_once;
    const int64_t rounding = with_tail * planes(samples);
    return full + (rounding < full ? rounding : full);
  }
};

/// The plan.
struct ChunkPlan {
  PlanState* state;        ///< [1]
  TileChunk* chunk_order;  ///< [counts.chunks] longest first
  int32_t* tile_order;     ///< [tiles] longest list first
  int32_t* tile_planes;    ///< [tiles] still/: first plane of a tile

  TileChunk* tail;     ///< [counts.tail] still/: chunks of tails
  CutList* cut_lists;  ///< [counts.cut_lists] moment/: in the order of tile_order
  int blocks_at_once;  ///< kBlocksPerSm per multiprocessor of the device
};

}  // namespace ar::cuda
