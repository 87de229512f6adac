// The kernels of packed rows, run on the host: they make what those of separate rows make, bit for bit.
#include <random>

#include "cuda_on_host.h"
// After it: kernels.
#include <gtest/gtest.h>

#include "cuda/project/project.cuh"
#include "cuda/project/project_vjp.cuh"

namespace ar::cuda {
namespace {

constexpr int kCount = 3 * ProjectPolicy::kThreads + 21, kBlocks = 4, kCoefficients = 4, kDegree = 1;
using Cam = Camera<float>;

std::vector<float> random_numbers(size_t count, float low, float high, int seed) {
  std::mt19937 bits(seed);
  std::vector<float> numbers(count);
  for (float& x : numbers) x = std::uniform_real_distribution<float>(low, high)(bits);
  return numbers;
}
template <class V> V* as(std::vector<float>& numbers) { return reinterpret_cast<V*>(numbers.data()); }
template <class V> bool same(const std::vector<V>& a, const std::vector<V>& b) {
  return a.size() == b.size() && std::memcmp(a.data(), b.data(), a.size() * sizeof(V)) == 0;
}

/// Gaussians around and beside what a camera sees.
struct Scene {
  std::vector<float> means = random_numbers(3 * kCount, -3, 3, 1), scales = random_numbers(3 * kCount, 0.02f, 0.2f, 2);
  std::vector<float> rotations = random_numbers(4 * kCount, -1, 1, 3), opacities = random_numbers(kCount, 0.1f, 1, 4);
  std::vector<float> shs = random_numbers(3 * kCoefficients * kCount, -1, 1, 5);
  std::vector<float> view = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0.1f, 0.2f, 4, 1};
  std::vector<float> proj = {2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1, 1, 0.2f, 0.4f, 3.99f, 4}, position = {-0.1f, -0.2f, -4};
  CameraView<float> camera = {view.data(), proj.data(), position.data(), 40, 30, 0.5f, 0.5f};
  FootprintChoice footprint = {};

  Scene() {
    shs[3 * kCoefficients * 7] = NAN;  // of Gaussians that are seen, below
    means[3 * 7] = means[3 * 7 + 1] = means[3 * 7 + 2] = 0;
  }
  Gaussians<float> gaussians() {
    Gaussians<float> g = {};
    g.n = kCount;
    g.means = as<Vec3<float>>(means);
    g.scales = as<Vec3<float>>(scales);
    g.rotations = as<Vec4<float>>(rotations);
    g.opacities = opacities.data();
    g.shs = as<Vec3<float>>(shs);
    g.sh_stride = kCoefficients;
    g.sh_degree = kDegree;
    g.scale_modifier = 1;
    return g;
  }
  ProjectRowsParams params() {
    ProjectRowsParams p = {};
    p.camera = camera;
    p.gaussians = gaussians();
    p.footprint = footprint;
    p.bounds = cull_bounds<float>(footprint);
    return p;
  }
};

/// ProjectedRows, or gradients with respect to them.
struct Rows {
  std::vector<float> means2d, cov2d, dets, opacities, depths, colors;
  explicit Rows(size_t n) : means2d(2 * n), cov2d(3 * n), dets(n), opacities(n), depths(n), colors(3 * n) {}
  ProjectedRows<float> view() {
    return {as<Vec2<float>>(means2d), as<Sym2<float>>(cov2d), dets.data(),
            opacities.data(),         depths.data(),          as<Vec3<float>>(colors)};
  }
};

void project(const ProjectRowsParams& p) {
  cuda_on_host::launch(kBlocks, ProjectPolicy::kThreads, [&] { project_rows_kernel<Cam>(p); });
}

/// Packed rows, as they are counted and written, behind a place that is left for others.
struct Packed {
  std::vector<int32_t> ends, radii, ids;
  std::vector<float> rows;
  int count = 0;

