// A warp of blend_vjp takes a tile's pixels back through a chunk, and writes rows of pair_grads.
#pragma once

#include "cuda/still/vjp_sums.cuh"
#include "cuda/tile/stage.cuh"

namespace ar::cuda {

/// Pairs [begin, end) of a tile's list.
struct VjpChunk {
  TileList list;
  int begin, end;
  int plane;  ///< first plane of the chunk's checkpoints
  const TileGrid& grid;
  int64_t image;     ///< pixels of the image
  Vec2<float> size;  ///< of the image [px]

  __device__ __forceinline__ VjpChunk(const BlendVjpParams& params, TileChunk chunk)
      : list(list_of(params.lists, params.grid, chunk.tile)),
        begin(chunk.chunk * kChunkLength),
        end(list.of_patch ? list.count : min(list.count, begin + kChunkLength)),
        plane(chunk.plane),
        grid(params.grid),
        image(int64_t(grid.width) * grid.height),
        size({float(grid.width), float(grid.height)}) {}

  /// Of a lane's pixel of subtile b; -1 outside of the image.
  template <class F> __device__ int64_t pixel_index(int b, int lane) const {
    const Vec2<float> p = pixel_of<F>(b, lane);
    const int x = list.x0 + int(p.x), y = list.y0 + int(p.y);
    return x < grid.width && y < grid.height ? int64_t(y) * grid.width + x : int64_t(-1);
  }
};

/// Pairs up to the last that any pixel composited. Also writes batch.subtile_last; __syncwarp() must follow.
template <class F, class Batch>
__device__ __forceinline__ int find_last(const BlendVjpParams& params, const VjpChunk& chunk, Batch& batch) {
  const int lane = lane_id();
  int tile_last = 0;
  AR_UNROLL for (int b = 0; b < kSubtiles; ++b) {
    const int64_t i = chunk.pixel_index<F>(b, lane);
    int last = 0;
    AR_UNROLL for (int s = 0; s < F::kSamples; ++s) last =
        max(last, i < 0 ? 0 : params.last[sample_index<F>(chunk.image, i, s)]);
    last = warp_max(last);
    if (lane == 0) batch.subtile_last[b] = last;
    tile_last = max(tile_last, last);
  }
  return tile_last;
}

/// `final`: only the background follows. checkpoints: [samples, kTilePixels] after the chunk.
template <class F, int C>
__device__ __forceinline__ void start_pixels(const BlendVjpParams& params, const VjpChunk& chunk,
                                             const Checkpoint<C>* checkpoints, bool final, LanePixels<F, C>& pixels) {
  const int lane = lane_id();
  const float* dL_dplanes[C];  // with three channels none is null
  Values<C> background;
  AR_UNROLL for (int c = 0; c < C; ++c) {
    const bool used = C == 3 || c < params.channels.count;
    dL_dplanes[c] = C == 3 ? params.dL_dimage.first + c * chunk.image
                    : used ? params.dL_dimage.plane(c, chunk.image)
                           : nullptr;
    background.v[c] = used ? params.background[c] : 0;
  }
  AR_UNROLL for (int b = 0; b < kSubtiles; ++b) {
    const int64_t i = chunk.pixel_index<F>(b, lane);
    const float scale = i < 0 ? 0 : kSampleShare<F>;
    Values<C> g;
    AR_UNROLL for (int c = 0; c < C; ++c) g.v[c] = i >= 0 && (C == 3 || dL_dplanes[c]) ? scale * dL_dplanes[c][i] : 0;
    pixels.set_gradient(b, g);
    AR_UNROLL for (int s = 0; s < F::kSamples; ++s) {
      const int last = i < 0 ? 0 : params.last[sample_index<F>(chunk.image, i, s)];
      float transmittance = 1, behind = 0;
      if (final) {
        transmittance = i < 0 ? 1.0f : params.transmittance[sample_index<F>(chunk.image, i, s)];
        behind = dot(g, background);
      } else {
        const Checkpoint<C> c = checkpoints[s * kTilePixels + b * 32 + lane];
        transmittance = abs(c.transmittance);
        behind = dot(g, c.channels) / transmittance;
      }
      // Alpha is a channel with background -1.
      if (params.dL_dalpha && i >= 0) {
        const float open = final ? 1 : params.transmittance[sample_index<F>(chunk.image, i, s)] / transmittance;
        behind -= scale * params.dL_dalpha[i] * open;
      }
      pixels.sample(s, b) = {transmittance, behind};
      pixels.set_last(s, b, last);
    }
  }
}

template <class F, int C, bool kMeans> class ChunkWalk {
 public:
  __device__ __forceinline__ ChunkWalk(const BlendVjpParams& params, const VjpChunk& chunk, LanePixels<F, C>& pixels,
                                       VjpBatch<F, C>& batch)
      : params_(params), chunk_(chunk), list_(chunk.list), pixels_(pixels), batch_(batch) {}

  /// In batches of 32 pairs: lists those that reach a pixel, then walks them.
  __device__ __forceinline__ void run(int tile_last) {
    static_assert(kChunkLength % 32 == 0);  // no batch begins before the chunk
    for (int k1 = min(chunk_.end, tile_last); k1 > chunk_.begin; k1 = (k1 - 1) / 32 * 32) {
      const int k0 = (k1 - 1) / 32 * 32, k = k0 + lane_;
      uint32_t reach = 0;
      Mat2<float> mean_map = {0, 0, 0, 0};
      __syncwarp();  // all have read the last batch
      Splat<F, float> own;
      int32_t id = 0, row = 0;
      if (k < k1) {
        id = list_.splat(k);
        row = list_.slot(k);
        own = load_splat<F>(params_.splats, id);
        reach = subtile_reach<F>(own, list_.x0, list_.y0);
        AR_UNROLL for (int b = 0; b < kSubtiles; ++b) reach &= ~(uint32_t(k >= batch_.subtile_last[b]) << b);
        if (kMeans) mean_map = F::mean_map(own.shape);
        if (reach == 0 && !list_.of_patch) clear_pair(params_, row);
      }
      const uint32_t reaching = __ballot_sync(kAllLanes, reach != 0);
      if (reach) {
        batch_.splats[__popc(reaching >> lane_ >> 1)] = {
            tile_terms(own, list_), channels_of<C>(params_.channels, own, id), reach | uint32_t(lane_) << 27, row};
      }
      const int listed = __popc(reaching);
      __syncwarp();
      if constexpr (!kMeans) {
        walk_listed<MeanSums::kNone>(k0, listed, mean_map);
      } else if (params_.mean_sums == MeanSums::kNorm) {
        walk_listed<MeanSums::kNorm>(k0, listed, mean_map);
      } else {
        walk_listed<MeanSums::kAbsolute>(k0, listed, mean_map);
      }
    }
  }

 private:
  static constexpr int S = F::kSamples, kSumCount = 6 + C;

  /// k0: first pair of the batch. `mean_map`: of the lane's own pair.
  template <MeanSums kKind> __device__ void walk_listed(int k0, int listed, const Mat2<float>& mean_map) {
    if constexpr (kHoldsSamples<C>) {
      for (int n = 0; n < listed; n += PairSums::kPairs) {
        const int count = min(listed - n, PairSums::kPairs);
        const auto* splat = batch_.splats + n;
        PairSums::Pair* pair = batch_.pair_sums.pairs;
        for (int left = count; left > 0; --left) walk<kKind>(*splat++, k0, mean_map, *pair++);
        sum_pairs(n, count);
      }
    } else {
      for (int n = 0; n < listed; ++n) walk<kKind>(batch_.splats[n], k0, mean_map, n);
    }
  }

  /// `to`: a PairSums::Pair, or the index in the list.
  template <MeanSums kKind, class To>
  __device__ void walk(const ListedSplat<F, C>& listed, int k0, const Mat2<float>& mean_map, To&& to) {
    const ListedSplat<F, C> splat = listed;
    // A ballot tells the compiler that all lanes branch alike.
    const uint32_t reached = __ballot_sync(kAllLanes, splat.reach_and_index & subtile_bit_);
    const int j = int(splat.reach_and_index >> 27), at = k0 + j;
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
    put_grads(row, shape, weighted, channels, to);
    if constexpr (kMeans) {
      const float total = warp_sum_of_two(means.x, means.y);
      if (lane_ % 16 == 0)
        put_sum(params_.pair_grads, kPairGradWidth, list_.of_patch, row, kPairMeans + lane_ / 16, total);
    }
  }

  /// The pixel of subtile b is at p. `at`: the pair, by reference, or the compiler turns comparisons around.
  template <MeanSums kKind>
  __device__ void add_pixel(const ListedSplat<F, C>& splat, const int& at, const Mat2<float>& mean_map, int b,
                            Vec2<float> p, ShapeGrad<float>& shape, float& weighted, Values<C>& channels,
                            Vec2<float>& means) {
    const float4 g = pixels_.gradient(b);
    const Values<4> of_pixel_g = {{g.x, g.y, g.z, g.w}};
    float g_color = madd(g.x, splat.channels.v[0], madd(g.y, splat.channels.v[1], g.z * splat.channels.v[2]));
    if (C > 3) g_color = madd(g.w, splat.channels.v[C - 1], g_color);
    float contribution = 0;
    ShapeGrad<float> of_pixel = {{0, 0}, {0, 0, 0}};
    AR_UNROLL for (int s = 0; s < S; ++s) {
      const float alpha = F::alpha(splat.terms, p, s);
      // `&`, because to read `last` after the first comparison would be to wait.
      const bool mask = (alpha >= float(kAlphaMin)) & (at < pixels_.last_of(s, b, g));
      if (s == 0 && S == 1 && !kTakesTwo<F, C> && !__any_sync(kAllLanes, mask)) break;
      VjpSample sample = pixels_.sample(s, b);
      const BlendGrad<float> grad = blend_sample_vjp(mask, alpha, g_color, sample.transmittance, sample.behind);
      pixels_.sample(s, b) = sample;
      F::add_alpha_vjp(splat.terms, p, s, grad.of_alpha, shape);
      // Again for the pixel alone: MeanSums change no bit of other sums.
      if (kMeans) F::add_alpha_vjp(splat.terms, p, s, grad.of_alpha, of_pixel);
      contribution = s == 0 ? grad.contribution : contribution + grad.contribution;
      weighted += grad.of_alpha.weighted;
    }
    AR_UNROLL for (int c = 0; c < C; ++c) channels.v[c] = madd(contribution, of_pixel_g.v[c], channels.v[c]);
    if (kMeans) {
      const Vec2<float> offset = {sum_of_pixel<F>(of_pixel.offset.x), sum_of_pixel<F>(of_pixel.offset.y)};
      const Vec2<float> of_mean = mean_sums_of(kKind, chunk_.size, transform_transposed(mean_map, offset));
      if (writes_pixel<F>(lane_)) means = means + of_mean;
    }
  }

  /// Sums over lanes into the pair's row, or stores values at `to` for sum_pairs().
  template <class To>
  __device__ __forceinline__ void put_grads(int32_t row, ShapeGrad<float> shape, float weighted,
                                            const Values<C>& channels, To& to) {
    float values[kSumCount] = {shape.offset.x, shape.offset.y, shape.shape.xx,
                               shape.shape.xy, shape.shape.yy, weighted};
    AR_UNROLL for (int c = 0; c < C; ++c) values[6 + c] = channels.v[c];
    if constexpr (kHoldsSamples<C>) {
      to.put(values);
    } else {
      const float sum = sum_values(values);
      if (!list_.of_patch) {
        sums_[int64_t(row) * kPairGradWidth] = sum;  // by all lanes: to choose some takes longer
      } else if (has_value_first<kSumCount>(lane_)) {
        atomicAdd(&sums_[int64_t(row) * kPairGradWidth], sum);
      }
    }
  }

  __device__ void sum_pairs(int from, int count) {
    __syncwarp();
    float four[4], ninth;
    batch_.pair_sums.sum(four, ninth);
    __syncwarp();
    if (lane_ / 4 >= count) return;
    float* const row = params_.pair_grads + int64_t(batch_.splats[from + lane_ / 4].row) * kPairGradWidth;
    float* const place = row + lane_ / 2 % 2 * 4;
    if (!list_.of_patch) {
      *reinterpret_cast<float4*>(place) = {four[0], four[1], four[2], four[3]};
      if (lane_ % 4 == 0) row[8] = ninth;
    } else if (lane_ % 2 == 0) {
      AR_UNROLL for (int v = 0; v < 4; ++v) atomicAdd(place + v, four[v]);
      if (lane_ % 4 == 0) atomicAdd(row + 8, ninth);
    }
  }

  const BlendVjpParams& params_;
  const VjpChunk& chunk_;
  const TileList& list_;
  LanePixels<F, C>& pixels_;
  VjpBatch<F, C>& batch_;
  const int lane_ = lane_id();
  const Vec2<float> p0_ = position_of<F>(0, lane_);  ///< in subtile 0
  const uint32_t subtile_bit_ = lane_ < kSubtiles ? 1u << lane_ : 0;
  const int value_ = summed_value<kSumCount>(lane_);                                      ///< of sum_values()
  float* const sums_ = params_.pair_grads + (value_ == 9 ? kPairFourthChannel : value_);  ///< of row 0
};

}  // namespace ar::cuda
