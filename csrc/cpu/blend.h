// Loops of blend and blend_vjp: a work item is a tile, a step a splat, a vector part of a tile row.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstring>

#include "core/bin.h"
#include "core/blend.h"
#include "core/choose.h"
#include "core/footprint/registry.h"
#include "cpu/pack.h"
#include "cpu/parallel.h"
#include "cpu/tasks.h"

namespace ar::AR_ISA {

inline constexpr int kTilePixels = kTile * kTile;

/// The pixels of one tile, and which of them lie in the image.
struct TileView {
  int x0, y0, columns, rows;

  TileView(TileGrid grid, int64_t tile)
      : x0(int(tile % grid.columns()) * kTile),
        y0(int(tile / grid.columns()) * kTile),
        columns(std::min(kTile, grid.width - x0)),
        rows(std::min(kTile, grid.height - y0)) {}

  int64_t pixel(TileGrid grid, int row) const { return int64_t(y0 + row) * grid.width + x0; }
};

/// Copies the part of a tile that lies in the image, rows of `columns`, between image and tile.
template <typename T> void load_tile(const TileView& view, TileGrid grid, const T* image, T* tile) {
  for (int y = 0; y < view.rows; ++y)
    std::memcpy(tile + y * kTile, image + view.pixel(grid, y), view.columns * sizeof(T));
}
template <typename T> void store_tile(const TileView& view, TileGrid grid, const T* tile, T* image) {
  for (int y = 0; y < view.rows; ++y)
    std::memcpy(image + view.pixel(grid, y), tile + y * kTile, view.columns * sizeof(T));
}

/// 0, 1, 2, ... as scalars, to be loaded as lanes.
template <typename T> struct LaneIndex {
  alignas(64) T value[kTile];
  LaneIndex() {
    for (int i = 0; i < kTile; ++i) value[i] = T(i);
  }
};

/// The packs of a tile that a splat can reach: bit r of rows[c] for pack c of row r.
template <typename T> struct TileMask {
  static constexpr int kCount = LanesOf<T>::kCount, kPacks = kTile / kCount;
  uint32_t rows[kPacks];
};

template <class F, typename T>
AR_HD TileMask<T> reach_of(const Splat<F, T>& splat, const TileView& view, const LaneIndex<T>& lanes) {
  using V = typename LanesOf<T>::Type;
  constexpr int kCount = TileMask<T>::kCount, kPacks = TileMask<T>::kPacks;
  const Support<T> support = support_of(splat);
  TileMask<T> mask = {};
  AR_UNROLL
  for (int row = 0; row < kTile; row += kCount) {
    const V y = V(T(view.y0)) + load(lanes.value + row, V());
    const Span<V> span = F::kReach == 0 ? chord_of(support, y) : columns_of(support, y, y);
    AR_UNROLL
    for (int c = 0; c < kPacks; ++c) {
      const V first = V(T(view.x0 + c * kCount)), last = V(T(view.x0 + c * kCount + kCount - 1));
      mask.rows[c] |= bits((span.lo <= last) & (span.hi >= first)) << row;
    }
  }
  return mask;
}

/// Rows of a tile with an open sample.
template <int kSamples, typename T> uint32_t find_open_rows(const T (&transmittance)[kSamples][kTilePixels]) {
  using V = typename LanesOf<T>::Type;
  uint32_t open = 0;
  for (int row = 0; row < kTile; ++row) {
    V largest(T(0));
    for (int s = 0; s < kSamples; ++s) {
      for (int x = 0; x < kTile; x += LanesOf<T>::kCount)
        largest = max(largest, load(transmittance[s] + row * kTile + x, V()));
    }
    open |= uint32_t(bits(largest > V(T(0))) != 0) << row;
  }
  return open;
}

/// How many splats pass between two looks at which rows are still open.
inline constexpr int64_t kLook = 16;

template <class F, typename T> void blend_tile(const cpu::BlendTask<T>& task, int64_t tile) {
  using V = typename LanesOf<T>::Type;
  constexpr int kCount = LanesOf<T>::kCount, kSamples = F::kSamples;
  const auto* splats = reinterpret_cast<const Splat<F, T>*>(task.splats);
  const TileView view(task.grid, tile);
  const LaneIndex<T> lanes;
  alignas(64) T transmittance[kSamples][kTilePixels];
  alignas(64) int32_t last[kSamples][kTilePixels] = {};
  alignas(64) T color[3][kTilePixels] = {};
  for (int s = 0; s < kSamples; ++s) {
    for (int i = 0; i < kTilePixels; ++i) transmittance[s][i] = i % kTile < view.columns ? T(1) : T(-1);
  }
  const uint32_t rows_in_image = (1u << view.rows) - 1;
  uint32_t open_rows = rows_in_image;
  const int64_t begin = task.tile_offsets[tile], end = task.tile_offsets[tile + 1];
  for (int64_t k = begin; k < end; ++k) {
    if ((k - begin) % kLook == kLook - 1) {
      open_rows = rows_in_image & find_open_rows<kSamples, T>(transmittance);
      if (open_rows == 0) break;
    }
    if (k + 4 < end) __builtin_prefetch(&splats[task.pairs[k + 4]]);
    const Splat<F, T>& splat = splats[task.pairs[k]];
    const TileMask<T> reach = reach_of(splat, view, lanes);
    const Vec2<T> origin = {T(view.x0) - splat.mean.x, T(view.y0) - splat.mean.y};
    const auto terms = F::terms(splat.shape, splat.opacity, origin);
    const Vec3<V> splat_color = {V(splat.color.x), V(splat.color.y), V(splat.color.z)};
    const IndexOf<V> index(int32_t(k - begin + 1));
    for (int c = 0; c < TileMask<T>::kPacks; ++c) {
      const V x = load(lanes.value + c * kCount, V());
      for (uint32_t rows = reach.rows[c] & open_rows; rows != 0; rows &= rows - 1) {
        const int row = __builtin_ctz(rows), pixel = row * kTile + c * kCount;
        const Vec2<V> p = {x, V(lanes.value[row])};
        V contribution(T(0));
        AR_UNROLL
        for (int s = 0; s < kSamples; ++s) {
          V t = load(transmittance[s] + pixel, V());
          const Blended<V> blended = blend_sample(F::alpha(terms, p, s), t);
          store(transmittance[s] + pixel, t);
          contribution = contribution + blended.contribution;
          if (task.last) {
            store_index(last[s] + pixel, select(blended.mask, index, load_index(last[s] + pixel, V())));
          }
        }
        store(color[0] + pixel, madd(contribution, splat_color.x, load(color[0] + pixel, V())));
        store(color[1] + pixel, madd(contribution, splat_color.y, load(color[1] + pixel, V())));
        store(color[2] + pixel, madd(contribution, splat_color.z, load(color[2] + pixel, V())));
      }
    }
  }
  const int64_t plane = int64_t(task.grid.width) * task.grid.height;
  alignas(64) T through[kTilePixels] = {};  // mean transmittance of the samples
  for (int s = 0; s < kSamples; ++s) {
    for (int i = 0; i < kTilePixels; ++i) {
      transmittance[s][i] = std::abs(transmittance[s][i]);
      through[i] += transmittance[s][i] / T(kSamples);
    }
    if (task.transmittance) store_tile(view, task.grid, transmittance[s], task.transmittance + s * plane);
    if (task.last) store_tile(view, task.grid, last[s], task.last + s * plane);
  }
  for (int c = 0; c < 3; ++c) {
    for (int i = 0; i < kTilePixels; ++i) color[c][i] = color[c][i] / T(kSamples) + through[i] * task.background[c];
    store_tile(view, task.grid, color[c], task.image + c * plane);
  }
  if (task.alpha) {
    for (int i = 0; i < kTilePixels; ++i) through[i] = T(1) - through[i];
    store_tile(view, task.grid, through, task.alpha);
  }
}

/// Calls f(F{}) for what a tile is blended with: F itself, or for `adaptive` the one of Boxes that was chosen.
template <class F, class Boxes, class Function>
void visit_tile_footprint(const int32_t* tile_samples, int64_t tile, Function&& f) {
  if constexpr (std::is_same_v<F, Adaptive>) {
    visit_samples(tile_samples[tile], Boxes{}, f);
  } else {
    f(F{});
  }
}

template <class F, typename T> void choose(const cpu::ChooseTask<T>& task) {
  const auto* splats = reinterpret_cast<const Splat<F, T>*>(task.splats);
  const SampleLimits<T> limits = sample_limits<T>(task.options.tolerance);
  cpu::parallel_for(task.grid.tiles(), task.threads, [&](int64_t tile) {
    const Vec2<T> center = tile_center<T>(task.grid, tile);
    SampleEstimate<T> estimate;
    for (int64_t k = task.tile_offsets[tile]; k < task.tile_offsets[tile + 1] && !estimate.dark(); ++k) {
      const Splat<F, T>& splat = splats[task.pairs[k]];
      const Vec2<T> d = {center.x - splat.mean.x, center.y - splat.mean.y};
      estimate.add(tile_share(splat.shape, splat.opacity, d), splat.color);
    }
    task.tile_samples[tile] =
        limits.choose(estimate.value({task.background[0], task.background[1], task.background[2]}));
  });
}

template <class F, typename T> void blend(const cpu::BlendTask<T>& task) {
  cpu::parallel_for(task.grid.tiles(), task.threads, [&](int64_t tile) {
    visit_tile_footprint<F, AdaptiveBoxes>(task.tile_samples, tile,
                                           [&](auto f) { blend_tile<decltype(f), T>(task, tile); });
  });
}

template <class F, typename T, bool kAbs> void blend_vjp_tile(const cpu::BlendVjpTask<T>& task, int64_t tile) {
  using V = typename LanesOf<T>::Type;
  constexpr int kCount = LanesOf<T>::kCount, kSamples = F::kSamples;
  const auto* splats = reinterpret_cast<const Splat<F, T>*>(task.splats);
  const TileView view(task.grid, tile);
  const LaneIndex<T> lanes;
  const int64_t plane = int64_t(task.grid.width) * task.grid.height;
  alignas(64) T transmittance[kSamples][kTilePixels];
  alignas(64) T behind[kSamples][kTilePixels];
  alignas(64) int32_t last[kSamples][kTilePixels] = {};
  alignas(64) T g[3][kTilePixels] = {};  // dL/d(one sample's colour)
  int32_t row_last[kTile] = {}, tile_last = 0;
  alignas(64) T g_alpha[kTilePixels] = {};
  for (int c = 0; c < 3; ++c) {
    load_tile(view, task.grid, task.dL_dimage + c * plane, g[c]);
    for (int i = 0; i < kTilePixels; ++i) g[c][i] /= T(kSamples);
  }
  if (task.dL_dalpha) load_tile(view, task.grid, task.dL_dalpha, g_alpha);
  for (int s = 0; s < kSamples; ++s) {
    std::fill_n(transmittance[s], kTilePixels, T(1));
    load_tile(view, task.grid, task.transmittance + s * plane, transmittance[s]);
    load_tile(view, task.grid, task.last + s * plane, last[s]);
    for (int i = 0; i < kTilePixels; ++i) {
      behind[s][i] = g[0][i] * task.background[0] + g[1][i] * task.background[1] + g[2][i] * task.background[2];
      row_last[i / kTile] = std::max(row_last[i / kTile], last[s][i]);
    }
    // What is covered does not let the background through: a background of its own.
    if (task.dL_dalpha) {
      for (int i = 0; i < kTilePixels; ++i) behind[s][i] -= g_alpha[i] / T(kSamples);
    }
  }
  for (int row = 0; row < kTile; ++row) tile_last = std::max(tile_last, row_last[row]);
  const uint32_t rows_in_image = (1u << view.rows) - 1;
  const int64_t begin = task.tile_offsets[tile], end = task.tile_offsets[tile + 1];
  std::fill(task.pair_grads + begin + tile_last, task.pair_grads + end, PairGrad<T>{});
  if (kAbs) std::fill(task.pair_abs + begin + tile_last, task.pair_abs + end, Vec2<T>{});
  for (int32_t k = tile_last - 1; k >= 0; --k) {
    if (k >= 4) __builtin_prefetch(&splats[task.pairs[begin + k - 4]]);
    const Splat<F, T>& splat = splats[task.pairs[begin + k]];
    const TileMask<T> reach = reach_of(splat, view, lanes);
    const Vec2<T> origin = {T(view.x0) - splat.mean.x, T(view.y0) - splat.mean.y};
    const auto terms = F::terms(splat.shape, splat.opacity, origin);
    const V zero = V(T(0));
    const Vec3<V> splat_color = {V(splat.color.x), V(splat.color.y), V(splat.color.z)};
    const IndexOf<V> index(k);
    ShapeGrad<V> shape = {{zero, zero}, {zero, zero, zero}};
    V weighted = zero;
    Vec3<V> color = {zero, zero, zero};
    Vec2<V> abs2d = {zero, zero};
    for (int c = 0; c < TileMask<T>::kPacks; ++c) {
      const V x = load(lanes.value + c * kCount, V());
      for (uint32_t rows = reach.rows[c] & rows_in_image; rows != 0; rows &= rows - 1) {
        const int row = __builtin_ctz(rows), pixel = row * kTile + c * kCount;
        if (k >= row_last[row]) continue;
        const Vec2<V> p = {x, V(lanes.value[row])};
        const Vec3<V> gp = {load(g[0] + pixel, V()), load(g[1] + pixel, V()), load(g[2] + pixel, V())};
        const V g_color = madd(gp.x, splat_color.x, madd(gp.y, splat_color.y, gp.z * splat_color.z));
        V contribution = zero;
        ShapeGrad<V> of_pixel = {{zero, zero}, {zero, zero, zero}};
        AR_UNROLL
        for (int s = 0; s < kSamples; ++s) {
          const V alpha = F::alpha(terms, p, s);
          const MaskOf<V> mask = (alpha >= V(T(kAlphaMin))) & (index < load_index(last[s] + pixel, V()));
          V t = load(transmittance[s] + pixel, V()), b = load(behind[s] + pixel, V());
          const BlendGrad<V> grad = blend_sample_vjp(mask, alpha, g_color, t, b);
          store(transmittance[s] + pixel, t);
          store(behind[s] + pixel, b);
          contribution = contribution + grad.contribution;
          weighted = madd(grad.dL_dalpha, alpha, weighted);
          F::add_alpha_vjp(terms, p, s, alpha, grad.dL_dalpha, shape);
          // Again for the pixel alone: to ask for it must not change the other sums by a bit.
          if (kAbs) F::add_alpha_vjp(terms, p, s, alpha, grad.dL_dalpha, of_pixel);
        }
        color = {madd(contribution, gp.x, color.x), madd(contribution, gp.y, color.y),
                 madd(contribution, gp.z, color.z)};
        if (kAbs) {
          const Vec2<V> by_mean = transform_transposed(F::mean_map(splat.shape), of_pixel.offset);
          abs2d = abs2d + Vec2<V>{abs(by_mean.x), abs(by_mean.y)};
        }
      }
    }
    const ShapeGrad<T> total = {{sum(shape.offset.x), sum(shape.offset.y)},
                                {sum(shape.shape.xx), sum(shape.shape.xy), sum(shape.shape.yy)}};
    const T total_weighted = sum(weighted);
    task.pair_grads[begin + k] = {
        F::collect(terms, total, total_weighted), total_weighted, {sum(color.x), sum(color.y), sum(color.z)}};
    if (kAbs) task.pair_abs[begin + k] = {sum(abs2d.x), sum(abs2d.y)};
  }
}

template <class F, typename T> void blend_vjp(const cpu::BlendVjpTask<T>& task) {
  cpu::parallel_for(task.grid.tiles(), task.threads, [&](int64_t tile) {
    visit_tile_footprint<F, AdaptiveBoxesVjp>(task.tile_samples, tile, [&](auto f) {
      if (task.pair_abs) {
        blend_vjp_tile<decltype(f), T, true>(task, tile);
      } else {
        blend_vjp_tile<decltype(f), T, false>(task, tile);
      }
    });
  });
}

}  // namespace ar::AR_ISA
