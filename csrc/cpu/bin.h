// Loops of bin: a stable counting sort of pairs by tile, over splats in depth order.
#pragma once

#include <algorithm>

#include "core/bin.h"
#include "cpu/isa.h"
#include "cpu/parallel.h"
#include "cpu/sort.h"
#include "cpu/tasks.h"

namespace ar::AR_ISA {

/// How far ahead of its use a splat is fetched: splats are visited in depth order, which is random
/// in memory.
inline constexpr int64_t kAhead = 12;

/// visit(splat index, tile) for the pairs of part p of the splats, in depth order.
template <class F, typename T, class Visit>
AR_HD void for_each_pair(const cpu::BinTask<T>& task, int64_t p, const Visit& visit) {
  const auto* splats = reinterpret_cast<const Splat<F, T>*>(task.splats);
  const cpu::Part part = cpu::part_of(task.n, task.parts, p);
  for (int64_t k = part.begin; k < part.end; ++k) {
    if (k + kAhead < part.end) __builtin_prefetch(&splats[task.order[k + kAhead]]);
    const int32_t j = task.order[k];
    if (!(splats[j].level > T(0))) continue;
    for_each_tile(support_of(splats[j]), task.grid, [&](int64_t tile) { visit(j, tile); });
  }
}

/// Sorts by depth, counts the pairs of each tile, and turns the counts into places.
template <class F, typename T> void count_pairs(cpu::BinTask<T>& task) {
  cpu::sort_by_depth(task.depths, task.n, task.threads, task.order);
  const int64_t tiles = task.grid.tiles();
  // Parts only speed things up. Their histograms may not outgrow the splats.
  task.parts = std::clamp<int64_t>(task.n / std::max<int64_t>(tiles, 1), 1, task.threads);
  task.cursors.assign(task.parts * tiles, 0);
  cpu::parallel_for(task.parts, task.threads, [&](int64_t p) {
    int64_t* count = task.cursors.data() + p * tiles;
    for_each_pair<F>(task, p, [&](int32_t j, int64_t tile) {
      ++count[tile];
      if (task.splat_offsets) ++task.splat_offsets[j];
    });
  });
  int64_t total = 0;
  for (int64_t tile = 0; tile < tiles; ++tile) {
    task.tile_offsets[tile] = total;
    for (int64_t p = 0; p < task.parts; ++p) {
      const int64_t count = task.cursors[p * tiles + tile];
      task.cursors[p * tiles + tile] = total;
      total += count;
    }
  }
  task.tile_offsets[tiles] = total;
  if (task.splat_offsets) {
    int64_t sum = 0;
    for (int64_t j = 0; j <= task.n; ++j) {
      const int64_t count = task.splat_offsets[j];
      task.splat_offsets[j] = sum;
      sum += count;
    }
  }
}

template <class F, typename T> void scatter_pairs(cpu::BinTask<T>& task) {
  const int64_t tiles = task.grid.tiles();
  cpu::parallel_for(task.parts, task.threads, [&](int64_t p) {
    int64_t* cursor = task.cursors.data() + p * tiles;
    int32_t current = -1;
    int64_t next = 0;  // place in positions: a splat's pairs come one after the other
    for_each_pair<F>(task, p, [&](int32_t j, int64_t tile) {
      const int64_t place = cursor[tile]++;
      task.pairs[place] = j;
      if (!task.positions) return;
      if (j != current) {
        current = j;
        next = task.splat_offsets[j];
      }
      task.positions[next++] = place;
    });
  });
}

}  // namespace ar::AR_ISA
