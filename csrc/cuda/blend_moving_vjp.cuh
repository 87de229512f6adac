// Kernel of blend_vjp for footprints whose samples move: a block per tile of 8x8 pixels, a lane per few cells of a
// pixel, back to front.
//
// The state of a sample in front of a splat cannot be had from the state behind it, since the displacement depends on
// itself through alpha. So a warp composites each chunk of 32 splats once more, from the checkpoint that blend has left
// in front of it, keeps where the samples were in front of each splat, and then walks back over those that its pixels
// show.
//
// In small images a block has a segment of a tile's list, so that long lists are differentiated side by side. What the
// samples carry from splat to splat on the way back goes through a segment as an affine map. So one kernel finds the
// map of every segment, another chains them from the last segment to the first, and a third has the sums, each segment
// from what it gets from behind.
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
template <class F, int C, class Layout> struct MovingVjpShared {
  static constexpr int kMeans = 6 + C, kSums = kMeans + 2;
  /// Splats that a block takes between barriers: two chunks, if a block of any device has room for their sums. With
  /// many cells one, which leaves more fast memory for the places of samples, and fewer numbers are spilled.
  static constexpr int kBatch = F::kSamples <= 4 && Layout::kWarps * kSums <= 192 ? 2 * kStateChunk : kStateChunk;
  MovingStage<F, C, Layout, kBatch> stage;
  float sums[Layout::kWarps][kBatch][kSums];            ///< of a warp's pixels
  uint32_t hits[Layout::kWarps][kBatch / kStateChunk];  ///< splats that have sums of a warp
  int32_t rows[kBatch];
  Mat2<float> mean_maps[kBatch];
  int last[Layout::kWarps];  ///< place behind the last splat that a warp composited
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
struct AdjointMap {
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
    return first[(piece * AdjointMap::kNumbers + number) * kPlane];
  }
  __device__ Adjoint adjoint(int64_t piece, int number = 0) const {
    return {at(piece, number), {at(piece, number + 1), at(piece, number + 2)}};
  }
  __device__ AdjointMap map(int64_t piece) const {
    return {adjoint(piece), adjoint(piece, 3), {at(piece, 6), at(piece, 7)}, {at(piece, 8), at(piece, 9)}};
  }
  __device__ void put(int64_t piece, const Adjoint& a, int number = 0) const {
    at(piece, number) = a.behind;
    at(piece, number + 1) = a.dL_dplace.x;
    at(piece, number + 2) = a.dL_dplace.y;
  }
  __device__ void put(int64_t piece, const AdjointMap& m) const {
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
    AdjointMap maps[kAhead];
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
/// from behind. kMaps: finds the maps of the segments instead of the sums, but of the first ones, which nobody needs.
/// `overflow_only`: other kernels do the work, unless there were too many pairs.
template <class F, int C, class Layout, int kSegment = 0, bool kMaps = false>
__global__ void __launch_bounds__(Layout::kThreads, std::max(1, kMovingVjpThreads<C> / Layout::kThreads))
    moving_vjp_kernel(const BlendVjpParams params, int first, bool overflow_only) {
  using Shared = MovingVjpShared<F, C, Layout>;
  using Samples = MovingSamples<F, Layout, (kSegment > 0)>;
  constexpr int S = F::kSamples, kCells = Layout::kCells, kBatch = Shared::kBatch, kColumns = kMaps ? 4 : 1;
  constexpr bool kMany = C > kFewChannels;  // `first` may be above 0, and there may be more channels than C
  static_assert(kSegment % kBatch == 0 && Layout::kBlocks == 1);
  Shared& shared = *reinterpret_cast<Shared*>(dynamic_shared());
  TilePiece piece = {0, 0};
  if constexpr (kSegment > 0) {
    piece = find_piece(params.lists, params.grid, kSegment, blockIdx.x);
    if (kMaps && piece.index == 0) return;
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
  Samples samples(pixel.inside);

  int last[kCells], warp_last = 0;
#pragma unroll
  for (int i = 0; i < kCells; ++i) {
    last[i] =
        pixel.inside && samples.exists(i) ? params.last[(Layout::first_sample() + i) * pixel.image + pixel.index] : 0;
    warp_last = max(warp_last, last[i]);
  }
  warp_last = warp_max(warp_last);
  if (lane == 0) shared.last[warp] = warp_last;
  __syncthreads();
  int tile_last = 0;
#pragma unroll
  for (int w = 0; w < Layout::kWarps; ++w) tile_last = max(tile_last, shared.last[w]);
  if (!kMaps && first % kChannelGroup == 0 && !list.overflow) {  // pairs that nothing reached
    constexpr int kQuads = kChannelGroup / 4;
    const int rest = min(list.count, end);
    for (int k = max(tile_last, begin) + threadIdx.x / kQuads; k < rest; k += Layout::kThreads / kQuads) {
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
  const auto gradient = [&](int channel) {  // with respect to a channel of one sample
    const float* plane = channel < channel_count ? params.dL_dimage.plane(channel, pixel.image) : nullptr;
    return pixel.inside && plane ? 1.0f / S * plane[pixel.index] : 0.0f;
  };
  Values<C> g;
  float through = 0;  // what the background gives
#pragma unroll
  for (int c = 0; c < C; ++c) {
    g.v[c] = gradient(first + c);
    if (first + c < channel_count) through += g.v[c] * params.background[first + c];
  }
  if (all_at_once && first == 0) {
    for (int c = C; c < channel_count; ++c) through += gradient(c) * params.background[c];
  }
  // Alpha is 1 - transmittance: its gradient acts like one more channel whose background is -1.
  if (first == 0 && params.dL_dalpha && pixel.inside) through -= 1.0f / S * params.dL_dalpha[pixel.index];
  Adjoint adjoint[kCells][kColumns];
#pragma unroll
  for (int i = 0; i < kCells; ++i) {
    adjoint[i][0] = {through, {0, 0}};
    if (kSegment > 0 && last[i] > end) adjoint[i][0] = kMaps ? Adjoint{0, {0, 0}} : maps_of(i).adjoint(number + 1);
    if constexpr (kMaps) {
      adjoint[i][1] = {1, {0, 0}};
      adjoint[i][2] = {0, {1, 0}};
      adjoint[i][3] = {0, {0, 1}};
    }
  }

  float* const lane_sums = &shared.sums[warp][0][sum_of_lane<C>()];
  Vec2<float> places_in_front[kStateChunk][kCells];
  // Composites those of the staged splats [from, from + 32) that reach the warp; the first of them is pair k. Returns
  // those that a sample of the warp shows, and keeps the places of the samples in front of all.
  const auto replay = [&](int from, int k) {
    uint32_t shown = 0;
    int kept = 0;
    for (uint32_t left = shared.stage.reached(from); left != 0; ++kept) {
      const int bit = take_first(left);
      const auto& terms = shared.stage.splats[from + bit].terms;
      const Vec2<float> of_pixel = transform(terms.w, p, terms.node[0]);
      bool any = false;
#pragma unroll
      for (int i = 0; i < kCells; ++i) {
        const Vec2<float> z = F::whitened_node(terms, of_pixel, samples.place[i]);
        places_in_front[kept][i] = samples.place[i];
        any |= replay_placed_sample<F>(terms, z, exp2(F::log_alpha(terms, z)), k + bit < last[i], samples.bounds[i],
                                       samples.transmittance[i], samples.place[i]);
      }
      shown |= uint32_t(any) << bit;
    }
    return warp_or(shown);
  };

  const int stop = min(tile_last, end);
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
    __syncthreads();
    if (next_id >= 0) prefetch(splats + next_id);  // so that the next batch need not wait for memory
    id = next_id;
    const Samples at_batch = samples;
    for (int from = kBatch - kStateChunk; from >= 0; from -= kStateChunk) {
      uint32_t shown = 0;
      if (k0 + from < warp_last) {
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
        const Vec2<float> of_pixel = transform(splat.terms.w, p, splat.terms.node[0]);
        float g_color = g.v[0] * splat.channels.v[0];
#pragma unroll
        for (int c = 1; c < C; ++c) g_color = madd(g.v[c], splat.channels.v[c], g_color);
        if (all_at_once && first == 0) {
          const float* row = params.channels.row(list.splat(k0 + j));
          for (int c = C; c < channel_count; ++c) g_color = madd(gradient(c), row[c], g_color);
        }
        PairGrad<float> sum = {};
        float contribution = 0;
#pragma unroll
        for (int i = 0; i < kCells; ++i) {
          const Vec2<float> place = places_in_front[kept][i];
          const Vec2<float> z = F::whitened_node(splat.terms, of_pixel, place);
          const float raw = exp2(F::log_alpha(splat.terms, z));
          const bool mask = raw >= float(kAlphaMin) && k0 + j < last[i];
          MovingBlendGrad<float> grad;
          float in_front = 1;
#pragma unroll
          for (int c = kColumns - 1; c >= 0; --c) {  // the sums are those of the first
            Adjoint& a = adjoint[i][c];
            in_front = samples.transmittance[i];
            grad = blend_placed_sample_vjp<F>(splat.terms, z, mask ? raw : 0.0f, samples.bounds[i],
                                              c == 0 ? g_color : 0.0f, place, in_front, a.behind, a.dL_dplace);
          }
          samples.transmittance[i] = in_front;
          const PairGrad<float> of_sample = {grad.of_splat.sums, grad.of_splat.weighted};
          sum = i == 0 ? of_sample : sum + of_sample;
          contribution = i == 0 ? grad.contribution : contribution + grad.contribution;
        }
        if (kMaps) continue;
        if (with_means && with_shape) {
          const Vec2<float> offset = {Layout::sum_lanes(sum.shape.offset.x), Layout::sum_lanes(sum.shape.offset.y)};
          const Vec2<float> size = {float(params.grid.width), float(params.grid.height)};
          Vec2<float> means = mean_sums_of(params.mean_sums, size, transform_transposed(shared.mean_maps[j], offset));
          if (Layout::first_sample() > 0) means = {0, 0};  // once for a pixel
          means = {warp_sum(means.x), warp_sum(means.y)};
          if (lane < 2) shared.sums[warp][j][Shared::kMeans + lane] = lane == 0 ? means.x : means.y;
        }
        sum.shape = F::collect(splat.terms, sum.shape, sum.weighted);
        put_warp_sums(sum, times(contribution, g), lane_sums + j * Shared::kSums);
      }
      if (lane == 0) shared.hits[warp][from / kStateChunk] = shown;
    }
    if (kMaps) continue;
    __syncthreads();
    const auto write_sums = [&](auto used) {  // a constant, so that to divide by it costs little
      for (int t = threadIdx.x; t < count * used; t += Layout::kThreads) {
        const int j = t / used, v = t % used;
        float sum = 0;
#pragma unroll
        for (int w = 0; w < Layout::kWarps; ++w) {
          if (shared.hits[w][j / kStateChunk] >> (j % kStateChunk) & 1) sum += shared.sums[w][j][v];
        }
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
  }
  if constexpr (kMaps) {
#pragma unroll
    for (int i = 0; i < kCells; ++i) {
      const Adjoint(&a)[kColumns] = adjoint[i];
      if (last[i] > begin) maps_of(i).put(number, AdjointMap{a[0], a[1], a[2].dL_dplace, a[3].dL_dplace});
    }
  }
}

}  // namespace ar::cuda
