// Packs of every instruction set against the standard library: the bounds that cpu/pack.h states.
#include <algorithm>
#include <cmath>
#include <functional>

#include "instruction_sets.h"
#include "support.h"

namespace ar::test {
namespace {

class PackTest : public ::testing::TestWithParam<InstructionSet> {
 protected:
  void SetUp() override {
    if (!GetParam().supported) GTEST_SKIP() << "this CPU lacks " << GetParam().name;
  }

  using Check = std::function<void(float a, float b, float c, float result)>;

  /// check(a[i], b[i], c[i], result) for every i; sizes are filled up with zeros.
  static void for_each_result(PackOps::Map map, std::vector<float> a, std::vector<float> b, std::vector<float> c,
                              const Check& check) {
    const size_t lanes = GetParam().ops.lanes, size = (a.size() + lanes - 1) / lanes * lanes;
    a.resize(size);
    b.resize(size);
    c.resize(size);
    std::vector<float> out(lanes);
    for (size_t i = 0; i < size; i += lanes) {
      map(&a[i], &b[i], &c[i], out.data());
      for (size_t k = 0; k < lanes; ++k) check(a[i + k], b[i + k], c[i + k], out[k]);
    }
  }
};

INSTANTIATE_TEST_SUITE_P(, PackTest, ::testing::ValuesIn(instruction_sets()),
                         [](const auto& info) { return info.param.name; });

std::vector<float> ramp(double lo, double hi, int n) {
  std::vector<float> x(n);
  for (int i = 0; i < n; ++i) x[i] = float(lo + (hi - lo) * i / (n - 1));
  return x;
}

std::vector<float> randoms(uint64_t seed, int n) {
  Random random(seed);
  std::vector<float> x(n);
  for (float& v : x) v = float(random.normal() * random.log_uniform(1e-20, 1e18));
  return x;
}

/// The stated bound, relative.
constexpr double kExp2Error = 3e-7;

TEST_P(PackTest, Exp2IsWithinItsBound) {
  for_each_result(GetParam().ops.exp2, ramp(-126, 127, 2000003), {}, {},
                  [](float x, float, float, float r) { ASSERT_NEAR(r / std::exp2(double(x)), 1, kExp2Error) << x; });
}

TEST_P(PackTest, Exp2IsClamped) {
  const float inf = std::numeric_limits<float>::infinity();
  for_each_result(GetParam().ops.exp2, {-inf, -1e30f, -127.0f, -126.5f}, {}, {}, [](float x, float, float, float r) {
    ASSERT_NEAR(r / std::exp2(std::max(double(x), -126.0)), 1, kExp2Error) << x;
  });
}

// The stated bound, relative.
TEST_P(PackTest, ErfcIsWithinItsBound) {
  for_each_result(GetParam().ops.erfc, ramp(-9, 9, 2000003), {}, {}, [](float x, float, float, float r) {
    const double tail = x > 0 ? double(x) * x : 0;
    ASSERT_NEAR(r / std::erfc(double(x)), 1, 1e-6 + 1.5e-7 * tail) << x;
  });
}

TEST_P(PackTest, ErfcStaysInRangeBeyond) {
  const float inf = std::numeric_limits<float>::infinity();
  for_each_result(GetParam().ops.erfc, {9.0f, 9.5f, 20.0f, 1e6f, 1e18f, -9.0f, -20.0f, -1e18f, -inf}, {}, {},
                  [](float x, float, float, float r) {
                    if (x == 0) return;  // filled up
                    ASSERT_GE(r, x > 0 ? 0 : 2 - 1e-6) << x;
                    ASSERT_LE(r, x > 0 ? 1e-36 : 2) << x;
                  });
}

TEST_P(PackTest, ExactOperations) {
  const PackOps& ops = GetParam().ops;
  const std::vector<float> a = randoms(1, 999), b = randoms(2, 999), c = randoms(3, 999);
  for_each_result(ops.min, a, b, c, [](float a, float b, float, float r) { ASSERT_EQ(r, std::min(a, b)); });
  for_each_result(ops.max, a, b, c, [](float a, float b, float, float r) { ASSERT_EQ(r, std::max(a, b)); });
  for_each_result(ops.abs, a, b, c, [](float a, float, float, float r) { ASSERT_EQ(r, std::abs(a)); });
  for_each_result(ops.select, a, b, c, [](float a, float b, float c, float r) { ASSERT_EQ(r, a < b ? b : c); });
  std::vector<float> positive = a;
  for (float& x : positive) x = std::abs(x);
  for_each_result(ops.sqrt, positive, b, c, [](float a, float, float, float r) { ASSERT_EQ(r, std::sqrt(a)); });
}

TEST_P(PackTest, MaddRoundsAtMostTwice) {
  for_each_result(GetParam().ops.madd, randoms(1, 999), randoms(2, 999), randoms(3, 999),
                  [](float a, float b, float c, float r) {
                    const double product = double(a) * b, exact = product + c;
                    // One rounding of the product and one of the sum, or only the latter.
                    ASSERT_LE(std::abs(r - exact), 1.001 * kEps<float> * (std::abs(product) + std::abs(exact)) + 1e-44)
                        << a << " " << b << " " << c;
                  });
}

TEST_P(PackTest, SumAndBits) {
  const int lanes = GetParam().ops.lanes;
  Random random(4);
  for (int trial = 0; trial < 200; ++trial) {
    std::vector<float> a(lanes), zero(lanes, 0.0f);
    double exact = 0, size = 0;
    uint32_t negative = 0;
    for (int i = 0; i < lanes; ++i) {
      a[i] = float(random.normal());
      exact += a[i];
      size += std::abs(a[i]);
      negative |= uint32_t(a[i] < 0) << i;
    }
    ASSERT_EQ(GetParam().ops.bits(a.data(), zero.data()), negative);
    // Pairwise: each term passes log2(lanes) <= 4 roundings.
    ASSERT_NEAR(GetParam().ops.sum(a.data()), exact, 4.001 * kEps<float> * size);
  }
}

TEST_P(PackTest, EightSumsHaveTheBitsOfEach) {
  const int lanes = GetParam().ops.lanes;
  Random random(5);
  for (int trial = 0; trial < 200; ++trial) {
    std::vector<float> a(8 * lanes), sums(8);
    for (float& x : a) x = float(random.normal());
    GetParam().ops.sum_lanes(a.data(), sums.data());
    for (int i = 0; i < 8; ++i) ASSERT_EQ(sums[i], GetParam().ops.sum(a.data() + i * lanes)) << i;
  }
}

TEST_P(PackTest, LanesComeBack) {
  const int lanes = GetParam().ops.lanes;
  std::vector<float> a(lanes), otherwise(lanes), out(lanes);
  for (int i = 0; i < lanes; ++i) a[i] = float(i + 1), otherwise[i] = float(-i - 1);
  ASSERT_EQ(GetParam().ops.keep_lanes(0, a.data(), otherwise.data(), out.data()), 0);
  for (uint32_t kept = 1; kept < 1u << lanes; ++kept) {
    const int numbers = GetParam().ops.keep_lanes(kept, a.data(), otherwise.data(), out.data());
    const int count = __builtin_popcount(kept);
    ASSERT_TRUE(numbers == count || numbers == lanes) << kept;
    for (int i = 0; i < lanes; ++i) {
      const bool is_kept = kept >> i & 1;
      ASSERT_TRUE(out[i] == a[i] || (!is_kept && out[i] == otherwise[i])) << kept << " " << i;
      if (!is_kept && numbers == count) {
        ASSERT_EQ(out[i], otherwise[i]) << kept << " " << i;
      }
    }
  }
}

// Splats of `point` without dilation have the largest whitening, with which rounding grows. Means at a pixel's centre
// show the thinnest of them.
TEST_P(PackTest, NoPackThatShowsASplatIsPassedOver) {
  const Footprint& point = footprint_named("point");
  FootprintOptions options = point.options;
  options.number = 0;
  const TileGrid grid = {64, 48};
  Random random(6);
  int visible = 0;
  for (int trial = 0; trial < search_trials(50000); ++trial) {
    const double s2 = random.log_uniform(1e-7, 1), s1 = s2 * random.log_uniform(1, random.below(2) ? 10 : 1e4);
    SplatRow<float> splat = {};
    point.in_float.prepare(rounded<float>(covariance(s1, s2, random.uniform(0, kPi))), options, splat);
    splat.mean = {float(random.uniform(0, 63)), float(random.uniform(0, 47))};
    if (trial % 2) splat.mean = {std::round(splat.mean.x), std::round(splat.mean.y)};
    splat.opacity = float(random.uniform(0.01, 1));
    splat.level = point.in_float.level(splat);
    const int column = int(splat.mean.x) / kTile, row = int(splat.mean.y) / kTile;
    bool reached[kTile * kTile];
    GetParam().ops.reach(&splat.mean.x, grid.width, grid.height, int64_t(row) * grid.columns() + column, reached);
    for (int i = 0; i < kTile * kTile; ++i) {
      float alpha;
      const Vec2<float> at = {float(column * kTile + i % kTile), float(row * kTile + i / kTile)};
      point.in_float.alphas(splat, {at.x - splat.mean.x, at.y - splat.mean.y}, &alpha);
      if (!(alpha >= float(kAlphaMin))) continue;
      ++visible;
      ASSERT_TRUE(reached[i]) << "trial " << trial << " alpha " << alpha << " sigma " << s1 << ", " << s2;
    }
  }
  EXPECT_GT(visible, search_trials(50000));
}

template <typename T> class LanesTest : public ::testing::Test {};
using Scalars = ::testing::Types<float, double>;
TYPED_TEST_SUITE(LanesTest, Scalars);

// c d is made to cancel a b down to a few units in the last place; long double holds float's products.
TYPED_TEST(LanesTest, DifferenceOfProductsKeepsItsBound) {
  using T = TypeParam;
  Random random(5);
  for (int trial = 0; trial < search_trials(100000); ++trial) {
    const T a = T(random.normal()), b = T(random.normal()), c = T(random.normal());
    T d = a * b / c;
    for (int k = random.below(4); k > 0; --k) d = std::nextafter(d, T(1e9));
    // Exact: the rounding of each product, then their difference, all by fma in twice the precision.
    const long double ab = (long double)a * b, cd = (long double)c * d;
    const T tail_ab = std::fma(a, b, -T(ab)), tail_cd = std::fma(c, d, -T(cd));
    const long double exact = ((long double)T(ab) - T(cd)) + ((long double)tail_ab - tail_cd);
    ASSERT_NEAR(difference_of_products(a, b, c, d), double(exact), 3 * kEps<T> * std::abs(double(exact)));
  }
}

// Four units in the last place, where it is a normal number.
TYPED_TEST(LanesTest, ErfcKeepsItsBound) {
  using T = TypeParam;
  for (double y = -6; y < (sizeof(T) == 4 ? 9.1 : 26); y += 1e-4) {
    const T x = T(y);
    ASSERT_NEAR(double(erfc(x) / erfcl(x)), 1, 8 * kEps<T>) << y;
  }
}

// The stated remainders, and the roundings of at most three operations.
TYPED_TEST(LanesTest, OneMinusExpKeepsItsBound) {
  using T = TypeParam;
  const double remainder = sizeof(T) == 4 ? 8e-8 : 5e-17;
  for (double y = 1e-12; y < 90; y *= 1.01) {
    const T x = T(y);
    ASSERT_NEAR(one_minus_exp(x, std::exp(-x)) / double(-std::expm1(-(long double)x)), 1, remainder + 6 * kEps<T>) << y;
  }
}

}  // namespace
}  // namespace ar::test
