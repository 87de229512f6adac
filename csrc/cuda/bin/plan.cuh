// Kernels that write the ChunkPlan (chunk_plan.h): count_work counts tiles and chunks by length, plan orders them.
#pragma once

#include "cuda/bin/policy.h"
#include "cuda/launch.cuh"
#include "cuda/params.h"
#include "cuda/warp.cuh"

namespace ar::cuda {

/// Longer work has a lower class, and begins first.
__device__ inline int work_class(int length) { return __clz(length); }

/// The next index in class `of`, if `wanted`, with an atomic per class of a warp.
__device__ inline int take_place(int32_t* next, int of, bool wanted) {
  const uint32_t peers = __match_any_sync(kAllLanes, wanted ? of : -1);
  const int leader = __ffs(int(peers)) - 1;
  int first = 0;
  if (wanted && lane_id() == leader) first = atomicAdd(&next[of], __popc(peers));
  return shuffle(first, leader) + __popc(peers & ((1u << lane_id()) - 1));
}

struct PlannedTile {
  int n;         ///< pairs
  int length;    ///< pairs of a chunk
  bool is_long;  ///< by ListCut::long_from()

  __device__ PlannedTile(const TileLists& lists, int64_t tile, const ListCut& cut) {
    const bool in_patches = lists.counts->in_patches(lists.capacity);
    n = in_patches ? 1 : int(lists.tile_offsets[tile + 1] - lists.tile_offsets[tile]);
    is_long = cut.max_segments > 0 && !in_patches && n >= cut.long_from(lists.counts->pairs);
    length = is_long ? cut.segment : cut.whole ? kWholeList : kChunkLength;
  }
  /// Full chunks, and the last segment of a long list.
  __device__ int full() const { return (is_long ? n + length - 1 : n) / length; }
  __device__ int rest() const { return is_long ? 0 : n % length; }
  /// Segments have the class of their list.
  __device__ int full_class() const { return work_class(is_long ? n : length); }
};

__global__ void __launch_bounds__(PlanPolicy::kCountThreads)
    count_work_kernel(const TileLists lists, int64_t tiles, ListCut cut, PlanState* state) {
  wait_for_earlier_kernels();
  static_assert(kLengthClasses < PlanPolicy::kCountThreads);
  __shared__ WorkSizes sizes;
  const int c = threadIdx.x;
  if (c < kLengthClasses) sizes.tiles[c] = sizes.chunks[c] = 0;
  __syncthreads();
  const int64_t stride = int64_t(gridDim.x) * PlanPolicy::kCountThreads;
  for (int64_t first = blockIdx.x * PlanPolicy::kCountThreads + threadIdx.x; first < tiles;
       first += PlanPolicy::kTilesAtOnce * stride) {
    const auto planned = [&](int64_t tile) { return PlannedTile(lists, min(tile, tiles - 1), cut); };
    const PlannedTile at_once[PlanPolicy::kTilesAtOnce] = {planned(first), planned(first + stride)};
    AR_UNROLL for (int k = 0; k < PlanPolicy::kTilesAtOnce; ++k) {
      if (first + k * stride >= tiles) break;
      const PlannedTile& tile = at_once[k];
      const int full = tile.full(), rest = tile.rest();
      atomicAdd(&sizes.tiles[work_class(tile.n)], 1);
      if (full > 0) atomicAdd(&sizes.chunks[tile.full_class()], full);
      if (rest > 0) atomicAdd(&sizes.chunks[work_class(rest)], 1);
    }
  }
  __syncthreads();
  if (c < kLengthClasses) {
    WorkSizes& counted = state->counted[blockIdx.x];
    counted.tiles[c] = sizes.tiles[c], counted.chunks[c] = sizes.chunks[c];
  }
  if (blockIdx.x != 0) return;
  PlanCounts& counts = state->counts;
  if (c < kLengthClasses) state->placed.tiles[c] = state->placed.chunks[c] = 0;
  if (c == 0) counts.planes = counts.tail = counts.open_tiles = 0;
}

/// Of class threadIdx.x; `of`: tiles or chunks.
template <class Of> __device__ int size_of_class(const PlanState& state, Of&& of) {
  static_assert(kLengthClasses < PlanPolicy::kThreads);
  const int c = threadIdx.x;
  int size = 0;
  AR_UNROLL for (int k = 0; k < PlanState::kCounters; ++k) size += c < kLengthClasses ? of(state.counted[k])[c] : 0;
  return size;
}

/// Long lists are cut, longest class first, up to the limit of segments.
struct CutClasses {
  int lists = 0, segments = 0, longest = 0;
  int chunks_of_class;  ///< of this thread's class

