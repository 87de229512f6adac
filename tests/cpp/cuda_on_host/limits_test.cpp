// Numbers that the CUDA path keeps in 32 bits, at the largest sizes that it takes: 2^30 - 1 pairs (max_items).
#include <gtest/gtest.h>

#include <limits>

#include "cuda/params.h"

namespace ar::cuda {
namespace {

constexpr int64_t kMostPairs = (int64_t(1) << 30) - 1, kMostPlanes = std::numeric_limits<int32_t>::max();
/// From a few tiles to the most that an image may have.
constexpr TileGrid kGrids[] = {{16, 16}, {240, 135}, {7680, 4320}, {1 << 20, 1 << 16}};

TEST(Limits, PlanesOfAPlanAreCountedInInt32) {
  for (const TileGrid grid : kGrids) {
    for (const int samples : {1, 4}) {  // of a lane
      for (const int channels : {3, 4}) {
        for (const bool keep : {false, true}) {
          for (const int multiprocessors : {1, 132, 1024}) {
            const CheckpointLayout layout = {channels, keep};
            EXPECT_LE(layout.max_planes(grid, samples, kMostPairs, kBlocksPerSm * multiprocessors), kMostPlanes)
                << grid.width << " x " << grid.height << ", " << samples << " samples, " << channels << " channels";
          }
        }
      }
    }
  }
}

TEST(Limits, OneListOfAllSplatsHasOneChunk) {
  EXPECT_LT(kMostPairs, kWholeList);
  EXPECT_LT(kMostPairs, kNoList);
  // The kernels count pairs in int32, up to the end of the last chunk.
  EXPECT_LE(kMostPairs + kChunkLength, std::numeric_limits<int32_t>::max());
}

}  // namespace
}  // namespace ar::cuda
