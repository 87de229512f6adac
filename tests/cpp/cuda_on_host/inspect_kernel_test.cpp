// The kernel of inspect, run on the host, in tiles of every size that samples that move have.
#include "cuda_on_host.h"
// After it: kernels.
#include <gtest/gtest.h>

#include <algorithm>
#include <numeric>

#include "cuda/dispatch.h"
#include "cuda/inspect.cuh"
#include "random_splats.h"

namespace ar::cuda {
namespace {

constexpr int kWidth = 27, kHeight = 21, kSplats = 60, kUnwritten = -777;

struct Looks {
  std::vector<float> median = std::vector<float>(kWidth * kHeight, kUnwritten);
  std::vector<int32_t> dominant = std::vector<int32_t>(kWidth * kHeight, kUnwritten);
  std::vector<int32_t> touched = std::vector<int32_t>(kSplats), largest = touched, in_front = touched;
  std::vector<int32_t> dominated = touched;
  std::vector<int64_t> units = std::vector<int64_t>(kSplats);
};

/// Of random splats, all of which are in the list of every tile of 2^kBits pixels a side. Splat k has the depth k + 1.
template <int kBits, Look kLook = Look::kStatistics> Looks inspect_tiles() {
  constexpr int kSide = 1 << kBits;
  using F = Moment<1>;
  constexpr TileGrid grid = {kWidth, kHeight, kBits};
  std::mt19937 bits(7);
  const auto splats = random_splats<F>(bits, kSplats, grid, -2, 2, 0.9f,
                                       [](const Cov2d<float>& cov) { return F::prepare(cov, FootprintOptions{0}); });
  std::vector<int32_t> pairs;
  std::vector<int64_t> offsets = {0};
  for (int tile = 0; tile < grid.tiles(); ++tile) {
    for (int k = 0; k < kSplats; ++k) pairs.push_back(k);
    offsets.push_back(int64_t(pairs.size()));
  }
  Counts counts = {int64_t(pairs.size()), kSplats};
  Looks looks;
  InspectParams params = {};
  params.splats = &splats[0].mean.x;
  params.grid = grid;
  params.lists = lists_of(pairs, offsets, counts);
  std::vector<float> depths(kSplats);
  std::iota(depths.begin(), depths.end(), 1.0f);
  params.depths = depths.data();
  params.median = looks.median.data();
  params.dominant = looks.dominant.data();
  params.touched = looks.touched.data();
  params.largest = looks.largest.data();
  params.in_front = looks.in_front.data();
  params.dominated = looks.dominated.data();
  params.units = looks.units.data();
  cuda_on_host::launch(int(grid.tiles()), kInspectThreads<kSide>, [&] { inspect_kernel<F, kSide, kLook>(params); });
  return looks;
}

/// Every pixel is looked at, and the size of tiles changes nothing but how positions are rounded.
void expect_the_same(const Looks& small, const Looks& large) {
  int different = 0;
  for (int i = 0; i < kWidth * kHeight; ++i) {
    ASSERT_NE(small.median[i], kUnwritten) << i;
    ASSERT_NE(large.median[i], kUnwritten) << i;
    different += small.median[i] != large.median[i] || small.dominant[i] != large.dominant[i];
  }
  EXPECT_LE(different, 2);
  for (int k = 0; k < kSplats; ++k) {
    EXPECT_NEAR(small.touched[k], large.touched[k], 2) << k;
    EXPECT_NEAR(double(small.units[k]), double(large.units[k]),
                1e-4 * double(small.units[k]) + double(weight_units(0.01f)))
        << k;
  }
}
TEST(InspectKernel, FindsTheSameWithoutStatistics) {
  const Looks all = inspect_tiles<kTileBits>(), images = inspect_tiles<kTileBits, Look::kImages>();
  EXPECT_EQ(images.median, all.median);
  EXPECT_EQ(images.dominant, all.dominant);
  EXPECT_GT(*std::max_element(all.median.begin(), all.median.end()), 1);
  for (const int32_t touched : images.touched) EXPECT_EQ(touched, 0);
  const Looks medians = inspect_tiles<kTileBits, Look::kMedian>();
  EXPECT_EQ(medians.median, all.median);
  for (const int32_t dominant : medians.dominant) EXPECT_EQ(dominant, kUnwritten);
}

/// Of a camera that looks along z from -1, and of one with a lens that orders by distance.
TEST(InspectKernel, FindsDepthsOfMeans) {
  const float view[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 1, 1}, zeros[16] = {};
  const Vec3<float> mean = {3, 4, 11};
  InspectParams params = {};
  params.means = &mean;
  params.camera = {view, zeros, zeros, kWidth, kHeight, 1, 1};
  EXPECT_EQ(depth_of_splat(params, 0), 12);
  Lens<float> lens = {};
  lens.model = float(kCameraModel<Fisheye>);
  params.camera.lens = reinterpret_cast<const float*>(&lens);
  EXPECT_EQ(depth_of_splat(params, 0), 13);
}

TEST(InspectKernel, LooksAtEveryPixel) {
  const Looks usual = inspect_tiles<kMovingTileBits>();
  expect_the_same(usual, inspect_tiles<kTileBits>());
  expect_the_same(inspect_tiles<kMovingTileBits - 1>(), usual);
}

}  // namespace
}  // namespace ar::cuda
