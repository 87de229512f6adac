// Sums over pixels: the gradient of a pair. Warps write sums to shared memory or group_sums; VjpBatch::write adds them
// up to rows of pair_grads and channel_sums.
#pragma once

#include "cuda/moment/vjp_grads.cuh"

namespace ar::cuda {

static_assert(kStateChunk == 32, "a warp's chunk is a mask of 32 bits");

/// With kInside also the sums of groups.
template <class F, int C, class Layout, int kPairs, bool kInside> struct VjpBatch {
  static constexpr int kBatch = kPairs, kChunks = kPairs / kStateChunk;
  static constexpr int kMeans = 6 + C, kSums = kMeans + 2;
  /// Of a group: PairGrad, C channels, MeanSums.
  using SumsOfGroup = float[kPairs][kSums];
  MovingStage<F, C, Layout, kPairs> stage;
  uint32_t hits[Layout::kGroups][kChunks];  ///< pairs with sums of a group
  int32_t rows[kPairs];
  Mat2<float> mean_maps[kPairs];
  std::conditional_t<kInside, SumsOfGroup[Layout::kGroups], char> inside;

  __device__ void load(int t, const BlendVjpParams& params, int first, const TileList& list, int k0, int32_t id,
                       bool with_means) {
    stage.load_one(t, params, first, list, id);
    if (id < 0) return;
    rows[t] = list.slot(k0 + t);
    if (with_means) mean_maps[t] = F::mean_map(load_splat<F>(params.splats, id).shape);
  }
  __device__ bool is_hit(int group, int j) const { return hits[group][j / kStateChunk] >> (j % kStateChunk) & 1; }

  /// PairGrad is added to that of earlier channels.
  template <class Total>
  __device__ void write(const BlendVjpParams& params, int first, WantedSums<C> wanted, const TileList& list, int count,
                        Total&& total) const {
    if (wanted.means) {
      write_first<kSums>(params, first, wanted, list, count, total);
    } else {
      write_first<kMeans>(params, first, wanted, list, count, total);
    }
  }

 private:
  /// kUsed: sums of a pair, a constant for cheap divisions.
  template <int kUsed, class Total>
  __device__ void write_first(const BlendVjpParams& params, int first, WantedSums<C> wanted, const TileList& list,
                              int count, Total&& total) const {
    for (int t = int(threadIdx.x); t < count * kUsed; t += Layout::kThreads) {
      const int j = t / kUsed, v = t % kUsed;
      float sum = total(j, v);
      const int32_t row = rows[j];
      const auto put = [&](int column) {
        if (wanted.kMany && first > 0 && !list.of_patch)
          sum += params.pair_grads[int64_t(row) * kPairGradWidth + column];
        put_sum(params.pair_grads, kPairGradWidth, list.of_patch, row, column, sum);
      };
      if (v >= 6 && v < kMeans) {
        if (wanted.kMany) {
          put_sum(params.channel_sums, kChannelGroup, list.of_patch, row, first % kChannelGroup + v - 6, sum);
        } else {
          put(v == 9 ? kPairFourthChannel : v);
        }
      } else if (wanted.shape) {
        put(v < 6 ? v : kPairMeans + v - kMeans);
      }
    }
  }
};

/// Of pairs that no sample composited.
template <int kThreads>
__device__ void clear_pairs(const BlendVjpParams& params, const TileList& list, int begin, int end, int first) {
  if (first % kChannelGroup != 0 || list.of_patch) return;
  for (int k = begin + int(threadIdx.x) / kClearThreads; k < end; k += kThreads / kClearThreads)
    clear_pair_together<kChannelGroup>(params, list.slot(k), first == 0);
}

/// The sum that a lane gets from put_warp_sums.
template <int C> __device__ int sum_of_lane() { return summed_value<(C <= kFewChannels) ? 6 + C : 8>(lane_id()); }

/// `sums`: address of the lane's sum_of_lane().
template <int C> __device__ void put_warp_sums(const PairGrad<float>& grad, const Values<C>& channels, float* sums) {
  const ShapeGrad<float>& shape = grad.shape;
  float values[C <= kFewChannels ? 6 + C : 8] = {shape.offset.x, shape.offset.y, shape.shape.xx,
                                                 shape.shape.xy, shape.shape.yy, grad.weighted};
  if constexpr (C <= kFewChannels) {
    AR_UNROLL for (int c = 0; c < C; ++c) values[6 + c] = channels.v[c];
    *sums = sum_values(values);  // by all lanes: cheaper than a test
  } else {
    static_assert(C == 8);
    const float sum = sum_values(values), of_channels = sum_values(channels.v);
    const int lane = lane_id();
    if (lane % 4 != 0) return;
    if (lane < 24) *sums = sum;
    sums[6] = of_channels;
  }
}

/// Into sums[0] and sums[1]. `offset`: summed over the lane's samples.
template <class Layout>
__device__ void put_warp_means(const BlendVjpParams& params, const Mat2<float>& mean_map, Vec2<float> offset,
                               float* sums) {
  const int lane = lane_id();
  offset = {Layout::sum_lanes(offset.x), Layout::sum_lanes(offset.y)};
  const Vec2<float> size = {float(params.grid.width), float(params.grid.height)};
  Vec2<float> means = mean_sums_of(params.mean_sums, size, transform_transposed(mean_map, offset));
  if (Layout::first_sample() > 0) means = {0, 0};
  means = {warp_sum(means.x), warp_sum(means.y)};
  if (lane < 2) sums[lane] = lane == 0 ? means.x : means.y;
}

}  // namespace ar::cuda
