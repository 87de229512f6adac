// Kernels segment_maps and chain_maps: the first two steps of the backward pass through lists that are cut, for
// footprints whose samples move. blend_vjp_moment (blend_vjp.cu) launches them before segment_vjp_kernel.
//
// What a sample carries from splat to splat on the way back (Adjoint) goes through a segment as an affine map. So the
// segments of a list can be differentiated side by side: segment_maps finds the map of each segment, front to back, and
// chain_maps applies them from the last segment to the first. They read the checkpoints and `last` of blend and write
// adjoint_maps, where segment_vjp_kernel finds what each segment gets from the farther ones, and checkpoints.
#pragma once

#include <algorithm>

#include "cuda/launch.cuh"
#include "cuda/moment/vjp_grads.cuh"

namespace ar::cuda {

/// How an Adjoint goes through a segment: the image of zero, and what a change of each of the three numbers adds. A
/// change of the position does not reach `later`.
struct SegmentMap {
  static constexpr int kNumbers = kMapNumbers;
  Adjoint of_zero, by_later;
  Vec2<float> by_x, by_y;

  __device__ Adjoint operator()(const Adjoint& a) const {
    const Vec2<float>&zero = of_zero.dL_dposition, &later = by_later.dL_dposition, &at = a.dL_dposition;
    return {madd(by_later.later, a.later, of_zero.later),
            {madd(by_y.x, at.y, madd(by_x.x, at.x, madd(later.x, a.later, zero.x))),
             madd(by_y.y, at.y, madd(by_x.y, at.x, madd(later.y, a.later, zero.y)))}};
  }
};

/// The maps of a pixel's sample in adjoint_maps. chain_maps replaces `of_zero` of a segment by the Adjoint before it.
/// `kTilePixels`: pixels of a tile.
template <class F, int kTilePixels> struct MapMemory {
  static constexpr int kPlane = F::kSamples * kTilePixels;
  float* first;  ///< of the sample

  __device__ MapMemory(float* maps, int sample, int pixel_number) : first(maps + pixel_number * F::kSamples + sample) {}
  /// The numbers of an Adjoint or a SegmentMap from number `from` of the map of a segment on.
  template <class Numbers> __device__ Numbers get(int64_t segment, int from = 0) const {
    float numbers[sizeof(Numbers) / sizeof(float)];
    for (float& number : numbers) number = first[(segment * SegmentMap::kNumbers + from++) * kPlane];
    Numbers all;
    memcpy(&all, numbers, sizeof all);
    return all;
  }
  template <class Numbers> __device__ void put(int64_t segment, const Numbers& all, int from = 0) const {
    float numbers[sizeof(Numbers) / sizeof(float)];
    memcpy(numbers, &all, sizeof all);
    for (float number : numbers) first[(segment * SegmentMap::kNumbers + from++) * kPlane] = number;
  }
};

/// How samples are shared out for segments in tiles of kSide x kSide pixels. There are many segments with small splats,
/// so that few pixels per warp are best.
template <class F, int kSide>
using SegmentLayout = std::conditional_t<(F::kSamples <= 4 || kSide < kMovingTile), CellLayout<1, F::kSamples, kSide>,
                                         CellLayout<2, 8, kSide>>;
/// The same for maps, which no lanes add up: with many cells a lane per sample, so that a warp has few pixels and
/// passes over more splats; in small blocks, since warps do not have equally much to do.
template <class F, int kSide>
using MapLayout = std::conditional_t<(F::kSamples > 4), CellLayout<1, 16, kSide, 4>, SegmentLayout<F, kSide>>;

/// A block per segment of kSegment pairs and part of a tile: writes the maps of its samples, and the checkpoints within
/// the segment. Not for the first segments of lists: nobody needs their maps, and blend has stored their checkpoints.
/// For the C channels from `first` on.
template <class F, int C, int kSide, int kSegment, class Layout = MapLayout<F, kSide>>
__global__ void __launch_bounds__(Layout::kThreads, blocks_per_sm(kMapThreads / Layout::kThreads, Layout::kThreads))
    segment_maps_kernel(const BlendVjpParams params, int first) {
  wait_for_earlier_kernels();
  using Lane = VjpLane<F, C, Layout, true>;
  using Samples = typename Lane::Samples;
  constexpr int kBatch = std::min(Layout::kThreads, 256);
  static_assert(Layout::kCells == 1);
  __shared__ MovingStage<F, C, Layout, kBatch> stage;
  __shared__ int last_of_warps[Layout::kWarps];
  const ListSegment segment(*params.plan, params.chunk_order, int(blockIdx.x) / Layout::kBlocks);
  if (segment.tile < 0 || segment.index == 0) return;
  const TileList list = list_of(params.lists, params.grid, segment.tile);
  const TileCheckpoints tile_checkpoints(params.lists, list, params.grid, segment.tile);
  Lane lane(params, list);
  lane.begin(params, first, WantedSums<C>(params, first));
  Samples& samples = lane.samples;
  const int begin = segment.index * kSegment, end = begin + kSegment, last = lane.last.samples[0];
  const int stop = min(lane.last.of_block(last_of_warps), end);
  samples.load(tile_checkpoints.at<Samples>(params.checkpoints, begin), begin, lane.last.samples);
  const float before = samples.transmittance[0];
  AdjointMap<float> map = {0, {0, 0}, {0, 0}, {1, 0, 0, 1}};
  int32_t id = stage.splat_of(list, begin, stop);
  for (int k = begin; k < stop; k += kBatch) {
    const int count = min(kBatch, min(lane.last.warp, stop) - k);  // of what this warp needs
    const int32_t next_id = stage.splat_of(list, k + kBatch, stop);
    __syncthreads();  // all have read the last batch
    stage.load(params, first, list, id);
    __syncthreads();
    if (next_id >= 0) prefetch_splat(params.splats, next_id);  // so that the next batch need not wait for memory
    id = next_id;
    for (int from = 0; from < count; from += kStateChunk) {
      if (first == 0 && k + from > begin)
        samples.store(tile_checkpoints.at<Samples>(params.checkpoints, k + from), k + from, lane.last.samples);
      const int listed = stage.lists.list(stage.reach, from, from + kStateChunk);
      stage.lists.for_each(0, listed, [&](uint32_t j) {
        TileSplatRef<F, C> splat = stage.splats[j];
        const auto [z, raw] = lane.corners.see(splat.terms, 0, samples.position[0]);
        const bool mask = raw >= float(kAlphaMin) && k + int(j) < last;
        if (!__any_sync(kAllLanes, mask)) return;
        const float g_color = lane.grad.times(splat.channels, params, lane.pixel, [&] { return list.splat(k + j); });
        map_placed_sample<F>(splat.terms, z, raw, mask, UnitCell<F::kSide>(), g_color, samples.transmittance[0],
                             samples.position[0], map);
      });
      __syncwarp();  // all have read the list
    }
  }
  if (last <= begin) return;
  SegmentMap m = {{divide(map.color, before), map.of_color},
                  {divide(samples.transmittance[0], before), map.of_behind},
                  {map.of_place.xx, map.of_place.yx},
                  {map.of_place.xy, map.of_place.yy}};
  // After the segment with a sample's last splat there is only the background.
  if (last <= end) m.of_zero = m(lane.adjoint[0]);
  using Memory = MapMemory<F, Layout::kTilePixels>;
  Memory(params.adjoint_maps, Layout::first_sample(), Layout::pixel_number()).put(segment.number, m);
}

/// A thread per sample of a tile whose list is cut: applies the maps of its segments, from the last to the first.
template <class F, int kSide, int kSegment>
__global__ void __launch_bounds__(kSide* kSide) chain_maps_kernel(const BlendVjpParams params) {
  wait_for_earlier_kernels();
  constexpr int S = F::kSamples, kPixels = kSide * kSide;
  const int index = int(blockIdx.x) / S, t = int(blockIdx.x) % S * kPixels + int(threadIdx.x);
  const int number = t / S, sample = t % S;
  if (blockIdx.x == 0 && threadIdx.x == 0) *params.chunks_taken = 0;  // for segment_vjp_kernel
  if (index >= params.plan->counts.cut_lists) return;
  const CutList cut = params.cut_lists[index];
  const TileList list = list_of(params.lists, params.grid, cut.tile);
  const Pixel pixel(list, params.grid, {float(number % kSide), float(number / kSide)});
  if (!pixel.inside) return;
  // Of the segment with the sample's last splat segment_maps has written the Adjoint itself.
  int segment = (params.last[sample * pixel.image + pixel.index] - 1) / kSegment;
  if (segment <= 1) return;
  const int64_t first = cut.first;
  const MapMemory<F, kPixels> memory(params.adjoint_maps, sample, number);
  Adjoint adjoint = memory.template get<Adjoint>(first + segment);
  for (; segment > 1; segment -= kMapsAhead) {
    SegmentMap maps[kMapsAhead];
#pragma unroll
    for (int i = 0; i < kMapsAhead; ++i) maps[i] = memory.template get<SegmentMap>(first + max(segment - 1 - i, 1));
#pragma unroll
    for (int i = 0; i < kMapsAhead; ++i) {
      if (segment - 1 - i < 1) return;
      adjoint = maps[i](adjoint);
      memory.put(first + segment - 1 - i, adjoint);
    }
  }
}

}  // namespace ar::cuda
