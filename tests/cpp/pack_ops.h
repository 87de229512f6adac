// PackOps of one instruction set: pack_ops_*.cpp include this with the target switched.
#pragma once

#include "cpu/tile.h"
#include "pack_ops_table.h"

namespace ar::AR_ISA {

extern const test::PackOps kPackOps;
const test::PackOps kPackOps = {
    kLanes,
    [](const float* a, const float*, const float*, float* out) { exp2(Pack::load(a)).store(out); },
    [](const float* a, const float*, const float*, float* out) { erfc(Pack::load(a)).store(out); },
    [](const float* a, const float*, const float*, float* out) { sqrt(Pack::load(a)).store(out); },
    [](const float* a, const float*, const float*, float* out) { abs(Pack::load(a)).store(out); },
    [](const float* a, const float* b, const float*, float* out) { min(Pack::load(a), Pack::load(b)).store(out); },
    [](const float* a, const float* b, const float*, float* out) { max(Pack::load(a), Pack::load(b)).store(out); },
    [](const float* a, const float* b, const float* c, float* out) {
      madd(Pack::load(a), Pack::load(b), Pack::load(c)).store(out);
    },
    [](const float* a, const float* b, const float* c, float* out) {
      select(Pack::load(a) < Pack::load(b), Pack::load(b), Pack::load(c)).store(out);
    },
    [](const float* a) { return sum(Pack::load(a)); },
    [](const float* a, float* sums) {
      Pack packs[8];
      for (int i = 0; i < 8; ++i) packs[i] = Pack::load(a + i * kLanes);
      float eight[8];
      sum_lanes(packs, eight);
      std::copy_n(eight, 8, sums);
    },
    [](const float* a, const float* b) { return bits(Pack::load(a) < Pack::load(b)); },
    [](uint32_t lanes, const float* a, const float* otherwise, float* out) {
      float stored[kLanes];
      store_lanes(stored, lanes, Pack::load(a));
      load_lanes(stored, lanes, Pack::load(otherwise)).store(out);
      return lanes_stored(lanes, Pack());
    },
    [](const float* splat, int width, int height, int64_t tile, bool* reached) {
      const TileView view(TileGrid{width, height}, tile);
      const PackSet<float> packs = reach_of(splat_at<Point>(splat, 0), view);
      for (int i = 0; i < kTilePixels; ++i) {
        const int pack = Packs<float>::place(i % kTile, i / kTile) / kLanes;
        reached[i] = packs.words[pack / PackSet<float>::kBits] >> pack % PackSet<float>::kBits & 1;
      }
    },
};

}  // namespace ar::AR_ISA
