// Loops of bin: a stable counting sort of pairs by tile, over splats by depth. After count_pairs() the caller
// allocates.
#pragma once

#include <algorithm>

#include "core/bin.h"
#include "cpu/chunks.h"
#include "cpu/sort.h"

namespace ar::AR_ISA {

/// Splats from prefetch to use.
inline constexpr int64_t kAhead = 12;
/// Splats that are worth another thread.
inline constexpr int64_t kPart = 1024;

/// Tiles and offsets of a splat, and of an earlier one what its offset points to.
template <typename T> AR_HD void prefetch_pairs_of(const cpu::BinParams<T>& p, int64_t k, int64_t end) {
  if (k + 2 * kAhead < end) {
    const int32_t j = p.order[k + 2 * kAhead];
    __builtin_prefetch(&p.tiles[j]);
    if (p.positions) __builtin_prefetch(p.splat_offsets + j);
  }
  if (p.positions && k + kAhead < end) __builtin_prefetch(p.positions + p.splat_offsets[p.order[k + kAhead]], 1);
}

template <class F, typename T> void find_tiles_of(cpu::BinParams<T>& p) {
  const auto* splats = reinterpret_cast<const Splat<F, T>*>(p.splats);
  for_each_chunk(p.n, p.threads, [&](int64_t, int64_t begin, int64_t end) {
    for (int64_t j = begin; j < end; ++j) {
      TileBox box = {0, 0, 0, 0};
      if (splats[j].level > T(0)) box = find_tiles(support_of(splats[j]), p.grid);
      p.tiles[j] = {box.mask, box.count > 0 ? box.row : -1, box.column};
      if (p.splat_offsets) p.splat_offsets[j] = box.count;
    }
  });
  if (p.splat_offsets) p.splat_offsets[p.n] = 0;
}

template <class F, typename T, class Visit>
void for_each_pair_of(const cpu::BinParams<T>& p, int64_t part_index, const Visit& visit) {
  const auto* splats = reinterpret_cast<const Splat<F, T>*>(p.splats);
  const cpu::Part part = cpu::part_of(p.n, p.parts, part_index);
  const int64_t columns = p.grid.columns();
  for (int64_t k = part.begin; k < part.end; ++k) {
    prefetch_pairs_of(p, k, part.end);
    const int32_t j = p.order[k];
    const cpu::SplatTiles& tiles = p.tiles[j];
    if (tiles.row < 0) continue;
    if (tiles.mask == 0) {
      for_each_tile(support_of(splats[j]), p.grid, [&](int64_t tile) { visit(j, tile); });
      continue;
    }
    const int64_t first = tiles.row * columns + tiles.column;
    for (TileMask left = tiles.mask; left != 0; left &= left - 1) {
      const int bit = __builtin_ctzll(left);
      visit(j, first + (bit >> 3) * columns + (bit & 7));
    }
  }
}
/// visit(splat, tile) for pairs of a part of the splats.
template <typename T, class Visit>
void for_each_pair(const cpu::BinParams<T>& p, int64_t part_index, const Visit& visit) {
  visit_footprint(p.footprint, Footprints{},
                  [&](auto f) AR_HD_LAMBDA { for_each_pair_of<PixelsOf<decltype(f)>>(p, part_index, visit); });
}

template <typename T> void count_pairs(cpu::BinParams<T>& p) {
  p.tiles.reset(new cpu::SplatTiles[p.n]);
  visit_footprint(p.footprint, Footprints{}, [&](auto f) AR_HD_LAMBDA { find_tiles_of<PixelsOf<decltype(f)>>(p); });
  p.order.reset(new int32_t[p.n]);
  cpu::sort_by_depth(p.depths, p.n, p.threads, p.order.get());
  const int64_t tiles = p.grid.tiles();
  // A part has kPart splats or more, and no more tiles than splats.
  p.parts = std::clamp<int64_t>(p.n / std::max(tiles, kPart), 1, p.threads);
  p.cursors.reset(new int64_t[p.parts * tiles]);
  cpu::parallel_for(p.parts, p.threads, [&](int64_t part) {
    int64_t* count = p.cursors.get() + part * tiles;
    for (int64_t tile = 0; tile < tiles; ++tile) count[tile] = 0;
    for_each_pair(p, part, [&](int32_t, int64_t tile) { ++count[tile]; });
  });
  p.tile_offsets[tiles] = cpu::place_items(p.cursors.get(), p.parts, tiles, p.threads, p.tile_offsets);
  if (p.splat_offsets) cpu::sum_before(p.splat_offsets, p.n + 1, p.threads);
}

template <typename T> void scatter_pairs(cpu::BinParams<T>& p) {
  const int64_t tiles = p.grid.tiles();
  cpu::parallel_for(p.parts, p.threads, [&](int64_t part) {
    int64_t* cursor = p.cursors.get() + part * tiles;
    int32_t current = -1;
    int64_t next = 0;  // Index in positions.
    for_each_pair(p, part, [&](int32_t j, int64_t tile) {
      const int64_t pair = cursor[tile]++;
      p.pairs[pair] = j;
      if (!p.positions) return;
      if (j != current) {
        current = j;
        next = p.splat_offsets[j];
      }
      p.positions[next++] = pair;
    });
  });
}

}  // namespace ar::AR_ISA
