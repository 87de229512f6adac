// Kernel of blend_vjp for footprints whose samples move: a block per tile of 8x8 pixels, a lane per few cells of a
// pixel, back to front.
//
// The state of a sample in front of a splat cannot be had from the state behind it, since the displacement depends on
// itself through alpha. So a warp composites each chunk of 32 splats once more, from the checkpoint that blend has left
// in front of it, keeps where the samples were in front of each splat, and then walks back over those that its pixels
// show.
//
// dL/dalpha is linear in the gradient of the image: of many channels each kernel adds the share of its own to the six
// sums of a pair, which a single block owns. Only MeanSums need all channels at once: where they are wanted, the first
// kernel makes all sums, and reads the channels of the others where they lie.
#pragma once

#include <algorithm>

#include "cuda/blend_moving.cuh"

namespace ar::cuda {

static_assert(kStateChunk == 32, "a warp's chunk is a mask of 32 bits");

/// What a block keeps in shared memory. Sums of a pair: PairGrad, C channels, MeanSums.
template <class F, int C, class Layout> struct MovingVjpShared {
  static constexpr int kMeans = 6 + C, kSums = kMeans + 2;
  /// Splats that a block takes between barriers: two chunks, if a block of any device has room for their sums.
  static constexpr int kBatch = Layout::kWarps * kSums <= 192 ? 2 * kStateChunk : kStateChunk;
  MovingStage<F, C, Layout, kBatch> stage;
  float sums[Layout::kWarps][kBatch][kSums];            ///< of a warp's pixels
  uint32_t hits[Layout::kWarps][kBatch / kStateChunk];  ///< splats that have sums of a warp
  int32_t rows[kBatch];
  Mat2<float> mean_maps[kBatch];
  int last[Layout::kWarps];  ///< place behind the last splat that a warp composited
};

/// Sums PairGrad and `channels` over a warp, in `sums` as MovingVjpShared has them. All lanes must call it.
template <int C> __device__ void put_warp_sums(const PairGrad<float>& grad, const Values<C>& channels, float* sums) {
  const ShapeGrad<float>& shape = grad.shape;
  const int lane = lane_id();
  const float of_shape[6] = {shape.offset.x, shape.offset.y, shape.shape.xx,
                             shape.shape.xy, shape.shape.yy, grad.weighted};
  float values[C <= kFewChannels ? 6 + C : 8] = {};
#pragma unroll
  for (int v = 0; v < 6; ++v) values[v] = of_shape[v];
  if constexpr (C <= kFewChannels) {
#pragma unroll
    for (int c = 0; c < C; ++c) values[6 + c] = channels.v[c];
    const float sum = sum_values(values);
    const int value = summed_value<6 + C>(lane);
    if (value >= 0) sums[value] = sum;
  } else {
    static_assert(C == 8);
    const float sum = sum_values(values), of_channels = sum_values(channels.v);
    if (lane % 4 != 0) return;
    if (lane < 24) sums[lane / 4] = sum;
    sums[6 + lane / 4] = of_channels;
  }
}

/// Threads that an SM should hold: bounds the registers, as waiting for the samples in front costs more than a few
/// numbers in memory.
template <int C> inline constexpr int kMovingVjpThreads = C == 3 ? 1024 : 512;

template <class F, int C, class Layout>
__global__ void __launch_bounds__(Layout::kThreads, std::max(1, kMovingVjpThreads<C> / Layout::kThreads))
    moving_vjp_kernel(const BlendVjpParams params, int first) {
  using Shared = MovingVjpShared<F, C, Layout>;
  using Samples = MovingSamples<F, Layout>;
  constexpr int S = F::kSamples, kCells = Layout::kCells, kBatch = Shared::kBatch;
  Shared& shared = *reinterpret_cast<Shared*>(dynamic_shared());
  const int tile = listed_tile<S>(params, int(blockIdx.x));
  if (tile < 0) return;
  const TileList list = list_of(params.lists, params.grid, tile);
  const StatePlaces places(params.lists, list, params.grid, tile);
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const int lane = lane_id(), warp = threadIdx.x / 32, channel_count = params.channels.count;
  const bool with_means = params.mean_sums != MeanSums::kNone, all_at_once = with_means && channel_count > C;
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
  if (first % kChannelGroup == 0 && !list.overflow) {  // pairs that nothing reached
    constexpr int kQuads = kChannelGroup / 4;
    for (int k = tile_last + threadIdx.x / kQuads; k < list.count; k += Layout::kThreads / kQuads) {
      const int q = threadIdx.x % kQuads;
      const int64_t slot = list.slot(k);
      const float4 zero = {0, 0, 0, 0};
      if (first == 0 && q < kPairGradWidth / 4)
        reinterpret_cast<float4*>(params.pair_grads + slot * kPairGradWidth)[q] = zero;
      if (params.channel_sums) reinterpret_cast<float4*>(params.channel_sums + slot * kChannelGroup)[q] = zero;
    }
  }

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
  float behind[kCells];
  Vec2<float> dL_dplace[kCells];
#pragma unroll
  for (int i = 0; i < kCells; ++i) behind[i] = through, dL_dplace[i] = {0, 0};

  Vec2<float> places_in_front[kStateChunk][kCells];
  // Composites those of the staged splats [from, from + 32) that reach the warp; the first of them is pair k. Returns
  // those that a sample of the warp shows, and keeps the places of the samples in front of all.
  const auto replay = [&](int from, int k) {
    uint32_t shown = 0;
    int kept = 0;
    for (uint32_t mask = shared.stage.reached(from); mask != 0; mask &= mask - 1, ++kept) {
      const int bit = __ffs(mask) - 1;
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

  int k0 = (tile_last - 1) / kBatch * kBatch;
  int32_t id = shared.stage.splat_of(list, k0, tile_last);
  for (int k1 = tile_last; k1 > 0; k1 = k0, k0 -= kBatch) {
    const int count = k1 - k0;
    if (places.spacing > kStateChunk) {  // with too many pairs: from the checkpoint to the batch
      int k = k0 / places.spacing * places.spacing;
      samples.load(params.checkpoints, places, k);
      for (; k < k0; k += kBatch) {
        __syncthreads();
        shared.stage.load(splats, params.channels, first, list, shared.stage.splat_of(list, k, k0));
        __syncthreads();
        for (int from = 0; from < kBatch; from += kStateChunk) replay(from, k + from);
      }
    }
    const int32_t next_id = k0 > 0 ? shared.stage.splat_of(list, k0 - kBatch, k0) : -1;
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
        if (places.spacing > kStateChunk) {
          samples = at_batch;
          for (int ahead = 0; ahead < from; ahead += kStateChunk) replay(ahead, k0 + ahead);
        } else {
          samples.load(params.checkpoints, places, k0 + from);
        }
        shown = replay(from, k0 + from);
      }
      const uint32_t reached = shared.stage.reached(from);
      for (uint32_t mask = shown; mask != 0;) {
        const int bit = 31 - __clz(mask), j = from + bit;
        mask ^= 1u << bit;
        const int kept = __popc(reached & ((1u << bit) - 1));
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
          const MovingBlendGrad<float> grad =
              blend_placed_sample_vjp<F>(splat.terms, z, mask ? raw : 0.0f, samples.bounds[i], g_color, place,
                                         samples.transmittance[i], behind[i], dL_dplace[i]);
          const PairGrad<float> of_sample = {grad.of_splat.sums, grad.of_splat.weighted};
          sum = i == 0 ? of_sample : sum + of_sample;
          contribution = i == 0 ? grad.contribution : contribution + grad.contribution;
        }
        float* sums = shared.sums[warp][j];
        if (with_means && with_shape) {
          const Vec2<float> offset = {Layout::sum_lanes(sum.shape.offset.x), Layout::sum_lanes(sum.shape.offset.y)};
          const Vec2<float> size = {float(params.grid.width), float(params.grid.height)};
          Vec2<float> means = mean_sums_of(params.mean_sums, size, transform_transposed(shared.mean_maps[j], offset));
          if (Layout::first_sample() > 0) means = {0, 0};  // once for a pixel
          means = {warp_sum(means.x), warp_sum(means.y)};
          if (lane < 2) sums[Shared::kMeans + lane] = lane == 0 ? means.x : means.y;
        }
        sum.shape = F::collect(splat.terms, sum.shape, sum.weighted);
        put_warp_sums(sum, times(contribution, g), sums);
      }
      if (lane == 0) shared.hits[warp][from / kStateChunk] = shown;
    }
    __syncthreads();
    const int used = with_means ? Shared::kSums : Shared::kMeans;
    for (int t = threadIdx.x; t < count * used; t += Layout::kThreads) {
      const int j = t / used, v = t % used;
      float sum = 0;
#pragma unroll
      for (int w = 0; w < Layout::kWarps; ++w) {
        if (shared.hits[w][j / kStateChunk] >> (j % kStateChunk) & 1) sum += shared.sums[w][j][v];
      }
      const int32_t row = shared.rows[j];
      const auto put = [&](int column) {
        if (first > 0 && !list.overflow) sum += params.pair_grads[int64_t(row) * kPairGradWidth + column];
        put_sum(params.pair_grads, kPairGradWidth, list.overflow, row, column, sum);
      };
      if (v >= 6 && v < Shared::kMeans) {
        if (C > kFewChannels) {
          put_sum(params.channel_sums, kChannelGroup, list.overflow, row, first % kChannelGroup + v - 6, sum);
        } else {
          put(v == 9 ? kPairFourthChannel : v);
        }
      } else if (with_shape) {
        put(v < 6 ? v : kPairMeans + v - Shared::kMeans);
      }
    }
  }
}

}  // namespace ar::cuda
