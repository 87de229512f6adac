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
    std::vector<int32_t> expected(depths.size()), order(depths.size());
    std::iota(expected.begin(), expected.end(), 0);
    std::stable_sort(expected.begin(), expected.end(), [&](int32_t a, int32_t b) { return depths[a] < depths[b]; });
    for (const int threads : {1, 2, 7}) {
      cpu::sort_by_depth(depths.data(), int64_t(depths.size()), threads, order.data());
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

// A digit in which the keys of one thread agree, and those of another do not.
TYPED_TEST(SortTest, PartsThatDiffer) {
  Random random(3);
  std::vector<TypeParam> depths(10000, TypeParam(0));
  for (int i = 0; i < 5000; ++i) depths[i] = TypeParam(random.log_uniform(1e-30, 1e30));
  this->expect_stable_order(depths);
  std::reverse(depths.begin(), depths.end());
  this->expect_stable_order(depths);
}

// Alone, where every key has the same digits but for the sign, and among others.
TYPED_TEST(SortTest, ZerosOfBothSignsAreEqual) {
  this->expect_stable_order({TypeParam(0), TypeParam(-0.0), TypeParam(0), TypeParam(-0.0)});
  this->expect_stable_order({TypeParam(2), TypeParam(-0.0), TypeParam(1e-30), TypeParam(0), TypeParam(-0.0)});
}

TEST(SumBefore, OfEveryLength) {
  Random random(3);
  for (const int n : {0, 1, 5, 4096, 8191, 8192, 50001}) {
    std::vector<int64_t> numbers(n);
    for (int64_t& number : numbers) number = random.below(100);
    std::vector<int64_t> expected(n);
    int64_t all = 0;
    for (int i = 0; i < n; ++i) expected[i] = all, all += numbers[i];
    for (const int threads : {1, 2, 7}) {
      std::vector<int64_t> sums = numbers;
      EXPECT_EQ(cpu::sum_before(sums.data(), n, threads), all);
      EXPECT_EQ(sums, expected) << n << " numbers, " << threads << " threads";
    }
  }
}

TEST(PlaceItems, ByKindThenPart) {
  Random random(4);
  for (const int kinds : {1, 7, 256, 257, 9000}) {
    for (const int parts : {1, 5}) {
      std::vector<int64_t> counts(parts * kinds), expected(parts * kinds), expected_firsts(kinds);
      for (int64_t& count : counts) count = random.below(4);
      int64_t all = 0;
      for (int kind = 0; kind < kinds; ++kind) {
        expected_firsts[kind] = all;
        for (int part = 0; part < parts; ++part)
          expected[part * kinds + kind] = all, all += counts[part * kinds + kind];
      }
      for (const int threads : {1, 2, 7}) {
        std::vector<int64_t> places = counts, firsts(kinds, -1);
        EXPECT_EQ(cpu::place_items(places.data(), parts, kinds, threads, firsts.data()), all);
        EXPECT_EQ(places, expected) << kinds << " kinds, " << parts << " parts, " << threads << " threads";
        EXPECT_EQ(firsts, expected_firsts);
      }
    }
  }
}

}  // namespace
}  // namespace ar::test
