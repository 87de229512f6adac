// The depth sort against std::stable_sort.
#include "cpu/sort.h"

#include <algorithm>
#include <numeric>

#include "support.h"

namespace ar::test {
namespace {

template <typename T> class SortTest : public ::testing::Test {
 protected:
  static void expect_stable_order(const std::vector<T>& depths) {
    std::vector<int32_t> expected(depths.size()), order;
    std::iota(expected.begin(), expected.end(), 0);
    std::stable_sort(expected.begin(), expected.end(), [&](int32_t a, int32_t b) { return depths[a] < depths[b]; });
    for (const int threads : {1, 2, 7}) {
      cpu::sort_by_depth(depths.data(), int64_t(depths.size()), threads, order);
      ASSERT_EQ(order, expected) << threads << " threads";
    }
  }
};
using Depths = ::testing::Types<float, double>;
TYPED_TEST_SUITE(SortTest, Depths);

TYPED_TEST(SortTest, NoneAndOne) {
  this->expect_stable_order({});
  this->expect_stable_order({TypeParam(3)});
}

TYPED_TEST(SortTest, RandomDepths) {
  Random random(1);
  std::vector<TypeParam> depths(10007);
  for (auto& d : depths) d = TypeParam(random.log_uniform(1e-30, 1e30));
  this->expect_stable_order(depths);
}

TYPED_TEST(SortTest, TiesKeepInputOrder) {
  Random random(2);
  this->expect_stable_order(std::vector<TypeParam>(1000, TypeParam(0.2)));
  std::vector<TypeParam> depths(5000);
  for (auto& d : depths) d = TypeParam(random.below(20)) / TypeParam(3);
  this->expect_stable_order(depths);
}

// Keys that differ in a single bit, of every digit of the radix.
TYPED_TEST(SortTest, NeighboursAndPowersOfTwo) {
  std::vector<TypeParam> depths;
  for (int e = 60; e > -60; --e) {
    depths.push_back(std::ldexp(TypeParam(1), e));
    depths.push_back(std::nextafter(depths.back(), TypeParam(0)));
    depths.push_back(TypeParam(0));
  }
  this->expect_stable_order(depths);
}

}  // namespace
}  // namespace ar::test
