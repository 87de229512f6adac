// Kernels that plan the blending work: how lists are cut into chunks, and in which order work is begun.
#pragma once

#include "cuda/launch.cuh"
#include "cuda/stages.h"
#include "cuda/warp.cuh"

namespace ar::cuda {

inline constexpr int kCountWorkThreads = 1024, kPlanThreads = 256;

/// The class of a piece of work. Work is handed out by samples, and of those longest first, so that no block starts on
/// a long piece when the others are done. Lengths are classed by powers of two; within a class the order does not
/// matter.
__device__ inline int work_class(int samples, int length) {
  return sample_class(samples) * kLengthClasses + __clz(length);
}

/// Takes a place of the class `of` where `wanted`. Lanes of one class go together: atomics to one place are slow. All
/// lanes must call it.
__device__ inline int take_place(int32_t* next, int of, bool wanted) {
  const uint32_t peers = __match_any_sync(kAllLanes, wanted ? of : -1);
  const int leader = __ffs(int(peers)) - 1;
  int first = 0;
  if (wanted && lane_id() == leader) first = atomicAdd(&next[of], __popc(peers));
  return shuffle(first, leader) + __popc(peers & ((1u << lane_id()) - 1));
}

/// The list of a tile, and how it is cut.
struct PlannedTile {
  int samples, n;  ///< pairs
  int length;      ///< of a chunk

  __device__ PlannedTile(const TileLists& lists, int64_t tile, int most_samples, bool whole) {
    const bool overflow = lists.counts->pairs > lists.capacity;
    n = overflow ? 1 : int(lists.tile_offsets[tile + 1] - lists.tile_offsets[tile]);
    samples = lists.tile_samples ? lists.tile_samples[tile] : most_samples;
    length = whole ? kWholeList : chunk_length(samples);
  }
  __device__ int full() const { return n / length; }
  __device__ int rest() const { return n % length; }
  __device__ int chunks() const { return full() + (rest() > 0); }
};

/// Counts the work of each class, and begins the counts of the plan. A single block.
__global__ void __launch_bounds__(kCountWorkThreads)
    count_work_kernel(const TileLists lists, int64_t tiles, int most_samples, bool whole, PlanState* state) {
  wait_for_earlier_kernels();
  static_assert(kWorkClasses < kCountWorkThreads);
  constexpr int kAtOnce = 8;  // tiles of a thread whose loads wait together
  __shared__ int32_t tile_sizes[kWorkClasses], chunk_sizes[kWorkClasses];
  const int c = threadIdx.x;
  if (c < kWorkClasses) tile_sizes[c] = chunk_sizes[c] = 0;
  __syncthreads();
  for (int64_t first = threadIdx.x; first < tiles; first += kAtOnce * kCountWorkThreads) {
    int n[kAtOnce], samples[kAtOnce];
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) {
      const PlannedTile tile(lists, min(first + k * kCountWorkThreads, tiles - 1), most_samples, whole);
      n[k] = tile.n, samples[k] = tile.samples;
    }
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) {
      if (first + k * kCountWorkThreads >= tiles) break;
      const int length = whole ? kWholeList : chunk_length(samples[k]), full = n[k] / length, rest = n[k] % length;
      atomicAdd(&tile_sizes[work_class(samples[k], n[k])], 1);
      if (full > 0) atomicAdd(&chunk_sizes[work_class(samples[k], length)], full);
      if (rest > 0) atomicAdd(&chunk_sizes[work_class(samples[k], rest)], 1);
    }
  }
  __syncthreads();
  PlanCounts& counts = state->counts;
  const auto begin = [&](const int32_t* sizes, int32_t* next, SampleParts& parts) {
    int all;
    const int first = sum_before<kCountWorkThreads / 32>(c < kWorkClasses ? sizes[c] : 0, 0, all);
    if (c < kWorkClasses) next[c] = first;
    if (c <= kWorkClasses && c % kLengthClasses == 0) parts.first[c / kLengthClasses] = first;
  };
  begin(tile_sizes, state->next.tiles, counts.tiles);
  begin(chunk_sizes, state->next.chunks, counts.chunks);
  if (c < kSampleClasses) counts.open_tiles[c] = 0;
  if (c == 0) counts.planes = counts.tail = 0;
}

/// A tile's chunks [begin, end) and their places in a list of chunks, from `place` on.
struct ChunkRun {
  int place, begin, end;
};
/// Writes the run of each lane; `first`: what chunk 0 would be, `of_chunk`: planes of a chunk. A warp writes long runs
/// together, to neighbouring places. All lanes must call it.
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

/// Places come from atomics: which tile gets which differs from run to run, and changes no result.
__global__ void __launch_bounds__(kPlanThreads) plan_kernel(const TileLists lists, TileGrid grid, int most_samples,
                                                            bool whole, CheckpointLayout layout, const ChunkPlan plan) {
  wait_for_earlier_kernels();
  PlanNext& next = plan.state->next;
  PlanCounts& counts = plan.state->counts;
  const int64_t i = int64_t(blockIdx.x) * kPlanThreads + threadIdx.x;
  const bool valid = i < grid.tiles();
  const auto tile = int32_t(valid ? i : 0);
  const PlannedTile planned(lists, tile, most_samples, whole);
  const int samples = planned.samples, full = valid ? planned.full() : 0, rest = valid ? planned.rest() : 0;
  const int chunks = full + (rest > 0), front = front_chunks(grid, samples), tail = max(chunks - front, 0);
  const int planes = valid && !whole ? layout.tile_planes(grid, samples, chunks) : 0;
  // All atomics first: they wait together.
  const int plane = planes > 0 ? atomicAdd(&counts.planes, planes) : 0;
  const int full_place = full > 0 ? atomicAdd(&next.chunks[work_class(samples, planned.length)], full) : 0;
  const int tail_place = tail > 0 ? atomicAdd(&counts.tail, tail) : 0;
  const int tile_place = take_place(next.tiles, work_class(samples, planned.n), valid);
  const int rest_place = take_place(next.chunks, work_class(samples, rest), rest > 0);
  const int of_chunk = layout.planes(samples);
  const TileChunk first = {tile, 0, plane - layout.first_chunk(grid, samples) * of_chunk};
  if (valid) {
    plan.tile_order[tile_place] = tile;
    plan.tile_planes[tile] = plane;
  }
  write_run(plan.chunk_order, {full_place, 0, full}, first, of_chunk);
  if (rest > 0) plan.chunk_order[rest_place] = {tile, full, first.plane + full * of_chunk};
  write_run(plan.tail, {tail_place, front, front + tail}, first, of_chunk);
}

}  // namespace ar::cuda
