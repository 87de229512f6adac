// The tables of stages end to end, project -> bin -> blend and back.
#include "stages.h"

#include <algorithm>
#include <cstring>
#include <numeric>
#include <string>

#include "core/blend.h"
#include "instruction_sets.h"
#include "support.h"

namespace ar::test {
namespace {

template <typename T> struct Scene {
  TestCamera<T> camera;
  std::vector<T> background = {T(0.1), T(0.3), T(0.2)};
  std::vector<Vec3<T>> means = {}, scales = {}, colors = {};
  std::vector<Vec4<T>> rotations = {};
  std::vector<T> opacities = {}, dL_dimage = {}, dL_dalpha = {};
  std::vector<T> channels = {};  ///< [n, count], if not the colours
  int count = 3;

  Gaussians<T> gaussians() const {
    Gaussians<T> g = {};
    g.n = int64_t(means.size());
    g.means = means.data();
    g.scales = scales.data();
    g.rotations = rotations.data();
    g.opacities = opacities.data();
    g.colors = channels.empty() ? colors.data() : nullptr;
    g.scale_modifier = T(1);
    return g;
  }

  Pass<T> pass(FootprintChoice footprint, int threads = 1) const {
    Pass<T> pass;
    pass.camera = camera.camera_view();
    pass.gaussians = gaussians();
    pass.footprint = footprint;
    pass.background = background.data();
    pass.dL_dimage = dL_dimage.data();
    pass.dL_dalpha = dL_dalpha.empty() ? nullptr : dL_dalpha.data();
    pass.threads = threads;
    pass.count = count;
    if (!channels.empty()) pass.given = channels.data(), pass.given_count = count;
    return pass;
  }

  /// What splat i shows in channel c.
  T shown(int64_t i, int c) const { return channels.empty() ? (&colors[i].x)[c] : channels[i * count + c]; }
};

/// Gradients against differences of a loss that jumps where a splat crosses a threshold.
struct Differences {
  int compared = 0, smooth = 0;

