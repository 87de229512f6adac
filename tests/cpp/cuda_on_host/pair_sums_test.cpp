// What blend_vjp adds up over the lanes of a warp in shared memory.
#include <random>

#include "cuda_on_host.h"
// After it: kernels.
#include <gtest/gtest.h>

#include "cuda/still/vjp_sums.cuh"

namespace ar::cuda {
namespace {

/// Every lane has the sums of its pair's group and ninth value, to the bit those of sum_values, which other kernels add
/// up with; whatever the memory held before, for any number of pairs.
TEST(PairSums, AreThoseOfTheLanes) {
  constexpr int kPairs = PairSums::kPairs, kValues = PairSums::kValues;
  std::mt19937 bits(3);
  std::uniform_real_distribution<float> numbers(-1, 1);
  std::vector<float> values(kPairs * 32 * kValues);
  for (float& x : values) x = numbers(bits);
  const auto value = [&](int pair, int lane, int v) { return values[(pair * 32 + lane) * kValues + v]; };
  float expected[kPairs][kValues];
  for (const int count : {1, 5, kPairs}) {
    for (float4& x : dynamic_memory) x = {NAN, NAN, NAN, NAN};
    cuda_on_host::launch(1, 32, [&] {
      auto& sums = *reinterpret_cast<PairSums*>(dynamic_shared());
      const int lane = lane_id();
      for (int pair = 0; pair < count; ++pair) {
        float own[kValues];
        for (int v = 0; v < kValues; ++v) own[v] = value(pair, lane, v);
        sums.pairs[pair].put(own);
        const float sum = sum_values(own);
        expected[pair][summed_value<kValues>(lane)] = sum;
      }
      __syncwarp();
      float four[4], ninth;
      sums.sum(four, ninth);
      const int pair = lane / 4, group = lane / 2 % 2;
      if (pair >= count) return;
      for (int v = 0; v < 4; ++v) EXPECT_EQ(four[v], expected[pair][4 * group + v]) << lane;
      EXPECT_EQ(ninth, expected[pair][8]) << lane;
    });
  }
}

}  // namespace
}  // namespace ar::cuda
