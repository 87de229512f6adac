// Launches of bin: sorts, pairs, and the plan of the blending work.
#include <algorithm>

#include "cuda/bin.cuh"
#include "cuda/launch.cuh"

namespace ar::cuda {
namespace {

constexpr int kPlanThreads = 256;

/// Work is handed out by samples, and of those longest first, so that no block starts on a long piece when the others
/// are done. Lengths are classed by powers of two; within a class the order does not matter.
struct WorkClasses {
  __device__ static int of(int samples, int length) { return sample_class(samples) * kLengthClasses + __clz(length); }
  /// Adds a piece to its class and returns how many were there. Lanes of one class go together: atomics to one place
  /// are slow.
  __device__ static int take(int32_t* classes, int of) {
    const uint32_t peers = __match_any_sync(__activemask(), of);
    const int leader = __ffs(peers) - 1;
    int first = 0;
    if (lane_id() == leader) first = atomicAdd(&classes[of], __popc(peers));
    return __shfl_sync(peers, first, leader) + __popc(peers & ((1u << lane_id()) - 1));
  }
};

__device__ int list_length(const TileLists& lists, int64_t tile) {
  if (lists.counts->pairs > lists.capacity) return 1;
  return int(lists.tile_offsets[tile + 1] - lists.tile_offsets[tile]);
}

__device__ int samples_of(const TileLists& lists, int64_t tile, int most) {
  return lists.tile_samples ? lists.tile_samples[tile] : most;
}

/// Pairs of a chunk of a tile with so many samples.
__device__ int piece_length(int samples, bool whole) { return whole ? kWholeList : chunk_length(samples); }

__global__ void __launch_bounds__(kPlanThreads)
    count_work_kernel(const TileLists lists, int64_t tiles, int most_samples, bool whole, PlanCounters* counters) {
  const int64_t tile = int64_t(blockIdx.x) * kPlanThreads + threadIdx.x;
  if (tile >= tiles) return;
  const int samples = samples_of(lists, tile, most_samples), length = piece_length(samples, whole);
  const int n = list_length(lists, tile);
  WorkClasses::take(counters->tile_sizes, WorkClasses::of(samples, n));
  if (n >= length) atomicAdd(&counters->chunk_sizes[WorkClasses::of(samples, length)], n / length);
  if (n % length) WorkClasses::take(counters->chunk_sizes, WorkClasses::of(samples, n % length));
}

/// Places come from atomics: which tile gets which differs from run to run, and changes no result.
__global__ void __launch_bounds__(kPlanThreads) plan_kernel(const TileLists lists, TileGrid grid, int most_samples,
                                                            bool whole, CheckpointLayout layout, const ChunkPlan plan) {
  static_assert(kWorkClasses < kPlanThreads);
  __shared__ int tile_base[kWorkClasses], chunk_base[kWorkClasses];
  PlanCounters& counters = plan.state->counters;
  PlanCounts& counts = plan.state->counts;
  const auto find_bases = [&](const int32_t* sizes, int* base, SampleParts& parts) {
    const int c = threadIdx.x;
    int all;
    const int first = sum_before<kPlanThreads / 32>(c < kWorkClasses ? sizes[c] : 0, 0, all);
    if (c < kWorkClasses) base[c] = first;
    if (blockIdx.x == 0 && c <= kWorkClasses && c % kLengthClasses == 0) parts.first[c / kLengthClasses] = first;
    __syncthreads();
  };
  find_bases(counters.tile_sizes, tile_base, counts.tiles);
  find_bases(counters.chunk_sizes, chunk_base, counts.chunks);
  const int64_t tile = int64_t(blockIdx.x) * kPlanThreads + threadIdx.x;
  if (tile >= grid.tiles()) return;
  const int samples = samples_of(lists, tile, most_samples), length = piece_length(samples, whole);
  const int n = list_length(lists, tile), full = n / length, chunks = (n + length - 1) / length;
  const int tile_class = WorkClasses::of(samples, n);
  plan.tile_order[tile_base[tile_class] + WorkClasses::take(counters.tile_places, tile_class)] = int32_t(tile);
  const int planes = whole ? 0 : layout.tile_planes(grid, samples, chunks);
  const int plane = planes > 0 ? atomicAdd(&counts.planes, planes) : 0;
  plan.tile_planes[tile] = plane;
  const int first = layout.first_chunk(grid, samples), of_chunk = layout.planes(samples);
  const auto part = [&](int chunk) { return TileChunk{int32_t(tile), chunk, plane + (chunk - first) * of_chunk}; };
  if (full > 0) {
    const int c = WorkClasses::of(samples, length);
    TileChunk* order = plan.chunk_order + chunk_base[c] + atomicAdd(&counters.chunk_places[c], full);
    for (int chunk = 0; chunk < full; ++chunk) order[chunk] = part(chunk);
  }
  if (n % length) {
    const int c = WorkClasses::of(samples, n % length);
    plan.chunk_order[chunk_base[c] + WorkClasses::take(counters.chunk_places, c)] = part(full);
  }
  const int front = front_chunks(grid, samples);
  if (chunks > front) {
    TileChunk* tail = plan.tail + atomicAdd(&counts.tail, chunks - front);
    for (int chunk = front; chunk < chunks; ++chunk) tail[chunk - front] = part(chunk);
  }
}

template <class Value>
void sort_values(const TileSort<Value>& p, TileGrid grid, uint32_t* memory, cudaStream_t stream) {
  const int passes = tile_passes(grid);
  const TileScratch scratch(memory, p.capacity, passes);
  for (int pass = 0; pass < passes; ++pass) {
    // After an overflow the histograms are empty, and with them the sort.
    launch(sort_pass_kernel<kTileBits, Value, false>, {unsigned(scratch.blocks), TileDigits::kThreads}, stream, scratch,
           pass, false, 0, 0, p.tiles[pass % 2], p.tiles[1 - pass % 2], p.values[pass % 2], p.values[1 - pass % 2]);
  }
  launch(tile_offsets_kernel, {blocks_of(grid.tiles() + 1, kRangeTiles), kRangeTiles * kRangeLanes}, stream,
         p.tiles[passes % 2], p.counts, p.capacity, grid.tiles(), p.tile_offsets, p.feedback);
}

}  // namespace

int64_t max_items() { return kMaxSortItems; }

/// Bytes of so many words, rounded up so that what follows is aligned.
static int64_t aligned_bytes(int64_t words) { return (words * int64_t(sizeof(uint32_t)) + 15) / 16 * 16; }

int64_t depth_sort_scratch(int64_t n) { return aligned_bytes(DepthScratch::words(n, kDepthPasses)); }

int64_t tile_sort_scratch(int64_t capacity, TileGrid grid) {
  return aligned_bytes(TileScratch::words(capacity, tile_passes(grid)));
}

int tile_sort_result(TileGrid grid) { return tile_passes(grid) % 2; }

void count_depths(const DepthSort& p, void* memory, cudaStream_t stream) {
  const DepthScratch scratch(static_cast<uint32_t*>(memory), p.n, kDepthPasses);
  if (p.n == 0) return;
  launch(count_depths_kernel, {kCountBlocks, kCountThreads}, stream, p.keys[0], p.ranges, p.n, scratch.histograms,
         p.counts);
}

void sort_by_depth(const DepthSort& p, void* memory, cudaStream_t stream) {
  if (p.n == 0) return;
  const DepthScratch scratch(static_cast<uint32_t*>(memory), p.n, kDepthPasses);
  const LaunchShape shape = {unsigned(scratch.blocks), DepthDigits::kThreads};
  for_each_depth_pass(p, scratch, [&](auto kernel, auto... arguments) { launch(kernel, shape, stream, arguments...); });
}

void emit_pairs(const EmitParams& p, cudaStream_t stream) {
  if (p.n == 0) return;
  launch(emit_pairs_kernel, {blocks_of(p.n, kEmitThreads), kEmitThreads}, stream, p, tile_passes(p.grid));
}

void sort_by_tile(const TileSort<int32_t>& p, TileGrid grid, void* scratch, cudaStream_t stream) {
  sort_values(p, grid, static_cast<uint32_t*>(scratch), stream);
}
void sort_by_tile(const TileSort<SlotPair>& p, TileGrid grid, void* scratch, cudaStream_t stream) {
  sort_values(p, grid, static_cast<uint32_t*>(scratch), stream);
}

void plan_chunks(const TileLists& lists, TileGrid grid, int samples, bool whole, CheckpointLayout layout,
                 const ChunkPlan& plan, cudaStream_t stream) {
  const LaunchShape shape = {blocks_of(grid.tiles(), kPlanThreads), kPlanThreads};
  launch(count_work_kernel, shape, stream, lists, grid.tiles(), samples, whole, &plan.state->counters);
  launch(plan_kernel, shape, stream, lists, grid, samples, whole, layout, plan);
}

}  // namespace ar::cuda
