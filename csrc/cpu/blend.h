// Loops of blend and blend_vjp: a work item is a tile, a step a splat, a vector part of a tile row.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstring>

#include "core/bin.h"
#include "core/blend.h"
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
  for (int y = 0; y < view.rows; ++y) std::memcpy(tile + y * kTile, image + view.pixel(grid, y), view.columns * sizeof(T));
}
template <typename T> void store_tile(const TileView& view, TileGrid grid, const T* tile, T* image) {
  for (int y = 0; y < view.rows; ++y) std::memcpy(image + view.pixel(grid, y), tile + y * kTile, view.columns * sizeof(T));
}

/// Which lanes of which rows of a tile a splat can reach.
template <typename T> struct TileSpans {
  int first_row, last_row;
  alignas(64) T lo[kTile], hi[kTile];  ///< columns of each row, relative to the tile, clamped to it
};

template <class F, typename T> AR_HD void find_spans(const Splat<F, T>& splat, const TileView& view, const T* lane_index, TileSpans<T>& spans) {
  using V = typename LanesOf<T>::Type;
  constexpr int kCount = LanesOf<T>::kCount;
  const Support<T> support = support_of(splat);
  const Span<T> rows = rows_of(support);
  spans.first_row = int(std::ceil(ar::max(rows.lo - T(view.y0), T(0))));
  spans.last_row = int(std::floor(ar::min(rows.hi - T(view.y0), T(view.rows - 1))));
  if (rows.hi < T(view.y0)) spans.last_row = -1;
  for (int row = spans.first_row / kCount * kCount; row <= spans.last_row; row += kCount) {
    const V y = V(T(view.y0 + row)) + load(lane_index, V());
    const Span<V> columns = columns_of(support, y, y);
    const V x0 = V(T(view.x0));
    store(spans.lo + row, max(columns.lo - x0, V(T(0))));
    store(spans.hi + row, min(columns.hi - x0, V(T(kTile - 1))));
  }
}

