// The tables of stages end to end, project -> bin -> blend and back.
#include <algorithm>
#include <cstring>
#include <numeric>

#include "core/blend.h"
#include "instruction_sets.h"
#include "stages.h"
#include "support.h"

namespace ar::test {
namespace {

template <typename T> struct Scene {
  TestCamera<T> camera;
  T background[3] = {T(0.1), T(0.3), T(0.2)};
  std::vector<Vec3<T>> means = {}, scales = {}, colors = {};
  std::vector<Vec4<T>> rotations = {};
  std::vector<T> opacities = {}, dL_dimage = {};

  Gaussians<T> gaussians() const {
    return {int64_t(means.size()),
            means.data(),
            scales.data(),
            rotations.data(),
            nullptr,
            opacities.data(),
            nullptr,
            colors.data(),
            0,
            0,
            T(1)};
  }
};

/// Splats from 0.3 px across, some off screen, behind, equally deep, opaque or invisible. Numbers of
/// a Scene<float> and a Scene<double> are the same.
template <typename T> Scene<T> make_scene(int n, int width, int height) {
  const double tan_fov = 0.5, focal = width / (2 * tan_fov);
  Scene<T> scene = {{width, height, tan_fov, {0, 0, 0}, {0, 0}}};
  Random random(n + width);
  const auto single = [](double x) { return T(float(x)); };
  for (int i = 0; i < n; ++i) {
    const double z = random.below(3) ? random.uniform(1, 5) : 0.5 * random.below(12) - 0.5, size = std::abs(z) / focal;
    scene.means.push_back(
        {single(z * random.uniform(-0.7, 0.7)), single(z * random.uniform(-0.7, 0.7) * height / width), single(z)});
    const auto scale = [&] { return single(size * random.log_uniform(0.3, random.below(8) ? 4 : 15)); };
    scene.scales.push_back({scale(), scale(), scale()});
    scene.rotations.push_back(
        {single(random.normal()), single(random.normal()), single(random.normal()), single(random.normal())});
    scene.colors.push_back({single(random.uniform(0, 1)), single(random.uniform(0, 1)), single(random.uniform(0, 1))});
    scene.opacities.push_back(single(random.below(6) ? random.uniform(0, 0.9) : 1));
  }
  for (int i = 0; i < 3 * width * height; ++i) scene.dL_dimage.push_back(single(random.normal()));
  return scene;
}

template <typename T>
Rendered<T> run_stages(const cpu::Stages<T>& stages, const Scene<T>& scene, FootprintOptions options, int threads) {
  return test::run_stages(stages, scene.camera.look(), scene.gaussians(), scene.background, scene.dL_dimage.data(),
                          options, threads);
}

/// The same from the definitions: every pixel visits every Gaussian that is not culled, in depth order.
template <class F> Rendered<double> render_plainly(const Scene<double>& scene) {
  const Camera<double> camera = load_camera(scene.camera.look());
  const Gaussians<double> g = scene.gaussians();
  const FootprintOptions options = options_of<F>();
  const int width = scene.camera.width, height = scene.camera.height;
  Rendered<double> out;
  std::vector<Splat<F, double>> splats(g.n);
  std::vector<typename F::template Terms<double>> terms(g.n);
  std::vector<double> depths(g.n);
  std::vector<int> order;
  for (int i = 0; i < g.n; ++i) {
    out.radii.push_back(project(camera, g, i, options, splats[i], depths[i]));
    if (out.radii[i] == 0) continue;
    order.push_back(i);
    splats[i].color = g.colors[i];  // project() leaves it out where nothing shows
    terms[i] = F::terms(splats[i].shape, splats[i].opacity);
  }
  std::stable_sort(order.begin(), order.end(), [&](int a, int b) { return depths[a] < depths[b]; });
  std::vector<PairGrad<double>> sums(g.n, PairGrad<double>{});
  std::vector<Vec2<double>> absolute(g.n, Vec2<double>{});
  const Vec3<double> background = {scene.background[0], scene.background[1], scene.background[2]};
  out.image.resize(3 * width * height);
  for (int pixel = 0; pixel < width * height; ++pixel) {
    const auto plane = [&](auto& image, int c) -> auto& { return image[c * width * height + pixel]; };
    const double share = 1.0 / F::kSamples;
    const Vec3<double> gp = {share * plane(scene.dL_dimage, 0), share * plane(scene.dL_dimage, 1),
                             share * plane(scene.dL_dimage, 2)};
    std::vector<Vec2<double>> offset(g.n, Vec2<double>{});
    for (int s = 0; s < F::kSamples; ++s) {
      std::vector<double> alphas;
      std::vector<bool> masks;
      double transmittance = 1;
      for (const int i : order) {
        alphas.push_back(
            F::alpha(terms[i], Vec2<double>{pixel % width - splats[i].mean.x, pixel / width - splats[i].mean.y}, s));
        const Blended<double> b = blend_sample(alphas.back(), transmittance);
        masks.push_back(b.mask);
        for (int c = 0; c < 3; ++c) plane(out.image, c) += share * b.contribution * (&splats[i].color.x)[c];
      }
      transmittance = std::abs(transmittance);
      for (int c = 0; c < 3; ++c) plane(out.image, c) += share * transmittance * scene.background[c];
      double behind = dot(gp, background);
      for (size_t k = order.size(); k-- > 0;) {
        const int i = order[k];
        const BlendGrad<double> b =
            blend_sample_vjp(masks[k], alphas[k], dot(gp, splats[i].color), transmittance, behind);
        const Vec2<double> d = {pixel % width - splats[i].mean.x, pixel / width - splats[i].mean.y};
        ShapeGrad<double> one = {};
        F::add_alpha_vjp(terms[i], d, s, alphas[k], b.dL_dalpha, one);
        add(F::collect(terms[i], one, alphas[k] * b.dL_dalpha), sums[i].shape);
        offset[i] = offset[i] + one.offset;
        sums[i].weighted += alphas[k] * b.dL_dalpha;
        sums[i].color += b.contribution * gp;
      }
    }
    for (const int i : order) {
      const Vec2<double> by_mean = transform_transposed(F::mean_map(splats[i].shape), offset[i]);
      absolute[i] = absolute[i] + Vec2<double>{std::abs(by_mean.x), std::abs(by_mean.y)};
    }
  }
  GradArrays<double> grads(g.n);
  for (int i = 0; i < g.n; ++i) {
    zero_grads(g, i, grads.views);
    if (out.radii[i] == 0) continue;
    project_vjp<F>(camera, g, i, options, sums[i], grads.views);
    grads.views.means2d[4 * i + 2] = absolute[i].x * width / 2;
    grads.views.means2d[4 * i + 3] = absolute[i].y * height / 2;
  }
  out.grads = std::move(grads.all);
  return out;
}

template <class F> class StagesTest : public ::testing::Test {
 protected:
  template <typename T> static Rendered<T> render(const Scene<T>& scene, int threads = 2) {
    return run_stages(*cpu::find_stages<T>(F::kName), scene, options_of<F>(), threads);
  }
};
TYPED_TEST_SUITE(StagesTest, AllFootprints, FootprintName);

// Both in double, with the same formulas: only the order of sums differs. n terms of size m lose at
// most n eps m; 1e-9 of the largest gradient covers sums over 3000 pixels with room for the needles'
// dL/dSigma -> dL/dscale, which cancels by (s1/s2)^2 < 2500.
TYPED_TEST(StagesTest, DoubleIsThePlainLoop) {
  const Scene<double> scene = make_scene<double>(120, 53, 37);
  const Rendered<double> actual = this->render(scene), expected = render_plainly<TypeParam>(scene);
  EXPECT_EQ(actual.radii, expected.radii);
  for (size_t i = 0; i < actual.image.size(); ++i) ASSERT_NEAR(actual.image[i], expected.image[i], 1e-13) << i;
  double largest = 0;
  for (const double g : expected.grads) largest = std::max(largest, std::abs(g));
  for (size_t i = 0; i < actual.grads.size(); ++i)
    ASSERT_NEAR(actual.grads[i], expected.grads[i], 1e-9 * std::abs(expected.grads[i]) + 1e-12 * largest) << i;
}

TYPED_TEST(StagesTest, ThreadsChangeNoBit) {
  const Scene<float> scene = make_scene<float>(5000, 50, 35);  // two chunks
  const Rendered<float> one = this->render(scene, 1);
  for (const int threads : {2, 7}) {
    const Rendered<float> many = this->render(scene, threads);
    EXPECT_EQ(many.radii, one.radii);
    EXPECT_EQ(std::memcmp(many.image.data(), one.image.data(), one.image.size() * sizeof(float)), 0);
    EXPECT_EQ(std::memcmp(many.grads.data(), one.grads.data(), one.grads.size() * sizeof(float)), 0);
  }
}

// Worst case: float rounds a mean by 4 eps W = 1.6e-5 px, which changes log alpha by at most 3.4/0.3 px
// times that; call it, with the rounding of the covariance (1e-5 q/2), delta = 4e-4. A pixel's colour C
// obeys sum_k |dC/dlog alpha_k| <= 2 max colour, so it moves by at most 2 delta. Where rounding carries
// an alpha across 1/255 or a transmittance across 1e-4, a whole contribution, at most 0.01, comes or
// goes; a share of 2 delta/255 of the (splat, pixel) pairs is that close, less than a pixel in 100.
// Typical: a mean off by 2 eps W before a splat of 1 px, so 8e-6 for the RMS of the image and of the
// gradients; a flip adds 1/255 of one of their thousands of terms.
TYPED_TEST(StagesTest, EveryInstructionSetAgreesWithDouble) {
  using F = TypeParam;
  const double worst = 2 * 4e-4, typical = 8e-6;
  const auto squares = [](double a, double b) { return a + b * b; };
  const Rendered<double> expected = this->render(make_scene<double>(300, 67, 45));
  const Scene<float> scene = make_scene<float>(300, 67, 45);
  for (const InstructionSet& set : instruction_sets()) {
    if (!set.supported) continue;
    const Rendered<float> actual = run_stages(*set.stages(F::kName), scene, options_of<F>(), 2);
    int flips = 0;
    std::vector<double> small, grads;
    for (size_t i = 0; i < actual.image.size(); ++i) {
      const double error = std::abs(actual.image[i] - expected.image[i]);
      ASSERT_LT(error, 0.01 + worst) << set.name << " " << i;
      if (error > worst) {
        ++flips;
      } else {
        small.push_back(error);
      }
    }
    EXPECT_LE(flips, 67 * 45 / 100) << set.name;
    EXPECT_LT(std::accumulate(small.begin(), small.end(), 0.0, squares), typical * typical * small.size()) << set.name;
    for (size_t i = 0; i < actual.grads.size(); ++i) grads.push_back(actual.grads[i] - expected.grads[i]);
    const double size = std::accumulate(expected.grads.begin(), expected.grads.end(), 0.0, squares);
    const double bound = typical + flips * 1e-4;
    EXPECT_LT(std::accumulate(grads.begin(), grads.end(), 0.0, squares), bound * bound * size) << set.name;
  }
}

TYPED_TEST(StagesTest, EmptyScenesAndThinImages) {
  for (const auto& [width, height] : {std::pair(1, 1), std::pair(1, 4000), std::pair(4000, 1), std::pair(33, 17)}) {
    for (const bool hidden : {false, true}) {
      Scene<float> scene = make_scene<float>(hidden ? 50 : 0, width, height);
      for (auto& mean : scene.means) mean.z = -1;
      const Rendered<float> out = this->render(scene);
      EXPECT_EQ(out.pairs, 0);
      const int plane = width * height;
      for (int i = 0; i < 3 * plane; ++i) ASSERT_EQ(out.image[i], scene.background[i / plane]);
      for (const float g : out.grads) ASSERT_EQ(g, 0);
      for (const int radius : out.radii) ASSERT_EQ(radius, 0);
    }
    const Rendered<double> actual = this->render(make_scene<double>(10, width, height)),
                           expected = render_plainly<TypeParam>(make_scene<double>(10, width, height));
    EXPECT_GT(actual.pairs, 0);
    for (size_t i = 0; i < actual.image.size(); ++i) ASSERT_NEAR(actual.image[i], expected.image[i], 1e-13);
  }
}

// footprint_weight is the mean over the samples at opacity 1; its derivatives are by the offset and
// by (xx, xy, yy). The frozen frame's are checked in footprint_test.
TYPED_TEST(StagesTest, WeightAndItsAdjoint) {
  using F = TypeParam;
  const cpu::Stages<double>& stages = *cpu::find_stages<double>(F::kName);
  Random random(1);
  const int64_t n = cpu::kChunk + 100;
  std::vector<Vec2<double>> offsets(n), dL_doffsets(n);
  std::vector<Sym2<double>> covs(n), dL_dcovs(n);
  std::vector<double> weights(n), ones(n, 1.0);
  for (int64_t i = 0; i < n; ++i) {
    const double s2 = random.log_uniform(0.3, 3);
    const Cov2d<double> c = covariance(s2 * random.uniform(1.1, 3), s2, random.uniform(0, kPi));
    covs[i] = {c.xx, c.xy, c.yy};
    offsets[i] = {random.normal(), random.normal()};
  }
  cpu::WeightTask<double> task{};
  task.n = n;
  task.threads = 2;
  task.options = options_of<F>();
  task.offsets = offsets.data();
  task.covs = covs.data();
  task.dL_dweights = ones.data();
  task.weights = weights.data();
  task.dL_doffsets = dL_doffsets.data();
  task.dL_dcovs = dL_dcovs.data();
  stages.weight(task);
  stages.weight_vjp(task);
  for (int64_t i = 0; i < n; i += 50) {
    const double x[5] = {offsets[i].x, offsets[i].y, covs[i].xx, covs[i].xy, covs[i].yy};
    const double grads[5] = {dL_doffsets[i].x, dL_doffsets[i].y, dL_dcovs[i].xx, dL_dcovs[i].xy, dL_dcovs[i].yy};
    for (int k = 0; k < 5; ++k) {
      const auto moved = [&](double t) {
        double y[5];
        for (int j = 0; j < 5; ++j) y[j] = x[j] + (j == k ? t : 0);
        return weight<F>(Cov2d<double>{y[2], y[3], y[4], y[2] * y[4] - y[3] * y[3]}, Vec2<double>{y[0], y[1]}, 1.0);
      };
      ASSERT_NEAR(weights[i], moved(0), 1e-14);
      if (kIsFrozen<F> && k >= 2) continue;
      ASSERT_NEAR(grads[k], derivative(moved, 1e-4), 1e-7) << k;
    }
  }
}

TEST(FindStages, KnowsNoOtherNames) {
  EXPECT_EQ(cpu::find_stages<float>("nothing"), nullptr);
  EXPECT_EQ(cpu::find_stages<double>(""), nullptr);
}

}  // namespace
}  // namespace ar::test
