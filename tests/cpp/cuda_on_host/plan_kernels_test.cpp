// The kernels that plan the blending work, run on the host: every tile and every chunk is planned once, longest first,
// and no two chunks share planes of checkpoints.
#include <map>
#include <random>
#include <set>

#include "cuda_on_host.h"
// After it: kernels.
#include <gtest/gtest.h>

#include "cuda/plan.cuh"

namespace ar::cuda {
namespace {

int class_of(int samples, int length) { return work_class(samples, length); }

struct Case {
  TileGrid grid;
  int most_pairs;  ///< of a tile
  bool chosen, keep, whole;
  bool overflow = false;
};

void expect_planned(const Case& c) {
  constexpr int kMostSamples = 4;
  const int tiles = int(c.grid.tiles());
  std::mt19937 bits(7);
  std::vector<int64_t> offsets = {0};
  std::vector<int32_t> samples;
  for (int tile = 0; tile < tiles; ++tile) {
    const int n = bits() % 5 == 0 ? 0 : int(bits() % c.most_pairs) >> bits() % 6;
    offsets.push_back(offsets.back() + n);
    samples.push_back(c.chosen ? 1 << bits() % 3 : kMostSamples);
  }
  const Counts counts = {offsets.back(), 1};
  TileLists lists = {};
  lists.tile_offsets = offsets.data();
  lists.counts = &counts;
  lists.capacity = c.overflow ? offsets.back() - 1 : offsets.back();
  if (c.chosen) lists.tile_samples = samples.data();
  const auto pairs = [&](int tile) { return c.overflow ? 1 : int(offsets[tile + 1] - offsets[tile]); };
  const auto length = [&](int tile) { return c.whole ? kWholeList : chunk_length(samples[tile]); };

  const CheckpointLayout layout = {3, c.keep};
  std::vector<TileChunk> chunk_order(size_t(tiles + offsets.back() / chunk_length(1))), tail(chunk_order.size());
  std::vector<int32_t> tile_order(tiles, -1), tile_planes(tiles, -1);
  PlanState state;
  std::memset(&state, 0x55, sizeof state);  // nothing need be zero
  ChunkPlan plan = {&state, chunk_order.data(), tile_order.data(), tile_planes.data(), c.whole ? nullptr : tail.data()};
  cuda_on_host::launch(PlanState::kCounters, kCountWorkThreads,
                       [&] { count_work_kernel(lists, tiles, kMostSamples, c.whole, &state); });
  cuda_on_host::launch((tiles + kPlanThreads - 1) / kPlanThreads, kPlanThreads,
                       [&] { plan_kernel(lists, c.grid, kMostSamples, c.whole, layout, plan); });

  std::set<std::pair<int, int>> expected_tail;
  std::map<std::pair<int, int>, int> expected_chunks;  // their lengths
  int parts_of_tiles[kSampleClasses + 1] = {}, parts_of_chunks[kSampleClasses + 1] = {}, planes = 0;
  for (int tile = 0; tile < tiles; ++tile) {
    const int s = sample_class(samples[tile]), front = front_chunks(c.grid, samples[tile]);
    int chunk = 0;
    for (int k = 0; k < pairs(tile); k += length(tile), ++chunk) {
      expected_chunks[{tile, chunk}] = std::min(length(tile), pairs(tile) - k);
      if (chunk >= front) expected_tail.insert({tile, chunk});
    }
    if (!c.whole) planes += layout.tile_planes(c.grid, samples[tile], chunk);
    for (int after = s + 1; after <= kSampleClasses; ++after) ++parts_of_tiles[after], parts_of_chunks[after] += chunk;
  }
  const PlanCounts& made = state.counts;
  for (int s = 0; s <= kSampleClasses; ++s) {
    EXPECT_EQ(made.tiles.first[s], parts_of_tiles[s]);
    EXPECT_EQ(made.chunks.first[s], parts_of_chunks[s]);
    if (s < kSampleClasses) {
      EXPECT_EQ(made.open_tiles[s], 0);
    }
  }
  EXPECT_EQ(made.planes, planes);
  ASSERT_EQ(made.tail, int(expected_tail.size()));

  EXPECT_EQ(std::set<int>(tile_order.begin(), tile_order.end()).size(), size_t(tiles));
  for (int k = 1; k < tiles; ++k) {
    const int before = tile_order[k - 1], tile = tile_order[k];
    EXPECT_LE(class_of(samples[before], pairs(before)), class_of(samples[tile], pairs(tile)));
  }
  // Planes of a tile begin with those of the first chunk that has any.
  std::set<int> used;
  int last_class = 0;
  for (size_t k = 0; k < expected_chunks.size(); ++k) {
    const TileChunk& part = chunk_order[k];
    const auto found = expected_chunks.find({part.tile, part.chunk});
    ASSERT_TRUE(found != expected_chunks.end()) << part.tile << " " << part.chunk;
    const int of_class = class_of(samples[part.tile], found->second);
    EXPECT_GE(of_class, last_class);
    last_class = of_class;
    expected_chunks[found->first] = -1;  // seen
    const int s = samples[part.tile], of_chunk = layout.planes(s), first = layout.first_chunk(c.grid, s);
    EXPECT_EQ(part.plane, tile_planes[part.tile] + (part.chunk - first) * of_chunk);
  }
  for (const auto& [chunk, seen] : expected_chunks) ASSERT_EQ(seen, -1) << chunk.first << " " << chunk.second;
  for (int tile = 0; tile < tiles && !c.whole; ++tile) {
    const int chunks = (pairs(tile) + length(tile) - 1) / length(tile);
    const int own = layout.tile_planes(c.grid, samples[tile], chunks);
    for (int plane = 0; plane < own; ++plane) ASSERT_TRUE(used.insert(tile_planes[tile] + plane).second) << tile;
  }
  EXPECT_EQ(int(used.size()), planes);
  for (int k = 0; k < made.tail; ++k) EXPECT_EQ(expected_tail.erase({tail[k].tile, tail[k].chunk}), 1u);
  for (const TileChunk& part : std::vector<TileChunk>(tail.begin(), tail.begin() + made.tail)) {
    const int s = samples[part.tile];
    EXPECT_EQ(part.plane, tile_planes[part.tile] + (part.chunk - layout.first_chunk(c.grid, s)) * layout.planes(s));
  }
}

constexpr TileGrid kSmall = {240, 135}, kLarge = {2400, 2000};

TEST(PlanKernels, LongLists) { expect_planned({kSmall, 30000, false, true, false}); }
TEST(PlanKernels, LongListsWithoutBackward) { expect_planned({kSmall, 30000, false, false, false}); }
TEST(PlanKernels, ManyTiles) {
  // Threads of count_work go on to further tiles.
  ASSERT_GT(kLarge.tiles(), kTilesAtOnce * PlanState::kCounters * kCountWorkThreads);
  expect_planned({kLarge, 900, false, true, false});
}
TEST(PlanKernels, ChosenSamples) { expect_planned({kSmall, 5000, true, true, false}); }
TEST(PlanKernels, ChosenSamplesWithoutBackward) { expect_planned({kSmall, 5000, true, false, false}); }
TEST(PlanKernels, WholeLists) { expect_planned({kSmall, 5000, true, true, true}); }
TEST(PlanKernels, MorePairsThanRoom) { expect_planned({kSmall, 5000, false, true, false, true}); }

}  // namespace
}  // namespace ar::cuda
