// Kernel of blend_vjp for footprints whose samples move: a block per tile, a lane per few cells of a pixel, back to
// front.
//
// The state of a sample in front of a splat cannot be had from the state behind it, since the displacement depends on
// itself through alpha. So a warp composites each chunk of 32 splats once more, from the checkpoint that blend has left
// in front of it, keeps where the samples were in front of each splat, and then walks back over those that its pixels
// show.
//
// In small images a block has a segment of a tile's list, so that long lists are differentiated side by side. What the
// samples carry from splat to splat on the way back goes through a segment as an affine map. So one kernel finds the
// map of every segment, from front to back, another chains them from the last segment to the first, and a third has the
// sums, each segment from what it gets from behind.
//
// dL/dalpha is linear in the gradient of the image: of many channels each kernel adds the share of its own to the six
// sums of a pair, which a single block owns. Only MeanSums need all channels at once: where they are wanted, the first
// kernel makes all sums, and reads the channels of the others where they lie.
#pragma once

#include <algorithm>

#include "cuda/blend_moving.cuh"
#include "cuda/tile_pieces.cuh"

namespace ar::cuda {

static_assert(kStateChunk == 32, "a warp's chunk is a mask of 32 bits");

/// What a block keeps in shared memory. Sums of a pair: PairGrad, C channels, MeanSums.
template <class F, int C, class Layout, int kSegment = 0> struct MovingVjpShared {
  static constexpr int kMeans = 6 + C, kSums = kMeans + 2;
  /// In segments most pairs reach few of the many warps. There sums have slots only for the warps that a pair reaches,
  /// so that the warps have to wait for each other after more pairs.
  static constexpr bool kSparse = kSegment > 0 && Layout::kWarps > 2;
  /// Splats that a block takes between barriers: without kSparse two chunks, if a block of any device has room for
  /// their sums. With many cells one, which leaves more fast memory for the places of samples, and fewer numbers are
  /// spilled.
  static constexpr int kDense = F::kSamples <= 4 && Layout::kWarps * kSums <= 192 ? 2 * kStateChunk : kStateChunk;
  static constexpr int kBatch = kSparse ? std::min(kSegment, 16 * Layout::kWarps) : kDense;
  static constexpr int kChunks = kBatch / kStateChunk;
  /// No fewer than a chunk may need.
  static constexpr int kSlots = Layout::kWarps * (kSparse ? kStateChunk : kBatch);
  MovingStage<F, C, Layout, kBatch> stage;
  float sums[kSlots][kSums];               ///< of a warp's pixels
  uint32_t hits[Layout::kWarps][kChunks];  ///< splats that have sums of a warp
  int slots[kSparse ? kBatch + 1 : 1];  ///< those of pair j are [slots[j], slots[j + 1]), as if there was room for all
  int chunk_slots[kChunks];
  int32_t rows[kBatch];
  Mat2<float> mean_maps[kBatch];
  int last[Layout::kWarps];  ///< of LastSplats

  /// Hands out the slots of the staged pairs. All threads must call it, after the pairs have been loaded by the same
  /// threads and before any other reads them.
  __device__ void set_slots() {
    if constexpr (kSparse) {
      static_assert(kBatch % 32 == 0 && kStateChunk == 32);
      const int t = threadIdx.x, own = t < kBatch ? __popc(stage.reach[t]) : 0;
      const int up_to = warp_inclusive_sum(own);
      if (t < kBatch && lane_id() == 31) chunk_slots[t / 32] = up_to;
      __syncthreads();
      int before = 0;
      for (int c = 0; c < t / 32 && c < kChunks; ++c) before += chunk_slots[c];
      if (t < kBatch) slots[t + 1] = before + up_to;
      if (t == 0) slots[0] = 0;
    }
  }
  /// The first of the chunks whose sums are made together, the last of which is in front of chunk `end`.
  __device__ int first_chunk(int end) const {
    if constexpr (!kSparse) return 0;
    int first = end - 1;
    while (first > 0 && slots[end * kStateChunk] - slots[(first - 1) * kStateChunk] <= kSlots) --first;
    return first;
  }
  __device__ int first_slot(int chunk) const { return kSparse ? slots[kSparse ? chunk * kStateChunk : 0] : 0; }
  /// The sums of this warp for pair j. `first`: slots[] of the first pair whose sums are made together.
  __device__ float* sums_of(int j, int first) {
    const int warp = threadIdx.x / 32;
    if constexpr (!kSparse) return sums[warp * kBatch + j];
    return sums[slots[j] - first + __popc(stage.reach[j] & ((1u << warp) - 1))];
  }
  /// Value v of the sums of all warps for pair j.
  __device__ float total(int j, int v, int first) const {
    float sum = 0;
    const auto hit = [&](int warp) { return hits[warp][j / kStateChunk] >> (j % kStateChunk) & 1; };
    if constexpr (kSparse) {
      int slot = slots[j] - first;
      for (uint32_t left = stage.reach[j]; left != 0; left &= left - 1, ++slot) {
        if (hit(__ffs(int(left)) - 1)) sum += sums[slot][v];
      }
    } else {
#pragma unroll
      for (int w = 0; w < Layout::kWarps; ++w) {
        if (hit(w)) sum += sums[w * kBatch + j][v];
      }
    }
    return sum;
  }
};

/// Which of the sums of a pair a lane has after put_warp_sums. Of few channels every lane has one.
template <int C> __device__ int sum_of_lane() { return summed_value<(C <= kFewChannels) ? 6 + C : 8>(lane_id()); }

/// Sums PairGrad and `channels` over a warp. `sums` is where MovingVjpShared has sum sum_of_lane() of the pair. All
/// lanes must call it.
template <int C> __device__ void put_warp_sums(const PairGrad<float>& grad, const Values<C>& channels, float* sums) {
  const ShapeGrad<float>& shape = grad.shape;
  const float of_shape[6] = {shape.offset.x, shape.offset.y, shape.shape.xx,
                             shape.shape.xy, shape.shape.yy, grad.weighted};
  float values[C <= kFewChannels ? 6 + C : 8] = {};
#pragma unroll
  for (int v = 0; v < 6; ++v) values[v] = of_shape[v];
  if constexpr (C <= kFewChannels) {
#pragma unroll
    for (int c = 0; c < C; ++c) values[6 + c] = channels.v[c];
    *sums = sum_values(values);  // by all lanes, which costs less than to find the first of each sum
  } else {
    static_assert(C == 8);
    const float sum = sum_values(values), of_channels = sum_values(channels.v);
    const int lane = lane_id();
    if (lane % 4 != 0) return;
    if (lane < 24) *sums = sum;
    sums[6] = of_channels;
  }
}

/// Threads that an SM should hold: bounds the registers, as waiting for the samples in front costs more than a few
/// numbers in memory.
template <int C> inline constexpr int kMovingVjpThreads = C == 3 ? 1024 : 512;

/// What a sample carries from a splat to the one in front of it: the gradient-weighted colour behind, and the gradient
/// with respect to its place.
struct Adjoint {
  float behind;
  Vec2<float> dL_dplace;
};

/// How that goes through a segment: the image of zero, and what a change of each of the three numbers adds. A change of
/// the place does not reach `behind`.
struct SegmentMap {
  static constexpr int kNumbers = 10;
  Adjoint of_zero, by_behind;
  Vec2<float> by_x, by_y;

