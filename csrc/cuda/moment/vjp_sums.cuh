// A library for the backward kernels of footprints whose samples move: the sums over pixels that make the gradient of a
// pair. Each warp writes the sums of its pixels to shared memory or, for some segments, to BlendVjpParams::group_sums;
// write_pairs adds up the warps and writes rows of pair_grads and channel_sums.
#pragma once

#include <algorithm>

#include "cuda/moment/cells.cuh"

namespace ar::cuda {

static_assert(kStateChunk == 32, "a warp's chunk is a mask of 32 bits");

/// write_pairs() for kUsed sums of each pair, a constant so that divisions by it cost little.
template <int kUsed, int C, int kThreads, class Total>
__device__ void write_sums(const BlendVjpParams& params, int first, bool with_shape, const TileList& list,
                           const int32_t* rows, int count, Total&& total) {
  constexpr bool kMany = C > kFewChannels;
  constexpr int kMeans = 6 + C;
  for (int t = int(threadIdx.x); t < count * kUsed; t += kThreads) {
    const int j = t / kUsed, v = t % kUsed;
    float sum = total(j, v);
    const int32_t row = rows[j];
    const auto put = [&](int column) {
      if (kMany && first > 0 && !list.of_patch) sum += params.pair_grads[int64_t(row) * kPairGradWidth + column];
      put_sum(params.pair_grads, kPairGradWidth, list.of_patch, row, column, sum);
    };
    if (v >= 6 && v < kMeans) {
      if (kMany) {
        put_sum(params.channel_sums, kChannelGroup, list.of_patch, row, first % kChannelGroup + v - 6, sum);
      } else {
        put(v == 9 ? kPairFourthChannel : v);
      }
    } else if (with_shape) {
      put(v < 6 ? v : kPairMeans + v - kMeans);
    }
  }
}

/// Writes the sums total(j, v) of the first `count` pairs of a batch: C channels from `first` on, with_shape the six
/// sums of PairGrad, and with_means MeanSums. To the six sums it adds what the kernels of earlier channels have
/// written. `rows`: [count] row of each pair.
template <int C, int kThreads, class Total>
__device__ void write_pairs(const BlendVjpParams& params, int first, bool with_means, bool with_shape,
                            const TileList& list, const int32_t* rows, int count, Total&& total) {
  constexpr int kMeans = 6 + C;
  if (with_means) {
    write_sums<kMeans + 2, C, kThreads>(params, first, with_shape, list, rows, count, total);
  } else {
    write_sums<kMeans, C, kThreads>(params, first, with_shape, list, rows, count, total);
  }
}

/// What a block of moving_vjp_kernel keeps in shared memory. Sums of a pair: PairGrad, C channels, MeanSums.
template <class F, int C, class Layout> struct MovingVjpShared {
  static constexpr int kMeans = 6 + C, kSums = kMeans + 2;
  /// Splats between barriers: two chunks with one cell of a lane; with more cells one, which leaves more shared memory
  /// for the positions of samples.
  static constexpr int kBatch = Layout::kCells == 1 ? 2 * kStateChunk : kStateChunk, kChunks = kBatch / kStateChunk;
  MovingStage<F, C, Layout, kBatch> stage;
  float sums[Layout::kWarps][kBatch][kSums];  ///< of a warp's pixels
  uint32_t hits[Layout::kWarps][kChunks];     ///< splats that have sums of a warp
  int32_t rows[kBatch];
  Mat2<float> mean_maps[kBatch];
  int last[Layout::kWarps];  ///< of LastSplats

  /// Loads the batch that begins with pair k0, `id` = stage.splat_of(), with channels from `first` on, and with_means
  /// also what MeanSums need. All threads must call it.
  __device__ void load(const float* splats, const BlendVjpParams& params, int first, const TileList& list, int k0,
                       int32_t id, bool with_means) {
    stage.load(params, first, list, id);
    if (id >= 0) {
      const int t = threadIdx.x;
      rows[t] = list.slot(k0 + t);
      if (with_means) mean_maps[t] = F::mean_map(load_splat<F>(splats, id).shape);
    }
  }
  /// Value v of the sums of all warps for pair j.
  __device__ float total(int j, int v) const {
    float sum = 0;
#pragma unroll
    for (int w = 0; w < Layout::kWarps; ++w) {
      if (hits[w][j / kStateChunk] >> (j % kStateChunk) & 1) sum += sums[w][j][v];
    }
    return sum;
  }
};

/// The number of the sum that a lane has after put_warp_sums.
template <int C> __device__ int sum_of_lane() { return summed_value<(C <= kFewChannels) ? 6 + C : 8>(lane_id()); }

/// Sums PairGrad and `channels` over a warp into `sums`, the address of sum sum_of_lane() of the pair. All lanes must
/// call it.
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

/// Sums MeanSums over a warp into sums[0] and sums[1]; `offset`: ShapeGrad::offset summed over the lane's samples. All
/// lanes must call it.
template <class Layout>
__device__ void put_warp_means(const BlendVjpParams& params, const Mat2<float>& mean_map, Vec2<float> offset,
                               float* sums) {
  const int lane = lane_id();
  offset = {Layout::sum_lanes(offset.x), Layout::sum_lanes(offset.y)};
  const Vec2<float> size = {float(params.grid.width), float(params.grid.height)};
  Vec2<float> means = mean_sums_of(params.mean_sums, size, transform_transposed(mean_map, offset));
  if (Layout::first_sample() > 0) means = {0, 0};  // once for a pixel
  means = {warp_sum(means.x), warp_sum(means.y)};
  if (lane < 2) sums[lane] = lane == 0 ? means.x : means.y;
}

}  // namespace ar::cuda
