// Loop of blend_vjp: as blend.h, last splat first, for a window of channels. Writes gradients per pair.
#pragma once

#include "core/blend.h"
#include "cpu/parallel.h"
#include "cpu/replay.h"
#include "cpu/tile.h"

namespace ar::AR_ISA {

/// Per sample, for channels [first, first + count).
template <typename T>
void load_gradient(const cpu::BlendVjpParams<T>& p, const TileView& view, int first, int count, T samples, T* to) {
  constexpr int kCount = LanesOf<T>::kCount;
  using V = typename LanesOf<T>::Type;
  const int64_t size = int64_t(p.grid.width) * p.grid.height;
  for (int c = 0; c < count; ++c) {
    alignas(64) T plane[kTilePixels] = {};
    if (const T* image = p.dL_dimage.plane(first + c, size)) load_tile<T>(view, p.grid, image, plane);
    for (int i = 0; i < kTilePixels; i += kCount)
      store(channels_at(to, i, count) + c * kCount, load(plane + i, V()) / V(samples));
  }
}

/// Of all channels: what blend_sample_vjp calls `behind`, after the last splat.
template <typename T>
void load_background(const cpu::BlendVjpParams<T>& p, const TileView& view, T samples, const T* gradient, T* behind) {
  constexpr int kCount = LanesOf<T>::kCount;
  using V = typename LanesOf<T>::Type;
  const int channels = p.channels.count;
  for (int i = 0; i < kTilePixels; i += kCount) {
    V sum = V(T(0));
    for (int c = 0; c < channels; ++c) {
      const V g = load(gradient + i * channels + c * kCount, V());
      sum = sum + g * V(p.background[c]);
    }
    store(behind + i, sum);
  }
  if (!p.dL_dalpha) return;
  // Alpha is a channel with background -1.
  alignas(64) T dL_dalpha[kTilePixels] = {};
  load_tile<T>(view, p.grid, p.dL_dalpha, dL_dalpha);
  for (int i = 0; i < kTilePixels; ++i) behind[i] -= dL_dalpha[i] / samples;
}

/// Channels after the third change no bit if their gradient is zero.
template <class V, typename T> AR_HD V dot_channels(const T* gradient, const T* shown, int count) {
  constexpr int kCount = LanesOf<T>::kCount;
  const auto term = [&](int c, V sum) { return madd(load(gradient + c * kCount, V()), V(shown[c]), sum); };
  const V zero = V(T(0));
  if (count < 3) return count == 2 ? term(0, term(1, zero)) : term(0, zero);
  const V colors = term(0, term(1, load(gradient + 2 * kCount, V()) * V(shown[2])));
  if (count == 3) return colors;
  V sums[4] = {zero, zero, zero, zero};  // Four hide the latency of madd.
  int c = 3;
  for (; c + 4 <= count; c += 4) {
    AR_UNROLL for (int k = 0; k < 4; ++k) sums[k] = term(c + k, sums[k]);
  }
  for (; c < count; ++c) sums[0] = term(c, sums[0]);
  return colors + ((sums[0] + sums[1]) + (sums[2] + sums[3]));
}

/// `gradient`: scratch. `replay_memory`: null unless samples move.
template <class P, typename T>
AR_ONE_COPY void blend_vjp_tile(const cpu::BlendVjpParams<T>& p, int64_t tile, T* gradient, T* replay_memory) {
  using V = typename LanesOf<T>::Type;
  constexpr int kCount = LanesOf<T>::kCount, kSamples = P::kSamples;
  const TileView view(p.grid, tile);
  const TilePixels<T>& of_tile = kTilePixelsOf<T>;
  const int64_t size = int64_t(p.grid.width) * p.grid.height;
  const Vec2<T> size_px = {T(p.grid.width), T(p.grid.height)};
  // dL/dalpha needs all channels, the sums only the window's.
  const bool with_shape = p.pair_grads != nullptr, with_means = with_shape && p.pair_means;
  const int loaded = with_shape ? p.channels.count : p.count, window = with_shape ? p.first : 0, count = p.count;
  const bool three = count == 3;
  alignas(64) T transmittance[kSamples][kTilePixels];
  alignas(64) T behind[kSamples][kTilePixels];
  alignas(64) int32_t last[kSamples][kTilePixels] = {};
  alignas(64) T behind_all[kTilePixels] = {};
  LastPairs<T> pack_last = {};
  int32_t tile_last = 0;
  load_gradient(p, view, with_shape ? 0 : p.first, loaded, T(kSamples), gradient);
  if (with_shape) load_background(p, view, T(kSamples), gradient, behind_all);
  for (int s = 0; s < kSamples; ++s) {
    std::fill_n(transmittance[s], kTilePixels, T(1));
    load_tile<T>(view, p.grid, p.transmittance + s * size, transmittance[s]);
    load_tile<T>(view, p.grid, p.last + s * size, last[s]);
    std::copy_n(behind_all, kTilePixels, behind[s]);
    for (int i = 0; i < kTilePixels; ++i) {
      int32_t& of_pack = pack_last.of_pack[i / kCount];
      of_pack = std::max(of_pack, last[s][i]);
    }
  }
  for (const int32_t of_pack : pack_last.of_pack) tile_last = std::max(tile_last, of_pack);
  const int32_t* pairs = p.lists.pairs;
  const int64_t begin = p.lists.tile_offsets[tile], end = p.lists.tile_offsets[tile + 1];
  const auto write_zeros = [&](int64_t k) {
    if (with_shape) std::fill_n(p.pair_grads + k * p.pair_stride, cpu::kPairNumbers, T(0));
    if (with_means) p.pair_means[k] = {T(0), T(0)};
    std::fill_n(p.channel_sums + k * p.channel_stride, p.count, T(0));
  };
  for (int64_t k = begin + tile_last; k < end; ++k) write_zeros(k);
  TilePairs<P, T> dL_dplaces = {};
  Replay<P, T> replay({p, view, last, pack_last, begin, tile_last, replay_memory});
  // Pairs of the same k / kBatch. The replay needs no batch.
  TileSplat<P, T> batch[P::kMoves ? 1 : kBatch];
  const auto prefetch_before = [&](int32_t k) {
    if (k >= kPrefetch) prefetch_splat(p.splats, pairs[begin + k - kPrefetch]);
  };
  for (int32_t k = tile_last - 1; k >= 0; --k) {
    const int32_t j = pairs[begin + k], in_batch = P::kMoves ? 0 : k % kBatch;
    if constexpr (P::kMoves) {
      replay.enter(k);
      if (!replay.has(k)) {
        write_zeros(begin + k);
        continue;
      }
      prefetch_before(k);
      batch[0].splat = splat_at<P>(p.splats, j);
      batch[0].terms = terms_in_tile<P>(batch[0].splat, view);
    } else if (in_batch == kBatch - 1 || k == tile_last - 1) {
      for (int32_t i = in_batch; i >= 0; --i) {
        prefetch_before(k - in_batch + i);
        batch[i] = tile_splat<P>(p.splats, pairs[begin + k - in_batch + i], view);
      }
    }
    const TileSplat<P, T>& prepared = batch[in_batch];
    const auto& terms = prepared.terms;
    const T* shown = p.channels.row(j);
    const V zero = V(T(0));
    const IndexOf<V> index(k);
    ShapeGrad<V> shape = {{zero, zero}, {zero, zero, zero}};
    V weighted = zero;
    const Vec3<V> splat_color = three_channels<V>(shown, loaded == 3);
    Vec3<V> color = {zero, zero, zero};
    alignas(64) T sums[cpu::kWindow * kCount];
    if (!three) std::fill_n(sums, count * kCount, T(0));
    Vec2<V> mean_sums = {zero, zero};
    const auto visit = [&](int pixel) AR_HD_LAMBDA {
      const Vec2<V> at = {load(of_tile.x + pixel, V()), load(of_tile.y + pixel, V())};
      const T* g = channels_at(gradient, pixel, loaded);
      V g_color = zero;
      if (loaded == 3) {
        g_color = madd(load(g, V()), splat_color.x,
                       madd(load(g + kCount, V()), splat_color.y, load(g + 2 * kCount, V()) * splat_color.z));
      } else if (with_shape) {
        g_color = dot_channels<V>(g, shown, loaded);
      }
      V contribution = zero;
      ShapeGrad<V> of_pixel = {{zero, zero}, {zero, zero, zero}};
      if constexpr (P::kMoves) {
        const Vec2<V> z = P::whitened(terms, at, 0);
        MovingBlendGrad<V> grad = no_moving_blend_grad<V>();
        do {
          auto found = replay.take();
          AR_UNROLL for (int j = 0; j < Replay<P, T>::kGroup; ++j) {
            const int s = found.first + j;
            if (found.lanes[j] == 0) continue;
            V raw;
            Vec2<V> place;
            found.read(j, replay.bounds(s).lo, raw, place);
            V t = load(transmittance[s] + pixel, V()), b = load(behind[s] + pixel, V());
            Vec2<V> dL_dplace = dL_dplaces.at(s, pixel);
            add_placed_sample_vjp<P>(terms, P::whitened_node(terms, z, place), raw, replay.bounds(s), g_color, place, t,
                                     b, dL_dplace, grad);
            store(transmittance[s] + pixel, t);
            store(behind[s] + pixel, b);
            dL_dplaces.set(s, pixel, dL_dplace);
          }
        } while (replay.has(k) && replay.pixel() == pixel);
        contribution = grad.contribution;
        weighted = weighted + grad.of_splat.weighted;
        of_pixel = grad.of_splat.sums;
        shape = shape + of_pixel;
      } else {
        AR_UNROLL for (int s = 0; s < kSamples; ++s) {
          const V alpha = P::alpha(terms, at, s);
          const MaskOf<V> mask = (alpha >= V(T(kAlphaMin))) & (index < load_index(last[s] + pixel, V()));
          V t = load(transmittance[s] + pixel, V()), b = load(behind[s] + pixel, V());
          const BlendGrad<V> grad = blend_sample_vjp(mask, alpha, g_color, t, b);
          store(transmittance[s] + pixel, t);
          store(behind[s] + pixel, b);
          contribution = contribution + grad.contribution;
          weighted = weighted + grad.of_alpha.weighted;
          P::add_alpha_vjp(terms, at, s, grad.of_alpha, shape);
          // Again, so that mean sums change no bit of the others.
          if (with_means) P::add_alpha_vjp(terms, at, s, grad.of_alpha, of_pixel);
        }
      }
      g += window * kCount;
      if (three) {
        color = {madd(contribution, load(g, V()), color.x), madd(contribution, load(g + kCount, V()), color.y),
                 madd(contribution, load(g + 2 * kCount, V()), color.z)};
      } else {
        for (int i = 0; i < count * kCount; i += kCount)
          store(sums + i, madd(contribution, load(g + i, V()), load(sums + i, V())));
      }
      if (with_means) {
        const Vec2<V> by_mean = transform_transposed(P::mean_map(prepared.splat.shape), of_pixel.offset);
        mean_sums = mean_sums + mean_sums_of(p.mean_sums, size_px, by_mean);
      }
    };
    if constexpr (P::kMoves) {
      while (replay.has(k)) visit(replay.pixel());
    } else {
      for_each_pack(prepared.reach, pack_last.from(index), visit);
    }
    const V parts[] = {shape.offset.x, shape.offset.y, shape.shape.xx, shape.shape.xy,
                       shape.shape.yy, weighted,       color.x,        color.y};
    T totals[8];
    sum_lanes(parts, totals);
    const auto [offset_x, offset_y, xx, xy, yy, total_weighted, red, green] = totals;
    T* channel_sums = p.channel_sums + (begin + k) * p.channel_stride;
    if (three) {
      channel_sums[0] = red;
      channel_sums[1] = green;
      channel_sums[2] = sum(color.z);
    } else {
      for (int c = 0; c < count; ++c) channel_sums[c] = sum(load(sums + c * kCount, V()));
    }
    if (!with_shape) continue;
    auto* pair = reinterpret_cast<PairGrad<T>*>(p.pair_grads + (begin + k) * p.pair_stride);
    *pair = {{{offset_x, offset_y}, {xx, xy, yy}}, total_weighted};
    if (with_means) p.pair_means[begin + k] = {sum(mean_sums.x), sum(mean_sums.y)};
  }
}

template <class P, typename T> void blend_vjp(const cpu::BlendVjpParams<T>& p) {
  cpu::parallel_for(p.grid.tiles(), p.threads, [&](int64_t tile, int thread) {
    T* gradient = p.scratch + thread * int64_t(p.channels.count) * kTilePixels;
    T* replay_memory = p.replay ? p.replay + thread * cpu::kReplayNumbers : nullptr;
    blend_vjp_tile<P, T>(p, tile, gradient, replay_memory);
  });
}

}  // namespace ar::AR_ISA
