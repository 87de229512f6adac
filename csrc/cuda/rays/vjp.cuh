// Kernel blend_rays_vjp: the backward pass in the order along rays, for up to four channels. The order is taken as
// given. A block is a warp. It composites half a tile again, each lane logging what it composited (RayLog), and walks
// the log back. A step takes the splat of the farthest next event, in all lanes in which it is next: mostly in all that
// see it, at nearly the same depth. One lane adds each value of a sum, and no other warp has the tile: sums have a
// fixed order, but for tiles of a patch.
//
// The log keeps a lane's last events. If one is lost, the warp composites the half again, each lane up to there.
#pragma once

#include <limits>

#include "cuda/rays/walk.cuh"

namespace ar::cuda {

/// Whether the log keeps the opacity * weight of the one sample. Otherwise it is evaluated again.
template <class F> inline constexpr bool kLogsRaw = !F::kMoves && F::kSamples == 1;

/// RayEvent, and where samples were that move, or opacity * weight.
template <class F> inline constexpr int kLogWords = 3 + (F::kMoves ? 2 * F::kSamples : kLogsRaw<F> ? 1 : 0);

/// Values of PairGrad and C channels.
template <int C> inline constexpr int kRaySums = kPairChannels + C;

/// A splat that a lane has composited.
struct RayEvent {
  static constexpr int kNone = std::numeric_limits<int>::min(), kLost = std::numeric_limits<int>::max();

  int distance = kNone;     ///< ordered as depths; kLost: no longer in the log
  SlotPair pair = {0, -1};  ///< slot -1: of none
  float raw = 0;            ///< if kLogsRaw

  RayEvent() = default;
  /// Bits of positive numbers have their order; others only come in another.
  __device__ RayEvent(float depth, SlotPair pair, float raw) : pair(pair), raw(raw) {
    distance = min(max(__float_as_int(depth), kNone + 1), kLost - 1);
  }
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
    to[0] = uint32_t(event.distance);
    to[32] = uint32_t(event.pair.splat);
    to[64] = uint32_t(event.pair.slot);
    if constexpr (kLogsRaw<F>) to[96] = __float_as_uint(event.raw);
  }
  /// May be called for rows that were not put.
  __device__ RayEvent event(int row) const {
    const uint32_t* const from = row_at(row);
    RayEvent event;
    event.distance = int(from[0]);
    event.pair = {int32_t(from[32]), int32_t(from[64])};
    if constexpr (kLogsRaw<F>) event.raw = __int_as_float(int(from[96]));
    return event;
  }
  __device__ Places& places(int row) const {
    return reinterpret_cast<Places*>(row_at(row) - lane_id() + 96)[lane_id()];
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
  __device__ RayWalkBack(const BlendVjpParams& params, const TileList& list, Vec2<float> p, const LaneLog<F>& log)
      : params_(params), list_(list), p_(p), log_(log) {}

  /// Events of each lane before `end`, from the last to the first, until one is lost. Returns how many are left.
  __device__ int run(int end, RayAdjoint<F, C>& adjoint) const {
    const int lost = max(end - log_.rows, 0);
    const auto checked = [&](RayEvent event, int row) {
      if (row < lost) event.distance = row < 0 ? RayEvent::kNone : RayEvent::kLost, event.pair = {0, -1};
      return event;
    };
    RayEvent event = checked(log_.event(end - 1), end - 1), next = checked(log_.event(end - 2), end - 2);
    const int value = summed_value<kRaySums<C>>(lane_id());
    float* const sums = params_.pair_grads + (value < kPairMeans ? value : kPairFourthChannel);
    for (;;) {
      const int farthest = warp_max(event.distance);
      if (farthest == RayEvent::kNone || farthest == RayEvent::kLost) return end;
      const int lane = __ffs(int(__ballot_sync(kAllLanes, event.distance == farthest))) - 1;
      const SlotPair pair = {shuffle(event.pair.splat, lane), shuffle(event.pair.slot, lane)};
      const RayEvent after = log_.event(end - 3);  // used, and waited for, at the end
      const Splat<F, float> splat = load_splat<F>(params_.splats, pair.splat);
      const bool mine = event.pair.slot == pair.slot;
      float values[kRaySums<C>] = {};
      float means[2] = {0, 0};
      if (mine) add(splat, pair.splat, end - 1, event.raw, adjoint, values, means);
      const int64_t row = int64_t(pair.slot) * kPairGradWidth;
      const float sum = sum_values(values);
      if (has_value_first<kRaySums<C>>(lane_id())) atomicAdd(sums + row, sum);
      if (params_.mean_sums != MeanSums::kNone) {
        const float total = warp_sum_of_two(means[0], means[1]);
        if (lane_id() % 16 == 0) atomicAdd(params_.pair_grads + row + kPairMeans + lane_id() / 16, total);
      }
      if (!mine) continue;
      --end;
      event = next;
      next = checked(after, end - 2);
      prefetch_splat(params_.splats, next.pair.splat);
      if constexpr (F::kMoves) prefetch(&log_.places(end - 2));
    }
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
          log.put(row, {entries[i].depth, pairs[i], raw});
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
      const RayWalkBack<F, C> back(params, list, p, log);
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
