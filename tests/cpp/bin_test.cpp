// Extents of support ellipses and the tiles they touch, against searches over pixels and rectangles.
#include <algorithm>

#include "core/bin.h"
#include "support.h"

namespace ar::test {
namespace {

/// Whitened square distance of an offset.
double square(const Mat2<double>& w, double x, double y) {
  const Vec2<double> z = transform(w, Vec2<double>{x, y});
  return z.x * z.x + z.y * z.y;
}

/// Least square() over a rectangle of offsets: zero inside, else on an edge, where it is a parabola.
double least_in(const Mat2<double>& w, Vec2<double> lo, Vec2<double> hi) {
  if (lo.x <= 0 && hi.x >= 0 && lo.y <= 0 && hi.y >= 0) return 0;
  const double a = w.xx * w.xx + w.yx * w.yx, b = w.xx * w.xy + w.yx * w.yy, c = w.xy * w.xy + w.yy * w.yy;
  double least = 1e300;
  for (const double x : {lo.x, hi.x}) least = std::min(least, square(w, x, std::clamp(-b * x / c, lo.y, hi.y)));
  for (const double y : {lo.y, hi.y}) least = std::min(least, square(w, std::clamp(-b * y / a, lo.x, hi.x), y));
  return least;
}

struct Ellipse {
  Mat2<double> w;
  Support<double> support;
};

/// Both forms of w that footprints use, discs to needles, near, across and far off the image.
Ellipse random_ellipse(Random& random, double reach) {
  const double s2 = random.log_uniform(0.02, 20), s1 = s2 * random.log_uniform(1, random.below(2) ? 5 : 1000);
  const double angle = random.below(4) ? random.uniform(0, kPi) : kPi / 2 * random.below(3);
  const Vec2<double> mean = random.below(8) ? Vec2<double>{random.uniform(-30, 130), random.uniform(-30, 100)}
                                            : Vec2<double>{random.normal() * 1e4, random.normal() * 1e4};
  const Cov2d<double> cov = covariance(s1, s2, angle);
  const Mat2<double> w = random.below(2) ? whiten_wide_first(cov) : Cumulant::ellipse(Cumulant::prepare(cov, {}));
  const Mat2<double> frame =
      Analytic<FrameGradient::kFrozen>::ellipse(Analytic<FrameGradient::kFrozen>::prepare(cov, {}));
  const Mat2<double>& form = random.below(3) ? w : frame;
  return {form, make_support(mean, form, random.log_uniform(1e-3, 17), reach)};
}

constexpr double kReaches[] = {0, 0.25, 15 / 32.0};

TEST(Bin, TilesAreThoseThatTheSupportTouches) {
  const TileGrid grids[] = {{100, 70}, {1, 1}, {1, 400}, {400, 1}, {16, 32}, {17, 33}};
  Random random(1);
  for (int trial = 0; trial < search_trials(3000); ++trial) {
    const TileGrid grid = grids[trial % 6];
    const double r = kReaches[trial % 3];
    const auto [w, s] = random_ellipse(random, r);
    std::vector<int64_t> tiles;
    for_each_tile(s, grid, [&](int64_t tile) { tiles.push_back(tile); });
    ASSERT_TRUE(std::is_sorted(tiles.begin(), tiles.end()) &&
                std::adjacent_find(tiles.begin(), tiles.end()) == tiles.end());
    for (int64_t tile = 0; tile < grid.tiles(); ++tile) {
      const int x0 = int(tile % grid.columns()) * kTile, y0 = int(tile / grid.columns()) * kTile;
      const int x1 = std::min(x0 + kTile, grid.width) - 1, y1 = std::min(y0 + kTile, grid.height) - 1;
      const auto least = [&](double left, double top, double right, double bottom) {
        return least_in(w, {left - r - s.mean.x, top - r - s.mean.y}, {right + r - s.mean.x, bottom + r - s.mean.y});
      };
      if (std::binary_search(tiles.begin(), tiles.end(), tile)) {
        // The rounding of a distance of 1e4 px leaves 1e-12 px, a needle 1e-10 of its width.
        ASSERT_LE(least(x0, y0, x1, y1), s.level * (1 + 1e-6)) << "trial " << trial << " tile " << tile;
        continue;
      }
      for (int y = y0; y <= y1; ++y) {
        for (int x = x0; x <= x1; ++x)
          ASSERT_GT(least(x, y, x, y), s.level * (1 - 1e-6)) << "trial " << trial << " pixel " << x << " " << y;
      }
    }
    ASSERT_TRUE(tiles.empty() || touches_image(s, grid));
  }
}

TEST(Bin, MasksAreOfTheSameTiles) {
  const TileGrid grids[] = {{100, 70}, {1, 400}, {900, 700}, {900, 700, 3}};
  Random random(1);
  int masks = 0, without = 0;
  for (int trial = 0; trial < search_trials(5000); ++trial) {
    const TileGrid grid = grids[trial % 4];
    const Support<double> support = random_ellipse(random, kReaches[trial % 3]).support;
    std::vector<int64_t> tiles, found;
    for_each_tile(support, grid, [&](int64_t tile) { tiles.push_back(tile); });
    const TileBox box = find_tiles(support, grid);
    ASSERT_EQ(box.count, int(tiles.size()));
    for (int bit = 0; bit < 64; ++bit) {
      if (box.mask >> bit & 1) found.push_back(int64_t(box.row + bit / 8) * grid.columns() + box.column + bit % 8);
    }
    if (box.mask) {
      ASSERT_EQ(found, tiles) << "trial " << trial;
      ++masks;
    } else if (!tiles.empty()) {
      ++without;
    }
  }
  EXPECT_GT(masks, search_trials(1000));
  EXPECT_GT(without, search_trials(50));
}

/// Ends of the chord at y, offsets from the mean, from the quadratic itself; ends meet outside.
Span<double> chord(const Mat2<double>& w, double level, double y) {
  const double a = w.xx * w.xx + w.yx * w.yx, b = (w.xx * w.xy + w.yx * w.yy) * y;
  const double det = w.xx * w.yy - w.xy * w.yx, half = std::sqrt(std::max(level - det * det * y * y / a, 0.0) / a);
  return {-b / a - half, -b / a + half};
}

TEST(Bin, ExtentsAreExact) {
  Random random(2);
  for (int trial = 0; trial < search_trials(3000); ++trial) {
    const double r = kReaches[trial % 3];
    auto [w, s] = random_ellipse(random, r);
    s.mean = {random.uniform(-100, 100), random.uniform(-100, 100)};
    const double det = w.xx * w.yy - w.xy * w.yx,
                 height = std::sqrt(s.level * (w.xx * w.xx + w.yx * w.yx)) / std::abs(det);
    const double size = height + std::sqrt(s.level * (w.xy * w.xy + w.yy * w.yy)) / std::abs(det) + 100;
    ASSERT_NEAR(rows_of(s).hi - s.mean.y, height + r, 1e-12 * size);
    ASSERT_NEAR(s.mean.y - rows_of(s).lo, height + r, 1e-12 * size);

    double y0 = random.uniform(-1.5, 1.5) * (height + r), y1 = y0 + random.uniform(0, 1) * height;
    const Span<double> columns = columns_of(s, s.mean.y + y0, s.mean.y + y1);
    y0 = std::max(y0 - r, -height);
    y1 = std::min(y1 + r, height);
    if (y0 > y1) {
      ASSERT_LT(columns.hi, columns.lo);
      continue;
    }
    // The right end of the chord is a concave function of y, the left end its mirror image.
    const auto highest = [&](const auto& f) {
      double lo = y0, hi = y1;
      for (int k = 0; k < 200; ++k) {
        const double a = lo + (hi - lo) / 3, b = hi - (hi - lo) / 3;
        (f(a) < f(b) ? lo : hi) = f(a) < f(b) ? a : b;
      }
      return f(lo);
    };
    // A chord's half width is a root: eps inside it becomes sqrt(eps) at the tips.
    const double right = highest([&](double y) { return chord(w, s.level, y).hi; });
    const double left = -highest([&](double y) { return -chord(w, s.level, y).lo; });
    ASSERT_NEAR(columns.hi, s.mean.x + right + r, 1e-7 * size);
    ASSERT_NEAR(columns.lo, s.mean.x + left - r, 1e-7 * size);
  }
}

// No box that the ellipse reaches is passed over, and few that lie well outside are not.
TEST(Bin, BoxesThatTheSupportReaches) {
  Random random(5);
  int reached = 0, far = 0, far_reached = 0;
  for (int trial = 0; trial < search_trials(100000); ++trial) {
    const auto [w, s] = random_ellipse(random, 0);
    const Vec2<double> half = {0.5 * random.below(4), 0.5 * random.below(4)};
    const double size = 1.5 * std::max(s.half_width, s.half_height) + 4;
    const Vec2<double> center = {random.uniform(-size, size), random.uniform(-size, size)};
    const double least =
        least_in(w, {center.x - half.x, center.y - half.y}, {center.x + half.x, center.y + half.y}) / s.level;
    const bool says = reaches_box(make_box_reach(w, s.level - kLevelSlack, half, size), transform(w, center));
    if (least < 1 - 1e-9) {
      ++reached;
      ASSERT_TRUE(says) << "trial " << trial << " least " << least;
    }
    far += least > 4;
    far_reached += least > 4 && says;
  }
  EXPECT_GT(reached, search_trials(2000));
  EXPECT_LT(far_reached, 0.02 * far);
}

TEST(Bin, RangesSurviveAnySpan) {
  const float inf = std::numeric_limits<float>::infinity(), nan = std::numeric_limits<float>::quiet_NaN();
  const auto empty = [](Span<float> span) {
    const Range r = clamp_range(span, 100);
    return r.last < r.first;
  };
  EXPECT_TRUE(empty({nan, 5}) && empty({5, nan}) && empty({nan, nan}) && empty({6, 5}) && empty({1e9f, -1e9f}));
  EXPECT_TRUE(empty({-5, -1}) && empty({99.5f, 200}) && empty({3.25f, 3.75f}) && empty({inf, inf}));
  const Range all = clamp_range(Span<float>{-inf, inf}, 100), one = clamp_range(Span<float>{3, 3.5f}, 100);
  EXPECT_TRUE(all.first == 0 && all.last == 99 && one.first == 3 && one.last == 3);
}

class BinTest : public ::testing::TestWithParam<Footprint> {};
AR_ALL_FOOTPRINTS(BinTest);

/// Discs and needles of up to 1000 px, as kLevelSlack says.
SplatRow<float> random_splat(const Footprint& f, Random& random, TileGrid grid) {
  const double s2 = random.log_uniform(1e-3, 20), ratio = random.log_uniform(1, random.below(2) ? 10 : 1e6);
  const Cov2d<double> cov = covariance(std::min(1000.0, s2 * ratio), s2, random.uniform(0, kPi));
  SplatRow<float> splat = f.row(rounded<float>(cov));
  splat.mean = {float(random.uniform(-20, grid.width + 20)), float(random.uniform(-20, grid.height + 20))};
  return splat;
}

/// Blocks of pixels like those that the CPU composites together.
constexpr Vec2<int> kBlocks[] = {{1, 1}, {2, 2}, {4, 2}, {4, 4}};

/// Whether bin and then blend's own test of blocks let a splat reach a pixel.
bool reaches(const Footprint& f, const SplatRow<float>& splat, TileGrid grid, int x, int y) {
  const Support<float> support = support_of(splat, f.index);
  bool touched = false;
  if (splat.level > 0) {
    const int64_t wanted = int64_t(y / kTile) * grid.columns() + x / kTile;
    for_each_tile(support, grid, [&](int64_t tile) { touched |= tile == wanted; });
  }
  const Mat2<float> w = f.in_float.ellipse(splat);
  for (const Vec2<int> block : kBlocks) {
    const Vec2<float> middle = {0.5f * float(block.x - 1), 0.5f * float(block.y - 1)};
    const Vec2<float> center = {float(x / block.x * block.x) - splat.mean.x + middle.x,
                                float(y / block.y * block.y) - splat.mean.y + middle.y};
    const Vec2<float> half = {middle.x + float(f.reach), middle.y + float(f.reach)};
    const float distance = std::max(std::abs(center.x), std::abs(center.y));
    touched &= reaches_box(make_box_reach(w, splat.level, half, distance), transform(w, center));
  }
  return touched;
}

// In float, rounding included.
TEST_P(BinTest, NoVisiblePixelIsLost) {
  const Footprint& f = GetParam();
  const TileGrid grid = {70, 50};
  Random random(3);
  int visible = 0;
  for (int trial = 0; trial < search_trials(200); ++trial) {
    SplatRow<float> splat = random_splat(f, random, grid);
    splat.opacity = float(random.uniform(0.01, 1));
    splat.level = f.in_float.level(splat);
    for (int y = 0; y < grid.height; ++y) {
      for (int x = 0; x < grid.width; ++x) {
        float alphas[16];
        f.in_float.alphas(splat, {x - splat.mean.x, y - splat.mean.y}, alphas);
        if (*std::max_element(alphas, alphas + f.samples) < float(kAlphaMin)) continue;
        ++visible;
        ASSERT_TRUE(reaches(f, splat, grid, x, y)) << "trial " << trial << " opacity " << splat.opacity;
      }
    }
  }
  EXPECT_GT(visible, search_trials(5000));
}

// The opacity is such that one sample of one pixel just reaches 1/255: without kLevelSlack a rounding
// of the level or of the distance could lose it.
TEST_P(BinTest, NoPixelAtTheThresholdIsLost) {
  const Footprint& f = GetParam();
  const TileGrid grid = {2000, 1500};
  Random random(4);
  int checked = 0;
  for (int trial = 0; trial < search_trials(20000); ++trial) {
    SplatRow<float> splat = random_splat(f, random, grid);
    const Vec2<float> z = {float(random.uniform(-2.3, 2.3)), float(random.uniform(-2.3, 2.3))};
    const Vec2<float> d = unwhiten(f.in_float.ellipse(splat), z);
    const int x = int(std::lround(splat.mean.x + d.x)), y = int(std::lround(splat.mean.y + d.y)), s = trial % f.samples;
    const auto alpha = [&](float opacity) {
      float alphas[16];
      splat.opacity = opacity;
      f.in_float.alphas(splat, {x - splat.mean.x, y - splat.mean.y}, alphas);
      return alphas[s];
    };
    if (x < 0 || y < 0 || x >= grid.width || y >= grid.height || alpha(1) < float(kAlphaMin)) continue;
    splat.opacity = float(kAlphaMin) / alpha(1);
    while (alpha(splat.opacity) < float(kAlphaMin)) splat.opacity = std::nextafter(splat.opacity, 2.0f);
    splat.level = f.in_float.level(splat);
    ++checked;
    ASSERT_TRUE(reaches(f, splat, grid, x, y)) << "trial " << trial << " opacity " << splat.opacity;
  }
  EXPECT_GT(checked, search_trials(1000));
}

}  // namespace
}  // namespace ar::test
