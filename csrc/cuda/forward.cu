// The forward pass of CUDA, in the order of Backend (torch/backend.h). backend_cuda.cpp allocates, and calls these
// functions, which launch the kernels:
//
//   project   Gaussians to splats, or to public rows     project/project.cuh
//   bin       splats to a list for each tile, by depth   bin/bin.cuh, bin/sort.cuh
//   blend     lists to images                            bin/plan.cuh, then one of still/, moment/, channels/, rays/
//   inspect   lists to statistics                        inspect.cuh
#include <algorithm>

#include "cuda/bin/bin.cuh"
#include "cuda/bin/plan.cuh"
#include "cuda/dispatch.h"
#include "cuda/inspect.cuh"
#include "cuda/project/project.cuh"
#include "cuda/project/rays.cuh"

namespace ar::cuda {

// project

void project(const ProjectParams& p, cudaStream_t stream) {
  launch_rows(project_kernel<Camera<float>>, project_kernel<FullCamera<float>>, p, stream,
              multiprocessors() * ProjectPolicy::kBlocksPerSm);
}
void ray_depths(const RayDepthsParams& p, cudaStream_t stream) {
  launch_rows(ray_depths_kernel<Camera<float>>, ray_depths_kernel<FullCamera<float>>, p, stream);
}
void project_rows(const ProjectRowsParams& p, cudaStream_t stream) {
  launch_rows(project_rows_kernel<Camera<float>>, project_rows_kernel<FullCamera<float>>, p, stream);
  if (!p.rows.slopes) return;
  launch_rows(row_slopes_kernel<Camera<float>>, row_slopes_kernel<FullCamera<float>>, p, stream);
}
void shape_rows(const ShapeRowsParams& p, cudaStream_t stream) { launch_rows(shape_rows_kernel, p, p.n, stream); }

// bin

namespace {

template <int kBits, class Value> LaunchShape sort_shape(int64_t blocks) {
  // What a block has on devices of 7.5, less static variables.
  static_assert(sizeof(SortShared<kBits, Value>) <= 63 * 1024);
  return {unsigned(blocks), Digits<kBits>::kThreads, sizeof(SortShared<kBits, Value>)};
}

int64_t aligned_bytes(int64_t words) { return (words * int64_t(sizeof(uint32_t)) + 15) / 16 * 16; }

}  // namespace

int64_t max_items() { return kMaxSortItems; }
int64_t depth_sort_scratch(int64_t n) { return aligned_bytes(DepthScratch::words(n, kDepthPasses)); }
int64_t tile_sort_scratch(int64_t capacity, TileGrid grid) {
  const TileDigits digits(grid);
  return digits.with_bits([&](auto bits) { return aligned_bytes(SortScratch<bits>::words(capacity, digits.passes)); });
}
int tile_sort_result(TileGrid grid) { return TileDigits(grid).passes % 2; }

void count_depths(const DepthSort& p, void* memory, ZeroedMemory other_scratch, ZeroedMemory of_tiles,
                  cudaStream_t stream) {
  const DepthScratch scratch(static_cast<uint32_t*>(memory), p.n, kDepthPasses);
  launch(count_depths_kernel, {multiprocessors() * BinPolicy::kCountBlocksPerSm, BinPolicy::kCountThreads}, stream,
         p.keys[0], p.ranges, p.with_slots, p.n, scratch.histograms, p.counts, other_scratch, of_tiles);
}

void sort_by_depth(const DepthSort& p, void* memory, cudaStream_t stream) {
  if (p.n == 0) return;
  const DepthScratch scratch(static_cast<uint32_t*>(memory), p.n, kDepthPasses);
  const LaunchShape shape = sort_shape<kDepthBits, int32_t>(scratch.blocks);
  for_each_depth_pass(p, scratch, [&](auto kernel, auto... arguments) { launch(kernel, shape, stream, arguments...); });
}

void emit_pairs(const EmitParams& p, cudaStream_t stream) {
  if (p.n == 0) return;
  const TileDigits digits(p.grid);
  launch(emit_pairs_kernel, {blocks_of(p.n, BinPolicy::kEmitSplats), BinPolicy::kEmitThreads}, stream, p, digits);
  launch(emit_long_pairs_kernel, {multiprocessors() * BinPolicy::kLongBlocksPerSm, BinPolicy::kEmitThreads}, stream, p,
         digits);
}

template <class Value> void sort_by_tile(const TileSort<Value>& p, TileGrid grid, void* memory, cudaStream_t stream) {
  const TileDigits digits(grid);
  digits.with_bits([&](auto bits) {
    const SortScratch<bits> scratch(static_cast<uint32_t*>(memory), p.capacity, digits.passes);
    for (int pass = 0; pass < digits.passes; ++pass) {
      launch(sort_pass_kernel<bits, Value, false>, sort_shape<bits, Value>(scratch.blocks), stream, scratch, pass,
             false, &p.counts->listed, p.capacity, p.tiles[pass % 2], p.tiles[1 - pass % 2], p.values[pass % 2],
             p.values[1 - pass % 2]);
    }
  });
  constexpr int kTiles = BinPolicy::kOffsetTiles, kThreads = kTiles * BinPolicy::kOffsetLanes;
  launch(tile_offsets_kernel, {blocks_of(grid.tiles() + 1, kTiles), kThreads}, stream, p.tiles[digits.passes % 2],
         p.counts, grid.tiles(), p.tile_offsets, p.feedback);
}
template void sort_by_tile(const TileSort<int32_t>&, TileGrid, void*, cudaStream_t);
template void sort_by_tile(const TileSort<SlotPair>&, TileGrid, void*, cudaStream_t);

// blend

int multiprocessors_of_device() { return int(multiprocessors()); }

void plan_chunks(const TileLists& lists, TileGrid grid, int samples, const ListCut& cut, CheckpointLayout layout,
                 const ChunkPlan& plan, cudaStream_t stream) {
  const LaunchShape shape = {blocks_of(grid.tiles(), PlanPolicy::kThreads), PlanPolicy::kThreads};
  const LaunchShape counters = {PlanState::kCounters, PlanPolicy::kCountThreads};
  launch(count_work_kernel, counters, stream, lists, grid.tiles(), cut, plan.state);
  launch(plan_kernel, shape, stream, lists, grid, samples, cut, layout, plan);
}

void blend(int footprint, const BlendParams& p, cudaStream_t stream) {
  const Family family = family_at(footprint, p.channels.count, p.order.window > 0);
  if (family == Family::kStill) blend_still(footprint, p, stream);
  if (family == Family::kMoment) blend_moment(footprint, p, stream);
  if (family == Family::kChannels) blend_channels(footprint, p, stream);
  if (family == Family::kRays) blend_rays(footprint, p, stream);
}

// inspect

void inspect(int footprint, const InspectParams& p, cudaStream_t stream) {
  visit_pixels(footprint, [&](auto f) {
    using F = decltype(f);
    with_tile_side<F>(p.grid, [&](auto side) {
      const auto kernel = p.touched    ? inspect_kernel<F, side, Look::kStatistics>
                          : p.dominant ? inspect_kernel<F, side, Look::kImages>
                                       : inspect_kernel<F, side, Look::kMedian>;
      launch(kernel, {unsigned(p.grid.tiles()), kInspectThreads<side>}, stream, p);
    });
  });
}

}  // namespace ar::cuda
