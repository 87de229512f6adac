// The kernels of project and project_vjp, run on the host: for rows of visible and culled Gaussians, whatever they are
// made of, they write what the core's functions give one Gaussian after the other, to the bit.
#include <random>

#include "cuda_on_host.h"
// After it: kernels.
#include <gtest/gtest.h>

#include "cuda/project/project.cuh"
#include "cuda/project/project_vjp.cuh"

namespace ar::cuda {
namespace {

constexpr int kWidth = 64, kHeight = 48;
/// Two blocks; the last warp is not full.
constexpr int kCount = ProjectPolicy::kThreads + 50;

struct Case {
  const char* name;
  int sh_degree, sh_stride;  ///< stride 0: colours instead
  bool cov3ds, more_pairs_than_room;
};

struct Numbers {
  std::mt19937 bits{5};
  float uniform(float low, float high) { return std::uniform_real_distribution<float>(low, high)(bits); }
  std::vector<float> uniform(size_t count, float low, float high) {
    std::vector<float> out(count);
    for (float& x : out) x = uniform(low, high);
    return out;
  }
};

/// Gradients of every kind, NaN where nothing is written.
struct Outputs {
  std::vector<float> means, scales, rotations, cov3ds, opacities, shs, colors, means2d;
  GaussianGrads<float> grads = {};

  explicit Outputs(const Gaussians<float>& g) {
    const auto make = [&](std::vector<float>& numbers, int width, bool wanted) -> float* {
      numbers.assign(wanted ? size_t(kCount) * width : 0, NAN);
      return wanted ? numbers.data() : nullptr;
    };
    grads.means = reinterpret_cast<Vec3<float>*>(make(means, 3, true));
    grads.scales = reinterpret_cast<Vec3<float>*>(make(scales, 3, !g.cov3ds));
    grads.rotations = reinterpret_cast<Vec4<float>*>(make(rotations, 4, !g.cov3ds));
    grads.cov3ds = reinterpret_cast<Sym3<float>*>(make(cov3ds, 6, g.cov3ds));
    grads.opacities = make(opacities, 1, true);
    grads.shs = reinterpret_cast<Vec3<float>*>(make(shs, 3 * g.sh_stride, g.shs));
    grads.colors = reinterpret_cast<Vec3<float>*>(make(colors, 3, g.colors));
    grads.means2d = make(means2d, 4, true);
    grads.means2d_stride = 4;
    grads.mean_sums = MeanSums::kAbsolute;
  }
};

void expect_same_bits(const std::vector<float>& a, const std::vector<float>& b, const char* what) {
  ASSERT_EQ(a.size(), b.size());
  for (size_t k = 0; k < a.size(); ++k) {
    ASSERT_TRUE(std::isfinite(b[k])) << what << " " << k;
    ASSERT_EQ(__float_as_int(a[k]), __float_as_int(b[k])) << what << " " << k << ": " << a[k] << ", " << b[k];
  }
}

/// Gaussians in front of a camera, as a case wants them.
class Scene {
 public:
  Scene(const Case& c, Numbers& numbers)
      : means_(numbers.uniform(3 * kCount, -1, 1)),
        scales_(numbers.uniform(3 * kCount, 0.02f, 0.3f)),
        rotations_(numbers.uniform(4 * kCount, -1, 1)),
        opacities_(numbers.uniform(kCount, 0.1f, 0.9f)),
        shs_(numbers.uniform(size_t(3) * c.sh_stride * kCount, -1, 1)),
        colors_(numbers.uniform(3 * kCount, 0, 1)) {
    for (int i = 0; i < kCount; ++i) {
      const float a = scales_[3 * i], b = scales_[3 * i + 1], d = scales_[3 * i + 2];
      cov3ds_.push_back({a, 0.3f * std::min(a, b), 0, b, 0.2f * std::min(b, d), d});
    }
    g.n = kCount;
    g.means = reinterpret_cast<const Vec3<float>*>(means_.data());
    if (c.cov3ds) {
      g.cov3ds = cov3ds_.data();
    } else {
      g.scales = reinterpret_cast<const Vec3<float>*>(scales_.data());
      g.rotations = reinterpret_cast<const Vec4<float>*>(rotations_.data());
    }
    g.opacities = opacities_.data();
    if (c.sh_stride > 0) {
      g.shs = reinterpret_cast<const Vec3<float>*>(shs_.data());
    } else {
      g.colors = reinterpret_cast<const Vec3<float>*>(colors_.data());
    }
    g.sh_stride = c.sh_stride;
    g.sh_degree = c.sh_degree;
    g.scale_modifier = 1.5f;
  }

  Gaussians<float> g = {};
  CameraView<float> camera = {kView, kProj, kPosition, kWidth, kHeight, 1 / 1.5f, 0.5f};

