// The table of dispatch.h, written out a second time: which family of kernels blends each footprint of the registry, in
// tiles of which size, with how many samples in a lane. tests/project/test_build.py compares the names of its kernels
// with the sources.
#include "cuda_on_host.h"
// After it: what kernels include.
#include <gtest/gtest.h>

#include <string>

#include "cuda/dispatch.h"

namespace ar::cuda {
namespace {

/// A large image is one of 4096 tiles or more, of 16x16 pixels for `box` and of 8x8 pixels for `moment`.
constexpr int kSizes[][2] = {{40, 30}, {512, 512}, {1920, 1080}};

/// Of a footprint in one of the sizes.
struct Tiles {
  int side;  ///< px
  int samples_of_lane;
};
struct Expected {
  const char* key;
  Family few, more;  ///< up to four channels, and more
  int samples;
  Tiles of_sizes[3];
};

constexpr Family kStill = Family::kStill, kMoment = Family::kMoment, kChannels = Family::kChannels;
constexpr Expected kTable[] = {
    {"point", kStill, kChannels, 1, {{16, 1}, {16, 1}, {16, 1}}},
    {"mip", kStill, kChannels, 1, {{16, 1}, {16, 1}, {16, 1}}},
    {"analytic", kStill, kChannels, 1, {{16, 1}, {16, 1}, {16, 1}}},
    {"analytic_paper", kChannels, kChannels, 1, {{16, 1}, {16, 1}, {16, 1}}},
    {"cumulant", kStill, kChannels, 1, {{16, 1}, {16, 1}, {16, 1}}},
    {"box1", kStill, kChannels, 1, {{16, 1}, {16, 1}, {16, 1}}},
    {"box4", kStill, kChannels, 4, {{8, 1}, {8, 1}, {16, 4}}},
    {"box16", kStill, kChannels, 16, {{4, 1}, {4, 1}, {4, 1}}},
    {"moment1", kMoment, kMoment, 1, {{8, 1}, {16, 1}, {16, 1}}},
    {"moment4", kMoment, kMoment, 4, {{8, 4}, {8, 4}, {8, 4}}},
    {"moment16", kMoment, kMoment, 16, {{4, 16}, {8, 16}, {8, 16}}},
    {"erf", kChannels, kChannels, 1, {{16, 1}, {16, 1}, {16, 1}}},
    {"exact", kChannels, kChannels, 1, {{16, 1}, {16, 1}, {16, 1}}},
};
const Expected* expected_of(const std::string& key) {
  const auto* found = std::find_if(std::begin(kTable), std::end(kTable), [&](auto& row) { return key == row.key; });
  return found == std::end(kTable) ? nullptr : found;
}

/// The grid that csrc/torch makes for CUDA (grid_of of checks.cpp).
template <class F> TileGrid grid_of(int width, int height) {
  return F::kMoves ? moving_grid(F::kSamples, width, height) : spread_grid(spread_lanes<F>(), width, height);
}

/// The first kernel of a family, forward or backward; `cuts`: some lists are cut.
const char* first_kernel(Family family, bool cuts, bool forward) {
  if (family == kStill) return forward ? "blend_front_kernel" : "blend_vjp_kernel";
  if (family == kChannels) return forward ? "blend_groups_kernel" : "blend_groups_vjp_kernel";
  if (cuts) return forward ? "filter_kernel" : "segment_maps_kernel";
  return forward ? "moving_blend_kernel" : "moving_vjp_kernel";
}

TEST(Dispatch, HasOneFamilyAlongRays) {
  for_each_footprint(Footprints{}, [&](auto f) {
    using F = decltype(f);
    if (!F::kAlongRays) return;
    const int index = find_footprint(key_of<F>());
    for (const auto& [width, height] : kSizes) {
      const TileGrid grid = ray_grid(width, height);
      EXPECT_EQ(grid.side(), 8);
      const Route route = route_of(index, 3, 1000000, grid, cuda_on_host::kMultiprocessors, true);
      EXPECT_EQ(route.family, Family::kRays);
      EXPECT_EQ(route.samples_of_lane, F::kSamples);
      EXPECT_TRUE(route.cut.whole);
      EXPECT_EQ(route.cut.max_segments, 0);
      EXPECT_STREQ(route.forward[0], "blend_rays_kernel");
      EXPECT_STREQ(route.backward[0], "blend_rays_vjp_kernel");
    }
  });
}

TEST(Dispatch, IsWhatItsTableSays) {
  constexpr int kMultiprocessors = cuda_on_host::kMultiprocessors;
  int footprint = 0;
  for_each_footprint(Footprints{}, [&](auto f) {
    using F = decltype(f);
    SCOPED_TRACE(key_of<F>());
    const int index = footprint++;
    const Expected* expected = expected_of(key_of<F>());
    ASSERT_NE(expected, nullptr) << "the table has no row for this footprint";
    for (int size = 0; size < 3; ++size) {
      const auto [width, height] = kSizes[size];
      const TileGrid grid = grid_of<F>(width, height);
      EXPECT_EQ(grid.side(), expected->of_sizes[size].side) << width << " x " << height;
      for (const int channels : {1, 3, 4, 5, 40}) {
        for (const int64_t capacity : {100, 1000000}) {
          SCOPED_TRACE(testing::Message() << channels << " channels, " << width << " x " << height << ", room for "
                                          << capacity << " pairs");
          const Route route = route_of(index, channels, capacity, grid, kMultiprocessors);
          const Family family = channels <= 4 ? expected->few : expected->more;
          EXPECT_EQ(route.family, family);
          EXPECT_EQ(route.samples, expected->samples);
          EXPECT_EQ(route.samples_of_lane, expected->of_sizes[size].samples_of_lane);
          // still/ blends in chunks, which plan_chunks makes; the others blend whole lists, and moment/ cuts long ones.
          EXPECT_EQ(route.cut.whole, family != kStill);
          const bool cuts = route.cut.max_segments > 0;
          if (family != kMoment) {
            EXPECT_FALSE(cuts);
          }
          EXPECT_STREQ(route.forward[0], first_kernel(family, cuts, true));
          EXPECT_STREQ(route.backward[0], first_kernel(family, cuts, false));
        }
      }
    }
  });
  EXPECT_EQ(footprint, int(std::size(kTable)));
}

/// All lists of small images are cut, but with tiles of 4x4 pixels; of large images the long ones, where there can be
/// any.
TEST(Dispatch, CutsListsOfMomentAlone) {
  const auto cuts = [](const char* key, int width, int height, int64_t capacity) {
    bool any = false;
    visit_footprint(find_footprint(key), Footprints{}, [&](auto f) {
      const TileGrid grid = grid_of<decltype(f)>(width, height);
      any = route_of(find_footprint(key), 3, capacity, grid, cuda_on_host::kMultiprocessors).cut.max_segments > 0;
    });
    return any;
  };
  for (const char* key : {"moment1", "moment4"}) {
    EXPECT_TRUE(cuts(key, 40, 30, 100)) << key;
    EXPECT_FALSE(cuts(key, 1920, 1080, 100)) << key;
    EXPECT_TRUE(cuts(key, 1920, 1080, 1000000)) << key;
  }
  EXPECT_FALSE(cuts("moment16", 40, 30, 100));
  EXPECT_TRUE(cuts("moment16", 40, 30, 1000000));
  EXPECT_TRUE(cuts("moment16", 1920, 1080, 1000000));
  EXPECT_FALSE(cuts("box4", 40, 30, 1000000));
}

}  // namespace
}  // namespace ar::cuda