  __device__ Adjoint operator()(const Adjoint& a) const {
    const auto place = [&](float zero, float behind, float x, float y) {
      return madd(y, a.dL_dplace.y, madd(x, a.dL_dplace.x, madd(behind, a.behind, zero)));
    };
    return {madd(by_behind.behind, a.behind, of_zero.behind),
            {place(of_zero.dL_dplace.x, by_behind.dL_dplace.x, by_x.x, by_y.x),
             place(of_zero.dL_dplace.y, by_behind.dL_dplace.y, by_x.y, by_y.y)}};
  }
};

/// Where the maps of a pixel's sample are. In place of `of_zero` of a segment is, in the end, what its front gives to
/// the segment before.
template <class F> struct MapMemory {
  static constexpr int kPlane = F::kSamples * kMovingPixels;
  float* first;  ///< of the sample

  __device__ MapMemory(float* maps, int sample, int pixel_number) : first(maps + pixel_number * F::kSamples + sample) {}
  __device__ float& at(int64_t piece, int number) const {
    return first[(piece * SegmentMap::kNumbers + number) * kPlane];
  }
  __device__ Adjoint adjoint(int64_t piece, int number = 0) const {
    return {at(piece, number), {at(piece, number + 1), at(piece, number + 2)}};
  }
  __device__ SegmentMap map(int64_t piece) const {
    return {adjoint(piece), adjoint(piece, 3), {at(piece, 6), at(piece, 7)}, {at(piece, 8), at(piece, 9)}};
  }
  __device__ void put(int64_t piece, const Adjoint& a, int number = 0) const {
    at(piece, number) = a.behind;
    at(piece, number + 1) = a.dL_dplace.x;
    at(piece, number + 2) = a.dL_dplace.y;
  }
  __device__ void put(int64_t piece, const SegmentMap& m) const {
    put(piece, m.of_zero);
    put(piece, m.by_behind, 3);
    at(piece, 6) = m.by_x.x, at(piece, 7) = m.by_x.y;
    at(piece, 8) = m.by_y.x, at(piece, 9) = m.by_y.y;
  }
};

/// Pairs of a segment. Longer ones need fewer maps, which count where there are many samples; shorter ones fill a
/// device with smaller scenes.
template <class F> inline constexpr int kMovingSegment = F::kSamples <= 4 ? 512 : 1024;
/// Samples shared out for segments, of which there are many, with small splats: few pixels per warp, and blocks small
/// enough for two on an SM. A single sample has a lane, so that none is idle.
template <class F>
using SegmentLayout = CellLayout<F::kSamples <= 4 ? 1 : 2, F::kSamples == 1   ? 1
                                                           : F::kSamples == 4 ? 4
                                                                              : 8>;

/// Samples shared out for the maps of segments, which no lanes add up: with many cells a sample to a lane, so that a
/// warp has few pixels and passes over more splats. A block has 16 warps at most.
template <class F>
using MapLayout = std::conditional_t<(F::kSamples > 4), CellLayout<1, 16, kMovingTile, 16>, SegmentLayout<F>>;

/// The gradient with respect to a sample of a lane's pixel.
template <class F, int C> struct SampleGrad {
  Values<C> channels;  ///< from `first` on
  float through = 0;   ///< what the background gives
  /// Several kernels have the channels, and this one, the first, adds those of the others to the gradient of alpha.
  bool with_others;

  __device__ static float channel(const BlendVjpParams& params, const Pixel& pixel, int c) {
    const float* plane = c < params.channels.count ? params.dL_dimage.plane(c, pixel.image) : nullptr;
    return pixel.inside && plane ? 1.0f / F::kSamples * plane[pixel.index] : 0.0f;
  }

  __device__ SampleGrad(const BlendVjpParams& params, const Pixel& pixel, int first)
      : with_others(C > kFewChannels && params.mean_sums != MeanSums::kNone && params.channels.count > C &&
                    first == 0) {
#pragma unroll
    for (int c = 0; c < C; ++c) {
      channels.v[c] = channel(params, pixel, first + c);
      if (first + c < params.channels.count) through += channels.v[c] * params.background[first + c];
    }
    if (with_others) {
      for (int c = C; c < params.channels.count; ++c) through += channel(params, pixel, c) * params.background[c];
    }
    // Alpha is 1 - transmittance: its gradient acts like one more channel whose background is -1.
    if (first == 0 && params.dL_dalpha && pixel.inside) through -= 1.0f / F::kSamples * params.dL_dalpha[pixel.index];
  }

  /// Its scalar product with the colour of a splat, `id()`.
  template <class Id>
  __device__ float times(const Values<C>& color, const BlendVjpParams& params, const Pixel& pixel, Id&& id) const {
    float product = channels.v[0] * color.v[0];
#pragma unroll
    for (int c = 1; c < C; ++c) product = madd(channels.v[c], color.v[c], product);
    if (with_others) {
      const float* row = params.channels.row(id());
      for (int c = C; c < params.channels.count; ++c) product = madd(channel(params, pixel, c), row[c], product);
    }
    return product;
  }
};

/// The place behind the last splat that was composited, in its tile's list: into each of a lane's samples, and into any
/// of its warp and its block.
template <class F, class Layout> struct LastSplats {
  int samples[Layout::kCells], warp = 0, block = 0;

  /// `of_warps`: in shared memory. All threads of a block must call it.
  __device__ LastSplats(const int32_t* last, const Pixel& pixel, int (&of_warps)[Layout::kWarps]) {
#pragma unroll
    for (int i = 0; i < Layout::kCells; ++i) {
      const int sample = Layout::first_sample() + i;
      samples[i] = pixel.inside && sample < F::kSamples ? last[sample * pixel.image + pixel.index] : 0;
      warp = max(warp, samples[i]);
    }
    warp = warp_max(warp);
    if (lane_id() == 0) of_warps[threadIdx.x / 32] = warp;
    __syncthreads();
#pragma unroll
    for (int w = 0; w < Layout::kWarps; ++w) block = max(block, of_warps[w]);
  }
};

/// A block per segment of kSegment pairs and part of a tile: the maps of its samples, but of the first segments of
/// tiles, which nobody needs.
template <class F, int C, int kSegment, class Layout = MapLayout<F>>
__global__ void __launch_bounds__(Layout::kThreads, 1024 / Layout::kThreads)
    segment_maps_kernel(const BlendVjpParams params, int first) {
  using Samples = MovingSamples<F, Layout, true>;
  constexpr int kCells = Layout::kCells, kBatch = std::min(Layout::kThreads, 256);
  __shared__ MovingStage<F, C, Layout, kBatch> stage;
  __shared__ int last_of_warps[Layout::kWarps];
  const int64_t number = int(blockIdx.x) / Layout::kBlocks;  // of the piece
  const TilePiece piece = find_piece(params.lists, params.grid, kSegment, number);
  if (piece.tile < 0 || piece.index == 0) return;
  const TileList list = list_of(params.lists, params.grid, piece.tile);
  const StatePlaces places(params.lists, list, params.grid, piece.tile);
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const Vec2<float> p = Layout::pixel();
  const Pixel pixel(list, params.grid, p);
  const SampleGrad<F, C> grad(params, pixel, first);
  const CellCorners<F, Layout> corners(p);
  Samples samples(pixel.inside);
  const LastSplats<F, Layout> last(params.last, pixel, last_of_warps);
  const int begin = piece.index * kSegment, end = begin + kSegment, stop = min(last.block, end);
  samples.load(params.checkpoints + (places.first + begin / kStateChunk - 1) * Samples::kCheckpoint, begin,
               last.samples);
  AdjointMap<float> maps[kCells];
  float before[kCells];  // the transmittance
#pragma unroll
  for (int i = 0; i < kCells; ++i) {
    maps[i] = {0, {0, 0}, {0, 0}, {1, 0, 0, 1}};
    before[i] = samples.transmittance[i];
  }
  int32_t id = stage.splat_of(list, begin, stop);
  for (int k = begin; k < stop; k += kBatch) {
    const int count = min(kBatch, min(last.warp, stop) - k);  // of what this warp needs
    const int32_t next_id = stage.splat_of(list, k + kBatch, stop);
    __syncthreads();  // all have read the last batch
    stage.load(splats, params.channels, first, list, id);
    __syncthreads();
    if (next_id >= 0) prefetch(splats + next_id);  // so that the next batch need not wait for memory
    id = next_id;
    for (int from = 0; from < count; from += 32) {
      for (uint32_t left = stage.reached(from); left != 0;) {
        const int j = from + take_first(left);
        TileSplatRef<F, C> splat = stage.splats[j];
        const Vec2<float> row = corners.row(splat.terms);
        Vec2<float> z[kCells];
        float raw[kCells];
        bool mask[kCells], any = false;
#pragma unroll
        for (int i = 0; i < kCells; ++i) {
          z[i] = corners.node(splat.terms, row, i, samples.place[i]);
          raw[i] = exp2(F::log_alpha(splat.terms, z[i]));
          mask[i] = raw[i] >= float(kAlphaMin) && k + j < last.samples[i];
          any |= mask[i];
        }
        if (!__any_sync(kAllLanes, any)) continue;
        const float g_color = grad.times(splat.channels, params, pixel, [&] { return list.splat(k + j); });
#pragma unroll
        for (int i = 0; i < kCells; ++i)
          map_placed_sample<F>(splat.terms, z[i], raw[i], mask[i], UnitCell<F::kSide>(), g_color,
                               samples.transmittance[i], samples.place[i], maps[i]);
      }
    }
  }
#pragma unroll
  for (int i = 0; i < kCells; ++i) {
    if (last.samples[i] <= begin) continue;
    const AdjointMap<float>& m = maps[i];
    SegmentMap map = {{divide(m.color, before[i]), m.of_color},
                      {divide(samples.transmittance[i], before[i]), m.of_behind},
                      {m.of_place.xx, m.of_place.yx},
                      {m.of_place.xy, m.of_place.yy}};
    // Behind the segment with a sample's last splat is the background.
    if (last.samples[i] <= end) map.of_zero = map({grad.through, {0, 0}});
    MapMemory<F>(params.adjoint_maps, Layout::first_sample() + i, Layout::pixel_number()).put(number, map);
  }
}

/// A thread per sample of a tile: from the maps of its segments to what each gets from behind.
template <class F, int kSegment>
__global__ void __launch_bounds__(kMovingPixels) chain_maps_kernel(const BlendVjpParams params) {
  constexpr int S = F::kSamples;
  const int tile = int(blockIdx.x) / S, t = int(blockIdx.x) % S * kMovingPixels + int(threadIdx.x);
  const int number = t / S, sample = t % S;
  const TileList list = list_of(params.lists, params.grid, tile);
  const Pixel pixel(list, params.grid, {float(number % kMovingTile), float(number / kMovingTile)});
  if (list.overflow || !pixel.inside) return;
  // The map of the segment with the last splat of the sample already is what its front gives.
  int segment = (params.last[sample * pixel.image + pixel.index] - 1) / kSegment;
  if (segment <= 1) return;
  const int64_t first = first_piece(params.lists, kSegment, tile);
  const MapMemory<F> memory(params.adjoint_maps, sample, number);
  Adjoint adjoint = memory.adjoint(first + segment);
  constexpr int kAhead = 8;  // segments whose maps are read at once, since each of them waits for memory
  for (; segment > 1; segment -= kAhead) {
    SegmentMap maps[kAhead];
#pragma unroll
    for (int i = 0; i < kAhead; ++i) maps[i] = memory.map(first + max(segment - 1 - i, 1));
#pragma unroll
    for (int i = 0; i < kAhead; ++i) {
      if (segment - 1 - i < 1) return;
      adjoint = maps[i](adjoint);
      memory.put(first + segment - 1 - i, adjoint);
    }
  }
}

/// A block per tile, or with kSegment > 0 per segment of so many pairs of a tile's list, from what the segment gets
/// from behind. `overflow_only`: other kernels do the work, unless there were too many pairs.
template <class F, int C, class Layout, int kSegment = 0>
__global__ void __launch_bounds__(Layout::kThreads, std::max(1, kMovingVjpThreads<C> / Layout::kThreads))
    moving_vjp_kernel(const BlendVjpParams params, int first, bool overflow_only) {
  using Shared = MovingVjpShared<F, C, Layout, kSegment>;
  using Samples = MovingSamples<F, Layout, (kSegment > 0)>;
  constexpr int S = F::kSamples, kCells = Layout::kCells, kBatch = Shared::kBatch;
  constexpr bool kMany = C > kFewChannels;  // `first` may be above 0, and there may be more channels than C
  static_assert(kSegment % kBatch == 0 && Layout::kBlocks == 1);
  Shared& shared = *reinterpret_cast<Shared*>(dynamic_shared());
  TilePiece piece = {0, 0};
  if constexpr (kSegment > 0) {
    piece = find_piece(params.lists, params.grid, kSegment, blockIdx.x);
  } else {
    piece.tile = listed_tile<S>(params, int(blockIdx.x));
  }
  const int tile = piece.tile;
  if (tile < 0) return;
  const TileList list = list_of(params.lists, params.grid, tile);
  if (overflow_only && !list.overflow) return;
  const int begin = piece.index * kSegment, end = kSegment > 0 ? begin + kSegment : kWholeList;
  const StatePlaces places(params.lists, list, params.grid, tile);
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const int lane = lane_id(), warp = threadIdx.x / 32, channel_count = params.channels.count;
  const bool with_means = params.mean_sums != MeanSums::kNone;
  const bool all_at_once = kMany && with_means && channel_count > C;
  const bool with_shape = !all_at_once || first == 0;
  const Vec2<float> p = Layout::pixel();
  const Pixel pixel(list, params.grid, p);
  const CellCorners<F, Layout> corners(p);
  Samples samples(pixel.inside);

  const LastSplats<F, Layout> lasts(params.last, pixel, shared.last);
  const int (&last)[kCells] = lasts.samples;
  if (first % kChannelGroup == 0 && !list.overflow) {  // pairs that nothing reached
    constexpr int kQuads = kChannelGroup / 4;
    const int rest = min(list.count, end);
    for (int k = max(lasts.block, begin) + threadIdx.x / kQuads; k < rest; k += Layout::kThreads / kQuads) {
      const int q = threadIdx.x % kQuads;
      const int64_t slot = list.slot(k);
      const float4 zero = {0, 0, 0, 0};
      if (first == 0 && q < kPairGradWidth / 4)
        reinterpret_cast<float4*>(params.pair_grads + slot * kPairGradWidth)[q] = zero;
      if (params.channel_sums) reinterpret_cast<float4*>(params.channel_sums + slot * kChannelGroup)[q] = zero;
    }
  }

  const int64_t number = kSegment > 0 ? int64_t(blockIdx.x) : 0;  // of the piece
  const auto maps_of = [&](int i) {
    return MapMemory<F>(params.adjoint_maps, Layout::first_sample() + i, Layout::pixel_number());
  };
  const SampleGrad<F, C> grad(params, pixel, first);
  Adjoint adjoint[kCells];
#pragma unroll
  for (int i = 0; i < kCells; ++i) {
    adjoint[i] = {grad.through, {0, 0}};
    if (kSegment > 0 && last[i] > end) adjoint[i] = maps_of(i).adjoint(number + 1);
  }

  const int own_sum = sum_of_lane<C>();
  Vec2<float> places_in_front[kStateChunk][kCells];
  // Composites those of the staged splats [from, from + 32) that reach the warp; the first of them is pair k. Returns
  // those that a sample of the warp shows, and keeps the places of the samples in front of all.
  const auto replay = [&](int from, int k) {
    uint32_t shown = 0;
    int kept = 0;
    for (uint32_t left = shared.stage.reached(from); left != 0; ++kept) {
      const int bit = take_first(left);
      const auto& terms = shared.stage.splats[from + bit].terms;
      const Vec2<float> row = corners.row(terms);
      bool any = false;
#pragma unroll
      for (int i = 0; i < kCells; ++i) {
        const Vec2<float> z = corners.node(terms, row, i, samples.place[i]);
        places_in_front[kept][i] = samples.place[i];
        any |= replay_placed_sample<F>(terms, z, exp2(F::log_alpha(terms, z)), k + bit < last[i], UnitCell<F::kSide>(),
                                       samples.transmittance[i], samples.place[i]);
      }
      shown |= uint32_t(any) << bit;
    }
    return warp_or(shown);
  };

  const int stop = min(lasts.block, end);
  int k0 = (stop - 1) / kBatch * kBatch;
  int32_t id = shared.stage.splat_of(list, k0, stop);
  for (int k1 = stop; k1 > begin; k1 = k0, k0 -= kBatch) {
    const int count = k1 - k0;
    if (kSegment == 0 && places.spacing > kStateChunk) {  // with too many pairs: from the checkpoint to the batch
      const int checkpoint = k0 / places.spacing;
      int k = checkpoint * places.spacing;
      samples.load(params.checkpoints + (places.first + checkpoint - 1) * Samples::kCheckpoint, k, last);
      for (; k < k0; k += kBatch) {
        __syncthreads();
        shared.stage.load(splats, params.channels, first, list, shared.stage.splat_of(list, k, k0));
        __syncthreads();
        for (int from = 0; from < kBatch; from += kStateChunk) replay(from, k + from);
      }
    }
    const int32_t next_id = k0 > begin ? shared.stage.splat_of(list, k0 - kBatch, k0) : -1;
    __syncthreads();  // all have read what the last batch left
    shared.stage.load(splats, params.channels, first, list, id);
    if (id >= 0) {
      const int t = threadIdx.x;
      shared.rows[t] = list.overflow ? id : list.slot(k0 + t);
      if (with_means) shared.mean_maps[t] = F::mean_map(splats[id].shape);
    }
    shared.set_slots();
    __syncthreads();
    if (next_id >= 0) prefetch(splats + next_id);  // so that the next batch need not wait for memory
    id = next_id;
    const Samples at_batch = samples;
    for (int part_end = Shared::kChunks, part = 0; part_end > 0; part_end = part) {
      part = shared.first_chunk(part_end);
      const int first_slot = shared.first_slot(part);
      for (int from = (part_end - 1) * kStateChunk; from >= part * kStateChunk; from -= kStateChunk) {
        uint32_t shown = 0;
        if (k0 + from < lasts.warp) {
          if (kSegment == 0 && places.spacing > kStateChunk) {
            samples = at_batch;
            for (int ahead = 0; ahead < from; ahead += kStateChunk) replay(ahead, k0 + ahead);
          } else {
            const int64_t number = places.first + (k0 + from) / kStateChunk - 1;
            samples.load(params.checkpoints + number * Samples::kCheckpoint, k0 + from, last);
          }
          shown = replay(from, k0 + from);
        }
        const uint32_t reached = shared.stage.reached(from);
        for (uint32_t mask = shown; mask != 0;) {
          const int bit = 31 - __clz(mask), j = from + bit;
          mask ^= 1u << bit;
          const int kept = __popc(reached >> (31 - bit)) - 1;
          TileSplatRef<F, C> splat = shared.stage.splats[j];
          float* const sums = shared.sums_of(j, first_slot);
          const Vec2<float> row = corners.row(splat.terms);
          const float g_color = grad.times(splat.channels, params, pixel, [&] { return list.splat(k0 + j); });
          PairGrad<float> sum = {};
          float contribution = 0;
#pragma unroll
          for (int i = 0; i < kCells; ++i) {
            const Vec2<float> place = places_in_front[kept][i];
            const Vec2<float> z = corners.node(splat.terms, row, i, place);
            const float raw = exp2(F::log_alpha(splat.terms, z));
            const bool composited = raw >= float(kAlphaMin) && k0 + j < last[i];
            const MovingBlendGrad<float> of_sample =
                blend_placed_sample_vjp<F>(splat.terms, z, composited ? raw : 0.0f, UnitCell<F::kSide>(), g_color,
                                           place, samples.transmittance[i], adjoint[i].behind, adjoint[i].dL_dplace);
            const PairGrad<float> pair = {of_sample.of_splat.sums, of_sample.of_splat.weighted};
            sum = i == 0 ? pair : sum + pair;
            contribution = i == 0 ? of_sample.contribution : contribution + of_sample.contribution;
          }
          if (with_means && with_shape) {
            const Vec2<float> offset = {Layout::sum_lanes(sum.shape.offset.x), Layout::sum_lanes(sum.shape.offset.y)};
            const Vec2<float> size = {float(params.grid.width), float(params.grid.height)};
            Vec2<float> means = mean_sums_of(params.mean_sums, size, transform_transposed(shared.mean_maps[j], offset));
            if (Layout::first_sample() > 0) means = {0, 0};  // once for a pixel
            means = {warp_sum(means.x), warp_sum(means.y)};
            if (lane < 2) sums[Shared::kMeans + lane] = lane == 0 ? means.x : means.y;
          }
          sum.shape = F::collect(splat.terms, sum.shape, sum.weighted);
          put_warp_sums(sum, times(contribution, grad.channels), sums + own_sum);
        }
        if (lane == 0) shared.hits[warp][from / kStateChunk] = shown;
      }
      __syncthreads();
      const auto write_sums = [&](auto used) {  // a constant, so that to divide by it costs little
        const int first_pair = part * kStateChunk, end_pair = min(count, part_end * kStateChunk);
        for (int t = first_pair * used + int(threadIdx.x); t < end_pair * used; t += Layout::kThreads) {
          const int j = t / used, v = t % used;
          float sum = shared.total(j, v, first_slot);
          const int32_t row = shared.rows[j];
          const auto put = [&](int column) {
            if (kMany && first > 0 && !list.overflow) sum += params.pair_grads[int64_t(row) * kPairGradWidth + column];
            put_sum(params.pair_grads, kPairGradWidth, list.overflow, row, column, sum);
          };
          if (v >= 6 && v < Shared::kMeans) {
            if (kMany) {
              put_sum(params.channel_sums, kChannelGroup, list.overflow, row, first % kChannelGroup + v - 6, sum);
            } else {
              put(v == 9 ? kPairFourthChannel : v);
            }
          } else if (with_shape) {
            put(v < 6 ? v : kPairMeans + v - Shared::kMeans);
          }
        }
      };
      if (with_means) {
        write_sums(std::integral_constant<int, Shared::kSums>());
      } else {
        write_sums(std::integral_constant<int, Shared::kMeans>());
      }
      if (part > 0) __syncthreads();  // all have read the sums
    }
  }
}

}  // namespace ar::cuda