  /// lists_of_class, counted: of this thread's class. All threads must call it.
  __device__ CutClasses(const ListCut& cut, const TileLists& tile_lists, int lists_of_class, int counted)
      : chunks_of_class(counted) {
    const int64_t pairs = tile_lists.counts->pairs;
    if (cut.max_segments == 0 || tile_lists.counts->in_patches(tile_lists.capacity)) return;
    constexpr int kWarps = PlanPolicy::kThreads / 32;
    const int of_length = threadIdx.x;  // beyond the classes both sizes are 0
    const bool are_long = of_length <= __clz(cut.long_from(pairs));
    int all;
    const int up_to = counted + sum_before<kWarps>(are_long ? counted : 0, 0, all);
    const bool are_cut = are_long && up_to <= min(int64_t(cut.max_segments), cut.segment_limit(pairs));
    if (are_long && !are_cut) chunks_of_class = lists_of_class;
    sum_before<kWarps>(are_cut ? lists_of_class : 0, 0, lists);
    sum_before<kWarps>(are_cut ? counted : 0, 0, segments);
    sum_before<kWarps>(are_cut && of_length <= __clz(cut.longest_from) ? lists_of_class : 0, 0, longest);
  }
};

/// `size`: of this thread's class. Returns the size of all. All threads must call it, then __syncthreads().
__device__ inline int find_begins(int size, int32_t (&begins)[kLengthClasses]) {
  const int c = threadIdx.x;
  int all;
  const int first = sum_before<PlanPolicy::kThreads / 32>(size, 0, all);
  if (c < kLengthClasses) begins[c] = first;
  return all;
}

/// Chunks [begin, end) of a tile, at index `place` of a list.
struct ChunkRun {
  int place, begin, end;
};
/// A warp writes long runs together. `first`: what chunk 0 would be. `of_chunk`: planes of a chunk.
__device__ inline void write_run(TileChunk* list, const ChunkRun& run, const TileChunk& first, int of_chunk) {
  constexpr int kMany = 4;
  const bool many = run.end - run.begin > kMany;
  for (int k = run.begin; k < run.end && !many; ++k)
    list[run.place + k - run.begin] = {first.tile, k, first.plane + k * of_chunk};
  for (uint32_t lanes = __brev(__ballot_sync(kAllLanes, many)); lanes != 0;) {
    const int lane = take_first(lanes), begin = shuffle(run.begin, lane), end = shuffle(run.end, lane);
    const int place = shuffle(run.place, lane) - begin, tile = shuffle(first.tile, lane);
    const int plane = shuffle(first.plane, lane), step = shuffle(of_chunk, lane);
    for (int k = begin + lane_id(); k < end; k += 32) list[place + k] = {tile, k, plane + k * step};
  }
}

/// A thread per tile. Atomics hand out indices, whose order changes no result. `samples`: of a lane.
__global__ void __launch_bounds__(PlanPolicy::kThreads)
    plan_kernel(const TileLists lists, TileGrid grid, int samples, ListCut cut, CheckpointLayout layout,
                const ChunkPlan plan) {
  wait_for_earlier_kernels();
  __shared__ WorkSizes begins;
  WorkSizes& placed = plan.state->placed;
  PlanCounts& counts = plan.state->counts;
  const int64_t i = int64_t(blockIdx.x) * PlanPolicy::kThreads + threadIdx.x;
  const bool valid = i < grid.tiles();
  const auto tile = int32_t(valid ? i : 0);
  const PlannedTile planned(lists, tile, cut);
  const int full = valid ? planned.full() : 0, rest = valid ? planned.rest() : 0;
  const int chunks = full + (rest > 0), front = front_chunks(grid, lists.counts->pairs, plan.blocks_at_once);
  const int tail = cut.whole ? 0 : max(chunks - front, 0);
  const int planes = valid && !cut.whole ? layout.tile_planes(front, samples, chunks) : 0;
  // All atomics first: they wait together.
  const int full_class = planned.full_class(), rest_class = work_class(rest);
  const int tile_class = work_class(planned.n);
  const int plane = planes > 0 ? atomicAdd(&counts.planes, planes) : 0;
  const int full_place = full > 0 ? atomicAdd(&placed.chunks[full_class], full) : 0;
  const int tail_place = tail > 0 ? atomicAdd(&counts.tail, tail) : 0;
  const int tile_place = take_place(placed.tiles, tile_class, valid);
  const int rest_place = take_place(placed.chunks, rest_class, rest > 0);
  const int tiles_of_class = size_of_class(*plan.state, [](auto& sizes) { return sizes.tiles; });
  const int chunks_of_class = size_of_class(*plan.state, [](auto& sizes) { return sizes.chunks; });
  const CutClasses cut_classes(cut, lists, tiles_of_class, chunks_of_class);
  find_begins(tiles_of_class, begins.tiles);
  const int all_chunks = find_begins(cut_classes.chunks_of_class, begins.chunks);
  __syncthreads();
  const int of_chunk = layout.planes(samples);
  const TileChunk first = {tile, 0, plane - layout.first_chunk(front) * of_chunk};
  const int place = begins.tiles[tile_class] + tile_place;
  const bool is_cut = planned.is_long && begins.tiles[tile_class] < cut_classes.lists;
  const ChunkRun as_one = {begins.chunks[tile_class] + tile_place, 0, min(full, 1)};
  const ChunkRun run = planned.is_long && !is_cut ? as_one : ChunkRun{begins.chunks[full_class] + full_place, 0, full};
  if (valid) {
    plan.tile_order[place] = tile;
    plan.tile_planes[tile] = plane;
    if (is_cut) plan.cut_lists[place] = {tile, run.place, full};
  }
  if (i == 0) {
    counts.cut_lists = cut_classes.lists, counts.longest_lists = cut_classes.longest;
    counts.segments = cut_classes.segments, counts.chunks = all_chunks;
  }
  write_run(plan.chunk_order, run, first, of_chunk);
  if (rest > 0) plan.chunk_order[begins.chunks[rest_class] + rest_place] = {tile, full, first.plane + full * of_chunk};
  write_run(plan.tail, {tail_place, front, front + tail}, first, of_chunk);
}

}  // namespace ar::cuda
