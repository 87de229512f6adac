// Loop of blend_vjp in the order along rays, which is taken as given (core/order.h). A pack composites its splats
// again, logs them, walks the log back, and adds to rows of pairs lane by lane: in a fixed order, since a tile has one
// thread.
#pragma once

#include "cpu/blend_rays.h"
#include "cpu/blend_vjp.h"

namespace ar::AR_ISA {

/// An entry that a lane composited.
template <class P, typename T> struct RayEvent {
  using V = typename LanesOf<T>::Type;
  alignas(64) int32_t places[LanesOf<T>::kCount];
  V raw[P::kSamples];                           ///< Zero where a sample did not composite it.
  Vec2<V> before[P::kMoves ? P::kSamples : 1];  ///< Places of samples that move.
  uint32_t lanes;
};

/// The rows of a tile's pairs.
template <typename T> struct PairRows {
  const cpu::BlendVjpParams<T>& p;
  int64_t begin;

  void clear(int32_t count) const {
    for (int64_t k = begin; k < begin + count; ++k) {
      std::fill_n(p.pair_grads + k * p.pair_stride, cpu::kPairNumbers, T(0));
      if (p.pair_means) p.pair_means[k] = {T(0), T(0)};
      std::fill_n(p.channel_sums + k * p.channel_stride, p.count, T(0));
    }
  }
  /// `gradient`: of the channels in a lane, `stride` apart. of_splat: what the pixel adds.
  template <class P>
  AR_HD void add(int32_t place, const Splat<P, T>& splat, const PairGrad<T>& of_splat, T contribution,
                 const T* gradient, int stride) const {
    auto& sum = *reinterpret_cast<PairGrad<T>*>(p.pair_grads + (begin + place) * p.pair_stride);
    sum = sum + of_splat;
    T* channels = p.channel_sums + (begin + place) * p.channel_stride;
    for (int c = 0; c < p.count; ++c) channels[c] += contribution * gradient[c * stride];
    if (!p.pair_means) return;
    const Vec2<T> by_mean = transform_transposed(P::mean_map(splat.shape), of_splat.shape.offset);
    Vec2<T>& means = p.pair_means[begin + place];
    means = means + mean_sums_of(p.mean_sums, Vec2<T>{T(p.grid.width), T(p.grid.height)}, by_mean);
  }
};

/// Walks back over the log of the pack at `pixel`. `gradient`: as load_gradient() leaves it, `behind`: as
/// load_background() does.
template <class P, typename T>
void walk_back(const RayList<P, T>& list, const std::vector<RayEvent<P, T>>& log, const PairRows<T>& rows,
               Vec2<typename LanesOf<T>::Type> at, RaySamples<P, T>& samples, const T* gradient, const T* behind_all) {
  using V = typename LanesOf<T>::Type;
  constexpr int kCount = LanesOf<T>::kCount, kSamples = P::kSamples;
  const int channels = rows.p.channels.count;
  V behind[kSamples];
  Vec2<V> dL_dplace[kSamples];
  for (int s = 0; s < kSamples; ++s) {
    samples.transmittance[s] = abs(samples.transmittance[s]);
    behind[s] = load(behind_all, V());
    dL_dplace[s] = {V(T(0)), V(T(0))};
  }
  for (size_t k = log.size(); k-- > 0;) {
    const RayEvent<P, T>& event = log[k];
    V shown[kMaxRayChannels], g_color(T(0));
    alignas(64) T numbers[kMaxRayChannels][kCount] = {};
    for_each_lane(event.lanes, [&](int lane) AR_HD_LAMBDA {
      const T* from = list[event.places[lane]].channels;
      for (int c = 0; c < channels; ++c) numbers[c][lane] = from[c];
    });
    for (int c = 0; c < channels; ++c) {
      shown[c] = load(numbers[c], V());
      g_color = madd(load(gradient + c * kCount, V()), shown[c], g_color);
    }
    alignas(64) T contributions[kCount];
    if constexpr (P::kMoves) {
      const auto terms = gather_terms<P, T>(list, event.lanes, event.places);
      const Vec2<V> z = P::whitened(terms, at, 0);
      MovingBlendGrad<V> grad = no_moving_blend_grad<V>();
      for (int s = 0; s < kSamples; ++s)
        add_placed_sample_vjp<P>(terms, P::whitened_node(terms, z, event.before[s]), event.raw[s], samples.bounds(s),
                                 g_color, event.before[s], samples.transmittance[s], behind[s], dL_dplace[s], grad);
      const ShapeGrad<V>& sums = grad.of_splat.sums;
      alignas(64) T of_lanes[6][kCount];
      const V parts[6] = {sums.offset.x, sums.offset.y, sums.shape.xx,
                          sums.shape.xy, sums.shape.yy, grad.of_splat.weighted};
      for (int n = 0; n < 6; ++n) store(of_lanes[n], parts[n]);
      store(contributions, grad.contribution);
      for_each_lane(event.lanes, [&](int lane) AR_HD_LAMBDA {
        const PairGrad<T> of_splat = {
            {{of_lanes[0][lane], of_lanes[1][lane]}, {of_lanes[2][lane], of_lanes[3][lane], of_lanes[4][lane]}},
            of_lanes[5][lane]};
        const int32_t place = event.places[lane];
        rows.template add<P>(place, list[place].splat.splat, of_splat, contributions[lane], gradient + lane, kCount);
      });
    } else {
      alignas(64) T of_alphas[kSamples][kCount], weights[kSamples][kCount], x[kCount], y[kCount];
      V contribution(T(0));
      for (int s = 0; s < kSamples; ++s) {
        const BlendGrad<V> grad =
            blend_sample_vjp(event.raw[s] > V(T(0)), event.raw[s], g_color, samples.transmittance[s], behind[s]);
        contribution = contribution + grad.contribution;
        store(of_alphas[s], grad.of_alpha.dL_dalpha);
        store(weights[s], grad.of_alpha.weighted);
      }
      store(contributions, contribution);
      store(x, at.x), store(y, at.y);
      for_each_lane(event.lanes, [&](int lane) AR_HD_LAMBDA {
        const int32_t place = event.places[lane];
        const auto& splat = list[place].splat;
        PairGrad<T> of_splat = {};
        for (int s = 0; s < kSamples; ++s) {
          P::add_alpha_vjp(splat.terms, Vec2<T>{x[lane], y[lane]}, s,
                           AlphaGrad<T>{of_alphas[s][lane], weights[s][lane]}, of_splat.shape);
          of_splat.weighted += weights[s][lane];
        }
        rows.template add<P>(place, splat.splat, of_splat, contributions[lane], gradient + lane, kCount);
      });
    }
  }
}

/// `gradient`: scratch.
template <class P, typename T>
AR_ONE_COPY void blend_rays_vjp_tile(const cpu::BlendVjpParams<T>& p, int64_t tile, T* gradient) {
  using V = typename LanesOf<T>::Type;
  constexpr int kCount = LanesOf<T>::kCount, kSamples = P::kSamples;
  RayList<P, T> list(p, tile);
  const PairRows<T> rows = {p, p.lists.tile_offsets[tile]};
  rows.clear(list.length());
  const int channels = p.channels.count;
  alignas(64) T behind[kTilePixels] = {}, inside[kTilePixels];
  load_gradient(p, list.view, 0, channels, T(kSamples), gradient);
  load_background(p, list.view, T(kSamples), gradient, behind);
  std::fill_n(inside, kTilePixels, T(-1));
  for_each_run<T>(list.view, p.grid,
                  [&](int first, int64_t, int count) AR_HD_LAMBDA { std::fill_n(inside + first, count, T(1)); });
  std::vector<RayEvent<P, T>> log;
  for (int pixel = 0; pixel < kTilePixels; pixel += kCount) {
    RaySamples<P, T> samples(inside + pixel);
    if (!samples.any_open()) continue;
    RayWalk<P, T> walk(list, pixel, p.order.window);
    log.clear();
    walk.run([&](const auto& entry, uint32_t lanes) AR_HD_LAMBDA {
      RayEvent<P, T> event = {};
      store_index(event.places, entry.place);
      blend_entry<P, T>(list, entry, event.places, lanes, walk.at, samples,
                        [&](int s, V raw, const Blended<V>& blended) AR_HD_LAMBDA {
                          event.raw[s] = select(blended.mask, raw, V(T(0)));
                          event.lanes |= bits(blended.mask);
                          if constexpr (P::kMoves) event.before[s] = samples.places[s];
                        });
      if (event.lanes != 0) log.push_back(event);
      return samples.any_open();
    });
    walk_back<P, T>(list, log, rows, walk.at, samples, channels_at(gradient, pixel, channels), behind + pixel);
  }
}

template <class P, typename T> void blend_rays_vjp(const cpu::BlendVjpParams<T>& p) {
  cpu::parallel_for(p.grid.tiles(), p.threads, [&](int64_t tile, int thread) {
    blend_rays_vjp_tile<P, T>(p, tile, p.scratch + thread * int64_t(p.channels.count) * kTilePixels);
  });
}

}  // namespace ar::AR_ISA
