// The kernels that sort splats by depth, and that find the pairs of each tile, run on the host, against the algorithms
// of the standard library.
#include <cstring>
#include <numeric>
#include <random>

#include "cuda_on_host.h"
// After it: kernels.
#include <gtest/gtest.h>

#include "cuda/bin.cuh"

namespace ar::cuda {
namespace {

constexpr float kCulled = -1;

uint32_t key_of(float depth) {
  if (depth == kCulled) return kCulledKey;
  uint32_t key;
  std::memcpy(&key, &depth, sizeof key);
  return key + kDepthKeyOffset;
}

/// Sorts as count_depths and sort_by_depth do, but for passes behind the first `passes`: what these leave must be the
/// result.
void expect_sorted(const std::vector<float>& depths, int passes = kDepthPasses) {
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

  std::vector<uint32_t> memory(DepthScratch::words(n, kDepthPasses));
  const DepthScratch scratch(memory.data(), n, kDepthPasses);
  Counts counts = {};
  const DepthSort sort = {
      n, {keys[0].data(), keys[1].data()}, {order[0].data(), order[1].data()}, ranges.data(), &counts};
  cuda_on_host::launch(2, kCountThreads,
                       [&] { count_depths_kernel(sort.keys[0], sort.ranges, n, scratch.histograms, sort.counts); });
  ASSERT_EQ(counts.splats, int64_t(expected.size()));
  ASSERT_EQ(counts.pairs, pairs);
  for_each_depth_pass(sort, scratch, [&](auto kernel, auto... arguments) {
    if (passes-- > 0) cuda_on_host::launch(int(scratch.blocks), DepthDigits::kThreads, [&] { kernel(arguments...); });
  });
  order[0].resize(expected.size());
  ASSERT_EQ(order[0], expected);
}

std::vector<float> random_depths(int n, float nearest, float farthest, int one_culled_in = 3) {
  std::mt19937 bits(7);
  std::uniform_real_distribution<float> uniform(std::log(nearest), std::log(farthest));
  std::vector<float> depths;
  for (int i = 0; i < n; ++i) depths.push_back(bits() % one_culled_in == 0 ? kCulled : std::exp(uniform(bits)));
  return depths;
}

TEST(SortKernels, Depths) { expect_sorted(random_depths(2 * kSortTile + 100, 0.2f, 100)); }

/// Where all depths lie between 1/8 and 8192 the last pass has nothing to do, and may be left out.
TEST(SortKernels, TheLastPassIsForDepthsThatAreVeryDifferent) {
  std::vector<float> depths = random_depths(kSortTile + 700, 0.125f, 8191);
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

TEST(SortKernels, DepthsOfEveryMagnitude) { expect_sorted(random_depths(kSortTile + 1, 1e-37f, 1e37f)); }

TEST(SortKernels, FewAndNoDepths) {
  expect_sorted({2});
  expect_sorted({kCulled, kCulled});
  expect_sorted({3, kCulled, 0, 1, 3, 0});
}

TEST(SortKernels, TiesKeepInputOrder) {
  std::vector<float> depths = random_depths(kSortTile, 0.2f, 4);
  for (float& depth : depths) depth = depth == kCulled ? kCulled : std::ceil(depth);
  expect_sorted(depths);
}

TEST(SortKernels, FirstPairsOfTiles) {
  std::mt19937 bits(7);
  for (const int tile_count : {1, 15, 100}) {
    for (const int pairs : {0, 1, 8, 9, 10, 81, 5000}) {
      std::vector<uint32_t> tiles(pairs);
      for (uint32_t& tile : tiles) tile = uint32_t(bits() % tile_count) * 2 % tile_count;  // some tiles have none
      std::sort(tiles.begin(), tiles.end());
      std::vector<int64_t> offsets(tile_count + 1, -1), expected;
      for (int tile = 0; tile <= tile_count; ++tile)
        expected.push_back(std::lower_bound(tiles.begin(), tiles.end(), uint32_t(tile)) - tiles.begin());
      const Counts counts = {pairs, pairs};
      uint64_t word = 0;
      cuda_on_host::launch(tile_count / kRangeTiles + 1, kRangeTiles * kRangeLanes, [&] {
        tile_offsets_kernel(tiles.data(), &counts, pairs, tile_count, offsets.data(), {&word, 3});
      });
      EXPECT_EQ(offsets, expected) << tile_count << " tiles, " << pairs << " pairs";
      EXPECT_EQ(word, uint64_t(3) << 32 | uint64_t(pairs));
    }
  }
}

}  // namespace
}  // namespace ar::cuda
