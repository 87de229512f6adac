// Loop of inspect: which Gaussians pixels show, and pixels Gaussians.
#pragma once

#include <cmath>
#include <cstring>

#include "core/inspect.h"
#include "cpu/blend.h"
#include "cpu/parallel.h"

namespace ar::AR_ISA {

/// `bits` of a float that is not negative: they have its order.
inline void atomic_max(int32_t* bits, float value) {
  int32_t wanted, seen = __atomic_load_n(bits, __ATOMIC_RELAXED);
  std::memcpy(&wanted, &value, sizeof wanted);
  while (seen < wanted && !__atomic_compare_exchange_n(bits, &seen, wanted, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
  }
}

template <class F, typename T> void inspect_tile(const cpu::InspectTask<T>& task, int64_t tile) {
  const auto* splats = reinterpret_cast<const Splat<F, T>*>(task.splats);
  const TileView view(task.grid, tile);
  PixelLook<T, F::kSamples> pixels[kTilePixels];
  for (int i = 0; i < kTilePixels; ++i) pixels[i].start(i % kTile < view.columns && i / kTile < view.rows);
  for (int64_t k = task.tile_offsets[tile]; k < task.tile_offsets[tile + 1]; ++k) {
    const Splat<F, T>& splat = splats[task.pairs[k]];
    const int32_t id = task.ids[task.pairs[k]];
    const Support<T> support = support_of(splat);
    const auto terms = F::terms(splat.shape, splat.opacity, {T(view.x0) - splat.mean.x, T(view.y0) - splat.mean.y});
    int32_t touched = 0;
    int64_t units = 0;
    T largest = T(0);
    for (int row = 0; row < view.rows; ++row) {
      const Span<T> span = columns_of(support, T(view.y0 + row), T(view.y0 + row));
      for (int column = 0; column < view.columns; ++column) {
        if (!(span.lo <= T(view.x0 + column) && span.hi >= T(view.x0 + column))) continue;
        auto& pixel = pixels[row * kTile + column];
        if (!pixel.open()) continue;
        const T weight = pixel.template add<F>(terms, {T(column), T(row)}, id);
        touched += weight > T(0);
        units += weight_units(weight);
        largest = max(largest, weight);
      }
    }
    if (touched == 0) continue;
    __atomic_fetch_add(&task.touched[id], touched, __ATOMIC_RELAXED);
    __atomic_fetch_add(&task.units[id], units, __ATOMIC_RELAXED);
    atomic_max(&task.largest[id], float(largest));
  }
  for (int row = 0; row < view.rows; ++row) {
    for (int column = 0; column < view.columns; ++column) {
      const int64_t i = int64_t(view.y0 + row) * task.grid.width + view.x0 + column;
      task.median[i] = pixels[row * kTile + column].median;
      task.dominant[i] = pixels[row * kTile + column].dominant;
    }
  }
}

template <class F, typename T> void inspect(const cpu::InspectTask<T>& task) {
  cpu::parallel_for(task.grid.tiles(), task.threads, [&](int64_t tile) {
    visit_tile_footprint<F, AdaptiveBoxes>(task.tile_samples, tile,
                                           [&](auto f) { inspect_tile<decltype(f), T>(task, tile); });
  });
}

}  // namespace ar::AR_ISA
