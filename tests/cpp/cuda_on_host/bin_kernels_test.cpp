// The kernels that sort splats by depth, and that find the pairs of each tile, run on the host, against the algorithms
// of the standard library.
#include <cstring>
#include <numeric>
#include <random>

#include "cuda_on_host.h"
// After it: kernels.
#include <gtest/gtest.h>

#include "cuda/bin/bin.cuh"
#include "cuda/project/project.cuh"
#include "cuda/tile/lists.cuh"

namespace ar::cuda {
namespace {

constexpr float kCulled = -1;
constexpr int kDepthTile = Digits<kDepthBits>::kTile;

uint32_t key_of(float depth) {
  if (depth == kCulled) return kCulledKey;
  uint32_t key;
  std::memcpy(&key, &depth, sizeof key);
  return key + kDepthKeyOffset;
}

/// Memory in which a kernel should find zeros but does not yet, in whole pieces of 16 bytes.
std::vector<uint32_t> garbage(int64_t words) { return std::vector<uint32_t>((words + 3) / 4 * 4, 0xdeadbeef); }
ZeroedMemory memory_from(std::vector<uint32_t>& words, int64_t first) {
  return {words.data() + first, int64_t((words.size() - first) * sizeof(uint32_t))};
}

/// Every slot belongs to one splat, and those of 32 neighbours lie in their order.
void expect_slots(const std::vector<PairRange>& ranges, int64_t pairs) {
  std::vector<int> owners(pairs);
  int64_t next = 0;
  for (size_t i = 0; i < ranges.size(); ++i) {
    const auto& [first, count] = ranges[i];
    if (count == 0) continue;
    ASSERT_TRUE(first >= 0 && first + count <= pairs) << i;
    const bool begins = std::all_of(&ranges[i / 32 * 32], &ranges[i], [](PairRange r) { return r.count == 0; });
    if (!begins) {
      ASSERT_EQ(first, next) << i;
    }
    next = first + count;
    for (int k = 0; k < count; ++k) ++owners[first + k];
  }
  ASSERT_EQ(owners, std::vector<int>(pairs, 1));
}

/// Sorts as count_depths and sort_by_depth do, but for passes behind the first `passes`: what these leave must be the
/// result.
void expect_sorted(const std::vector<float>& depths, int passes, bool with_slots) {
  const auto n = int64_t(depths.size());
  std::vector<uint32_t> keys[2] = {{}, std::vector<uint32_t>(n)};
  for (float depth : depths) keys[0].push_back(key_of(depth));
  std::vector<int32_t> order[2] = {std::vector<int32_t>(n, -1), std::vector<int32_t>(n, -1)};
  std::vector<PairRange> ranges;
  std::vector<int32_t> expected;
  int64_t pairs = 0;
  for (int32_t i = 0; i < n; ++i) {
    const int count = depths[i] == kCulled ? 0 : i % 3 + 1;
    ranges.push_back({0, count});
    pairs += count;
    if (count > 0) expected.push_back(i);
  }
  std::stable_sort(expected.begin(), expected.end(), [&](int32_t a, int32_t b) { return depths[a] < depths[b]; });

  std::vector<uint32_t> memory = garbage(DepthScratch::words(n, kDepthPasses)), other = garbage(5000);
  std::fill_n(memory.begin(), kDepthHistogramWords, 0u);
  const DepthScratch scratch(memory.data(), n, kDepthPasses);
  Counts counts = {};
  const DepthSort sort = {
      n, {keys[0].data(), keys[1].data()}, {order[0].data(), order[1].data()}, ranges.data(), with_slots, &counts};
  cuda_on_host::launch(2, BinPolicy::kCountThreads, [&] {
    count_depths_kernel(sort.keys[0], sort.ranges, with_slots, n, scratch.histograms, sort.counts,
                        memory_from(memory, kDepthHistogramWords), memory_from(other, 0));
  });
  ASSERT_EQ(other, std::vector<uint32_t>(other.size()));
  ASSERT_EQ(counts.splats, int64_t(expected.size()));
  ASSERT_EQ(counts.pairs, pairs);
  if (with_slots) expect_slots(ranges, pairs);
  for_each_depth_pass(sort, scratch, [&](auto kernel, auto... arguments) {
    if (passes-- > 0)
      cuda_on_host::launch(int(scratch.blocks), Digits<kDepthBits>::kThreads, [&] { kernel(arguments...); });
  });
  order[0].resize(expected.size());
  ASSERT_EQ(order[0], expected);
}

void expect_sorted(const std::vector<float>& depths, int passes = kDepthPasses) {
  for (const bool with_slots : {false, true}) expect_sorted(depths, passes, with_slots);
}

std::vector<float> random_depths(int n, float nearest, float farthest, int one_culled_in = 3) {
  std::mt19937 bits(7);
  std::uniform_real_distribution<float> uniform(std::log(nearest), std::log(farthest));
  std::vector<float> depths;
  for (int i = 0; i < n; ++i) depths.push_back(bits() % one_culled_in == 0 ? kCulled : std::exp(uniform(bits)));
  return depths;
}

TEST(BinKernels, Depths) { expect_sorted(random_depths(2 * kDepthTile + 100, 0.2f, 100)); }

/// Where all depths lie between 1/8 and 8192 the last pass has nothing to do, and may be left out.
TEST(BinKernels, TheLastPassIsForDepthsThatAreVeryDifferent) {
  std::vector<float> depths = random_depths(kDepthTile + 700, 0.125f, 8191);
  depths[5] = 0.125f, depths[6] = std::nextafter(8192.0f, 0.0f);
  expect_sorted(depths, 3);
  expect_sorted(depths);
  for (const float other : {std::nextafter(0.125f, 0.0f), 8192.0f}) {
    depths[700] = other;
    expect_sorted(depths);
  }
  for (float& depth : depths) depth = depth == kCulled ? kCulled : 65536 * depth;  // all of them far away
  expect_sorted(depths);
}

TEST(BinKernels, DepthsOfEveryMagnitude) { expect_sorted(random_depths(kDepthTile + 1, 1e-37f, 1e37f)); }

TEST(BinKernels, FewAndNoDepths) {
  expect_sorted({2});
  expect_sorted({kCulled, kCulled});
  expect_sorted({3, kCulled, 0, 1, 3, 0});
}

/// More pairs of 32 splats than an int holds are told as more than there is room for.
TEST(BinKernels, CountsMorePairsThanAnIntHolds) {
  std::vector<uint32_t> keys(32, key_of(1));
  std::vector<PairRange> ranges(keys.size(), {0, 1 << 27});
  for (const bool with_slots : {false, true}) {
    std::vector<uint32_t> histograms(kDepthHistogramWords);
    Counts counts = {};
    cuda_on_host::launch(1, BinPolicy::kCountThreads, [&] {
      count_depths_kernel(keys.data(), ranges.data(), with_slots, 32, histograms.data(), &counts, {}, {});
    });
    EXPECT_EQ(counts.pairs, int64_t(1) << 32);
    EXPECT_EQ(counts.splats, 32);
  }
}

TEST(BinKernels, TiesKeepInputOrder) {
  std::vector<float> depths = random_depths(kDepthTile, 0.2f, 4);
  for (float& depth : depths) depth = depth == kCulled ? kCulled : std::ceil(depth);
  expect_sorted(depths);
}

SlotPair value_of(int32_t k, SlotPair) { return {k * 7, k}; }
int32_t value_of(int32_t k, int32_t) { return k; }
bool operator==(SlotPair a, SlotPair b) { return a.splat == b.splat && a.slot == b.slot; }

/// Sorts pairs as sort_by_tile does, with room for more than there are.
template <class Value> void expect_sorted_by_tile(int pairs, TileGrid grid) {
  std::mt19937 bits(7);
  const TileDigits digits(grid);
  const int room = pairs + pairs / 3 + 1;
  std::vector<uint32_t> tiles[2] = {std::vector<uint32_t>(room), std::vector<uint32_t>(room)};
  std::vector<Value> values[2] = {std::vector<Value>(room), std::vector<Value>(room)};
  std::vector<int32_t> order(pairs);
  std::iota(order.begin(), order.end(), 0);
  for (const int32_t k : order) {
    tiles[0][k] = uint32_t(bits() % grid.tiles());
    values[0][k] = value_of(k, Value());
  }
  std::stable_sort(order.begin(), order.end(), [&](int32_t a, int32_t b) { return tiles[0][a] < tiles[0][b]; });
  const std::vector<uint32_t> unsorted = tiles[0];
  const int64_t count = pairs;
  digits.with_bits([&](auto bits) {
    using D = Digits<bits>;
    std::vector<uint32_t> memory(SortScratch<bits>::words(room, digits.passes));
    const SortScratch<bits> scratch(memory.data(), room, digits.passes);
    for (int k = 0; k < pairs; ++k) {
      for (int d = 0; d < digits.passes; ++d) ++scratch.histograms[d * D::kBins + D::of(unsorted[k], d)];
    }
    for (int pass = 0; pass < digits.passes; ++pass) {
      const int from = pass % 2;
      cuda_on_host::launch(int(scratch.blocks), D::kThreads, [&] {
        sort_pass_kernel<bits, Value, false>(scratch, pass, false, &count, room, tiles[from].data(),
                                             tiles[1 - from].data(), values[from].data(), values[1 - from].data());
      });
    }
  });
  for (int k = 0; k < pairs; ++k) {
    ASSERT_TRUE(values[digits.passes % 2][k] == value_of(order[k], Value())) << k;
    ASSERT_EQ(tiles[digits.passes % 2][k], unsorted[order[k]]) << k;
  }
}

TEST(BinKernels, DigitsOfTiles) {
  const auto expect_digits = [](TileGrid grid, int passes, int bits) {
    const TileDigits digits(grid);
    EXPECT_EQ(digits.passes, passes) << grid.tiles() << " tiles";
    EXPECT_EQ(digits.bits, bits) << grid.tiles() << " tiles";
    EXPECT_LE(grid.tiles(), int64_t(1) << (passes * bits));
  };
  expect_digits({16, 16}, 1, 7);
  expect_digits({16 * 128, 16}, 1, 7);
  expect_digits({16 * 129, 16}, 1, 8);
  expect_digits({16 * 257, 16}, 2, 7);
  expect_digits({1920, 1080}, 2, 7);
  expect_digits({16 * 128, 16 * 128}, 2, 7);
  expect_digits({16 * 128, 16 * 129}, 2, 8);
  expect_digits({7680, 4320}, 3, 7);
  expect_digits({16 * 2048, 16 * 2048}, 3, 8);
  expect_digits({16 * 30000, 16 * 30000}, 4, 8);
}

TEST(BinKernels, PairsByTile) {
  // One digit of seven and of eight bits, and two of either.
  for (const TileGrid grid : {TileGrid{100, 90}, TileGrid{200, 240}, TileGrid{700, 300}, TileGrid{2100, 2100}}) {
    for (const int pairs : {0, 1, 40, Digits<8>::kTile, 2 * Digits<8>::kTile + 100}) {
      expect_sorted_by_tile<int32_t>(pairs, grid);
      expect_sorted_by_tile<SlotPair>(pairs, grid);
    }
  }
}

/// Splats from a fraction of a pixel to the whole image, in an image with more rows of tiles than a warp has lanes.
std::vector<SplatRow<float>> random_splats(int n, TileGrid grid) {
  using F = Mip;
  std::mt19937 bits(7);
  const auto uniform = [&](float low, float high) { return std::uniform_real_distribution<float>(low, high)(bits); };
  std::vector<SplatRow<float>> splats(n);
  for (SplatRow<float>& splat : splats) {
    const float a = std::exp(uniform(-2, 11)), b = std::exp(uniform(-2, 6));
    const F::Shape<float> shape = F::prepare(Cov2d<float>{b, 0, a, a * b}, FootprintOptions{0});
    splat.mean = {uniform(0, float(grid.width)), uniform(0, float(grid.height))};
    set_shape<F>(splat, shape);
    splat.opacity = uniform(0.1f, 1);
    splat.level = F::level(shape, splat.opacity);
  }
  return splats;
}

/// Whether all of `some` are among `all`, in the same order.
bool is_subsequence(const std::vector<int>& some, const std::vector<int>& all) {
  size_t found = 0;
  for (const int x : all) found += found < some.size() && some[found] == x;
  return found == some.size();
}

/// Splats and what bin makes of them before it writes pairs.
struct ToEmit {
  static constexpr TileGrid kGrid = {170, 700};
  static constexpr int n = BinPolicy::kEmitSplats + BinPolicy::kEmitThreads + 30;