 private:
  static constexpr float kView[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0.1f, -0.2f, 4, 1};
  static constexpr float kProj[16] = {1.5f, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1, 1, 0.15f, -0.4f, 4, 4};
  static constexpr float kPosition[3] = {-0.1f, 0.2f, -4};
  std::vector<float> means_, scales_, rotations_, opacities_, shs_, colors_;
  std::vector<Sym3<float>> cov3ds_;
};

class ProjectKernel : public testing::TestWithParam<Case> {};

TEST_P(ProjectKernel, WritesWhatTheCoreGives) {
  Numbers numbers;
  const Scene scene(GetParam(), numbers);
  const Gaussians<float>& g = scene.g;
  ProjectParams p = {};
  p.camera = scene.camera;
  p.gaussians = g;
  p.footprint.index = find_footprint("box1");
  // From closer by, so that some Gaussians touch no tile or are culled.
  constexpr float kZoom = 5;
  float proj[16];
  for (int k = 0; k < 16; ++k) proj[k] = scene.camera.proj[k] * (k % 4 < 2 ? kZoom : 1);
  p.camera.proj = proj;
  p.camera.tan_half_fov_x /= kZoom;
  p.camera.tan_half_fov_y /= kZoom;
  p.grid = {kWidth, kHeight};
  p.bounds = cull_bounds<float>(p.footprint);
  std::vector<SplatRow<float>> splats(kCount);
  std::vector<int32_t> radii(kCount, -1);
  std::vector<uint32_t> keys(kCount), histograms(kDepthHistogramWords, 7);
  std::vector<PairRange> ranges(kCount, {-1, -1});
  std::vector<SplatTiles> tiles(kCount);
  Counts counts = {5, 5};
  p.splats = &splats[0].mean.x;
  p.radii = radii.data();
  p.keys = keys.data();
  p.ranges = ranges.data();
  p.tiles = tiles.data();
  p.counts = &counts;
  p.depth_histograms = histograms.data();
  // A single block, which takes all Gaussians in turns.
  cuda_on_host::launch(1, ProjectPolicy::kThreads, [&] { project_kernel<Camera<float>>(p); });
  EXPECT_EQ(histograms, std::vector<uint32_t>(histograms.size()));
  EXPECT_EQ(counts.pairs + counts.splats, 0);

  const Camera<float> camera = load_camera(p.camera);
  int shown = 0;
  for (int i = 0; i < kCount; ++i) {
    SplatRow<float> splat = {};
    float depth = 0;
    const int radius = ar::project(camera, g, i, p.footprint, splat, depth);
    ASSERT_EQ(radii[i], radius) << i;
    if (radius > 0) ASSERT_EQ(std::memcmp(&splats[i], &splat, sizeof splat), 0) << i;
    const bool lit = splat.level > 0;
    const SplatTiles expected = lit ? splat_tiles_of(support_of(splat, p.footprint.index), p.grid) : SplatTiles{};
    shown += expected.count > 0;
    ASSERT_EQ(ranges[i].count, expected.count) << i;
    ASSERT_EQ(keys[i], expected.count > 0 ? depth_key(depth) : kCulledKey) << i;
    if (expected.count > 0) ASSERT_EQ(std::memcmp(&tiles[i], &expected, sizeof expected), 0) << i;
  }
  EXPECT_GT(shown, kCount / 10);
  EXPECT_LT(shown, kCount);
}

class ProjectVjpKernel : public testing::TestWithParam<Case> {};

TEST_P(ProjectVjpKernel, WritesWhatTheCoreGives) {
  const Case c = GetParam();
  Numbers numbers;
  const Scene scene(c, numbers);
  const Gaussians<float>& g = scene.g;

  // A third of the Gaussians have no pairs, and none of the second warp; one has so many that its warp sums them.
  std::vector<PairRange> ranges;
  int pairs = 0;
  for (int i = 0; i < kCount; ++i) {
    const bool seen = i / 32 != 1 && numbers.bits() % 3 > 0;
    const int count = i == 40 + 60 ? ProjectPolicy::kManyPairs + 11 : seen ? 1 + int(numbers.bits() % 9) : 0;
    ranges.push_back({pairs, count});
    pairs += count;
  }
  // Multiples of 1/64, whose sums are exact in whatever order.
  std::vector<float> pair_grads(size_t(std::max(pairs, kCount)) * kPairGradWidth);
  for (float& x : pair_grads) x = std::round(numbers.uniform(-64, 64)) / 64;
  const Counts counts = {pairs, kCount};

  ProjectVjpParams p = {};
  p.camera = scene.camera;
  p.gaussians = g;
  p.sums = {kCount, ranges.data(), &counts, c.more_pairs_than_room ? 1 : pairs, pair_grads.data()};
  const Outputs results(g), expected(g);
  p.grads = results.grads;
  cuda_on_host::launch((kCount + ProjectPolicy::kThreads - 1) / ProjectPolicy::kThreads, ProjectPolicy::kThreads,
                       [&] { project_vjp_kernel<Camera<float>>(p); });
  // What project_vjp leaves out, and only that: one block, which goes on to the last warps.
  Outputs zeros(g);
  const auto zero = [&](const Outputs& out) {
    const ZeroGradsParams to_zero = {g, out.grads, ranges.data()};
    cuda_on_host::launch(1, ProjectPolicy::kZeroThreads, [&] { zero_culled_grads_kernel(to_zero); });
  };
  zero(zeros);
  for (int i = 0; i < kCount; ++i) {
    ASSERT_EQ(std::isnan(results.means[3 * i]), i / 32 == 1) << i;
    ASSERT_EQ(std::isnan(zeros.means[3 * i]), i / 32 != 1) << i;
  }
  zero(results);

  const Camera<float> camera = load_camera(p.camera);
  for (int i = 0; i < kCount; ++i) {
    if (ranges[i].count == 0) {
      zero_grads(g, i, expected.grads);
      continue;
    }
    SplatSums sums = {};
    const int first = c.more_pairs_than_room ? i : ranges[i].first, rows = c.more_pairs_than_room ? 1 : ranges[i].count;
    for (int k = 0; k < rows * kPairGradWidth; ++k)
      sums.value[k % kPairGradWidth] += pair_grads[first * kPairGradWidth + k];
    const auto grad_of = [&](const Cov2d<float>& cov, float) { return projected_grad(p.footprint, cov, sums.grad()); };
    ar::project_vjp(camera, g, i, grad_of, ShownGrad<float>{sums.color(), 0}, g.shs ? g.shs + i * g.sh_stride : nullptr,
                    g.shs ? expected.grads.shs + i * g.sh_stride : nullptr, expected.grads);
    write_mean_sums(expected.grads, i, camera.size, sums.mean_sums());
  }
  expect_same_bits(results.means, expected.means, "means");
  expect_same_bits(results.scales, expected.scales, "scales");
  expect_same_bits(results.rotations, expected.rotations, "rotations");
  expect_same_bits(results.cov3ds, expected.cov3ds, "cov3ds");
  expect_same_bits(results.opacities, expected.opacities, "opacities");
  expect_same_bits(results.shs, expected.shs, "shs");
  expect_same_bits(results.colors, expected.colors, "colors");
  expect_same_bits(results.means2d, expected.means2d, "means2d");
}

/// More groups of 32 Gaussians than there are warps, of which the view shows a third.
TEST(ZeroCulledGrads, GoesThroughAllGroups) {
  for (const int n : {1, 31, 130, 32 * 4 * 4, 32 * 4 * 9 + 7, 32 * 4 * 13 - 32}) {
    Numbers numbers;
    std::vector<PairRange> ranges(n);
    for (int i = 0; i < n; ++i) ranges[i].count = i / 32 % 3 == 1 && numbers.bits() % 9 == 0;
    std::vector<float> opacities(n, 7);
    ZeroGradsParams p = {};
    p.gaussians.n = n;
    p.grads.opacities = opacities.data();
    p.ranges = ranges.data();
    cuda_on_host::launch(1, ProjectPolicy::kZeroThreads, [&] { zero_culled_grads_kernel(p); });
    for (int i = 0; i < n; ++i) {
      const auto begin = ranges.begin() + i / 32 * 32, end = ranges.begin() + std::min(n, i / 32 * 32 + 32);
      const bool shown = std::any_of(begin, end, [](PairRange r) { return r.count > 0; });
      ASSERT_EQ(opacities[i], shown ? 7 : 0) << i << " of " << n;
    }
  }
}

constexpr auto kName = [](const testing::TestParamInfo<Case>& info) { return info.param.name; };

INSTANTIATE_TEST_SUITE_P(Of, ProjectKernel,
                         testing::Values(Case{"Degree3", 3, 16, false, false}, Case{"Degree1", 1, 4, false, false},
                                         Case{"Cov3ds", 3, 16, true, false}, Case{"Colors", 0, 0, false, false}),
                         kName);
INSTANTIATE_TEST_SUITE_P(Of, ProjectVjpKernel,
                         testing::Values(Case{"Degree3", 3, 16, false, false},
                                         Case{"Degree2OfRoomFor3", 2, 16, false, false},
                                         Case{"Degree1", 1, 4, false, false}, Case{"LongRows", 3, 20, false, false},
                                         Case{"Cov3ds", 3, 16, true, false}, Case{"Colors", 0, 0, false, false},
                                         Case{"TooManyPairs", 3, 16, false, true}),
                         kName);

}  // namespace
}  // namespace ar::cuda
