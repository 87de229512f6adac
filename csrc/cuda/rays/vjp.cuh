// Kernel blend_rays_vjp: the backward pass in the order along rays, for up to four channels. The order is taken as
// given. A block composites a tile again, each warp logging row by row what its lanes composited (RayLog). Then one
// warp after the other walks back over its log. Lanes are at different splats: in every row of the log those with the
// same splat are added up, lane after lane, and then added to the row of the pair. The tile has no other block, and
// __syncwarp() is between rows, so that all sums have a fixed order; only tiles of a patch change it.
//
// The log keeps the last rows. If there were more, the block composites the tile again up to the first row kept.
#pragma once

#include "cuda/rays/vjp_walk.cuh"

namespace ar::cuda::by_blocks {

/// In a row of the log a lane has its place in the list (-1: nothing was composited), and where its samples were, or
/// the opacity * weight of its one sample.
template <class F> inline constexpr int kLogWords = 1 + (F::kMoves ? 2 * F::kSamples : kKeepsRaw<F> ? 1 : 0);

/// Values of PairGrad and C channels.
template <int C> inline constexpr int kRaySums = kPairChannels + C;

template <class F, int C> struct RayVjpShared {
  RayStage<F> stage;
  float of_lanes[32 * (kRaySums<C> | 1)];  ///< of the one warp that walks back
  int32_t rows[kRayWarps];                 ///< of the logs
  int chunk;
};

/// Adds to rows of pair_grads what lanes have for them: value k to column(k). A lane with row -1 has nothing.
/// `of_lanes` has room for 32 (kCount | 1) numbers.
template <int kCount, class Column>
__device__ void add_to_rows(float* of_lanes, const float (&values)[kCount], int32_t row, float* pair_grads,
                            Column&& column) {
  constexpr int kStride = kCount | 1, kAtOnce = 32 / kCount;  // rows that are added to together
  const int lane = lane_id(), own = lane / kCount, k = lane % kCount;
  AR_UNROLL for (int v = 0; v < kCount; ++v) of_lanes[lane * kStride + v] = values[v];
  const uint32_t alike = __match_any_sync(kAllLanes, row);
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

/// A lane's part of the log. Only the lane itself reads it.
template <class F> class LaneLog {
 public:
  __device__ explicit LaneLog(const RayLog& log)
      : words_(log.words + (int64_t(blockIdx.x) * kRayWarps + threadIdx.x / 32) * log.rows * kRowWords + lane_id()),
        rows_(log.rows) {}

  __device__ void put(int row, int32_t place, const RayEntry& entry, const Vec2<float>* places) const {
    uint32_t* const to = row_at(row);
    to[0] = uint32_t(place);
    if constexpr (kKeepsRaw<F>) to[32] = __float_as_uint(entry.raw);
    if constexpr (F::kMoves) {
      AR_UNROLL for (int s = 0; s < F::kSamples; ++s) {
        to[(2 * s + 1) * 32] = __float_as_uint(places[s].x);
        to[(2 * s + 2) * 32] = __float_as_uint(places[s].y);
      }
    }
  }
  __device__ void get(int row, RayEntry& entry, Vec2<float>* places) const {
    const uint32_t* const from = row_at(row);
    entry.payload = int32_t(from[0]);
    if constexpr (kKeepsRaw<F>) entry.raw = __int_as_float(int(from[32]));
    if constexpr (F::kMoves) {
      AR_UNROLL for (int s = 0; s < F::kSamples; ++s) {
        places[s] = {__int_as_float(int(from[(2 * s + 1) * 32])), __int_as_float(int(from[(2 * s + 2) * 32]))};
      }
    }
  }

 private:
  static constexpr int kRowWords = 32 * kLogWords<F>;

  __device__ uint32_t* row_at(int row) const { return words_ + int64_t(row % rows_) * kRowWords; }

  uint32_t* const words_;
  const int rows_;
};

/// What a lane carries back from splat to splat.
template <class F, int C> struct RayAdjoint {
  static constexpr int S = F::kSamples;
  Values<C> gradient;  ///< of one sample's channels
  float transmittance[S], behind[S];
  Vec2<float> dL_dplace[F::kMoves ? S : 1];
  int stopped[S];  ///< row of the log from which on the sample composited nothing

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
  __device__ RayWalkBack(const BlendVjpParams& params, const TileList& list, Vec2<float> p, float* of_lanes)
      : params_(params), list_(list), p_(p), of_lanes_(of_lanes) {}

  /// Rows [begin, end) of the log, from the last to the first.
  __device__ void run(const LaneLog<F>& log, int begin, int end, RayAdjoint<F, C>& adjoint) const {
    Event next = {};
    if (end > begin) load(log, end - 1, next);
    for (int row = end - 1; row >= begin; --row) {
      const Event event = next;
      const bool any = event.entry.payload >= 0;
      const Splat<F, float> splat = load_splat<F>(params_.splats, event.pair.splat);
      if (row > begin) load(log, row - 1, next);  // while the splat is on its way
      float values[kRaySums<C>] = {};
      float means[2] = {0, 0};
      if (any) add(event, splat, row, adjoint, values, means);
      const int32_t to = any ? event.pair.slot : -1;
      add_to_rows(of_lanes_, values, to, params_.pair_grads,
                  [](int k) { return k < kPairMeans ? k : kPairFourthChannel; });
      if (params_.mean_sums != MeanSums::kNone)
        add_to_rows(of_lanes_, means, to, params_.pair_grads, [](int k) { return kPairMeans + k; });
    }
  }

 private:
  static constexpr int S = F::kSamples;
  struct Event {
    RayEntry entry;
    SlotPair pair;
    Vec2<float> places[F::kMoves ? S : 1];  ///< before the splat
  };

  __device__ void load(const LaneLog<F>& log, int row, Event& event) const {
    log.get(row, event.entry, event.places);
    event.pair = reinterpret_cast<const SlotPair*>(list_.pairs)[max(event.entry.payload, 0)];
  }

  __device__ void add(const Event& event, const Splat<F, float>& splat, int row, RayAdjoint<F, C>& to,
                      float (&values)[kRaySums<C>], float (&means)[2]) const {
    const Values<C> channels = channels_of<C>(params_.channels, splat, event.pair.splat);
    float g_color = 0, contribution = 0, weighted = 0;
    AR_UNROLL for (int c = 0; c < C; ++c) g_color = madd(to.gradient.v[c], channels.v[c], g_color);
    const auto terms = tile_terms(splat, list_);
    ShapeGrad<float> shape = {{0, 0}, {0, 0, 0}};
    if constexpr (F::kMoves) {
      LeavingSplat<F> leaving = {};
      leaving.set(splat, list_, p_);
      MovingBlendGrad<float> grad = no_moving_blend_grad<float>();
      AR_UNROLL for (int s = 0; s < S; ++s) {
        Vec2<float> at;
        const float seen = leaving.raw(p_, s, event.places[s], at);
        const float raw = composited(seen, row, to.stopped[s]) ? seen : 0;
        add_placed_sample_vjp<F>(terms, at, raw, F::template cell<float>(s), g_color, event.places[s],
                                 to.transmittance[s], to.behind[s], to.dL_dplace[s], grad);
      }
      contribution = grad.contribution;
      weighted = grad.of_splat.weighted;
      shape = grad.of_splat.sums;
    } else {
      AR_UNROLL for (int s = 0; s < S; ++s) {
        const float raw = kKeepsRaw<F> ? event.entry.raw : F::alpha(terms, p_, s);
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
  float* const of_lanes_;
};

/// Composites the tile, up to row `end` of the log. Returns the rows that the warp has logged.
template <class F, class Shared, class Adjoint>
__device__ int log_rays(const BlendVjpParams& params, const TileList& list, Shared& shared, Vec2<float> p,
                        RaySamples<F>& samples, const LaneLog<F>& log, int end, Adjoint& adjoint) {
  constexpr int S = F::kSamples, kAtOnce = RayPolicy::kAtOnce<F>;
  int row = 0;
  walk_rays<F>(
      params, list, shared.stage, reinterpret_cast<float*>(&shared + 1), p, samples.open(),
      [](int place, int32_t) { return place; },
      [&](const RayEntry(&entries)[kAtOnce]) {
        AR_UNROLL for (int i = 0; i < kAtOnce; ++i) {
          const RayEntry& entry = entries[i];
          if (!__any_sync(kAllLanes, entry.payload >= 0)) continue;
          if (row == end) return false;
          LeavingSplat<F> leaving = {};
          if constexpr (!kKeepsRaw<F>)
            leaving.set(load_splat<F>(params.splats, list.splat(max(entry.payload, 0))), list, p);
          Vec2<float> before[F::kMoves ? S : 1];
          if constexpr (F::kMoves) {
            AR_UNROLL for (int s = 0; s < S; ++s) before[s] = samples.places[s];
          }
          bool any = false;
          AR_UNROLL for (int s = 0; s < S; ++s) {
            const bool open = samples.transmittance[s] > 0;
            any |= blend_leaving(leaving, entry, p, s, samples).mask;
            if (open & (samples.transmittance[s] < 0)) adjoint.stopped[s] = row;
          }
          log.put(row, any ? entry.payload : -1, entry, before);
          ++row;
        }
        return samples.open();
      });
  return row;
}

/// C: as in blend_rays. Each block claims tiles until none is left.
template <class F, int C>
__global__ void __launch_bounds__(kRayThreads, blocks_per_sm(RayPolicy::kVjpBlocks<F>, kRayThreads))
    blend_rays_vjp_kernel(const BlendVjpParams params) {
  wait_for_earlier_kernels();
  constexpr int S = F::kSamples;
  auto& shared = *reinterpret_cast<RayVjpShared<F, C>*>(dynamic_shared());
  const int warp = threadIdx.x / 32;
  const Vec2<float> p = RayBoxes::pixel();
  const LaneLog<F> log(params.ray_log);
  for (;;) {
    __syncthreads();
    if (threadIdx.x == 0) shared.chunk = atomicAdd(params.chunks_taken, 1);
    __syncthreads();
    const int tile = listed_tile(params, shared.chunk);
    if (tile < 0) return;
    const TileList list = list_of(params.lists, params.grid, tile);
    for (int k = threadIdx.x; k < list.count && !list.of_patch; k += kRayThreads) clear_pair(params, list.slot(k));
    const Pixel pixel(list, params.grid, p);
    const RayWalkBack<F, C> back(params, list, p, shared.of_lanes);
    RayAdjoint<F, C> adjoint(params, pixel);
    // `turn`: of this warp the rows up to `end` are left; -1: none has a log yet.
    for (int turn = -1, end = kWholeList; turn < kRayWarps;) {
      RaySamples<F> samples(pixel.inside && (turn < 0 || turn == warp));
      const int rows = log_rays<F>(params, list, shared, p, samples, log, end, adjoint);
      if (turn < 0) {
        AR_UNROLL for (int s = 0; s < S; ++s) adjoint.transmittance[s] = abs(samples.transmittance[s]);
        if (lane_id() == 0) shared.rows[warp] = rows;
      }
      __syncthreads();
      if (turn < 0) turn = 0, end = shared.rows[0];
      while (turn < kRayWarps) {
        const int begin = max(end - params.ray_log.rows, 0);
        if (turn == warp) back.run(log, begin, end, adjoint);
        __syncthreads();
        end = begin;
        if (end > 0) break;
        if (++turn < kRayWarps) end = shared.rows[turn];
      }
    }
  }
}

}  // namespace ar::cuda::by_blocks
