// Which boxes of pixels a splat reaches, and which warps of a block: no pixel that shows a splat may be passed over.
#include "cuda_on_host.h"
// After it: kernels.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <random>

#include "core/footprint/registry.h"
#include "cuda/moment/maps.cuh"

namespace ar::cuda {
namespace {

class Draws {
 public:
  double uniform(double low, double high) { return std::uniform_real_distribution<double>(low, high)(bits_); }
  /// Evenly by orders of magnitude.
  double spread(double low, double high) { return std::exp(uniform(std::log(low), std::log(high))); }
  int below(int n) { return std::uniform_int_distribution<int>(0, n - 1)(bits_); }

 private:
  std::mt19937_64 bits_{1};
};

/// Of the splats that are drawn.
struct Kind {
  int count;
  double thinnest, thickest;  ///< standard deviation across a splat [px]; along it up to 1000 px
  /// Whether the mean is the centre of a pixel of the tile, which shows splats that are much thinner than a pixel; else
  /// the border of its ellipse is near the tile, or around it.
  bool at_pixel;
};

/// A splat of footprint F for the pixels (x0, y0) to (x0 + side, y0 + side).
template <class F>
bool draw_splat(Draws& draws, const Kind& kind, FootprintOptions options, int x0, int y0, int side,
                Splat<PixelsOf<F>, float>& splat) {
  const double minor = draws.spread(kind.thinnest, kind.thickest);
  const double major = std::min(1000.0, minor * draws.spread(1, 1e6));
  const double angle = draws.below(3) == 0 ? kPi / 2 * draws.below(4) + draws.spread(1e-8, 0.1)
                                           : draws.uniform(0, kPi);  // many nearly along an axis
  const double c = std::cos(angle), s = std::sin(angle), a = major * major, b = minor * minor;
  const Cov2d<float> cov = {float(a * c * c + b * s * s), float((a - b) * c * s), float(a * s * s + b * c * c),
                            float(a * b)};
  const auto shape = F::prepare(cov, options);
  static_assert(sizeof shape == sizeof splat.shape);
  std::memcpy(&splat.shape, &shape, sizeof shape);
  splat.opacity = float(draws.spread(0.005, 1));
  splat.level = F::level(shape, splat.opacity);
  if (!(splat.level > 0 && splat.level < 1e6f)) return false;
  if (kind.at_pixel) {
    splat.mean = {float(x0 + draws.below(side)), float(y0 + draws.below(side))};
    return true;
  }
  const Mat2<float> w = F::ellipse(shape);
  const double det = double(w.xx) * w.yy - double(w.xy) * w.yx;
  // From the mean to a point on the border of the ellipse, or within it.
  const double radius = std::sqrt(splat.level) * (draws.below(3) ? draws.uniform(0.9, 1.02) : draws.uniform(0, 1));
  const double turn = draws.uniform(0, 2 * kPi), zx = radius * std::cos(turn), zy = radius * std::sin(turn);
  const double to_x = (w.yy * zx - w.xy * zy) / det, to_y = (w.xx * zy - w.yx * zx) / det;
  splat.mean = {float(x0 + draws.uniform(-2, side + 1) - to_x), float(y0 + draws.uniform(-2, side + 1) - to_y)};
  return true;
}

/// Whether a sample of the pixel at p, relative to that for which `terms` were made, shows the splat: of footprints
/// whose samples move, at any place in the pixel where one may be, here a grid of places.
template <class P, class Terms> bool shows(const Terms& terms, Vec2<float> p) {
  const auto visible = [](float alpha) { return alpha >= float(kAlphaMin); };
  if constexpr (P::kMoves) {
    constexpr int kPlaces = 5;
    for (int i = 0; i < kPlaces * kPlaces; ++i) {
      const Vec2<float> place = {float(i % kPlaces) / (kPlaces - 1) - 0.5f, float(i / kPlaces) / (kPlaces - 1) - 0.5f};
      const Vec2<float> z = P::whitened_node(terms, P::Gaussian::whitened(terms, p, 0), place);
      if (visible(exp2(P::log_alpha(terms, z)))) return true;
    }
  } else {
    for (int s = 0; s < P::kSamples; ++s) {
      if (visible(P::alpha(terms, p, s))) return true;
    }
  }
  return false;
}

template <class F, int kWide, int kHigh, int kColumns, int kRows>
void expect_no_pixel_is_passed_over(const Kind& kind, FootprintOptions options = {}) {
  using P = PixelsOf<F>;
  SCOPED_TRACE(testing::Message() << F::kName << ", " << P::kSamples << " samples, boxes of " << kWide << "x" << kHigh);
  Draws draws;
  int visible = 0, said = 0, boxes = 0;
  for (int n = 0; n < kind.count; ++n) {
    const int x0 = kTile * draws.below(256), y0 = kTile * draws.below(256);
    Splat<P, float> splat;
    if (!draw_splat<F>(draws, kind, options, x0, y0, kWide * kColumns, splat)) continue;
    const uint32_t reached = reached_boxes<kWide, kHigh, kColumns, kRows, P>(splat, x0, y0);
    const auto terms =
        P::terms(splat.shape, splat.opacity, Vec2<float>{float(x0) - splat.mean.x, float(y0) - splat.mean.y});
    for (int box = 0; box < kColumns * kRows; ++box, ++boxes) {
      bool shown = false;
      for (int i = 0; i < kWide * kHigh && !shown; ++i) {
        const int x = box % kColumns * kWide + i % kWide, y = box / kColumns * kHigh + i / kWide;
        shown = shows<P>(terms, {float(x), float(y)});
      }
      const bool says = reached >> box & 1;
      visible += shown, said += says;
      ASSERT_TRUE(says || !shown) << "splat " << n << " at " << splat.mean.x << ", " << splat.mean.y << ", box " << box
                                  << " of the tile at " << x0 << ", " << y0;
    }
  }
  EXPECT_GT(visible, boxes / 20);
  EXPECT_LE(said - visible, boxes / 6) << "of " << boxes;  // of use too
}

TEST(ReachedBoxes, HoldEveryPixelThatShowsTheSplat) {
  constexpr Kind kAll = {4000, 1e-3, 20, false};
  expect_no_pixel_is_passed_over<Box<1>, 8, 4, 2, 4>(kAll);
  expect_no_pixel_is_passed_over<Box<4>, 8, 4, 2, 4>(kAll);
  expect_no_pixel_is_passed_over<Box<16>, 8, 4, 2, 4>(kAll);
  expect_no_pixel_is_passed_over<Analytic<FrameGradient::kFrozen>, 8, 4, 2, 4>(kAll);
  expect_no_pixel_is_passed_over<Cumulant, 8, 4, 2, 4>(kAll);
  expect_no_pixel_is_passed_over<Moment<1>, 8, 4, 2, 4>(kAll);
  expect_no_pixel_is_passed_over<Moment<4>, 4, 4, 2, 2>(kAll);
  expect_no_pixel_is_passed_over<Moment<16>, 2, 1, 4, 4>(kAll);
}

TEST(ReachedBoxes, HoldThePixelsOfSplatsThatNothingWidens) {
  FootprintOptions undilated = {};
  undilated.number = 0;
  expect_no_pixel_is_passed_over<Point, 8, 4, 2, 4>({4000, 1e-5, 20, false}, undilated);
  expect_no_pixel_is_passed_over<Point, 8, 4, 2, 4>({50000, 1e-7, 1e-5, true}, undilated);
}

/// A splat much smaller than a pixel reaches the group of its pixel, and no group that is farther away.
template <class F, class Layout> void expect_the_warp_of_each_pixel() {
  SCOPED_TRACE(testing::Message() << F::kSamples << " cells, " << Layout::kWarps << " warps of " << Layout::kWide << "x"
                                  << Layout::kHigh << " pixels, " << Layout::kBlocks << " blocks");
  constexpr int kX0 = 96, kY0 = 208;
  int found = 0;
  for (int block = 0; block < Layout::kBlocks; ++block) {
    blockIdx.x = block;
    for (int i = 0; i < Layout::kSide * Layout::kSide; ++i) {
      const Vec2<float> at = {float(i % Layout::kSide), float(i / Layout::kSide)};
      Splat<F, float> splat = {};
      splat.mean = {kX0 + at.x, kY0 + at.y};
      splat.shape.w = {400, 0, 400};
      splat.shape.amp = splat.level = 1;
      const uint32_t reached = Layout::template block_reach<F>(splat, kX0, kY0);
      for (int thread = 0; thread < Layout::kThreads; ++thread) {
        threadIdx.x = thread;
        const Vec2<float> p = Layout::pixel();
        if (p.x != at.x || p.y != at.y) continue;
        ++found;
        ASSERT_TRUE(reached >> thread / 32 & 1) << "pixel " << at.x << ", " << at.y;
      }
      for (int warp = 0; warp < Layout::kWarps; ++warp) {
        bool near = false;
        for (int lane = 0; lane < 32; ++lane) {
          threadIdx.x = 32 * warp + lane;
          const Vec2<float> p = Layout::pixel();
          near |= std::abs(p.x - at.x) <= 1 && std::abs(p.y - at.y) <= 1;
        }
        ASSERT_TRUE(near || !(reached >> warp & 1)) << "pixel " << at.x << ", " << at.y << ", warp " << warp;
      }
    }
  }
  EXPECT_EQ(found, Layout::kLanes * Layout::kSide * Layout::kSide);
}

template <class F, int kSide> void expect_the_warps_of_all_layouts() {
  expect_the_warp_of_each_pixel<F, EvenLayout<F, false, kSide>>();
  expect_the_warp_of_each_pixel<F, EvenLayout<F, true, kSide>>();
  expect_the_warp_of_each_pixel<F, SegmentLayout<F, kSide>>();
  expect_the_warp_of_each_pixel<F, MapLayout<F, kSide>>();
}

TEST(BlockReach, HasTheWarpOfEachPixel) {
  expect_the_warps_of_all_layouts<Moment<1>, kMovingTile>();
  expect_the_warps_of_all_layouts<Moment<1>, kTile>();
  expect_the_warps_of_all_layouts<Moment<4>, kMovingTile>();
  expect_the_warps_of_all_layouts<Moment<9>, kMovingTile>();
  expect_the_warps_of_all_layouts<Moment<16>, kMovingTile>();
  expect_the_warps_of_all_layouts<Moment<9>, kMovingTile / 2>();
  expect_the_warps_of_all_layouts<Moment<16>, kMovingTile / 2>();
}

}  // namespace
}  // namespace ar::cuda
