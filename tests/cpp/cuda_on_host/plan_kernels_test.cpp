// The kernels that plan the blending work, run on the host: every tile and every chunk is planned once, longest first,
// and no two chunks share planes of checkpoints.
#include <map>
#include <random>
#include <set>

#include "cuda_on_host.h"
// After it: kernels.
#include <gtest/gtest.h>

#include "cuda/bin/plan.cuh"
#include "cuda/moment/cut_lists.h"

namespace ar::cuda {
namespace {

/// Blocks that a device works on at once, and those of which each has a share of all pairs.
constexpr int kManyBlocks = kBlocksPerSm * cuda_on_host::kMultiprocessors;
constexpr int kListBlocks = MomentPolicy::kListBlocksPerSm * cuda_on_host::kMultiprocessors;
static_assert(kManyBlocks == 1056 && kListBlocks == 528);  // for which the cases below are made

struct Case {
  TileGrid grid;
  int most_pairs;  ///< of a tile
  bool keep;
  ListCut cut;
  bool overflow = false, expect_cut = false;
  int64_t more_room = 0;  ///< pairs
};

/// Whether lists of n pairs are cut: those that are long, while there is room for those of their class and longer ones.
bool is_cut(const Case& c, const std::vector<int>& lists, int64_t pairs, int n) {
  if (c.cut.max_segments == 0 || c.overflow || n < c.cut.long_from(pairs)) return false;
  int segments = 0;
  for (int other : lists) {
    if (work_class(other) <= work_class(n)) segments += (other + c.cut.segment - 1) / c.cut.segment;
  }
  return segments <= std::min<int64_t>(c.cut.max_segments, c.cut.segment_limit(pairs));
}

/// `samples`: of a lane.
void expect_planned(const Case& c, int samples = 4) {
  const int tiles = int(c.grid.tiles());
  std::mt19937 bits(7);
  std::vector<int64_t> offsets = {0};
  for (int tile = 0; tile < tiles; ++tile) {
    const int n = bits() % 5 == 0 ? 0 : int(bits() % c.most_pairs) >> bits() % 6;
    offsets.push_back(offsets.back() + n);
  }
  const Counts counts = {offsets.back(), 1};
  TileLists lists = {};
  lists.tile_offsets = offsets.data();
  lists.counts = &counts;
  lists.capacity = c.overflow ? offsets.back() - 1 : offsets.back() + c.more_room;
  const auto pairs = [&](int tile) { return c.overflow ? 1 : int(offsets[tile + 1] - offsets[tile]); };
  std::vector<int> all_pairs;
  for (int tile = 0; tile < tiles; ++tile) all_pairs.push_back(pairs(tile));
  std::map<int, bool> cut_by_length;  // by their lengths
  for (int n : all_pairs) {
    if (cut_by_length.count(n) == 0) cut_by_length[n] = is_cut(c, all_pairs, offsets.back(), n);
  }
  const bool whole = c.cut.whole;
  const auto length = [&](int tile) {
    return cut_by_length[pairs(tile)] ? c.cut.segment : whole ? kWholeList : kChunkLength;
  };

  const int front = front_chunks(c.grid, offsets.back(), kManyBlocks);
  const CheckpointLayout layout = {3, c.keep};
  std::vector<TileChunk> chunk_order(size_t(tiles + offsets.back() / kChunkLength + c.cut.max_segments));
  std::vector<TileChunk> tail(chunk_order.size());
  std::vector<CutList> cut_lists(size_t(c.cut.max_lists));
  std::vector<int32_t> tile_order(tiles, -1), tile_planes(tiles, -1);
  PlanState state;
  std::memset(&state, 0x55, sizeof state);  // nothing need be zero
  ChunkPlan plan = {
      &state,           chunk_order.data(), tile_order.data(), tile_planes.data(), whole ? nullptr : tail.data(),
      cut_lists.data(), kManyBlocks};
  cuda_on_host::launch(PlanState::kCounters, PlanPolicy::kCountThreads,
                       [&] { count_work_kernel(lists, tiles, c.cut, &state); });
  cuda_on_host::launch((tiles + PlanPolicy::kThreads - 1) / PlanPolicy::kThreads, PlanPolicy::kThreads,
                       [&] { plan_kernel(lists, c.grid, samples, c.cut, layout, plan); });

  std::set<std::pair<int, int>> expected_tail;
  std::map<std::pair<int, int>, int> expected_chunks;  // their lengths
  int planes = 0;
  for (int tile = 0; tile < tiles; ++tile) {
    int chunk = 0;
    for (int k = 0; k < pairs(tile); k += length(tile), ++chunk) {
      expected_chunks[{tile, chunk}] = std::min(length(tile), pairs(tile) - k);
      if (chunk >= front && !whole) expected_tail.insert({tile, chunk});
    }
    if (!whole) planes += layout.tile_planes(front, samples, chunk);
  }
  const PlanCounts& made = state.counts;
  EXPECT_EQ(made.chunks, int(expected_chunks.size()));
  EXPECT_EQ(made.open_tiles, 0);
  EXPECT_EQ(made.planes, planes);
  if (!whole && !c.overflow) {
    EXPECT_LE(made.planes, layout.max_planes(c.grid, samples, lists.capacity, kManyBlocks));
  }
  ASSERT_EQ(made.tail, int(expected_tail.size()));

  EXPECT_EQ(std::set<int>(tile_order.begin(), tile_order.end()).size(), size_t(tiles));
  for (int k = 1; k < tiles; ++k) {
    EXPECT_LE(work_class(pairs(tile_order[k - 1])), work_class(pairs(tile_order[k])));
  }
  // Planes of a tile begin with those of the first chunk that has any.
  std::set<int> used;
  int last_class = 0;
  for (size_t k = 0; k < expected_chunks.size(); ++k) {
    const TileChunk& part = chunk_order[k];
    const auto found = expected_chunks.find({part.tile, part.chunk});
    ASSERT_TRUE(found != expected_chunks.end()) << part.tile << " " << part.chunk;
    const int of_class = work_class(whole ? pairs(part.tile) : found->second);
    EXPECT_GE(of_class, last_class);
    last_class = of_class;
    expected_chunks[found->first] = -1;  // seen
    EXPECT_EQ(part.plane, tile_planes[part.tile] + (part.chunk - layout.first_chunk(front)) * layout.planes(samples));
  }
  for (const auto& [chunk, seen] : expected_chunks) ASSERT_EQ(seen, -1) << chunk.first << " " << chunk.second;
  for (int tile = 0; tile < tiles && !whole; ++tile) {
    const int chunks = (pairs(tile) + length(tile) - 1) / length(tile);
    const int own = layout.tile_planes(front, samples, chunks);
    for (int plane = 0; plane < own; ++plane) ASSERT_TRUE(used.insert(tile_planes[tile] + plane).second) << tile;
  }
  EXPECT_EQ(int(used.size()), planes);
  // Lists that are cut come first, and so do their segments, one list after the other.
  int long_count = 0;
  for (int n : all_pairs) long_count += cut_by_length[n];
  ASSERT_EQ(made.cut_lists, long_count);
  int longest_count = 0;
  for (int n : all_pairs) longest_count += cut_by_length[n] && n >= c.cut.longest_from;
  EXPECT_EQ(made.longest_lists, longest_count);
  EXPECT_EQ(longest_count > 0, c.cut.longest_from < kNoList);
  EXPECT_EQ(long_count > 0, c.expect_cut);
  std::vector<bool> seen(size_t(made.segments), false);
  for (int k = 0; k < long_count; ++k) {
    const CutList& list = cut_lists[k];
    EXPECT_EQ(list.tile, tile_order[k]);
    EXPECT_TRUE(cut_by_length[pairs(list.tile)]);
    EXPECT_EQ(list.segments, (pairs(list.tile) + c.cut.segment - 1) / c.cut.segment);
    for (int segment = 0; segment < list.segments; ++segment) {
      ASSERT_LT(list.first + segment, made.segments);
      EXPECT_EQ(chunk_order[list.first + segment].tile, list.tile);
      EXPECT_EQ(chunk_order[list.first + segment].chunk, segment);
      EXPECT_FALSE(seen[list.first + segment]);
      seen[list.first + segment] = true;
    }
  }
  EXPECT_EQ(std::count(seen.begin(), seen.end(), false), 0);

  for (int k = 0; k < made.tail; ++k) EXPECT_EQ(expected_tail.erase({tail[k].tile, tail[k].chunk}), 1u);
  for (const TileChunk& part : std::vector<TileChunk>(tail.begin(), tail.begin() + made.tail)) {
    EXPECT_EQ(part.plane, tile_planes[part.tile] + (part.chunk - layout.first_chunk(front)) * layout.planes(samples));
  }
}

constexpr TileGrid kSmall = {240, 135}, kLarge = {2400, 2000};

constexpr ListCut kChunks = {false}, kWhole = {true};

TEST(PlanKernels, LongLists) { expect_planned({kSmall, 30000, true, kChunks}); }
TEST(PlanKernels, LongListsWithoutBackward) { expect_planned({kSmall, 30000, false, kChunks}); }
TEST(PlanKernels, ManyTiles) {
  // Threads of count_work go on to further tiles.
  ASSERT_GT(kLarge.tiles(), PlanPolicy::kTilesAtOnce * PlanState::kCounters * PlanPolicy::kCountThreads);
  expect_planned({kLarge, 900, true, kChunks});
}
TEST(PlanKernels, LongListsOfManyTiles) {
  // Fronts of several chunks, beyond which some lists go.
  constexpr TileGrid kMany = {400, 400};
  ASSERT_GT(2 * kMany.tiles(), kManyBlocks);
  for (const bool keep : {false, true}) {
    for (const int samples : {1, 4}) expect_planned({kMany, 12000, keep, kChunks}, samples);
  }
}
TEST(PlanKernels, FrontsAreAShareOfAllPairs) {
  constexpr TileGrid kFew = {16 * 48, 16 * 11}, kMore = {16 * 23, 16 * 23};
  ASSERT_EQ(2 * kFew.tiles(), kManyBlocks);
  const auto front = [](TileGrid grid, int64_t pairs) { return front_chunks(grid, pairs, kManyBlocks); };
  EXPECT_EQ(front(kFew, 1 << 30), 1);
  EXPECT_EQ(front(kMore, 0), 2048 / kChunkLength);
  EXPECT_EQ(front(kMore, int64_t(2048) * kManyBlocks), 2048 / kChunkLength);
  EXPECT_EQ(front(kMore, int64_t(2049) * kManyBlocks), 4096 / kChunkLength);
  EXPECT_EQ(front(kMore, int64_t(1) << 50), (1 << 20) / kChunkLength);
  // On a device with half as many multiprocessors a block's share is twice as large, and fewer tiles are few.
  EXPECT_EQ(front_chunks(kFew, 0, kManyBlocks / 2), 2048 / kChunkLength);
  EXPECT_EQ(front_chunks(kMore, int64_t(2049) * kManyBlocks, kManyBlocks / 2), 8192 / kChunkLength);
}
TEST(PlanKernels, WholeLists) { expect_planned({kSmall, 5000, true, kWhole}); }
TEST(PlanKernels, MorePairsThanRoom) { expect_planned({kSmall, 5000, true, kChunks, true}); }

// Whole lists, of which the long ones are cut.
constexpr int kMost = 1 << 20;
TEST(PlanKernels, CutsLongLists) {
  expect_planned({kSmall, 5000, true, {true, 1024, 1 << 20, 512, kMost, 1000, 2048}, false, true});
}
TEST(PlanKernels, CutsWhatIsLongerThanAFairShare) {
  // There are some 100,000 pairs.
  ASSERT_EQ((ListCut{true, 256, 100}.long_from(100000)), 1024);
  expect_planned({kSmall, 5000, true, {true, 256, 100, 128, kMost, 1000}, false, true});
}
TEST(PlanKernels, CutsAllLists) {
  expect_planned({kSmall, 5000, true, {true, 0, 1, 512, kMost, 1000, 1024}, false, true});
}
TEST(PlanKernels, CutsTheLongestIfThereIsNoRoomForMore) {
  expect_planned({kSmall, 5000, true, {true, 256, 1 << 20, 128, 400, 1000, 256}, false, true});
}
TEST(PlanKernels, CutsTheSameListsHoweverMuchRoomThereIs) {
  // Some 100,000 pairs would make 12,000 segments.
  const ListCut cut = {true, 16, 1 << 20, 8, kMost, 1000};
  ASSERT_LT(cut.segment_limit(100000), 8000);
  for (const int64_t more_room : {0, 1 << 20}) expect_planned({kSmall, 5000, true, cut, false, true, more_room});
}
TEST(PlanKernels, CutsNothingWithoutRoom) { expect_planned({kSmall, 5000, true, {true, 256, 1 << 20, 128, 4, 1000}}); }
TEST(PlanKernels, HaveRoomForTheSegmentsOfLongLists) {
  const auto list_cut = [](int samples, int64_t capacity, TileGrid grid) {
    return moving_list_cut(samples, capacity, grid, cuda_on_host::kMultiprocessors);
  };
  // In a small image for all lists, the shortest of which make a segment each.
  const ListCut small = list_cut(4, 100000, kSmall);
  EXPECT_EQ(small.long_from(100000), 0);
  EXPECT_GE(small.max_segments, 100000 / small.segment + kSmall.tiles());
  EXPECT_EQ(small.max_lists, kSmall.tiles());
  // In a large one none if none can be long; all as long as they are few; and always those of a quarter of the pairs.
  EXPECT_EQ(list_cut(4, MomentPolicy::kLongList - 1, kLarge).max_segments, 0);
  for (const int samples : {1, 16}) {
    const int segment = moving_segment(samples, kLarge.side()), of_long_list = MomentPolicy::kLongList / segment;
    const ListCut few = list_cut(samples, 3 * (MomentPolicy::kLongList + 1), kLarge);
    EXPECT_EQ(few.long_from(3 * (MomentPolicy::kLongList + 1)), MomentPolicy::kLongList);
    EXPECT_GE(few.max_segments, 3 * (of_long_list + 1));
    EXPECT_GE(few.max_lists, 3);
    const int64_t pairs = 100000000;
    const ListCut many = list_cut(samples, pairs, kLarge);
    EXPECT_GE(many.long_from(pairs), pairs / kListBlocks);
    EXPECT_LT(many.long_from(pairs), 2 * pairs / kListBlocks);
    EXPECT_GE(many.max_segments, pairs / 4 / segment + kListBlocks);  // no more lists are that long
    EXPECT_LT(many.max_segments, pairs / 3 / segment);
    EXPECT_GE(many.max_lists, std::min<int64_t>(many.max_segments / of_long_list, kLarge.tiles()));
    // With more room, as after a frame with more pairs, as many segments of the same pairs are made.
    EXPECT_GT(list_cut(samples, 2 * pairs, kLarge).max_segments, many.max_segments);
    EXPECT_EQ(list_cut(samples, 2 * pairs, kLarge).segment_limit(pairs), many.max_segments);
    // Half as many blocks have shares twice as large.
    const ListCut of_half = moving_list_cut(samples, pairs, kLarge, cuda_on_host::kMultiprocessors / 2);
    EXPECT_EQ(of_half.long_from(pairs), 2 * many.long_from(pairs));
  }
}
TEST(PlanKernels, CutsNothingWithMorePairsThanRoom) {
  expect_planned({kSmall, 5000, true, {true, 0, 1, 512, kMost, 1000}, true});
}

}  // namespace
}  // namespace ar::cuda
