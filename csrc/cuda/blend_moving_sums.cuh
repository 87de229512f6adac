// The sums of pairs in blend_vjp for footprints whose samples move: each warp of a block leaves those of its pixels in
// shared memory, where they are added up and written.
#pragma once

#include <algorithm>

#include "cuda/blend_moving.cuh"

namespace ar::cuda {

static_assert(kStateChunk == 32, "a warp's chunk is a mask of 32 bits");

/// What a block keeps in shared memory. Sums of a pair: PairGrad, C channels, MeanSums.
template <class F, int C, class Layout, int kSegment = 0> struct MovingVjpShared {
  static constexpr int kMeans = 6 + C, kSums = kMeans + 2;
  /// In segments most pairs reach few of the many warps. There sums have slots only for the warps that a pair reaches,
  /// so that the warps have to wait for each other after more pairs.
  static constexpr bool kSparse = kSegment > 0 && Layout::kWarps > 2;
  /// Splats that a block takes between barriers: without kSparse two chunks with one cell. With more cells one, which
  /// leaves more shared memory for the places of samples.
  static constexpr int kDense = F::kSamples == 1 ? 2 * kStateChunk : kStateChunk;
  static constexpr int kBatch = kSparse ? std::min(kSegment, 16 * Layout::kWarps) : kDense;
  static constexpr int kChunks = kBatch / kStateChunk;
  /// No fewer than a chunk may need.
  static constexpr int kSlots = Layout::kWarps * (kSparse ? kStateChunk : kBatch);
  MovingStage<F, C, Layout, kBatch> stage;
  float sums[kSlots][kSums];               ///< of a warp's pixels
  uint32_t hits[Layout::kWarps][kChunks];  ///< splats that have sums of a warp
  int slots[kSparse ? kBatch + 1 : 1];   ///< those of pair j are [slots[j], slots[j + 1]), as if there was room for all
  alignas(16) int chunk_slots[kChunks];  ///< may be read 16 bytes at a time, which must not hold a slot as well
  int32_t rows[kBatch];
  Mat2<float> mean_maps[kBatch];
  int last[Layout::kWarps];  ///< of LastSplats

  /// Loads the batch that begins with pair k0, `id` = stage.splat_of(), with channels from `first` on and with_means
  /// what MeanSums need, and hands out the slots. All threads must call it.
  __device__ void load(const Splat<F, float>* splats, const BlendVjpParams& params, int first, const TileList& list,
                       int k0, int32_t id, bool with_means) {
    stage.load(splats, params.channels, first, list, id);
    if (id >= 0) {
      const int t = threadIdx.x;
      rows[t] = list.overflow ? id : list.slot(k0 + t);
      if (with_means) mean_maps[t] = F::mean_map(splats[id].shape);
    }
    set_slots();
  }
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

  /// Writes the sums of pairs [begin, end), kUsed of each: a constant, so that to divide by it costs little. `first`:
  /// the first of the channels; the kernels of those before have left their shares of the six other sums.
  /// `with_shape`: these sums and MeanSums too.
  template <int kUsed>
  __device__ void write(const BlendVjpParams& params, int first, bool with_shape, const TileList& list, int begin,
                        int end, int first_slot) const {
    constexpr bool kMany = C > kFewChannels;
    for (int t = begin * kUsed + int(threadIdx.x); t < end * kUsed; t += Layout::kThreads) {
      const int j = t / kUsed, v = t % kUsed;
      float sum = total(j, v, first_slot);
      const int32_t row = rows[j];
      const auto put = [&](int column) {
        if (kMany && first > 0 && !list.overflow) sum += params.pair_grads[int64_t(row) * kPairGradWidth + column];
        put_sum(params.pair_grads, kPairGradWidth, list.overflow, row, column, sum);
      };
      if (v >= 6 && v < kMeans) {
        if (kMany) {
          put_sum(params.channel_sums, kChannelGroup, list.overflow, row, first % kChannelGroup + v - 6, sum);
        } else {
          put(v == 9 ? kPairFourthChannel : v);
        }
      } else if (with_shape) {
        put(v < 6 ? v : kPairMeans + v - kMeans);
      }
    }
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

/// Sums MeanSums over a warp, where each lane has ShapeGrad::offset summed over its samples. `sums` is where
/// MovingVjpShared has those of the pair. All lanes must call it.
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
