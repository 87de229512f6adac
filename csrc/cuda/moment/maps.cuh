// Kernels segment_maps and chain_maps: the first steps of the backward pass for lists that are cut. A segment is an
// affine map of a sample's Adjoint. `segment_maps` writes the maps of all but the first to adjoint_maps, and
// checkpoints that blend did not store. `chain_maps` applies them, last first, and replaces them by what segment_vjp
// begins with.
#pragma once

#include <algorithm>
#include <cstring>

#include "cuda/launch.cuh"
#include "cuda/moment/vjp_grads.cuh"

namespace ar::cuda {

/// What zero becomes, and what a change of each number adds. The position does not change `later`.
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

/// The maps of a sample in adjoint_maps [segments, kMapNumbers, kTilePixels, samples]. chain_maps replaces of_zero by
/// the Adjoint before the segment.
template <class F, int kTilePixels> struct MapMemory {
  static constexpr int kPlane = F::kSamples * kTilePixels;
  float* first;

  __device__ MapMemory(float* maps, int sample, int pixel_number) : first(maps + pixel_number * F::kSamples + sample) {}
  /// An Adjoint or a SegmentMap, from number `from` on.
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

/// For segments. Most have small splats: few pixels per warp are best.
template <class F, int kSide>
using SegmentLayout = std::conditional_t<(F::kSamples <= 4 || kSide < kMovingTile), CellLayout<1, F::kSamples, kSide>,
                                         CellLayout<2, 8, kSide>>;
/// For maps, which no lanes add up: a lane per sample. Warps have unequal work, so blocks are small.
template <class F, int kSide>
using MapLayout = std::conditional_t<(F::kSamples > 4), CellLayout<1, 16, kSide, 4>, SegmentLayout<F, kSide>>;

/// A block has a segment and 1 / kBlocks of its tile. The first segment of a list needs no maps. Reads the channels
/// [first, first + C).
template <class F, int C, int kSide, int kSegment, class Layout = MapLayout<F, kSide>>
__global__ void __launch_bounds__(Layout::kThreads,
                                  blocks_per_sm(MomentPolicy::kMapThreads / Layout::kThreads, Layout::kThreads))
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
  const TileCheckpoints stored(params.lists, list, params.grid, segment.tile);
  Lane lane(params, list);
  lane.begin(params, first, WantedSums<C>(params, first));
  Samples& samples = lane.samples;
  const int begin = segment.index * kSegment, end = begin + kSegment, last = lane.last.samples[0];
  const int stop = min(lane.last.of_block(last_of_warps), end);
  samples.load(stored.at<Samples>(params.checkpoints, begin), begin, lane.last.samples);
  const float before = samples.transmittance[0];
  AdjointMap<float> map = {0, {0, 0}, {0, 0}, {1, 0, 0, 1}};
  int32_t id = stage.splat_of(list, begin, stop);
  for (int k = begin; k < stop; k += kBatch) {
    const int count = min(kBatch, min(lane.last.warp, stop) - k);
    const int32_t next_id = stage.splat_of(list, k + kBatch, stop);
    __syncthreads();  // all have read the last batch
    stage.load(params, first, list, id);
    __syncthreads();
    if (next_id >= 0) prefetch_splat(params.splats, next_id);
    id = next_id;
    for (int from = 0; from < count; from += kStateChunk) {
      if (first == 0 && k + from > begin)
        samples.store(stored.at<Samples>(params.checkpoints, k + from), k + from, lane.last.samples);
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
      __syncwarp();
    }
  }
  if (last <= begin) return;
  SegmentMap m = {{divide(map.color, before), map.of_color},
                  {divide(samples.transmittance[0], before), map.of_behind},
                  {map.of_place.xx, map.of_place.yx},
                  {map.of_place.xy, map.of_place.yy}};
  // After its last splat there is only the background.
  if (last <= end) m.of_zero = m(lane.adjoint[0]);
  using Memory = MapMemory<F, Layout::kTilePixels>;
  Memory(params.adjoint_maps, Layout::first_sample(), Layout::pixel_number()).put(segment.number, m);
}

/// A thread has a sample; block b has samples of list b / F::kSamples.
template <class F, int kSide, int kSegment>
__global__ void __launch_bounds__(kSide* kSide) chain_maps_kernel(const BlendVjpParams params) {
  wait_for_earlier_kernels();
  constexpr int S = F::kSamples, kPixels = kSide * kSide, kAhead = MomentPolicy::kMapsAhead;
  const int index = int(blockIdx.x) / S, t = int(blockIdx.x) % S * kPixels + int(threadIdx.x);
  const int number = t / S, sample = t % S;
  if (blockIdx.x == 0 && threadIdx.x == 0) *params.chunks_taken = 0;  // for segment_vjp_kernel
  if (index >= params.plan->counts.cut_lists) return;
  const CutList cut = params.cut_lists[index];
  const TileList list = list_of(params.lists, params.grid, cut.tile);
  const Pixel pixel(list, params.grid, {float(number % kSide), float(number / kSide)});
  if (!pixel.inside) return;
  // For this segment, segment_maps has written the Adjoint itself.
  int segment = (params.last[sample * pixel.image + pixel.index] - 1) / kSegment;
  if (segment <= 1) return;
  const int64_t first = cut.first;
  const MapMemory<F, kPixels> memory(params.adjoint_maps, sample, number);
  Adjoint adjoint = memory.template get<Adjoint>(first + segment);
  for (; segment > 1; segment -= kAhead) {
    SegmentMap maps[kAhead];
    AR_UNROLL for (int i = 0; i < kAhead; ++i) maps[i] =
        memory.template get<SegmentMap>(first + max(segment - 1 - i, 1));
    AR_UNROLL for (int i = 0; i < kAhead; ++i) {
      if (segment - 1 - i < 1) return;
      adjoint = maps[i](adjoint);
      memory.put(first + segment - 1 - i, adjoint);
    }
  }
}

}  // namespace ar::cuda