  /// `loss_at(t)`: the loss where the number that the gradient is by is larger by t. `least`, `times`: of the bound.
  template <class Loss>
  void compare(double gradient, const Loss& loss_at, double least, double times, const std::string& name) {
    if (gradient == 0) return;
    const double wide = derivative(loss_at, 2e-6), narrow = derivative(loss_at, 1e-6);
    const double bound = 1e-6 * std::abs(wide) + least;
    ++compared;
    if (std::abs(wide - narrow) > bound) return;  // two steps that agree straddle no threshold
    ++smooth;
    EXPECT_NEAR(gradient, narrow, times * bound) << name;
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

/// The same with `count` channels of its own, and a gradient with respect to alpha.
template <typename T> Scene<T> make_channel_scene(int n, int width, int height, int count) {
  Scene<T> scene = make_scene<T>(n, width, height);
  Random random(count);
  scene.count = count;
  const auto fill = [&](std::vector<T>& numbers, size_t size) {
    numbers.resize(size);
    for (T& x : numbers) x = T(float(random.normal()));
  };
  fill(scene.channels, size_t(n) * count);
  fill(scene.background, count);
  fill(scene.dL_dimage, size_t(count) * width * height);
  fill(scene.dL_dalpha, size_t(width) * height);
  return scene;
}

/// For comparisons of every number. Under sanitizers, which look at memory, fewer pixels and splats; the image's right
/// and lower edge cut tiles off in both.
template <typename T> Scene<T> make_usual_scene(int n = 120, int width = 53, int height = 37) {
  return kSanitized ? make_scene<T>(60, 35, 21) : make_scene<T>(n, width, height);
}

template <typename T> Rendered<T> render(const Footprint& f, const Scene<T>& scene, int threads = 1) {
  return run_stages(cpu::stages_of<T>(f.index), scene.pass(f.choice(), threads));
}

/// The same from the definitions: every pixel visits every Gaussian that is not culled, in depth order.
Rendered<double> render_plainly(const Footprint& f, const Scene<double>& scene) {
  const Camera<double> camera = load_camera(scene.camera.camera_view());
  const Gaussians<double> g = scene.gaussians();
  const Model<double>& model = f.in_double;
  const int width = scene.camera.width, height = scene.camera.height, count = scene.count, samples = f.samples;
  Rendered<double> out;
  std::vector<SplatRow<double>> splats(g.n);
  std::vector<double> depths(g.n);
  std::vector<int> order;
  for (int i = 0; i < g.n; ++i) {
    out.radii.push_back(project(camera, g, i, f.choice(), splats[i], depths[i]));
    if (out.radii[i] > 0) order.push_back(i);
  }
  std::stable_sort(order.begin(), order.end(), [&](int a, int b) { return depths[a] < depths[b]; });
  std::vector<PairGrad<double>> sums(g.n, PairGrad<double>{});
  std::vector<Vec2<double>> absolute(g.n, Vec2<double>{});
  out.image.resize(count * width * height);
  out.alpha.resize(width * height);
  out.dL_dchannels.resize(g.n * count);
  for (int pixel = 0; pixel < width * height; ++pixel) {
    const double share = 1.0 / samples;
    std::vector<double> gradient(count);
    double of_background = 0;
    for (int c = 0; c < count; ++c) {
      gradient[c] = share * scene.dL_dimage[c * width * height + pixel];
      of_background += gradient[c] * scene.background[c];
    }
    if (!scene.dL_dalpha.empty()) of_background -= share * scene.dL_dalpha[pixel];
    const auto offset_of = [&](int i) {
      return Vec2<double>{pixel % width - splats[i].mean.x, pixel / width - splats[i].mean.y};
    };
    struct Step {  // in front of a splat
      double transmittance;
      Vec2<double> moved;
      bool composited;
    };
    std::vector<PairGrad<double>> of_pixel(order.size(), PairGrad<double>{});
    for (int s = 0; s < samples; ++s) {
      std::vector<Step> steps;
      double transmittance = 1;
      Vec2<double> moved = {0, 0};
      for (const int i : order) {
        const Vec2<double> d = offset_of(i) + moved;
        const double raw = model.alpha(splats[i], d, s), in_front = transmittance;
        const Blended<double> b = blend_sample(raw, transmittance);
        steps.push_back({in_front, moved, b.mask});
        if (b.mask) moved = model.move(splats[i], d, s, std::min(raw, kAlphaMax), moved);
        for (int c = 0; c < count; ++c)
          out.image[c * width * height + pixel] += share * b.contribution * scene.shown(i, c);
      }
      transmittance = std::abs(transmittance);
      for (int c = 0; c < count; ++c)
        out.image[c * width * height + pixel] += share * transmittance * scene.background[c];
      out.alpha[pixel] += share * (1 - transmittance);
      double behind = of_background;
      Vec2<double> dL_dmoved = {0, 0};
      for (size_t k = order.size(); k-- > 0;) {
        if (!steps[k].composited) continue;
        const int i = order[k];
        const Vec2<double> d = offset_of(i) + steps[k].moved;
        const double raw = model.alpha(splats[i], d, s), alpha = std::min(raw, kAlphaMax);
        double g_color = 0;
        for (int c = 0; c < count; ++c) g_color += gradient[c] * scene.shown(i, c);
        const double difference = g_color - behind;
        const MoveGrad<double> grad = model.alpha_and_move_vjp(
            splats[i], d, s, alpha, raw <= kAlphaMax, steps[k].transmittance * difference, steps[k].moved, dL_dmoved);
        behind += alpha * difference;
        add(grad.sums, of_pixel[k].shape);
        of_pixel[k].weighted += grad.weighted;
        for (int c = 0; c < count; ++c) out.dL_dchannels[i * count + c] += steps[k].transmittance * alpha * gradient[c];
      }
    }
    for (size_t k = 0; k < order.size(); ++k) {
      const int i = order[k];
      sums[i].weighted += of_pixel[k].weighted;
      add(of_pixel[k].shape, sums[i].shape);
      const Vec2<double> by_mean = transform_transposed(model.mean_map(splats[i]), of_pixel[k].shape.offset);
      absolute[i] = absolute[i] + Vec2<double>{std::abs(by_mean.x), std::abs(by_mean.y)};
    }
  }
  GradArrays<double> grads(g);
  for (int i = 0; i < g.n; ++i) {
    zero_grads(g, i, grads.views);
    if (out.radii[i] == 0) continue;
    ShownGrad<double> shown = {};
    if (scene.channels.empty()) shown.color = *reinterpret_cast<const Vec3<double>*>(&out.dL_dchannels[3 * i]);
    project_vjp(
        camera, g, i, [&](const Cov2d<double>& cov, double) { return projected_grad(f.choice(), cov, sums[i]); }, shown,
        static_cast<const Vec3<double>*>(nullptr), static_cast<Vec3<double>*>(nullptr), grads.views);
    grads.views.means2d[4 * i + 2] = absolute[i].x * width / 2;
    grads.views.means2d[4 * i + 3] = absolute[i].y * height / 2;
  }
  out.grads = std::move(grads.all);
  return out;
}

/// Both in double, with the same formulas: only the order of sums differs. n terms of size m lose at most n eps m; 1e-9
/// of the largest gradient covers sums over 3000 pixels with room for the needles' dL/dSigma -> dL/dscale, which
/// cancels by (s1/s2)^2 < 2500.
void expect_same(const Rendered<double>& actual, const Rendered<double>& expected) {
  EXPECT_EQ(actual.radii, expected.radii);
  const auto compare = [](const std::vector<double>& a, const std::vector<double>& b, double relative, double floor,
                          const char* name) {
    ASSERT_EQ(a.size(), b.size()) << name;
    double largest = 0;
    for (const double x : b) largest = std::max(largest, std::abs(x));
    for (size_t i = 0; i < a.size(); ++i)
      ASSERT_NEAR(a[i], b[i], relative * std::abs(b[i]) + floor * largest) << name << " " << i;
  };
  compare(actual.image, expected.image, 0, 1e-13, "image");
  compare(actual.alpha, expected.alpha, 0, 1e-13, "alpha");
  compare(actual.grads, expected.grads, 1e-9, 1e-12, "gradient");
  if (!actual.dL_dchannels.empty())
    compare(actual.dL_dchannels, expected.dL_dchannels, 1e-9, 1e-12, "gradient of channels");
}

class StagesTest : public ::testing::TestWithParam<Footprint> {};
AR_ALL_FOOTPRINTS(StagesTest);

TEST_P(StagesTest, DoubleIsThePlainLoop) {
  const Scene<double> scene = make_usual_scene<double>();
  expect_same(render(GetParam(), scene), render_plainly(GetParam(), scene));
}

// Fewer channels than three, one window of them, and several; |dL/dmean| is that of all channels together.
TEST_P(StagesTest, AnyNumberOfChannels) {
  for (const int count : kSanitized ? std::vector{1, 37} : std::vector{1, 4, 5, 37}) {
    const Scene<double> scene =
        kSanitized ? make_channel_scene<double>(30, 21, 18, count) : make_channel_scene<double>(60, 35, 21, count);
    expect_same(render(GetParam(), scene), render_plainly(GetParam(), scene));
    if (HasFatalFailure()) return;
  }
}

void expect_same_bits(const Rendered<float>& a, const Rendered<float>& b) {
  const auto same = [](const std::vector<float>& a, const std::vector<float>& b) {
    return a.size() == b.size() && (a.empty() || std::memcmp(a.data(), b.data(), a.size() * sizeof(float)) == 0);
  };
  EXPECT_EQ(a.radii, b.radii);
  EXPECT_TRUE(same(a.image, b.image));
  EXPECT_TRUE(same(a.grads, b.grads));
  EXPECT_TRUE(same(a.dL_dchannels, b.dL_dchannels));
}

TEST_P(StagesTest, ThreadsChangeNoBit) {
  // Two chunks of Gaussians, of which one in eight is in front of the camera; two windows of channels.
  Scene<float> scenes[] = {make_scene<float>(5000, 50, 35),
                           make_channel_scene<float>(kSanitized ? 60 : 200, 50, 35, 35)};
  for (size_t i = 0; i < scenes[0].means.size(); ++i) {
    if (i % 8) scenes[0].means[i].z = -1;
  }
  for (const Scene<float>& scene : scenes) {
    const Rendered<float> one = render(GetParam(), scene, 1);
    for (const int threads : kSanitized ? std::vector{7} : std::vector{2, 7}) {
      expect_same_bits(render(GetParam(), scene, threads), one);
    }
  }
}

// So many splats that their pairs are placed in several parts.
TEST(ManySplats, ThreadsChangeNoBit) {
  const Footprint& footprint = footprints().front();
  const Scene<float> scene = make_scene<float>(6000, 50, 35);
  const Rendered<float> one = render(footprint, scene, 1);
  EXPECT_GT(std::count_if(one.radii.begin(), one.radii.end(), [](int radius) { return radius > 0; }), 3000);
  for (const int threads : {2, 7}) expect_same_bits(render(footprint, scene, threads), one);
}

// Worst case: float rounds a mean by 4 eps W = 1.6e-5 px, which changes log alpha by at most 3.4/0.3 px
// times that; call it, with the rounding of the covariance (1e-5 q/2), delta = 4e-4. A pixel's colour C
// obeys sum_k |dC/dlog alpha_k| <= 2 max colour, so it moves by at most 2 delta. Where rounding carries
// an alpha across 1/255 or a transmittance across 1e-4, a whole contribution, at most 0.01, comes or
// goes; a share of 2 delta/255 of the (splat, pixel) pairs is that close, less than a pixel in 100.
// Typical: a mean off by 2 eps W before a splat of 1 px, so 8e-6 for the RMS of the image and of the
// gradients; a flip adds 1/255 of one of their thousands of terms. One of S samples changes the pixel by a share of 1/S
// of that, which is why the gradients' flips are counted from 1/S of the bound on.
TEST_P(StagesTest, EveryInstructionSetAgreesWithDouble) {
  const Footprint& f = GetParam();
  const double worst = 2 * 4e-4, typical = 8e-6;
  const auto squares = [](double a, double b) { return a + b * b; };
  const Rendered<double> expected = render(f, make_scene<double>(300, 67, 45));
  const Scene<float> scene = make_scene<float>(300, 67, 45);
  for (const InstructionSet& set : instruction_sets()) {
    if (!set.supported) continue;
    const Rendered<float> actual = run_stages(set.stages(f.index), scene.pass(f.choice()));
    int flips = 0, sample_flips = 0;
    std::vector<double> small, grads;
    for (size_t i = 0; i < actual.image.size(); ++i) {
      const double error = std::abs(actual.image[i] - expected.image[i]);
      ASSERT_LT(error, 0.01 + worst) << set.name << " " << i;
      sample_flips += error > worst / f.samples;
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
    EXPECT_LE(sample_flips, 67 * 45 / 100) << set.name;
    const double bound = typical + sample_flips * 1e-4;
    EXPECT_LT(std::accumulate(grads.begin(), grads.end(), 0.0, squares), bound * bound * size) << set.name;
  }
}

// To ask for the sums of absolute values changes no bit of what is not one.
TEST_P(StagesTest, AbsoluteSumsChangeNoOtherBit) {
  const Scene<float> scene = make_usual_scene<float>(300, 67, 45);
  Pass<float> pass = scene.pass(GetParam().choice());
  const auto& stages = cpu::stages_of<float>(GetParam().index);
  const Rendered<float> with = run_stages(stages, pass);
  pass.absolute = false;
  const Rendered<float> without = run_stages(stages, pass);
  const size_t means2d = 14 * scene.means.size();
  EXPECT_EQ(std::memcmp(with.grads.data(), without.grads.data(), means2d * sizeof(float)), 0);
  for (size_t i = means2d; i < with.grads.size(); ++i) {
    if ((i - means2d) % 4 < 2) {
      ASSERT_EQ(with.grads[i], without.grads[i]);
    } else {
      ASSERT_EQ(without.grads[i], 0);
    }
  }
}

TEST_P(StagesTest, EmptyScenesAndThinImages) {
  const Footprint& f = GetParam();
  const int length = kSanitized ? 400 : 4000;
  for (const auto& [width, height] : {std::pair(1, 1), std::pair(1, length), std::pair(length, 1), std::pair(33, 17)}) {
    for (const bool hidden : {false, true}) {
      Scene<float> scene = make_scene<float>(hidden ? 50 : 0, width, height);
      for (auto& mean : scene.means) mean.z = -1;
      const Rendered<float> out = render(f, scene);
      EXPECT_EQ(out.pairs, 0);
      const int plane = width * height;
      for (int i = 0; i < 3 * plane; ++i) ASSERT_EQ(out.image[i], scene.background[i / plane]);
      for (const float g : out.grads) ASSERT_EQ(g, 0);
      for (const int radius : out.radii) ASSERT_EQ(radius, 0);
    }
    const Scene<double> scene = make_scene<double>(10, width, height);
    const Rendered<double> actual = render(f, scene), expected = render_plainly(f, scene);
    EXPECT_GT(actual.pairs, 0);
    for (size_t i = 0; i < actual.image.size(); ++i) ASSERT_NEAR(actual.image[i], expected.image[i], 1e-13);
  }
}

// footprint_weight is the mean over the samples at opacity 1; its derivatives are with respect to the offset and
// to (xx, xy, yy). The frozen frame's are checked in footprint_test.
TEST_P(StagesTest, WeightAndItsAdjoint) {
  const Footprint& f = GetParam();
  const cpu::Stages<double>& stages = cpu::stages_of<double>(f.index);
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
  cpu::WeightParams<double> p = {};
  p.n = n;
  p.threads = 1;
  p.options = f.options;
  p.offsets = offsets.data();
  p.covs = covs.data();
  p.dL_dweights = ones.data();
  p.weights = weights.data();
  p.dL_doffsets = dL_doffsets.data();
  p.dL_dcovs = dL_dcovs.data();
  stages.weight(p);
  stages.weight_vjp(p);
  for (int64_t i = 0; i < n; i += 50) {
    const double x[5] = {offsets[i].x, offsets[i].y, covs[i].xx, covs[i].xy, covs[i].yy};
    const double grads[5] = {dL_doffsets[i].x, dL_doffsets[i].y, dL_dcovs[i].xx, dL_dcovs[i].xy, dL_dcovs[i].yy};
    for (int k = 0; k < 5; ++k) {
      const auto moved = [&](double t) {
        double y[5];
        for (int j = 0; j < 5; ++j) y[j] = x[j] + (j == k ? t : 0);
        return weight(f, Cov2d<double>{y[2], y[3], y[4], y[2] * y[4] - y[3] * y[3]}, Vec2<double>{y[0], y[1]});
      };
      ASSERT_NEAR(weights[i], moved(0), 1e-14);
      if (f.is_frozen() && k >= 2) continue;
      ASSERT_NEAR(grads[k], derivative(moved, 1e-4), 1e-7) << k;
    }
  }
}

/// L = <dL_dimage, image>, in which no small step may carry an alpha across a threshold: smooth where it does not.
double loss_of(const Rendered<double>& out, const Scene<double>& scene) {
  double loss = std::inner_product(out.image.begin(), out.image.end(), scene.dL_dimage.begin(), 0.0);
  if (!scene.dL_dalpha.empty())
    loss += std::inner_product(out.alpha.begin(), out.alpha.end(), scene.dL_dalpha.begin(), 0.0);
  return loss;
}

// The colour, the depth and its inverse as channels that the projection writes, and a given one before them: every
// gradient by differences. A difference that straddles a threshold of alpha or of transmittance is off by a jump, which
// grows as the step shrinks: two steps that agree straddle none.
TEST(ChannelRows, GradientsMatchDifferences) {
  const Footprint& f = footprint_named("box4");
  Scene<double> scene = make_channel_scene<double>(25, 35, 21, 6);
  std::vector<double> given(25);
  Random random(3);
  for (double& x : given) x = random.normal();
  const auto run = [&] {
    Pass<double> pass = scene.pass(f.choice());
    pass.gaussians.colors = scene.colors.data();
    pass.given = given.data();
    pass.given_count = 1;
    pass.color = 1;
    pass.depth = 4;
    pass.inverse_depth = 5;
    return run_stages(cpu::stages_of<double>(f.index), pass);
  };
  const Rendered<double> actual = run();
  double largest = 0;
  for (size_t i = 0; i < 14 * given.size(); ++i) largest = std::max(largest, std::abs(actual.grads[i]));
  Differences differences;
  const auto compare = [&](double& number, double gradient, const char* name) {
    const double at = number;
    const auto loss_at = [&](double t) {
      number = at + t;
      const double loss = loss_of(run(), scene);
      number = at;
      return loss;
    };
    differences.compare(gradient, loss_at, 1e-8 * largest, 2, name);
  };
  const int n = int(given.size());
  for (int i = 0; i < n; i += kSanitized ? 4 : 1) {  // as in RowsTest
    for (int k = 0; k < 3; ++k) {
      compare((&scene.means[i].x)[k], actual.grads[3 * i + k], "mean");
      compare((&scene.colors[i].x)[k], actual.grads[11 * n + 3 * i + k], "colour");
    }
    compare(scene.opacities[i], actual.grads[10 * n + i], "opacity");
    compare(given[i], actual.dL_dchannels[6 * i], "given channel");
  }
  EXPECT_GT(differences.compared, kSanitized ? 20 : 80);
  EXPECT_GT(differences.smooth, differences.compared * (kSanitized ? 8 : 9) / 10);
}

// A number that is not finite, in any channel, culls what would show it, and nothing else.
TEST(ChannelRows, WhatIsNotFiniteIsCulled) {
  const Footprint& f = footprint_named("box1");
  const Scene<float> scene = make_channel_scene<float>(40, 35, 21, 5);
  const Rendered<float> expected = render(f, scene);
  for (const float bad : {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity(), -2e12f}) {
    for (int c = 0; c < 5; ++c) {
      Scene<float> broken = scene;
      for (int i = 0; i < 40; i += 2) broken.channels[5 * i + c] = bad;
      const Rendered<float> actual = render(f, broken);
      int culled = 0;
      for (int i = 0; i < 40; ++i) {
        if (i % 2) {
          EXPECT_EQ(actual.radii[i], expected.radii[i]);
        } else if (expected.radii[i] != actual.radii[i]) {
          EXPECT_EQ(actual.radii[i], 0);
          ++culled;
        }
      }
      EXPECT_GT(culled, 5);
      for (const float x : actual.image) ASSERT_TRUE(std::isfinite(x));
      for (const float x : actual.grads) ASSERT_TRUE(std::isfinite(x));
    }
  }
}

// Without a gradient of the image and of alpha all of it is zero.
TEST(ChannelRows, MissingGradientsAreZero) {
  const Footprint& f = footprint_named("analytic");
  const Scene<double> scene = make_channel_scene<double>(30, 35, 21, 4);
  Pass<double> pass = scene.pass(f.choice());
  pass.dL_dimage = nullptr;
  Scene<double> zero = scene;
  std::fill(zero.dL_dimage.begin(), zero.dL_dimage.end(), 0.0);
  const auto& stages = cpu::stages_of<double>(f.index);
  EXPECT_EQ(run_stages(stages, pass).grads, run_stages(stages, zero.pass(f.choice())).grads);
  pass.dL_dalpha = nullptr;
  for (const double g : run_stages(stages, pass).grads) EXPECT_EQ(g, 0);
}

/// Public rows of a scene, as project_rows leaves them.
template <typename T> struct Rows {
  std::vector<Vec2<T>> means2d;
  std::vector<Sym2<T>> cov2d;
  std::vector<T> dets, opacities, depths;
  std::vector<Vec3<T>> colors;
  std::vector<int32_t> radii;

  explicit Rows(int64_t n) : means2d(n), cov2d(n), dets(n), opacities(n), depths(n), colors(n), radii(n) {}
  ProjectedRows<T> view() {
    return {means2d.data(), cov2d.data(), dets.data(), opacities.data(), depths.data(), colors.data()};
  }
};

template <typename T> Rows<T> project_rows(const Footprint& f, const Scene<T>& scene) {
  const Pass<T> pass = scene.pass(f.choice());
  Rows<T> rows(pass.gaussians.n);
  cpu::ProjectRowsParams<T> p = {};
  p.camera = pass.camera;
  p.gaussians = pass.gaussians;
  p.footprint = pass.footprint;
  p.bounds = cull_bounds<T>(pass.footprint);
  p.threads = 1;
  static_cast<ProjectedRows<T>&>(p.rows) = rows.view();  // a table
  p.rows.features = &rows.colors[0].x;
  p.rows.stride = 3;
  p.rows.colored = true;
  p.rows.radii = rows.radii.data();
  cpu::stages_of<T>(f.index).of(p.camera).project_rows(p);
  return rows;
}

template <typename T> Lists<T> bin_rows(const Footprint& f, Rows<T>& rows, TileGrid grid) {
  const auto& stages = cpu::stages_of<T>(f.index);
  Lists<T> lists;
  const int64_t n = int64_t(rows.radii.size());
  lists.splats.resize(n * kSplatWidth);
  lists.ids.resize(n);
  std::iota(lists.ids.begin(), lists.ids.end(), 0);
  lists.depths = rows.depths;
  cpu::ShapeRowsParams<T> p = {};
  p.n = n;
  p.rows = rows.view();
  p.footprint = f.choice();
  p.grid = grid;
  p.threads = 1;
  p.splats = lists.splats.data();
  stages.shape_rows(p);
  lists.bin(stages, f.choice(), grid, 1);
  return lists;
}

class RowsTest : public ::testing::TestWithParam<Footprint> {};
AR_ALL_FOOTPRINTS(RowsTest);

/// What row_grads writes.
struct RowGrads {
  std::vector<Vec2<double>> means2d, absolute;
  std::vector<Sym2<double>> cov2d;
  std::vector<double> opacities;

  RowGrads(const Footprint& f, Rows<double>& rows, const Lists<double>& lists, const Sums<double>& sums)
      : means2d(rows.radii.size()), absolute(sums.absolute.empty() ? 0 : means2d.size()) {
    cov2d.resize(means2d.size());
    opacities.resize(means2d.size());
    cpu::RowGradsParams<double> p = {};
    p.pairs = lists.splat_pairs();
    p.n = int64_t(means2d.size());
    p.footprint = f.choice();
    p.threads = 1;
    p.rows = rows.view();
    p.pair_grads = sums.pairs.data();
    p.pair_stride = sums.stride;
    p.pair_means = sums.absolute.data();
    p.dL_dmeans2d = means2d.data();
    p.dL_dcov2d = cov2d.data();
    p.dL_dopacities = opacities.data();
    p.absolute = absolute.data();
    cpu::stages_of<double>(f.index).row_grads(p);
  }
};

/// The whole pass in stages: project_rows, bin, blend and back are the pass in one. The gradient with respect to
/// cov2d is one matrix there and factors here, hence the rounding of needles.
TEST_P(RowsTest, AreThePassInOne) {
  const Footprint& f = GetParam();
  const Scene<double> scene = make_scene<double>(120, 53, 37);
  const TileGrid grid = {53, 37};
  const Rendered<double> expected = render(f, scene);
  Rows<double> rows = project_rows(f, scene);
  EXPECT_EQ(rows.radii, expected.radii);
  for (size_t i = 0; i < rows.radii.size(); ++i) EXPECT_EQ(rows.dets[i] == -1, rows.radii[i] == 0);
  const auto& stages = cpu::stages_of<double>(f.index);
  const Lists<double> lists = bin_rows(f, rows, grid);
  const Channels<double> channels = channels_of<double>(lists, false, &rows.colors[0].x, 3, false);
  const Image<double> image = blend(stages, lists, grid, channels, scene.background.data(), 1);
  EXPECT_EQ(image.image, expected.image);
  const int64_t n = int64_t(scene.means.size());
  const Sums<double> sums = blend_vjp<double>(stages, lists, grid, channels, false, n, image, scene.background.data(),
                                              scene.dL_dimage.data(), nullptr, true, 1);
  const RowGrads by_row(f, rows, lists, sums);
  const std::vector<double> dL_ddepths(n);
  std::vector<int32_t> row_of(n);
  for (int64_t i = 0; i < n; ++i) row_of[i] = rows.radii[i] > 0 ? int32_t(i) : -1;
  GradArrays<double> grads(scene.gaussians());
  cpu::ProjectRowsVjpParams<double> vjp = {};
  vjp.camera = scene.camera.camera_view();
  vjp.gaussians = scene.gaussians();
  vjp.grads = grads.views;
  vjp.threads = 1;
  vjp.rows = {{row_of.data()},     by_row.means2d.data(),
              by_row.cov2d.data(), by_row.opacities.data(),
              dL_ddepths.data(),   reinterpret_cast<const Vec3<double>*>(sums.dL_dchannels.data())};
  stages.plain.project_rows_vjp(vjp);
  double largest = 0;
  for (const double g : expected.grads) largest = std::max(largest, std::abs(g));
  for (int64_t i = 0; i < 14 * n; ++i)
    ASSERT_NEAR(grads.all[i], expected.grads[i], 1e-7 * std::abs(expected.grads[i]) + 1e-9 * largest) << i;
  for (int64_t i = 0; i < n; ++i) {
    for (int k = 0; k < 2; ++k) {
      ASSERT_NEAR(grads.views.means2d[4 * i + k], expected.grads[14 * n + 4 * i + k], 1e-12 * largest);
      ASSERT_NEAR((&by_row.absolute[i].x)[k] * (k ? 37 : 53) / 2, expected.grads[14 * n + 4 * i + 2 + k],
                  1e-12 * largest);
    }
  }
}

/// L = <dL_dimage, image> from rows, with the determinant of cov2d.
struct RowsLoss {
  const Footprint& f;
  const Scene<double>& scene;
  TileGrid grid;

  double operator()(Rows<double> rows) const {
    const auto& stages = cpu::stages_of<double>(f.index);
    const Lists<double> lists = bin_rows(f, rows, grid);
    const auto image =
        blend(stages, lists, grid, channels_of<double>(lists, true, nullptr, 3, false), scene.background.data(), 1);
    return std::inner_product(image.image.begin(), image.image.end(), scene.dL_dimage.begin(), 0.0);
  }
};

// row_grads by differences: with respect to means2d, cov2d (its determinant with it) and opacities.
TEST_P(RowsTest, GradientsMatchDifferences) {
  const Footprint& f = GetParam();
  const Scene<double> scene = make_scene<double>(16, 19, 18);
  const RowsLoss loss = {f, scene, {19, 18}};
  Rows<double> rows = project_rows(f, scene);
  const int64_t n = int64_t(rows.radii.size());
  for (int64_t i = 0; i < n; ++i) {
    if (rows.radii[i] == 0) rows.opacities[i] = 0, rows.depths[i] = 0;
    const Sym2<double> c = rows.cov2d[i];
    rows.dets[i] = c.xx * c.yy - c.xy * c.xy;
  }
  const auto& stages = cpu::stages_of<double>(f.index);
  const Lists<double> lists = bin_rows(f, rows, loss.grid);
  const auto channels = channels_of<double>(lists, true, nullptr, 3, false);
  const auto image = blend(stages, lists, loss.grid, channels, scene.background.data(), 1);
  const Sums<double> sums = blend_vjp<double>(stages, lists, loss.grid, channels, true, n, image,
                                              scene.background.data(), scene.dL_dimage.data(), nullptr, false, 1);
  const RowGrads by_row(f, rows, lists, sums);
  Differences differences;
  const auto compare = [&](int64_t i, double& number, double gradient, const char* name) {
    const double at = number;
    const auto loss_at = [&](double t) {
      number = at + t;
      const Sym2<double> c = rows.cov2d[i];
      const double det = std::exchange(rows.dets[i], c.xx * c.yy - c.xy * c.xy), value = loss(rows);
      number = at;
      rows.dets[i] = det;
      return value;
    };
    differences.compare(gradient, loss_at, 1e-7, 4, name + (" " + std::to_string(i)));
  };
  // Every difference renders the same scene: under sanitizers that of a few Gaussians.
  for (int64_t i = 0; i < n; i += kSanitized ? 4 : 1) {
    compare(i, rows.means2d[i].x, by_row.means2d[i].x, "mean2d");
    compare(i, rows.means2d[i].y, by_row.means2d[i].y, "mean2d");
    compare(i, rows.opacities[i], by_row.opacities[i], "opacity");
    if (f.is_frozen()) continue;  // not the formula's derivative
    compare(i, rows.cov2d[i].xx, by_row.cov2d[i].xx, "cov2d xx");
    compare(i, rows.cov2d[i].xy, by_row.cov2d[i].xy, "cov2d xy");
    compare(i, rows.cov2d[i].yy, by_row.cov2d[i].yy, "cov2d yy");
  }
  EXPECT_GT(differences.compared, kSanitized ? 3 : 15);  // of so few the share that is smooth varies
  EXPECT_GT(differences.smooth, differences.compared * (kSanitized ? 5 : 8) / 10);
}

// Rows of any numbers make splats that touch no tile or that blend finitely.
TEST_P(RowsTest, AnyNumbersAreSafe) {
  const Footprint& f = GetParam();
  const float inf = std::numeric_limits<float>::infinity(), nan = std::numeric_limits<float>::quiet_NaN();
  const Scene<float> scene = make_scene<float>(60, 35, 21);
  const TileGrid grid = {35, 21};
  const auto& stages = cpu::stages_of<float>(f.index);
  for (const float bad : {nan, inf, -inf, -1.0f, 1e30f}) {
    for (int member = 0; member < 7; ++member) {
      Rows<float> rows = project_rows(f, scene);
      const auto spoil = [&](int i) -> float& {
        switch (member) {
          case 0:
            return rows.means2d[i].x;
          case 1:
            return rows.cov2d[i].xx;
          case 2:
            return rows.cov2d[i].yy;
          case 3:
            return rows.dets[i];
          case 4:
            return rows.opacities[i];
          case 5:
            return rows.depths[i];
          default:
            return rows.colors[i].y;
        }
      };
      for (int i = 0; i < 60; i += 3) spoil(i) = bad;
      for (int i = 0; i < 60; ++i) {
        if (rows.radii[i] == 0) rows.dets[i] = nan;
      }
      const Lists<float> lists = bin_rows(f, rows, grid);
      const auto image =
          blend(stages, lists, grid, channels_of<float>(lists, true, nullptr, 3, false), scene.background.data(), 1);
      for (const float x : image.image) ASSERT_TRUE(std::isfinite(x)) << member << " " << bad;
      // A mean of -1, a colour below zero and any depth that has an order are numbers like others.
      if (!(bad == -1 && (member == 0 || member == 6)) && !(bad > 0 && member == 5)) {
        for (int i = 0; i < 60; i += 3)
          ASSERT_EQ(lists.splat_offsets[i], lists.splat_offsets[i + 1]) << member << " " << bad;
      }
    }
  }
}

}  // namespace
}  // namespace ar::test
