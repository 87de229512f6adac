// Spherical harmonics of every degree.
#include "core/sh.h"
#include "core/footprint/normal.h"
#include "support.h"

namespace ar::test {
namespace {

constexpr int kCount = sh_count(kMaxShDegree);

// By rules that are exact: products of two harmonics are polynomials of degree 8 in z, of which the nodes take 11, and
// of frequencies up to 8 around the axis, of which the sectors take 31.
TEST(Harmonics, AreOrthonormal) {
  constexpr int kNodes = 6, kSectors = 32;
  static_assert(2 * kMaxShDegree < 2 * kNodes && 2 * kMaxShDegree < kSectors);
  using Rule = GaussLegendre<kNodes, double>;
  double products[kCount][kCount] = {};
  for (int i = 0; i < kNodes; ++i) {
    const double z = 2 * Rule::node(i), r = std::sqrt(1 - z * z), share = 4 * kPi * Rule::weight(i) / kSectors;
    for (int j = 0; j < kSectors; ++j) {
      const Vec2<double> xy = on_circle(r, 2 * kPi * j / kSectors);
      double basis[kCount];
      sh_basis<kMaxShDegree>(kMaxShDegree, Vec3<double>{xy.x, xy.y, z}, basis);
      for (int k = 0; k < kCount; ++k) {
        for (int l = 0; l <= k; ++l) products[k][l] += share * basis[k] * basis[l];
      }
    }
  }
  // A rounding for each of the terms, whose absolute values add up to 1 at most, and those of the harmonics themselves.
  constexpr double kBound = 2 * kNodes * kSectors * kEps<double>;
  for (int k = 0; k < kCount; ++k) {
    for (int l = 0; l <= k; ++l) EXPECT_NEAR(products[k][l], k == l ? 1 : 0, kBound) << k << " " << l;
  }
}

// Along the sphere: of what is off it a polynomial of a unit vector may say anything.
TEST(Harmonics, GradientsMatchDifferences) {
  Random random(1);
  for (int trial = 0; trial < 200; ++trial) {
    const int degree = trial % (kMaxShDegree + 1);
    const auto unit = [](Vec3<double> v) { return (1 / std::sqrt(dot(v, v))) * v; };
    const auto vector = [&] { return Vec3<double>{random.normal(), random.normal(), random.normal()}; };
    double weight[kCount] = {};
    for (int k = 0; k < sh_count(degree); ++k) weight[k] = random.normal();
    const Vec3<double> d = unit(vector()), along = unit(cross(d, vector()));
    const auto value = [&](double t) {
      double basis[kCount] = {}, sum = 0;
      sh_basis<kMaxShDegree>(degree, std::cos(t) * d + std::sin(t) * along, basis);
      for (int k = 0; k < kCount; ++k) sum += weight[k] * basis[k];
      return sum;
    };
    const Vec3<double> g = sh_basis_vjp<kMaxShDegree>(degree, d, weight);
    EXPECT_NEAR(dot(g, along), derivative(value, 1e-3), 1e-9) << "degree " << degree;
  }
}

// What the plain camera compiles is what the full one does.
TEST(Harmonics, TheSameBitsWhateverTheLargestDegree) {
  Random random(2);
  for (int trial = 0; trial < 1000; ++trial) {
    const int degree = trial % 4;
    const Vec3<float> d = {float(random.normal()), float(random.normal()), float(random.normal())};
    float a[kCount] = {}, b[kCount] = {}, weight[kCount];
    for (float& w : weight) w = float(random.normal());
    sh_basis<3>(degree, d, a);
    sh_basis<4>(degree, d, b);
    for (int k = 0; k < kCount; ++k) ASSERT_EQ(a[k], b[k]);
    const Vec3<float> g = sh_basis_vjp<3>(degree, d, weight), h = sh_basis_vjp<4>(degree, d, weight);
    ASSERT_TRUE(g.x == h.x && g.y == h.y && g.z == h.z);
  }
}

}  // namespace
}  // namespace ar::test
