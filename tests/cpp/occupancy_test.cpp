#include "cuda/occupancy.h"
#include "cuda/bin/policy.h"
#include "cuda/project/policy.h"

#include <gtest/gtest.h>

namespace ar::cuda {
namespace {

/// What setup.py compiles for, and the threads that a multiprocessor of it can hold, by NVIDIA's tables.
struct Device {
  int architecture, threads;
};
constexpr Device kDevices[] = {{750, 1024}, {800, 2048},  {860, 1536}, {890, 1536},
                               {900, 2048}, {1000, 2048}, {1200, 1536}};

/// Launch bounds with a number of blocks: the compiler drops those that are out of range.
struct Bound {
  const char* kernel;
  int blocks, threads;
};
constexpr Bound kBounds[] = {
    {"sort_pass_kernel<7>", SortPolicy<7>::kBlocks, SortPolicy<7>::kThreads},
    {"sort_pass_kernel<8>", SortPolicy<8>::kBlocks, SortPolicy<8>::kThreads},
    {"sort_pass_kernel<9>", SortPolicy<9>::kBlocks, SortPolicy<9>::kThreads},
    {"project_vjp_kernel", ProjectPolicy::kVjpBlocks, ProjectPolicy::kThreads},
    {"zero_culled_grads_kernel", ProjectPolicy::kZeroBlocks, ProjectPolicy::kZeroThreads},
};

TEST(OccupancyTest, LaunchBoundsAreInRangeOnEveryDevice) {
  for (const Device& device : kDevices) {
    EXPECT_EQ(resident_threads(device.architecture), device.threads);
    for (const Bound& bound : kBounds) {
      const int blocks = blocks_per_sm(bound.blocks, bound.threads, device.architecture);
      EXPECT_GE(blocks, 1) << bound.kernel;
      EXPECT_LE(blocks * bound.threads, device.threads) << bound.kernel << " on " << device.architecture;
    }
  }
}

TEST(OccupancyTest, LaunchBoundsAreClampedOnlyWhereTheyMustBe) {
  EXPECT_EQ(blocks_per_sm(16, 128, 900), 16);
  EXPECT_EQ(blocks_per_sm(16, 128, 860), 12);
  EXPECT_EQ(blocks_per_sm(16, 128, 750), 8);
  EXPECT_EQ(blocks_per_sm(5, 256, 860), 5);
  EXPECT_EQ(blocks_per_sm(5, 256, 750), 4);
  EXPECT_EQ(blocks_per_sm(2, 1024, 750), 1);
}

TEST(OccupancyTest, UnknownDevicesGetBoundsThatAreInRangeOnAll) { EXPECT_EQ(resident_threads(9999), 1024); }

}  // namespace
}  // namespace ar::cuda
