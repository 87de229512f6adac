// A warp of blend_vjp on its way back to front through the pairs of its chunk, for up to four channels.
#pragma once

#include "cuda/blend_vjp_chunk.cuh"
#include "cuda/blend_vjp_sums.cuh"

namespace ar::cuda {

/// Takes the pixels of a tile back to front through the pairs of a chunk, and sums over them what each pair gives.
template <class F, int C, Sums kSums> class ChunkWalk {
 public:
  static constexpr int kGroup = kVjpGroup<F, kSums>;
  using Group = VjpGroup<F, C, kGroup>;
  using Pixels = LanePixels<F, C, kSums>;

  /// `first`: of the samples that the warp takes. `group`: of the warps that share the chunk.
  __device__ __forceinline__ ChunkWalk(const BlendVjpParams& params, const VjpChunk& chunk, int first, Pixels& pixels,
                                       Group& group)
      : params_(params), chunk_(chunk), list_(chunk.list), pixels_(pixels), group_(group), first_(first) {}

  /// Goes through the whole chunk, in batches of 32 pairs: lists those that reach a pixel, then takes the pixels
  /// through these. `tile_last`: of find_last(). All warps that share the chunk must call it.
  __device__ __forceinline__ void run(int tile_last) {
    static_assert(kLength % 32 == 0);  // no batch begins before the chunk
    const bool lists = first_ == 0;    // one of the warps that share the chunk
    for (int k1 = min(chunk_.end, tile_last); k1 > chunk_.begin; k1 = (k1 - 1) / 32 * 32) {
      const int k0 = (k1 - 1) / 32 * 32, k = k0 + lane_;
      uint32_t reach = 0;
      Mat2<float> mean_map = {0, 0, 0, 0};
      group_sync();  // all have read the last batch
      // A lane for each pair. Not in a function of its own, with which some kernels get more instructions.
      Splat<F, float> own;
      int32_t id = 0, row = 0;
      if (k < k1) {
        id = list_.splat(k);
        row = list_.slot(k);
        own = splats_[id];
        reach = subtile_reach<F>(own, list_.x0, list_.y0);
#pragma unroll
        for (int b = 0; b < kSubtiles; ++b) reach &= ~(uint32_t(k >= group_.subtile_last[b]) << b);
        if (kMeans) mean_map = F::mean_map(own.shape);
        if (kGrads && reach == 0 && lists && !list_.of_patch) clear_pair(params_, row);
      }
      const uint32_t reaching = __ballot_sync(kAllLanes, reach != 0);
      if (reach && lists) {
        group_.splats[__popc(reaching >> lane_ >> 1)] = {
            tile_terms(own, list_), channels_of<C>(params_.channels, own, id), reach | uint32_t(lane_) << 27, row};
      }
      const int listed = __popc(reaching);
      group_sync();
      // Which MeanSums is known to the compiler, since pixels must not branch on it.
      if constexpr (!kMeans) {
        walk_listed<MeanSums::kNone>(k0, listed, mean_map);
      } else if (params_.mean_sums == MeanSums::kNorm) {
        walk_listed<MeanSums::kNorm>(k0, listed, mean_map);
      } else {
        walk_listed<MeanSums::kAbsolute>(k0, listed, mean_map);
      }
      if constexpr (kGroup > 1 && kGrads) sum_warps(listed);
    }
  }

 private:
  static constexpr int S = F::kSamples, kLength = chunk_length(S), kSumCount = 6 + C;
  static constexpr bool kGrads = kSums != Sums::kMeans, kMeans = kSums != Sums::kGrads;
  /// Whether the sums of several pairs are added up together, by PairSums.
  static constexpr bool kPairSums = kHoldsSamples<F, C>;
  static_assert(kGrads || !kPairSums);  // or there would be no sums to add up in shared memory
  /// A listed splat in use. A shared-out sample's number is not known when the code is compiled: keep its node
  /// indexable.
  using SplatInUse = std::conditional_t<kGroup == 1, ListedSplatRef<F, C>, const ListedSplat<F, C>&>;

  /// A barrier for the warps that share the chunk.
  __device__ __forceinline__ static void group_sync() {
    if constexpr (kGroup > 1) {
      __syncthreads();
    } else {
      __syncwarp();
    }
  }

  /// Takes the pixels through the listed splats, the first of which is the last of the tile's list. The batch begins
  /// with pair k0; `mean_map`: of the lane's own pair, for MeanSums.
  template <MeanSums kKind> __device__ void walk_listed(int k0, int listed, const Mat2<float>& mean_map) {
    if constexpr (kPairSums) {
      for (int n = 0; n < listed; n += PairSums::kPairs) {
        const int count = min(listed - n, PairSums::kPairs);
        const auto* splat = group_.splats + n;
        PairSums::Pair* pair = group_.pair_sums.pairs;
        for (int left = count; left > 0; --left) walk<kKind>(*splat++, k0, mean_map, *pair++);
        sum_pairs(n, count);
      }
    } else {
      for (int n = 0; n < listed; ++n) walk<kKind>(group_.splats[n], k0, mean_map, n);
    }
  }

  /// Takes the pixels that a listed splat reaches through it, and sums over them. `to`: where the values for its sums
  /// go, or its number among those that are listed.
  template <MeanSums kKind, class To>
  __device__ void walk(const ListedSplat<F, C>& listed, int k0, const Mat2<float>& mean_map, To&& to) {
    SplatInUse splat = listed;
    // By a ballot, so that the compiler knows that all lanes branch alike.
    const uint32_t reached = __ballot_sync(kAllLanes, splat.reach_and_place & subtile_bit_);
    const int j = int(splat.reach_and_place >> 27), at = k0 + j;
    const Mat2<float> m =
        !kMeans ? mean_map
                : Mat2<float>{__shfl_sync(kAllLanes, mean_map.xx, j), __shfl_sync(kAllLanes, mean_map.xy, j),
                              __shfl_sync(kAllLanes, mean_map.yx, j), __shfl_sync(kAllLanes, mean_map.yy, j)};
    ShapeGrad<float> shape = {{0, 0}, {0, 0, 0}};
    float weighted = 0;
    Values<C> channels = {};
    Vec2<float> means = {0, 0};
    visit_subtiles<F, C>(reached, p0_, [&](int b, Vec2<float> p) {
      add_pixel<kKind>(splat, at, m, b, p, shape, weighted, channels, means);
    });
    const int32_t row = splat.row;
    if constexpr (kGrads) put_grads(splat.terms, row, shape, weighted, channels, to);
    if (kMeans) {
      const float total = warp_sum_of_two(means.x, means.y);
      if (lane_ % 16 == 0) put(row, kPairMeans + lane_ / 16, total);
    }
  }

  /// Takes the lane's pixel of subtile b, at p, from behind a splat to its front, and adds to the lane's sums: `shape`
  /// as it is before F::collect, `means` of MeanSums. `at`: the splat's place in the tile's list; by reference,
  /// as the compiler else turns comparisons with it around.
  template <MeanSums kKind>
  __device__ void add_pixel(const SplatInUse& splat, const int& at, const Mat2<float>& mean_map, int b, Vec2<float> p,
                            ShapeGrad<float>& shape, float& weighted, Values<C>& channels, Vec2<float>& means) {
    const float4 g = pixels_.gradient(b);
    const Values<4> of_pixel_g = {{g.x, g.y, g.z, g.w}};
    float g_color = madd(g.x, splat.channels.v[0], madd(g.y, splat.channels.v[1], g.z * splat.channels.v[2]));
    if (C > 3) g_color = madd(g.w, splat.channels.v[C - 1], g_color);
    float contribution = 0;
    ShapeGrad<float> of_pixel = {{0, 0}, {0, 0, 0}};
#pragma unroll
    for (int s = 0; s < kVjpSamples<F, kSums>; ++s) {
      const int node = kGroup == 1 ? s : first_ + s;
      const float alpha = F::alpha(splat.terms, p, node);
      // Both are worked out: to read the second only after the first would be to wait for it.
      const bool mask = (alpha >= float(kAlphaMin)) & (at < pixels_.last_of(s, b, g));
      if (s == 0 && S == 1 && !kTakesTwo<F, C> && !__any_sync(kAllLanes, mask)) break;
      VjpSample sample = pixels_.sample(s, b);
      const BlendGrad<float> grad = blend_sample_vjp(mask, alpha, g_color, sample.transmittance, sample.behind);
      pixels_.sample(s, b) = sample;
      if (kGrads) F::add_alpha_vjp(splat.terms, p, node, grad.of_alpha, shape);
      // Again for the pixel alone: to ask for it must not change the other sums by a bit.
      if (kMeans) F::add_alpha_vjp(splat.terms, p, node, grad.of_alpha, of_pixel);
      contribution = s == 0 ? grad.contribution : contribution + grad.contribution;
      weighted += grad.of_alpha.weighted;
    }
#pragma unroll
    for (int c = 0; c < C; ++c) channels.v[c] = madd(contribution, of_pixel_g.v[c], channels.v[c]);
    if (kMeans) {
      const Vec2<float> offset = {sum_of_pixel<F>(of_pixel.offset.x), sum_of_pixel<F>(of_pixel.offset.y)};
      const Vec2<float> of_mean = mean_sums_of(kKind, chunk_.size, transform_transposed(mean_map, offset));
      if (writes_pixel<F>(lane_)) means = means + of_mean;
    }
  }

  /// Writes a sum of a pair.
  __device__ void put(int32_t row, int column, float x) {
    put_sum(params_.pair_grads, kPairGradWidth, list_.of_patch, row, column, x);
  }

  /// Adds the lanes' sums up and writes them to the pair's row, or leaves at `to` of walk() what sum_pairs() or
  /// sum_warps() will add up.
  template <class To>
  __device__ __forceinline__ void put_grads(const typename F::template Terms<float>& terms, int32_t row,
                                            ShapeGrad<float> sums, float weighted, const Values<C>& channels, To& to) {
    const ShapeGrad<float> shape = F::collect(terms, sums, weighted);
    float values[kSumCount] = {shape.offset.x, shape.offset.y, shape.shape.xx,
                               shape.shape.xy, shape.shape.yy, weighted};
#pragma unroll
    for (int c = 0; c < C; ++c) values[6 + c] = channels.v[c];
    if constexpr (kPairSums) {
      to.put(values);
    } else if constexpr (kGroup > 1) {
      const float sum = sum_values(values);
      if (has_value_first<kSumCount>(lane_)) group_.sums[warp_][to][value_] = sum;
    } else {
      const float sum = sum_values(values);
      if (!list_.of_patch) {
        sums_[int64_t(row) * kPairGradWidth] = sum;  // of all lanes: to find the first ones takes longer
      } else if (has_value_first<kSumCount>(lane_)) {
        atomicAdd(&sums_[int64_t(row) * kPairGradWidth], sum);
      }
    }
  }

  /// Adds up what the lanes have left of `count` listed splats, from number `from` on.
  __device__ void sum_pairs(int from, int count) {
    __syncwarp();
    float four[4], ninth;
    group_.pair_sums.sum(four, ninth);
    __syncwarp();
    if (lane_ / 4 >= count) return;
    float* const row = params_.pair_grads + int64_t(group_.splats[from + lane_ / 4].row) * kPairGradWidth;
    float* const place = row + lane_ / 2 % 2 * 4;
    if (!list_.of_patch) {
      *reinterpret_cast<float4*>(place) = {four[0], four[1], four[2], four[3]};
      if (lane_ % 4 == 0) row[8] = ninth;
    } else if (lane_ % 2 == 0) {
#pragma unroll
      for (int v = 0; v < 4; ++v) atomicAdd(place + v, four[v]);
      if (lane_ % 4 == 0) atomicAdd(row + 8, ninth);
    }
  }

  /// Adds up what the warps that share the chunk have left of the listed splats.
  __device__ __forceinline__ void sum_warps(int listed) {
    __syncthreads();
    for (int t = threadIdx.x; t < kSumCount * listed; t += 32 * kGroup) {
      const int n = t / kSumCount, v = t % kSumCount;
      float sum = group_.sums[0][n][v];
#pragma unroll
      for (int w = 1; w < kGroup; ++w) sum += group_.sums[w][n][v];
      put(group_.splats[n].row, v == 9 ? kPairFourthChannel : v, sum);
    }
  }

  const BlendVjpParams& params_;
  const VjpChunk& chunk_;
  const TileList& list_;
  Pixels& pixels_;
  Group& group_;
  const int first_;  ///< sample
  const int lane_ = lane_id(), warp_ = threadIdx.x / 32;
  const Splat<F, float>* const splats_ = reinterpret_cast<const Splat<F, float>*>(params_.splats);
  const Vec2<float> p0_ = place_of<F>(0, lane_);                      ///< of the lane's sample in subtile 0
  const uint32_t subtile_bit_ = lane_ < kSubtiles ? 1u << lane_ : 0;  ///< of subtile number `lane`
  const int value_ = summed_value<kSumCount>(lane_);                  ///< that sum_values leaves here
  float* const sums_ = params_.pair_grads + (value_ == 9 ? kPairFourthChannel : value_);  ///< of row 0
};

}  // namespace ar::cuda