/// 0, 1, 2, ... as scalars, to be loaded as lanes.
template <typename T> struct LaneIndex {
  alignas(64) T value[kTile];
  LaneIndex() {
    for (int i = 0; i < kTile; ++i) value[i] = T(i);
  }
};

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
  uint32_t open_rows = (1u << view.rows) - 1;
  const int64_t begin = task.tile_offsets[tile], end = task.tile_offsets[tile + 1];
  TileSpans<T> spans;
  for (int64_t k = begin; k < end && open_rows != 0; ++k) {
    if (k + 4 < end) __builtin_prefetch(&splats[task.pairs[k + 4]]);
    const Splat<F, T>& splat = splats[task.pairs[k]];
    find_spans(splat, view, lanes.value, spans);
    const auto terms = F::terms(splat.shape);
    const V opacity(splat.opacity);
    const IndexOf<V> index(int32_t(k - begin + 1));
    for (int row = spans.first_row; row <= spans.last_row; ++row) {
      if (!(open_rows >> row & 1) || spans.hi[row] < spans.lo[row]) continue;
      const V dy(T(view.y0 + row) - splat.mean.y);
      bool row_closed = false;
      for (int x = int(spans.lo[row]) / kCount * kCount; x <= int(spans.hi[row]); x += kCount) {
        const Vec2<V> d = {load(lanes.value + x, V()) + V(T(view.x0) - splat.mean.x), dy};
        const int pixel = row * kTile + x;
        V contribution(T(0));
        MaskOf<V> closed{};
        AR_UNROLL
        for (int s = 0; s < kSamples; ++s) {
          const V raw = opacity * F::weight(terms, d, s);
          V t = load(transmittance[s] + pixel, V());
          const Blended<V> blended = blend_sample(raw, t);
          store(transmittance[s] + pixel, t);
          contribution = contribution + blended.contribution;
          closed = closed | blended.closed;
          if (task.last) {
            store_index(last[s] + pixel, select(blended.mask, index, load_index(last[s] + pixel, V())));
          }
        }
        store(color[0] + pixel, madd(contribution, V(splat.color.x), load(color[0] + pixel, V())));
        store(color[1] + pixel, madd(contribution, V(splat.color.y), load(color[1] + pixel, V())));
        store(color[2] + pixel, madd(contribution, V(splat.color.z), load(color[2] + pixel, V())));
        row_closed |= any(closed);
      }
      if (row_closed) {
        bool open = false;
        for (int s = 0; s < kSamples; ++s) {
          for (int i = 0; i < kTile; ++i) open |= transmittance[s][row * kTile + i] > T(0);
        }
        if (!open) open_rows &= ~(1u << row);
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
}

template <class F, typename T> void blend(const cpu::BlendTask<T>& task) {
  cpu::parallel_for(task.grid.tiles(), task.threads, [&](int64_t tile) { blend_tile<F, T>(task, tile); });
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
  for (int c = 0; c < 3; ++c) {
    load_tile(view, task.grid, task.dL_dimage + c * plane, g[c]);
    for (int i = 0; i < kTilePixels; ++i) g[c][i] /= T(kSamples);
  }
  for (int s = 0; s < kSamples; ++s) {
    std::fill_n(transmittance[s], kTilePixels, T(1));
    load_tile(view, task.grid, task.transmittance + s * plane, transmittance[s]);
    load_tile(view, task.grid, task.last + s * plane, last[s]);
    for (int i = 0; i < kTilePixels; ++i) {
      behind[s][i] = g[0][i] * task.background[0] + g[1][i] * task.background[1] + g[2][i] * task.background[2];
      row_last[i / kTile] = std::max(row_last[i / kTile], last[s][i]);
    }
  }
  for (int row = 0; row < kTile; ++row) tile_last = std::max(tile_last, row_last[row]);
  const int64_t begin = task.tile_offsets[tile], end = task.tile_offsets[tile + 1];
  std::fill(task.pair_grads + begin + tile_last, task.pair_grads + end, PairGrad<T>{});
  if (kAbs) std::fill(task.pair_abs + begin + tile_last, task.pair_abs + end, Vec2<T>{});
  TileSpans<T> spans;
  for (int32_t k = tile_last - 1; k >= 0; --k) {
    if (k >= 4) __builtin_prefetch(&splats[task.pairs[begin + k - 4]]);
    const Splat<F, T>& splat = splats[task.pairs[begin + k]];
    find_spans(splat, view, lanes.value, spans);
    const auto terms = F::terms(splat.shape);
    const V opacity(splat.opacity), zero = V(T(0));
    const IndexOf<V> index(k);
    ShapeGrad<V> shape = {{zero, zero}, {zero, zero, zero}};
    V weighted = zero;
    Vec3<V> color = {zero, zero, zero};
    Vec2<V> abs2d = {zero, zero};
    for (int row = spans.first_row; row <= spans.last_row; ++row) {
      if (k >= row_last[row] || spans.hi[row] < spans.lo[row]) continue;
      const V dy(T(view.y0 + row) - splat.mean.y);
      for (int x = int(spans.lo[row]) / kCount * kCount; x <= int(spans.hi[row]); x += kCount) {
        const Vec2<V> d = {load(lanes.value + x, V()) + V(T(view.x0) - splat.mean.x), dy};
        const int pixel = row * kTile + x;
        const Vec3<V> gp = {load(g[0] + pixel, V()), load(g[1] + pixel, V()), load(g[2] + pixel, V())};
        const V g_color = madd(gp.x, V(splat.color.x), madd(gp.y, V(splat.color.y), gp.z * V(splat.color.z)));
        V contribution = zero;
        Vec2<V> offset = {zero, zero};
        AR_UNROLL
        for (int s = 0; s < kSamples; ++s) {
          const V weight = F::weight(terms, d, s), raw = opacity * weight;
          const MaskOf<V> mask = (raw >= V(T(kAlphaMin))) & (index < load_index(last[s] + pixel, V()));
          V t = load(transmittance[s] + pixel, V()), b = load(behind[s] + pixel, V());
          const BlendGrad<V> grad = blend_sample_vjp(mask, raw, g_color, t, b);
          store(transmittance[s] + pixel, t);
          store(behind[s] + pixel, b);
          contribution = contribution + grad.contribution;
          weighted = madd(grad.dL_dalpha, raw, weighted);
          const ShapeGrad<V> sg = F::weight_vjp(terms, d, s, weight, grad.dL_dalpha * opacity);
          offset = offset + sg.offset;
          shape.shape = {shape.shape.xx + sg.shape.xx, shape.shape.xy + sg.shape.xy, shape.shape.yy + sg.shape.yy};
        }
        shape.offset = shape.offset + offset;
        color = {madd(contribution, gp.x, color.x), madd(contribution, gp.y, color.y), madd(contribution, gp.z, color.z)};
        if (kAbs) {
          const Vec2<V> by_mean = transform_transposed(F::mean_map(splat.shape), offset);
          abs2d = abs2d + Vec2<V>{abs(by_mean.x), abs(by_mean.y)};
        }
      }
    }
    task.pair_grads[begin + k] = {{{sum(shape.offset.x), sum(shape.offset.y)},
                                   {sum(shape.shape.xx), sum(shape.shape.xy), sum(shape.shape.yy)}},
                                  sum(weighted),
                                  {sum(color.x), sum(color.y), sum(color.z)}};
    if (kAbs) task.pair_abs[begin + k] = {sum(abs2d.x), sum(abs2d.y)};
  }
}

template <class F, typename T> void blend_vjp(const cpu::BlendVjpTask<T>& task) {
  cpu::parallel_for(task.grid.tiles(), task.threads, [&](int64_t tile) {
    if (task.pair_abs) {
      blend_vjp_tile<F, T, true>(task, tile);
    } else {
      blend_vjp_tile<F, T, false>(task, tile);
    }
  });
}

}  // namespace ar::AR_ISA
