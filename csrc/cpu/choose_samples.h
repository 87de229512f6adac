// Loop of choose_samples: how many samples every tile of `adaptive` takes.
#pragma once

#include "core/choose.h"
#include "cpu/isa.h"
#include "cpu/parallel.h"
#include "cpu/stages.h"

namespace ar::AR_ISA {

template <typename T> void choose_samples(const cpu::ChooseSamplesParams<T>& p) {
  const auto* splats = reinterpret_cast<const Splat<Adaptive, T>*>(p.splats);
  const SampleLimits<T> limits = sample_limits<T>(p.tolerance);
  const auto background = [&](int c) { return c < p.background_count ? p.background[c] : T(0); };
  cpu::parallel_for(p.grid.tiles(), p.threads, [&](int64_t tile) {
    const Vec2<T> center = tile_center<T>(p.grid, tile);
    SampleEstimate<T> estimate;
    for (int64_t k = p.lists.tile_offsets[tile]; k < p.lists.tile_offsets[tile + 1] && !estimate.dark(); ++k) {
      const auto& splat = splats[p.lists.pairs[k]];
      const Vec2<T> d = {center.x - splat.mean.x, center.y - splat.mean.y};
      estimate.add(tile_share(splat.shape, splat.opacity, d), splat.color);
    }
    p.tile_samples[tile] = limits.choose(estimate.value({background(0), background(1), background(2)}));
  });
}

}  // namespace ar::AR_ISA
