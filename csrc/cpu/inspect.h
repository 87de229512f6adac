// Loop of inspect (core/inspect.h): walks lists as blend does. Threads add with atomics.
#pragma once

#include <cmath>
#include <cstring>

#include "core/inspect.h"
#include "cpu/parallel.h"
#include "cpu/tile.h"

namespace ar::AR_ISA {

/// Bits of floats >= 0 have their order.
inline void atomic_max(int32_t* bits, float value) {
  int32_t wanted, seen = __atomic_load_n(bits, __ATOMIC_RELAXED);
  std::memcpy(&wanted, &value, sizeof wanted);
  while (seen < wanted && !__atomic_compare_exchange_n(bits, &seen, wanted, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
  }
}

template <class P, Look kLook, typename T> AR_ONE_COPY void inspect_tile(const cpu::InspectParams<T>& p, int64_t tile) {
  const TileView view(p.grid, tile);
  PixelSummary<T, P, kLook> pixels[kTilePixels];
  bool open[kTilePixels];
  for (int i = 0; i < kTilePixels; ++i) {
    open[i] = i % kTile < view.columns && i / kTile < view.rows;
    pixels[i].start(open[i]);
  }
  int left = view.columns * view.rows;  // open pixels
  for (int64_t k = p.lists.tile_offsets[tile]; k < p.lists.tile_offsets[tile + 1] && left > 0; ++k) {
    const int32_t j = p.lists.pairs[k], id = p.ids[j];
    const Splat<P, T>& splat = splat_at<P>(p.splats, j);
    const Support<T> support = support_of(splat);
    const auto terms = P::terms(splat.shape, splat.opacity, {T(view.x0) - splat.mean.x, T(view.y0) - splat.mean.y});
    int32_t touched = 0, in_front = 0;
    int64_t units = 0;
    T largest = T(0);
    for (int row = 0; row < view.rows; ++row) {
      const Span<T> span = columns_of(support, T(view.y0 + row), T(view.y0 + row));
      for (int column = 0; column < view.columns; ++column) {
        if (!(span.lo <= T(view.x0 + column) && span.hi >= T(view.x0 + column))) continue;
        const int i = row * kTile + column;
        if (!open[i]) continue;
        const Shown<T> shown = pixels[i].add(terms, {T(column), T(row)}, j);
        open[i] = pixels[i].open();
        left -= !open[i];
        touched += shown.weight > T(0);
        in_front += shown.in_front;
        units += weight_units(shown.weight);
        largest = max(largest, shown.weight);
      }
    }
    if (kLook != Look::kStatistics || touched == 0) continue;
    __atomic_fetch_add(&p.touched[id], touched, __ATOMIC_RELAXED);
    __atomic_fetch_add(&p.in_front[id], in_front, __ATOMIC_RELAXED);
    __atomic_fetch_add(&p.units[id], units, __ATOMIC_RELAXED);
    atomic_max(&p.largest[id], float(largest));
  }
  for (int row = 0; row < view.rows; ++row) {
    for (int column = 0; column < view.columns; ++column) {
      const int64_t i = view.pixel(p.grid, row) + column;
      const auto& pixel = pixels[row * kTile + column];
      const int32_t dominant = pixel.dominant < 0 ? -1 : p.ids[pixel.dominant];
      if (p.median) p.median[i] = pixel.median < 0 ? T(0) : p.depths[pixel.median];
      if (p.dominant) p.dominant[i] = dominant;
      if (kLook == Look::kStatistics && dominant >= 0) __atomic_fetch_add(&p.dominated[dominant], 1, __ATOMIC_RELAXED);
    }
  }
}

template <class P, typename T> void inspect(const cpu::InspectParams<T>& p) {
  const auto of_tile = p.touched    ? inspect_tile<P, Look::kStatistics, T>
                       : p.dominant ? inspect_tile<P, Look::kImages, T>
                                    : inspect_tile<P, Look::kMedian, T>;
  cpu::parallel_for(p.grid.tiles(), p.threads, [&](int64_t tile) { of_tile(p, tile); });
}

}  // namespace ar::AR_ISA
