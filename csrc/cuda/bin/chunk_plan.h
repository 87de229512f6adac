// How lists are cut into chunks (front_chunks, ListCut), the order of work (ChunkPlan, written by plan.cuh), and where
// checkpoints of still/ lie (CheckpointLayout).
#pragma once

#include <cstdint>

#include "core/stages.h"
#include "cuda/moment/policy.h"
#include "cuda/still/policy.h"

namespace ar::cuda {

/// Blocks of 256 threads that fill a multiprocessor. Results depend on it in last bits.
inline constexpr int kBlocksPerSm = 8;
/// Pairs of a chunk of still/: the work of a warp of blend_vjp.
inline constexpr int kChunkLength = 256;
inline constexpr int kWholeList = 1 << 30;
inline constexpr int kNoList = 1 << 30;

/// Chunks in the front of a tile. The others, the tail, are blended side by side, which is more work. The front is
/// short if tiles cannot fill the device, else a block's share of `pairs` or more: fewer than blocks_at_once tiles have
/// a tail.
AR_HD int front_chunks(TileGrid grid, int64_t pairs, int blocks_at_once) {
  constexpr int64_t kMost = 1 << 30;  // with more pairs there are patches
  if (2 * grid.tiles() <= blocks_at_once) return StillPolicy::kShortFront;
  const int share = int(pairs < kMost ? pairs : kMost) / blocks_at_once;
  int front = StillPolicy::kLongFront * kChunkLength;
  while (front < share) front *= 2;
  return front / kChunkLength;
}

struct ListCut {
  bool whole;  ///< moment/, channels/: chunks are lists, or segments of long lists

  int at_least = 0, shares = 1, segment = 0;  ///< see long_from()
  int max_segments = 0, max_lists = 0;        ///< room; 0: no list is long
  int longest_from = kNoList;                 ///< pairs of the longest lists: a power of two; 0: all lists

  /// Most segments if all lists have `pairs`. Not by room: the same lists are cut alike.
  AR_HD int64_t segment_limit(int64_t pairs) const {
    if (at_least == 0) return max_segments;
    const int64_t all = pairs / segment + pairs / at_least;
    const int64_t few = MomentPolicy::kSegments + pairs / segment / MomentPolicy::kPairsPerSegmented;
    return all < few ? all : few;
  }
  /// Least pairs of a long list, if all lists have `pairs`: at_least, doubled until it is pairs / shares or more.
  AR_HD int long_from(int64_t pairs) const {
    int64_t from = at_least;
    while (from > 0 && from < pairs / shares) from *= 2;
    return int(from);
  }
};

struct PlanCounts {
  int32_t planes;  ///< of checkpoints
  int32_t chunks;  ///< in ChunkPlan::chunk_order
  int32_t tail;    ///< chunks of tails

  int32_t cut_lists, segments;  ///< the first of ChunkPlan::tile_order, and of chunk_order
  int32_t longest_lists;        ///< the first of these
  int32_t open_tiles;           ///< open after the front
};

/// Numbers of tiles and chunks by length (work_class() of plan.cuh).
inline constexpr int kLengthClasses = 33;
struct WorkSizes {
  int32_t tiles[kLengthClasses], chunks[kLengthClasses];
};
struct PlanState {
  static constexpr int kCounters = 8;  ///< blocks of count_work
  PlanCounts counts;
  WorkSizes counted[kCounters];  ///< by each block
  WorkSizes placed;              ///< so far
};

struct TileChunk {
  int32_t tile, chunk;
  int32_t plane;  ///< still/: first plane of its checkpoints
};

struct CutList {
  int32_t tile;
  int32_t first, segments;  ///< chunk_order[first, first + segments)
};
static_assert(sizeof(CutList) == sizeof(TileChunk), "they are rows of one array");

/// Checkpoints of still/: planes of kTile^2 floats, a number of every lane. With `keep` (a backward pass) a chunk has
/// channels and transmittance of every sample. Else it has one set of channels, and only the last front chunk and the
/// tail have planes.
struct CheckpointLayout {
  int channels;
  bool keep;

  AR_HD int planes(int samples) const { return keep ? samples * (channels + 1) : samples + channels; }
  /// The first chunk with planes. `front`: front_chunks().
  AR_HD int first_chunk(int front) const { return keep ? 0 : front - 1; }
  /// Without a tail the last chunk needs no planes.
  AR_HD int tile_planes(int front, int samples, int chunks) const {
    const int used = chunks > front ? chunks - first_chunk(front) : keep ? chunks - 1 : 0;
    return (used > 0 ? used : 0) * planes(samples);
  }
  /// For up to `pairs` pairs. Rounding adds a chunk to tiles with a tail: at most blocks_at_once.
  int64_t max_planes(TileGrid grid, int samples, int64_t pairs, int blocks_at_once) const {
    const int64_t full = (pairs / kChunkLength + 2) * planes(samples);
    const int64_t with_tail = grid.tiles() < blocks_at_once ? grid.tiles() : blocks_at_once;
    const int64_t rounding = with_tail * planes(samples);
    return full + (rounding < full ? rounding : full);
  }
};

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