  explicit Packed(Scene& scene) : ends(kCount) {
    ProjectRowsParams p = scene.params();
    std::vector<int32_t> seen(kCount, -1);
    p.flags = seen.data();
    project(p);
    for (int i = 0; i < kCount; ++i) ends[i] = count += seen[i] > 0;
    const int64_t first = 1;
    rows.assign(kPackedWidth * (count + 1), -7);
    radii.assign(count + 1, -7);
    ids.assign(count + 1, -7);
    p.flags = nullptr;
    p.packed = {as<PackedRow<float>>(rows), count, &first, ends.data(), radii.data(), ids.data(), 1000};
    project(p);  // without room for the last one
    EXPECT_EQ(ids.back(), -7);
    p.packed.room = count + 1;
    project(p);
    EXPECT_EQ(ids[0], -7);
    rows.erase(rows.begin(), rows.begin() + kPackedWidth);
    radii.erase(radii.begin());
    ids.erase(ids.begin());
  }
};

TEST(PackedKernels, RowsAreThoseOfSeparateColumns) {
  Scene scene;
  Rows rows(kCount);
  std::vector<int32_t> radii(kCount);
  ProjectRowsParams p = scene.params();
  static_cast<ProjectedRows<float>&>(p.rows) = rows.view();  // a table
  p.rows.features = rows.colors.data();
  p.rows.stride = 3;
  p.rows.colored = true;
  p.rows.radii = radii.data();
  project(p);
  Packed packed(scene);
  ASSERT_GT(packed.count, kCount / 10);
  ASSERT_LT(packed.count, kCount);
  int place = 0;
  for (int i = 0; i < kCount; ++i) {
    const bool not_finite = i == 7;
    if (radii[i] == 0 && !not_finite) continue;
    const PackedRow<float>& row = as<PackedRow<float>>(packed.rows)[place];
    EXPECT_EQ(row.id, 1000 + i);
    EXPECT_EQ(packed.ids[place], i);
    EXPECT_EQ(packed.radii[place], not_finite ? 0 : radii[i]);
    if (not_finite) {
      EXPECT_LT(row.det, 0);
    } else {
      const float expected[] = {
          rows.means2d[2 * i],    rows.means2d[2 * i + 1], rows.cov2d[3 * i], rows.cov2d[3 * i + 1],
          rows.cov2d[3 * i + 2],  rows.opacities[i],       rows.depths[i],    rows.colors[3 * i],
          rows.colors[3 * i + 1], rows.colors[3 * i + 2],  rows.dets[i]};
      EXPECT_EQ(std::memcmp(&row, expected, sizeof expected), 0) << i;
    }
    ++place;
  }
  EXPECT_EQ(place, packed.count);
}

TEST(PackedKernels, SplatsAreThoseOfSeparateColumns) {
  Scene scene;
  Packed packed(scene);
  const int n = packed.count;
  Rows rows(n);
  for (int i = 0; i < n; ++i) {
    const PackedRow<float>& row = as<PackedRow<float>>(packed.rows)[i];
    const ProjectedRows<float> to = rows.view();
    to.means2d[i] = row.mean, to.cov2d[i] = row.cov, to.dets[i] = row.det, to.opacities[i] = row.opacity;
    to.depths[i] = row.depth, to.colors[i] = row.color;
  }
  std::vector<float> splats[2], covs(4 * n), opacities(n);
  std::vector<uint32_t> keys[2];
  std::vector<PairRange> ranges[2];
  std::vector<SplatTiles> tiles[2];
  for (int k = 0; k < 2; ++k) {
    splats[k].resize(kSplatWidth * n);
    keys[k].resize(n);
    ranges[k].resize(n);
    tiles[k].resize(n);
    ShapeRowsParams p = {};
    p.n = n;
    p.footprint = scene.footprint;
    p.grid = {scene.camera.width, scene.camera.height};
    p.splats = splats[k].data();
    p.keys = keys[k].data();
    p.ranges = ranges[k].data();
    p.tiles = tiles[k].data();
    Counts counts = {7, 7};
    std::vector<uint32_t> histograms(kDepthHistogramWords + 1, 7);
    p.counts = &counts;
    p.depth_histograms = histograms.data();
    if (k == 0) {
      p.rows = rows.view();
    } else {
      p.packed = as<PackedRow<float>>(packed.rows);
      p.kept_covs = covs.data();
      p.kept_opacities = opacities.data();
    }
    cuda_on_host::launch(kBlocks, ProjectPolicy::kThreads, [&] { shape_rows_kernel(p); });
    EXPECT_EQ(counts.pairs, 0);
    EXPECT_EQ(counts.splats, 0);
    EXPECT_EQ(histograms.back(), 7u);
    histograms.pop_back();
    EXPECT_EQ(histograms, std::vector<uint32_t>(kDepthHistogramWords));
  }
  EXPECT_TRUE(same(splats[0], splats[1]));
  EXPECT_TRUE(same(keys[0], keys[1]));
  EXPECT_EQ(std::memcmp(ranges[0].data(), ranges[1].data(), n * sizeof(PairRange)), 0);
  EXPECT_EQ(std::memcmp(tiles[0].data(), tiles[1].data(), n * sizeof(SplatTiles)), 0);
  EXPECT_TRUE(same(opacities, rows.opacities));
  for (int i = 0; i < n; ++i) {
    EXPECT_EQ(covs[4 * i + 1], rows.cov2d[3 * i + 1]);
    EXPECT_EQ(covs[4 * i + 3], rows.dets[i]);
  }
}

TEST(PackedKernels, GradientsOfRowsAreThoseOfSeparateColumns) {
  constexpr int kRows = ProjectPolicy::kThreads + 37, kPairs = 3;
  Rows rows(kRows), expected(kRows);
  rows.cov2d = random_numbers(3 * kRows, 1, 2, 1);
  rows.opacities = random_numbers(kRows, 0.1f, 1, 2);
  std::vector<float> covs, absolute(2 * kRows), pairs = random_numbers(kPairs * kRows * kPairGradWidth, -1, 1, 3);
  std::vector<PairRange> ranges;
  for (int i = 0; i < kRows; ++i) {
    float* cov = &rows.cov2d[3 * i];
    cov[1] -= 1.5f;
    rows.dets[i] = cov[0] * cov[2] - cov[1] * cov[1];
    covs.insert(covs.end(), {cov[0], cov[1], cov[2], rows.dets[i]});
    ranges.push_back({i * kPairs, i % 5 == 0 ? 0 : kPairs});
  }
  Counts counts = {kPairs * kRows, kRows};
  RowGradsParams p = {};
  p.n = kRows;
  p.sums = {kRows, ranges.data(), &counts, kPairs * kRows, pairs.data()};
  const auto run = [&] { cuda_on_host::launch(2, ProjectPolicy::kThreads, [&] { row_grads_kernel(p); }); };
  p.rows = rows.view();
  const ProjectedRows<float> to = expected.view();
  p.dL_dmeans2d = to.means2d, p.dL_dcov2d = to.cov2d, p.dL_dopacities = to.opacities;
  p.absolute = as<Vec2<float>>(absolute);
  run();
  p = RowGradsParams{{kRows}, p.sums};
  p.kept_covs = covs.data();
  p.kept_opacities = rows.opacities.data();
  for (const int width : {kPackedGradWidth, kPackedGradWidthAbsolute}) {
    std::vector<float> packed(width * kRows + 1, -7);
    p.packed = packed.data();
    p.packed_width = width;
    run();
    EXPECT_EQ(packed.back(), -7);
    for (int i = 0; i < kRows; ++i) {
      const float* row = &packed[width * i];
      EXPECT_EQ(std::memcmp(row + kPackedMean, &expected.means2d[2 * i], 2 * sizeof(float)), 0) << i;
      EXPECT_EQ(std::memcmp(row + kPackedCov, &expected.cov2d[3 * i], 3 * sizeof(float)), 0) << i;
      EXPECT_EQ(row[kPackedOpacity], expected.opacities[i]);
      if (width == kPackedGradWidthAbsolute) {
        EXPECT_EQ(std::memcmp(row + kPackedAbsolute, &absolute[2 * i], 2 * sizeof(float)), 0) << i;
      }
      for (int c = 0; c < 3; ++c) {
        float sum = 0;
        for (int k = 0; k < ranges[i].count; ++k) sum += pairs[(i * kPairs + k) * kPairGradWidth + kPairChannels + c];
        EXPECT_EQ(row[kPackedColor + c], sum);
      }
    }
  }
}

/// Gradients with respect to the Gaussians of a scene.
struct Gradients {
  std::vector<float> means = fresh(3), scales = fresh(3), rotations = fresh(4), opacities = fresh(1);
  std::vector<float> shs = fresh(3 * kCoefficients);
  static std::vector<float> fresh(int width) { return std::vector<float>(width * kCount, -7); }
  std::vector<std::vector<float>*> all() { return {&means, &scales, &rotations, &opacities, &shs}; }
  GaussianGrads<float> view() {
    GaussianGrads<float> out = {};
    out.means = as<Vec3<float>>(means);
    out.scales = as<Vec3<float>>(scales);
    out.rotations = as<Vec4<float>>(rotations);
    out.opacities = opacities.data();
    out.shs = as<Vec3<float>>(shs);
    return out;
  }
};

TEST(PackedKernels, GradientsOfCamerasAreAdded) {
  Scene scene;
  Packed packed(scene);
  const int n = packed.count;
  std::vector<float> rows = random_numbers(kPackedGradWidth * n, -1, 1, 9);
  std::fill_n(rows.data() + 3 * kPackedGradWidth, kPackedGradWidth, 0.0f);
  std::vector<int32_t> places(kCount, -1), others(kCount, -1);
  for (int j = 0; j < n; ++j) places[packed.ids[j]] = j;
  for (int j = 0; j < n; j += 3) others[packed.ids[j]] = n - 1 - j;  // of another camera, which sees fewer
  const int broken = 7;                                              // whose colour is none
  std::fill_n(rows.data() + kPackedGradWidth * places[broken], kPackedGradWidth, 0.0f);
  others[broken] = -1;
  ProjectRowsVjpParams p = {};
  p.camera = scene.camera;
  p.gaussians = scene.gaussians();
  const auto column = [&](int first) { return rows.data() + first; };
  const int64_t stride = kPackedGradWidth * sizeof(float);
  p.rows.means2d = {reinterpret_cast<const Vec2<float>*>(column(kPackedMean)), stride};
  p.rows.cov2d = {reinterpret_cast<const Sym2<float>*>(column(kPackedCov)), stride};
  p.rows.opacities = {column(kPackedOpacity), stride};
  p.rows.colors = {reinterpret_cast<const Vec3<float>*>(column(kPackedColor)), stride};
  Gradients one, other, sum;
  const auto run = [&](Gradients& to, const std::vector<int32_t>& of_rows, bool add) {
    p.grads = to.view();
    p.rows.places.rows = of_rows.data();
    cuda_on_host::launch(kBlocks, ProjectPolicy::kThreads, [&] {
      add ? project_vjp_kernel<Cam, FromRows, StagedGrads>(p) : project_vjp_kernel<Cam, FromRows>(p);
    });
  };
  run(one, places, false);
  run(other, others, false);
  run(sum, places, false);
  run(sum, others, true);
  for (size_t k = 0; k < one.all().size(); ++k) {
    const std::vector<float>&a = *one.all()[k], &b = *other.all()[k], &c = *sum.all()[k];
    float largest = 0;
    for (size_t i = 0; i < a.size(); ++i) {
      ASSERT_EQ(c[i], a[i] + b[i]) << k << " " << i;
      largest = std::max(largest, std::abs(b[i]));
    }
    EXPECT_GT(largest, 0);
    const size_t width = a.size() / kCount;
    for (size_t i = width * broken; i < width * (broken + 1); ++i) EXPECT_EQ(c[i], 0);
  }
}

}  // namespace
}  // namespace ar::cuda
