// Kernel blend_rays_vjp: the backward pass in the order along rays, for up to four channels. The order is taken as
// given. A block is a warp. It composites half a tile again, each lane logging what it composited (RayLog), and walks
// the log back, row by row. Lanes are at different splats: those with the same splat are added up, lane after lane. No
// other warp has the tile, and __syncwarp() is between rows: sums have a fixed order, but for tiles of a patch.
//
// The log keeps the last rows. If there were more, the warp composites the half again, up to the first row kept.
#pragma once

#include <limits>

#include "cuda/rays/walk.cuh"

namespace ar::cuda {

/// Whether the log keeps the opacity * weight of the one sample. Otherwise it is evaluated again.
template <class F> inline constexpr bool kLogsRaw = !F::kMoves && F::kSamples == 1;

/// RayEvent, and where samples were that move.
template <class F> inline constexpr int kLogWords = 2 + (F::kMoves ? 2 * F::kSamples : kLogsRaw<F> ? 1 : 0);

/// Values of PairGrad and C channels.
template <int C> inline constexpr int kRaySums = kPairChannels + C;

/// Adds to rows of pair_grads what lanes have for them: value k to column(k). A lane with row -1 has nothing.
/// `of_lanes` has room for 32 (kCount | 1) numbers.
template <int kCount, class Column>
__device__ void add_to_rows(float* of_lanes, const float (&values)[kCount], int32_t row, float* pair_grads,
                            Column&& column) {
  constexpr int kStride = kCount | 1, kAtOnce = 32 / kCount;  // rows that are added to together
  const int lane = lane_id(), own = lane / kCount, k = lane % kCount;
  const uint32_t alike = __match_any_sync(kAllLanes, row);
  AR_UNROLL for (int v = 0; v < kCount; ++v) of_lanes[lane * kStride + v] = values[v];
  uint32_t leaders = __ballot_sync(kAllLanes, row >= 0 && (alike & ((1u << lane) - 1)) == 0);
  __syncwarp();
  while (leaders != 0) {
    int leader = -1;
    AR_UNROLL for (int g = 0; g < kAtOnce; ++g) {
      if (g == own) leader = __ffs(int(leaders)) - 1;
      leaders &= leaders - 1;  // zero stays zero
    }
    uint32_t members = shuffle(alike, leader & 31);
    const int32_t to = shuffle(row, leader & 31);
    if (leader >= 0) {
      float sum = 0;
      for (; members != 0; members &= members - 1) sum += of_lanes[(__ffs(int(members)) - 1) * kStride + k];
      atomicAdd(pair_grads + int64_t(to) * kPairGradWidth + column(k), sum);
    }
    __syncwarp();
  }
}

/// A splat that a lane has composited.
struct RayEvent {
  SlotPair pair;
  float raw;  ///< if kLogsRaw
};

/// A lane's own part of the log.
template <class F> class LaneLog {
 public:
  /// Where samples that move were, before the splat.
  struct alignas(F::kSamples > 1 ? 16 : 8) Places {
    Vec2<float> of[F::kSamples];
  };
  const int rows;

  __device__ explicit LaneLog(const RayLog& log)
      : rows(log.rows), words_(log.words + int64_t(blockIdx.x) * log.rows * kRowWords + lane_id()) {}

  __device__ void put(int row, const RayEvent& event) const {
    uint32_t* const to = row_at(row);
    to[0] = uint32_t(event.pair.splat);
    to[32] = uint32_t(event.pair.slot);
    if constexpr (kLogsRaw<F>) to[64] = __float_as_uint(event.raw);
  }
  /// None if the lane has not put `row`.
  __device__ RayEvent event(int row, bool put) const {
    const uint32_t* const from = row_at(row);
    RayEvent event = {{0, -1}, 0};
    if (!put) return event;
    event.pair = {int32_t(from[0]), int32_t(from[32])};
    if constexpr (kLogsRaw<F>) event.raw = __int_as_float(int(from[64]));
    return event;
  }
  __device__ Places& places(int row) const {
    return reinterpret_cast<Places*>(row_at(row) - lane_id() + 64)[lane_id()];
  }

 private:
  static constexpr int kRowWords = 32 * kLogWords<F>;

  __device__ uint32_t* row_at(int row) const { return words_ + (row & (rows - 1)) * kRowWords; }

  uint32_t* const words_;
};

/// What a lane carries back from splat to splat.
template <class F, int C> struct RayAdjoint {
  static constexpr int S = F::kSamples;
  Values<C> gradient;  ///< of one sample's channels
  float transmittance[S], behind[S];
  Vec2<float> dL_dplace[F::kMoves ? S : 1];
  int stopped[S];  ///< event from which on it composited nothing

  __device__ RayAdjoint(const BlendVjpParams& params, const Pixel& pixel) {
    using Samples = LaneSamples<S, 1>;
    float through = 0;
    AR_UNROLL for (int c = 0; c < C; ++c) {
      gradient.v[c] = sample_gradient<Samples>(params, pixel, c);
      if (c < params.channels.count) through = madd(gradient.v[c], params.background[c], through);
    }
    // Alpha is 1 - transmittance: like a channel whose background is -1.
    if (params.dL_dalpha && pixel.inside) through -= kSampleShare<Samples> * params.dL_dalpha[pixel.index];
    AR_UNROLL for (int s = 0; s < S; ++s) {
      transmittance[s] = 1;
      behind[s] = through;
      if constexpr (F::kMoves) dL_dplace[s] = {0, 0};
      stopped[s] = 1 << 30;
    }
  }
};

template <class F, int C> class RayWalkBack {
 public:
  __device__ RayWalkBack(const BlendVjpParams& params, const TileList& list, Vec2<float> p, const LaneLog<F>& log,
                         float* of_lanes)
      : params_(params), list_(list), p_(p), log_(log), of_lanes_(of_lanes) {}

  /// Events of each lane before `end`, from the last to the first that the log keeps. Returns how many are left.
  __device__ int run(int end, RayAdjoint<F, C>& adjoint) const {
    __syncwarp();  // windows read what is before them, and so `of_lanes`
    const int rows = warp_max(end), begin = max(rows - log_.rows, 0);
    const auto load = [&](int row) { return log_.event(row, (row >= begin) & (row < end)); };
    RayEvent event = load(rows - 1), next = load(rows - 2);
    for (int row = rows - 1; row >= begin; --row) {
      const RayEvent after = load(row - 2);  // while this row is worked on
      if constexpr (F::kMoves) prefetch(&log_.places(row - 1));
      prefetch_splat(params_.splats, next.pair.splat);
      const Splat<F, float> splat = load_splat<F>(params_.splats, event.pair.splat);
      float values[kRaySums<C>] = {};
      float means[2] = {0, 0};
      if (event.pair.slot >= 0) add(splat, event.pair.splat, row, event.raw, adjoint, values, means);
      add_to_rows(of_lanes_, values, event.pair.slot, params_.pair_grads,
                  [](int k) { return k < kPairMeans ? k : kPairFourthChannel; });
      if (params_.mean_sums != MeanSums::kNone)
        add_to_rows(of_lanes_, means, event.pair.slot, params_.pair_grads, [](int k) { return kPairMeans + k; });
      event = next;
      next = after;
    }
    return min(end, begin);
  }

 private:
  static constexpr int S = F::kSamples;

  /// Event `row` of the lane, of splat `id`. `logged`: its raw.
  __device__ void add(const Splat<F, float>& splat, int32_t id, int row, float logged, RayAdjoint<F, C>& to,
                      float (&values)[kRaySums<C>], float (&means)[2]) const {
    const Values<C> channels = channels_of<C>(params_.channels, splat, id);
    float g_color = 0, contribution = 0, weighted = 0;
    AR_UNROLL for (int c = 0; c < C; ++c) g_color = madd(to.gradient.v[c], channels.v[c], g_color);
    const auto terms = tile_terms(splat, list_);
    ShapeGrad<float> shape = {{0, 0}, {0, 0, 0}};
    if constexpr (F::kMoves) {
      LeavingSplat<F> leaving = {};
      leaving.set(splat, list_, p_);
      const typename LaneLog<F>::Places places = log_.places(row);
      MovingBlendGrad<float> grad = no_moving_blend_grad<float>();
      AR_UNROLL for (int s = 0; s < S; ++s) {
        const Vec2<float> place = places.of[s];
        Vec2<float> at;
        const float seen = leaving.raw(p_, s, place, at);
        const float raw = composited(seen, row, to.stopped[s]) ? seen : 0;
        add_placed_sample_vjp<F>(terms, at, raw, F::template cell<float>(s), g_color, place, to.transmittance[s],
                                 to.behind[s], to.dL_dplace[s], grad);
      }
      contribution = grad.contribution;
      weighted = grad.of_splat.weighted;
      shape = grad.of_splat.sums;
    } else {
      AR_UNROLL for (int s = 0; s < S; ++s) {
        const float raw = kLogsRaw<F> ? logged : F::alpha(terms, p_, s);
        const BlendGrad<float> grad =
            blend_sample_vjp(composited(raw, row, to.stopped[s]), raw, g_color, to.transmittance[s], to.behind[s]);
        F::add_alpha_vjp(terms, p_, s, grad.of_alpha, shape);
        contribution += grad.contribution;
        weighted += grad.of_alpha.weighted;
      }
    }
    const float numbers[] = {shape.offset.x, shape.offset.y, shape.shape.xx, shape.shape.xy, shape.shape.yy, weighted};
    AR_UNROLL for (int k = 0; k < kPairChannels; ++k) values[k] = numbers[k];
    AR_UNROLL for (int c = 0; c < C; ++c) values[kPairChannels + c] = contribution * to.gradient.v[c];
    if (params_.mean_sums == MeanSums::kNone) return;
    const Vec2<float> size = {float(params_.grid.width), float(params_.grid.height)};
    const Vec2<float> of_mean =
        mean_sums_of(params_.mean_sums, size, transform_transposed(F::mean_map(splat.shape), shape.offset));
    means[0] = of_mean.x, means[1] = of_mean.y;
  }

  __device__ static bool composited(float raw, int row, int stopped) {
    return (raw >= float(kAlphaMin)) & (row < stopped);
  }

  const BlendVjpParams& params_;
  const TileList& list_;
  const Vec2<float> p_;
  const LaneLog<F>& log_;
  float* const of_lanes_;
};

/// Composites half of the tile, each lane up to event `end`. Returns the lane's events.
template <class F, class Adjoint>
__device__ int log_rays(const BlendVjpParams& params, const TileList& list, int half, RaySamples<F>& samples,
                        const LaneLog<F>& log, int end, Adjoint& adjoint) {
  constexpr int S = F::kSamples, kAtOnce = RayPolicy::kAtOnce<F>;
  auto& stage = *reinterpret_cast<RayStage<F>*>(dynamic_shared());
  const Vec2<float> p = ray_pixel(half);
  int row = 0;
  walk_rays<F>(
      params, list, stage, reinterpret_cast<RayEntry*>(&stage + 1), half, samples.open(),
      [](int place, int32_t) { return place; },
      [&](const RayEntry(&entries)[kAtOnce]) {
        SlotPair pairs[kAtOnce];
        LeavingSplat<F> leaving[kAtOnce] = {};
        AR_UNROLL for (int i = 0; i < kAtOnce; ++i) {
          const int place = max(entries[i].payload, 0);  // any splat, for lanes that have none
          pairs[i] = reinterpret_cast<const SlotPair*>(list.pairs)[place];
          leaving[i].set(load_splat<F>(params.splats, pairs[i].splat), list, p);
        }
        AR_UNROLL for (int i = 0; i < kAtOnce; ++i) {
          typename LaneLog<F>::Places before;
          if constexpr (F::kMoves) {
            AR_UNROLL for (int s = 0; s < S; ++s) before.of[s] = samples.places[s];
          }
          bool any = false;
          float raw = 0;  // of the last sample
          AR_UNROLL for (int s = 0; s < S; ++s) {
            if (row == end) samples.transmittance[s] = -1;
            const bool open = samples.transmittance[s] > 0;
            any |= blend_leaving(leaving[i], entries[i], p, s, samples, raw).mask;
            if (open & (samples.transmittance[s] < 0)) adjoint.stopped[s] = row;
          }
          if (!any) continue;
          log.put(row, {pairs[i], raw});
          if constexpr (F::kMoves) log.places(row) = before;
          ++row;
        }
        return samples.open();
      });
  return row;
}

/// C: as in blend_rays. Blocks claim tiles.
template <class F, int C>
__global__ void __launch_bounds__(32, RayPolicy::kBlocks) blend_rays_vjp_kernel(const BlendVjpParams params) {
  wait_for_earlier_kernels();
  constexpr int S = F::kSamples, kAll = std::numeric_limits<int>::max();
  const LaneLog<F> log(params.ray_log);
  for (;;) {
    int taken = 0;
    if (lane_id() == 0) taken = atomicAdd(params.chunks_taken, 1);
    const int tile = listed_tile(params, shuffle(taken, 0));
    if (tile < 0) return;
    const TileList list = list_of(params.lists, params.grid, tile);
    for (int k = lane_id(); k < list.count && !list.of_patch; k += 32) clear_pair(params, list.slot(k));
    __syncwarp();  // before other lanes add
    for (int half = 0; half < kRayHalves; ++half) {
      const Vec2<float> p = ray_pixel(half);
      const Pixel pixel(list, params.grid, p);
      RayAdjoint<F, C> adjoint(params, pixel);
      // The stage is free then.
      static_assert(sizeof(RayStage<F>) >= 32 * (kRaySums<C> | 1) * sizeof(float));
      const RayWalkBack<F, C> back(params, list, p, log, reinterpret_cast<float*>(dynamic_shared()));
      for (int end = kAll; __any_sync(kAllLanes, end > 0);) {
        RaySamples<F> samples(pixel.inside && end > 0);
        const int events = log_rays<F>(params, list, half, samples, log, end, adjoint);
        if (end == kAll) {
          AR_UNROLL for (int s = 0; s < S; ++s) adjoint.transmittance[s] = abs(samples.transmittance[s]);
        }
        end = back.run(events, adjoint);
      }
    }
  }
}

}  // namespace ar::cuda