  const int footprint = find_footprint("mip");
  const std::vector<SplatRow<float>> splats = random_splats(n, kGrid);
  const TileDigits digits = TileDigits(kGrid);
  std::vector<int32_t> order = std::vector<int32_t>(n);
  std::vector<PairRange> ranges = std::vector<PairRange>(n);
  std::vector<SplatTiles> splat_tiles = std::vector<SplatTiles>(n);
  int32_t pairs = 0;

  ToEmit() {
    std::iota(order.begin(), order.end(), 0);
    std::shuffle(order.begin(), order.end(), std::mt19937(7));
    for (int i = 0; i < n; ++i) {  // slots are in another order than the pairs
      splat_tiles[i] = splat_tiles_of(support(i), kGrid);
      ranges[i] = {pairs, splat_tiles[i].count};
      pairs += ranges[i].count;
    }
  }
  Support<float> support(int i) const { return support_of(splats[i], footprint); }
};

/// Pairs as the kernels write them, with room for `capacity`.
struct Emitted {
  std::vector<uint32_t> tiles, counts_of_digits;
  std::vector<SlotPair> slot_pairs;
  std::vector<int32_t> splat_pairs;
  Counts counts;

  Emitted(const ToEmit& from, bool with_slots, int64_t capacity)
      : tiles(capacity),
        counts_of_digits(from.digits.passes * from.digits.bins()),
        slot_pairs(with_slots ? capacity : 0),
        splat_pairs(with_slots ? 0 : capacity),
        counts{from.pairs, from.n} {
    std::vector<uint32_t> status(emit_scratch(from.n) / sizeof(uint32_t));
    std::vector<int32_t> long_splats(from.n), long_places(from.n);
    EmitParams emit = {};
    emit.splats = &from.splats[0].mean.x;
    emit.n = from.n;
    emit.footprint = from.footprint;
    emit.grid = from.kGrid;
    emit.capacity = capacity;
    emit.counts = &counts;
    emit.order = from.order.data();
    emit.ranges = with_slots ? from.ranges.data() : nullptr;
    emit.splat_tiles = from.splat_tiles.data();
    emit.long_splats = long_splats.data();
    emit.long_places = long_places.data();
    emit.status = status.data();
    emit.tile_counts = counts_of_digits.data();
    emit.tiles = tiles.data();
    emit.splat_pairs = with_slots ? nullptr : splat_pairs.data();
    emit.slot_pairs = with_slots ? slot_pairs.data() : nullptr;
    // One block more than has splats, as where some are culled.
    cuda_on_host::launch((from.n + BinPolicy::kEmitSplats - 1) / BinPolicy::kEmitSplats + 1, BinPolicy::kEmitThreads,
                         [&] { emit_pairs_kernel(emit, from.digits); });
    cuda_on_host::launch(2, BinPolicy::kEmitThreads, [&] { emit_long_pairs_kernel(emit, from.digits); });
    tiles.resize(counts.listed);
    std::vector<uint32_t> expected_counts(counts_of_digits.size());
    for (const uint32_t tile : tiles) {
      for (int d = 0; d < from.digits.passes; ++d) ++expected_counts[d * from.digits.bins() + from.digits.of(tile, d)];
    }
    EXPECT_EQ(counts_of_digits, expected_counts);
  }
  int splat(int64_t k) const { return slot_pairs.empty() ? splat_pairs[k] : slot_pairs[k].splat; }
};

TEST(BinKernels, PairsOfSplats) {
  const ToEmit from;
  std::vector<uint32_t> expected_tiles;
  std::vector<SlotPair> expected_pairs;
  int few = 0, many = 0, too_long = 0, later_rows = 0;
  for (const int32_t i : from.order) {
    int32_t slot = from.ranges[i].first;
    for_each_tile(from.support(i), from.kGrid, [&](int64_t tile) {
      expected_tiles.push_back(uint32_t(tile));
      expected_pairs.push_back({i, slot++});
    });
    const SplatTiles& tiles = from.splat_tiles[i];
    ASSERT_EQ(slot - from.ranges[i].first, tiles.count);
    many += tiles.count > kManyTiles && tiles.mask != 0;
    too_long += tiles.count > 0 && tiles.mask == 0;
    few += few_tiles(tiles) != 0;
    for (int row = 0; row < 8; ++row) later_rows += row > 3 && (tiles.mask >> 8 * row & 0xff) != 0;
  }
  ASSERT_GT(few, from.n / 4);
  ASSERT_GT(many, from.n / 30);
  ASSERT_GT(too_long, from.n / 10);
  ASSERT_GT(later_rows, from.n / 50);

  for (const bool with_slots : {false, true}) {
    const Emitted emitted(from, with_slots, from.pairs);
    EXPECT_EQ(emitted.counts.listed, from.pairs);
    EXPECT_EQ(emitted.tiles, expected_tiles);
    for (int64_t k = 0; k < from.pairs; ++k) {
      if (with_slots) {
        ASSERT_TRUE(emitted.slot_pairs[k] == expected_pairs[k]) << k;
      } else {
        ASSERT_EQ(emitted.splat_pairs[k], expected_pairs[k].splat) << k;
      }
    }
  }
}

/// With less room patches get larger, down to one for all, and the list of each has every splat of its tiles by depth.
TEST(BinKernels, PairsOfSplatsAndCellsWhereThereIsNoRoomForTiles) {
  const ToEmit from;
  int64_t last_bits = 0;
  for (const int64_t capacity : {int64_t(from.pairs) - 1, int64_t(from.pairs) / 2, int64_t(from.n)}) {
    for (const bool with_slots : {false, true}) {
      const Emitted emitted(from, with_slots, capacity);
      ASSERT_LE(emitted.counts.listed, capacity);
      std::vector<std::vector<int>> lists(from.kGrid.tiles());
      for (int64_t k = 0; k < emitted.counts.listed; ++k) {
        lists[emitted.tiles[k]].push_back(emitted.splat(k));
        if (with_slots) ASSERT_EQ(emitted.slot_pairs[k].slot, emitted.slot_pairs[k].splat);
      }
      TileLists view = {};
      view.counts = &emitted.counts;
      const int64_t bits = emitted.counts.patch_bits;
      std::vector<std::vector<int>> of_tiles(lists.size());
      for (const int32_t i : from.order) {
        for_each_tile(from.support(i), from.kGrid, [&](int64_t tile) { of_tiles[tile].push_back(i); });
      }
      for (int tile = 0; tile < from.kGrid.tiles(); ++tile) {
        const TileInPatch of_patch(view, from.kGrid, tile);
        ASSERT_TRUE(of_patch.index >= 0 && of_patch.index < of_patch.tiles) << tile;
        if (of_patch.first_tile != tile) ASSERT_TRUE(lists[tile].empty()) << tile;
        const std::vector<int>& list = lists[of_patch.first_tile];
        ASSERT_TRUE(is_subsequence(of_tiles[tile], list)) << tile << " with patches of 4^" << bits << " tiles";
      }
      ASSERT_GT(bits, 0);
      ASSERT_GE(bits, last_bits);
      last_bits = bits;
    }
  }
  ASSERT_EQ(last_bits, 6) << "one patch for 11 x 44 tiles";
}

TEST(BinKernels, FirstPairsOfTiles) {
  std::mt19937 bits(7);
  for (const int tile_count : {1, 15, 100}) {
    for (const int pairs : {0, 1, 8, 9, 10, 81, 5000}) {
      std::vector<uint32_t> tiles(pairs);
      for (uint32_t& tile : tiles) tile = uint32_t(bits() % tile_count) * 2 % tile_count;  // some tiles have none
      std::sort(tiles.begin(), tiles.end());
      std::vector<int64_t> offsets(tile_count + 1, -1), expected;
      for (int tile = 0; tile <= tile_count; ++tile)
        expected.push_back(std::lower_bound(tiles.begin(), tiles.end(), uint32_t(tile)) - tiles.begin());
      const Counts counts = {pairs + 7, pairs, pairs};
      uint64_t word = 0;
      cuda_on_host::launch(tile_count / BinPolicy::kOffsetTiles + 1, BinPolicy::kOffsetTiles * BinPolicy::kOffsetLanes,
                           [&] { tile_offsets_kernel(tiles.data(), &counts, tile_count, offsets.data(), {&word, 3}); });
      EXPECT_EQ(offsets, expected) << tile_count << " tiles, " << pairs << " pairs";
      EXPECT_EQ(word, uint64_t(3) << 32 | uint64_t(pairs + 7));
    }
  }
}

}  // namespace
}  // namespace ar::cuda
