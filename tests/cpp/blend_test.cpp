// Compositing of one sample against a plain loop, differences and long double.
#include "core/blend.h"

#include <algorithm>

#include "core/footprint/moment.h"
#include "support.h"

namespace ar::test {
namespace {

/// Front to back, as the definition reads: skip below 1/255, cap, stop before T falls below 1e-4.
template <typename T> struct Composited {
  T color = 0, transmittance = 1;
  T error = 0;            ///< of the transmittance, relative, in roundings: T - T alpha cancels
  std::vector<int> used;  ///< splats composited
};
template <typename T, typename S> Composited<T> plain_loop(const std::vector<S>& alphas, const std::vector<S>& colors) {
  Composited<T> out;
  for (size_t k = 0; k < alphas.size(); ++k) {
    const T alpha = std::min(alphas[k], S(kAlphaMax));
    if (alpha < S(kAlphaMin)) continue;
    if (out.transmittance * (1 - alpha) < T(kTransmittanceMin)) break;
    out.color += out.transmittance * alpha * T(colors[k]);
    out.transmittance *= 1 - alpha;
    out.error += 2 / (1 - alpha);
    out.used.push_back(int(k));
  }
  return out;
}

template <typename T> Composited<T> blend_all(const std::vector<T>& alphas, const std::vector<T>& colors) {
  Composited<T> out;
  for (size_t k = 0; k < alphas.size(); ++k) {
    const Blended<T> b = blend_sample(alphas[k], out.transmittance);
    out.color += b.contribution * colors[k];
    EXPECT_TRUE(b.mask || b.contribution == 0);
    if (b.mask) out.used.push_back(int(k));
  }
  out.transmittance = std::abs(out.transmittance);
  return out;
}

/// Gradients by alpha and colour of g . color + background . transmittance, walked from the back.
template <typename T> struct Gradients {
  std::vector<T> alphas, colors;
  T transmittance;  ///< at the front
};
template <typename T>
Gradients<T> blend_all_vjp(const std::vector<T>& alphas, const std::vector<T>& colors, const Composited<T>& forward,
                           T g, T background) {
  Gradients<T> out = {std::vector<T>(alphas.size()), std::vector<T>(alphas.size()), forward.transmittance};
  T behind = background;
  for (int k = int(alphas.size()) - 1; k >= 0; --k) {
    const bool mask = std::binary_search(forward.used.begin(), forward.used.end(), k);
    const BlendGrad<T> b = blend_sample_vjp(mask, alphas[k], g * colors[k], out.transmittance, behind);
    out.alphas[k] = b.of_alpha.dL_dalpha;
    out.colors[k] = g * b.contribution;
  }
  return out;
}

template <typename T> std::vector<T> randoms(Random& random, int n, double lo, double hi) {
  std::vector<T> x(n);
  for (T& v : x) v = T(random.uniform(lo, hi));
  return x;
}

template <typename T> class BlendTest : public ::testing::Test {};
using Scalars = ::testing::Types<float, double>;
TYPED_TEST_SUITE(BlendTest, Scalars);

// n steps of three roundings each, against long double. No stack here comes so close to the stop
// rule that rounding decides.
TYPED_TEST(BlendTest, MatchesAPlainLoop) {
  using T = TypeParam;
  Random random(1);
  for (int trial = 0; trial < 2000; ++trial) {
    const int n = random.below(60);
    std::vector<T> alphas = randoms<T>(random, n, 0, trial % 2 ? 0.2 : 0.95);
    for (T& a : alphas) a *= random.below(4) ? T(1) : T(0.01);  // some below the threshold
    if (n > 0) alphas[random.below(n)] = T(1.5);                // one above the cap: two make an exact tie at the stop
    const std::vector<T> colors = randoms<T>(random, n, 0, 1);
    const Composited<T> actual = blend_all(alphas, colors);
    const auto expected = plain_loop<long double>(alphas, colors);
    ASSERT_EQ(actual.used, expected.used);
    ASSERT_NEAR(actual.color, double(expected.color), 3 * n * kEps<T>);
    ASSERT_NEAR(actual.transmittance, double(expected.transmittance),
                kEps<T> * double(expected.error * expected.transmittance));
  }
}

TYPED_TEST(BlendTest, ThresholdCapAndStop) {
  using T = TypeParam;
  const T least = T(kAlphaMin), below = std::nextafter(least, T(0)), cap = T(kAlphaMax);
  const std::vector<T> one = {1};
  EXPECT_EQ(blend_all<T>({least}, one).used.size(), 1u);
  EXPECT_EQ(blend_all<T>({below}, one).used.size(), 0u);
  EXPECT_EQ(blend_all<T>({T(5)}, one).color, cap);
  // 0.01 is left behind a capped splat; the second would leave 1e-4 but for rounding, the third is
  // beyond doubt. What comes after a stop is never drawn, however thin.
  const Composited<T> stopped = blend_all<T>({T(1), T(0.5), T(1), T(0.01)}, {1, 1, 1, 1});
  EXPECT_EQ(stopped.used, (std::vector<int>{0, 1}));
  EXPECT_NEAR(stopped.transmittance, 0.005, 0.005 * 100 * kEps<T>);
}

// Differences: the loss is linear in each alpha, so any step is exact but for rounding.
TEST(BlendVjp, MatchesDifferences) {
  Random random(2);
  for (int trial = 0; trial < 200; ++trial) {
    std::vector<double> alphas = randoms<double>(random, 25, 0.01, 0.3), colors = randoms<double>(random, 25, 0, 1);
    alphas[random.below(25)] = 1.2;    // capped: no gradient
    alphas[random.below(25)] = 0.003;  // not drawn: no gradient
    const double g = random.normal(), background = random.normal();
    const auto loss = [&] {
      const auto c = plain_loop<double>(alphas, colors);
      return g * c.color + background * c.transmittance;
    };
    const auto used = blend_all(alphas, colors);
    const auto grads = blend_all_vjp(alphas, colors, used, g, background);
    ASSERT_NEAR(grads.transmittance, 1, kEps<double> * 2 * plain_loop<double>(alphas, colors).error);  // there and back
    for (int k = 0; k < 25; ++k) {
      for (const bool by_alpha : {true, false}) {
        double& x = (by_alpha ? alphas : colors)[k];
        const double at = x, h = 1e-4;
        const double numeric = derivative(
            [&](double t) {
              x = at + t;
              const double l = loss();
              x = at;
              return l;
            },
            h);
        // Where a step crosses the stop rule there is no derivative to compare with.
        if (by_alpha && (std::abs(used.transmittance - kTransmittanceMin) < 1e-4 || used.used.size() < 20)) continue;
        ASSERT_NEAR((by_alpha ? grads.alphas : grads.colors)[k], numeric, 1e-10);
      }
    }
  }
}

// Deep stacks in float. T has passed 2 n roundings forward and 3 n back, `behind` 3 n; each is a mean
// of colours of at most 1.
TEST(BlendVjp, KeepsDeepStacksAccurate) {
  Random random(3);
  for (const int n : {60, 400, 1500}) {
    const std::vector<float> alphas = randoms<float>(random, n, 0.0045, 15.0 / n - 0.0045),
                             colors = randoms<float>(random, n, 0, 1);
    const auto used = blend_all(alphas, colors);
    ASSERT_EQ(used.used.size(), size_t(n));
    const auto grads = blend_all_vjp(alphas, colors, used, 1.0f, 0.5f);
    std::vector<long double> front(n), behind(n + 1, 0.5L);
    for (int k = 0; k < n; ++k) front[k] = k ? front[k - 1] * (1 - (long double)alphas[k - 1]) : 1.0L;
    for (int k = n; k-- > 0;)
      behind[k] = alphas[k] * (long double)colors[k] + (1 - (long double)alphas[k]) * behind[k + 1];
    for (int k = 0; k < n; ++k) {
      const double bound = 8 * n * kEps<float> * double(front[k]);
      ASSERT_NEAR(grads.alphas[k], double(front[k] * (colors[k] - behind[k + 1])), bound) << n << " " << k;
      ASSERT_NEAR(grads.colors[k], double(front[k] * alphas[k]), bound);
    }
  }
}

TEST(BlendSample, NoExponentBelowTheBoundReachesTheMinimum) {
  EXPECT_LT(kLogAlphaMin, std::log2(kAlphaMin) - 5e-5);
  EXPECT_GT(kLogAlphaMin, std::log2(kAlphaMin) - 5e-4);
}

/// Adjoint of blend_sample of a P that moves. `transmittance` and `state` are those in front of the splat; `dL_dmoved`
/// goes from behind the splat to in front of it.
template <class P, class Terms>
MovingBlendGrad<double> blend_moving_sample_vjp(const Terms& terms, Vec2<double> p, int s, bool before, double g_color,
                                                double transmittance, const SampleState<double, true>& state,
                                                double& behind, Vec2<double>& dL_dmoved) {
  const Vec2<double> at = p + state.moved;
  const double raw = P::alpha(terms, at, s), alpha = before && raw >= kAlphaMin ? std::min(raw, kAlphaMax) : 0;
  const bool free = alpha > 0 && raw <= kAlphaMax;
  const double difference = g_color - behind;
  behind = madd(alpha, difference, behind);
  return {transmittance * alpha,
          P::alpha_and_move_vjp(terms, at, s, alpha, free, transmittance * difference, state.moved, dL_dmoved)};
}

// A sample that moves, by its displacement, by its place, and by its place in its cell: three forms of the same, for a
// stack of splats and back.
template <int S> void expect_places_and_displacements_to_agree() {
  using P = Moment<S>;
  using V = Vec2<double>;
  Random random(40 + S);
  int composited = 0, held = 0;
  for (int trial = 0; trial < 300; ++trial) {
    const int s = trial % S, count = 30;
    const V p = {random.uniform(0, 16), random.uniform(0, 16)};
    const Vec2<double> node = P::node(s);
    const Bounds<double> cell = P::template cell<double>(s);
    std::vector<decltype(P::terms(GaussianShape<double>(), 1.0))> terms;
    std::vector<V> fronts, places;
    std::vector<double> front_transmittance, raws, colors = randoms<double>(random, count, 0, 1);
    SampleState<double, true> state = {};
    double by_moved = 1, by_place = 1, by_cell = 1, by_map = 1;
    V place = node, in_cell = {0.5, 0.5}, mapped = node;
    std::vector<V> places_in_cell;
    const auto cells_of = [](auto terms) {  // lengths in edges of cells
      terms.w = 1.0 / P::kSide * terms.w;
      return terms;
    };
    const auto z_in_cell = [&](const auto& terms, V at) {
      return P::whitened_node(cells_of(terms), transform(terms.w, p + cell.lo, terms.node[0]), at);
    };
    const UnitCell<P::kSide> unit_cell = {};
    AdjointMap<double> map = {0, {0, 0}, {0, 0}, {1, 0, 0, 1}};
    for (int k = 0; k < count; ++k) {
      const double xx = random.log_uniform(0.05, 3), yy = random.log_uniform(0.05, 3);
      const double xy = random.uniform(-0.9, 0.9) * std::sqrt(xx * yy);
      const auto shape = P::prepare(Cov2d<double>{xx, xy, yy, xx * yy - xy * xy}, FootprintOptions{});
      const V mean = {p.x + random.uniform(-2, 2), p.y + random.uniform(-2, 2)};
      terms.push_back(P::terms(shape, random.uniform(0.1, 1.2), V{-mean.x, -mean.y}));
      const V z = P::whitened_node(terms[k], P::whitened(terms[k], p, 0), place);
      const double raw = exp2(P::log_alpha(terms[k], z));
      const V at = p + state.moved;
      ASSERT_NEAR(raw, P::alpha(terms[k], at, s), 1e-11);
      fronts.push_back(state.moved), places.push_back(place), front_transmittance.push_back(by_moved);
      const Blended<double> a = blend_sample<P>(terms[k], p, s, by_moved, state);
      const Blended<double> b = blend_placed_sample<P>(terms[k], z, raw, cell, by_place, place);
      ASSERT_EQ(a.mask, b.mask);
      ASSERT_NEAR(a.contribution, b.contribution, 1e-10);
      ASSERT_NEAR(node.x + state.moved.x, place.x, 1e-10);
      ASSERT_NEAR(node.y + state.moved.y, place.y, 1e-10);
      places_in_cell.push_back(in_cell);
      blend_placed_sample<P>(cells_of(terms[k]), z_in_cell(terms[k], in_cell), raw, unit_cell, by_cell, in_cell);
      ASSERT_NEAR(by_cell, by_place, 1e-10);
      ASSERT_NEAR(cell.lo.x + in_cell.x / P::kSide, place.x, 1e-10);
      ASSERT_NEAR(cell.lo.y + in_cell.y / P::kSide, place.y, 1e-10);
      map_placed_sample<P>(terms[k], z, raw, b.mask, cell, colors[k], by_map, mapped, map);
      ASSERT_EQ(by_map, std::abs(by_place));
      ASSERT_EQ(mapped.x, place.x);
      ASSERT_EQ(mapped.y, place.y);
      raws.push_back(b.mask ? raw : 0);
      composited += b.mask;
      held += place.x == cell.lo.x || place.x == cell.hi.x || place.y == cell.lo.y || place.y == cell.hi.y;
    }
    const double behind = 0.7;
    const V dL_dlast = {0.3, -0.4};
    double behind_moved = behind, behind_place = behind, transmittance = by_map;
    double behind_in_cell = behind, transmittance_in_cell = by_map;
    constexpr double kUnit = P::kMoveGradUnit, kCellUnit = kUnit / P::kSide;
    V dL_dmoved = dL_dlast, dL_dplace = {kUnit * dL_dlast.x, kUnit * dL_dlast.y};
    V dL_din_cell = {kCellUnit * dL_dlast.x, kCellUnit * dL_dlast.y};
    for (int k = count - 1; k >= 0; --k) {
      const MovingBlendGrad<double> a =
          blend_moving_sample_vjp<P>(terms[k], p, s, raws[k] > 0, colors[k], front_transmittance[k],
                                     SampleState<double, true>{fronts[k]}, behind_moved, dL_dmoved);
      const V z = P::whitened_node(terms[k], P::whitened(terms[k], p, 0), places[k]);
      MovingBlendGrad<double> b = no_moving_blend_grad<double>(), c = b;
      add_placed_sample_vjp<P>(terms[k], z, raws[k], cell, colors[k], places[k], transmittance, behind_place, dL_dplace,
                               b);
      add_placed_sample_vjp<P>(cells_of(terms[k]), z_in_cell(terms[k], places_in_cell[k]), raws[k], unit_cell,
                               colors[k], places_in_cell[k], transmittance_in_cell, behind_in_cell, dL_din_cell, c);
      const auto numbers = [](const MovingBlendGrad<double>& grad, double behind, V dL_dplace, double transmittance) {
        const ShapeGrad<double>& sums = grad.of_splat.sums;
        return std::vector<double>{
            grad.contribution, grad.of_splat.weighted, sums.offset.x, sums.offset.y, sums.shape.xx,
            sums.shape.xy,     sums.shape.yy,          behind,        dL_dplace.x,   dL_dplace.y,
            transmittance};
      };
      const std::vector<double> expected = numbers(a, behind_moved, dL_dmoved, std::abs(front_transmittance[k]));
      const std::vector<double> actual =
          numbers(b, behind_place, {dL_dplace.x / kUnit, dL_dplace.y / kUnit}, transmittance);
      const std::vector<double> of_cell =
          numbers(c, behind_in_cell, {dL_din_cell.x / kCellUnit, dL_din_cell.y / kCellUnit}, transmittance_in_cell);
      // Rounding, which 1 / (1 - alpha)^2 enlarges by up to 1e4, and steps of up to 30 splats in a row.
      for (size_t i = 0; i < expected.size(); ++i) {
        ASSERT_NEAR(actual[i], expected[i], 1e-8 * (1 + std::abs(expected[i]))) << k << " " << i;
        ASSERT_NEAR(of_cell[i], expected[i], 1e-8 * (1 + std::abs(expected[i]))) << k << " " << i;
      }
    }
    const Mat2<double>& m = map.of_place;
    const V front =
        transform(m, V{kUnit * dL_dlast.x, kUnit * dL_dlast.y},
                  V{madd(map.of_behind.x, behind, map.of_color.x), madd(map.of_behind.y, behind, map.of_color.y)});
    ASSERT_NEAR(map.color + by_map * behind, behind_place, 1e-8);
    ASSERT_NEAR(front.x, dL_dplace.x, 1e-8 * (1 + std::abs(dL_dplace.x)));
    ASSERT_NEAR(front.y, dL_dplace.y, 1e-8 * (1 + std::abs(dL_dplace.y)));
  }
  EXPECT_GT(composited, 1000);
  EXPECT_GT(held, 20);
}
TEST(BlendSample, PlacesAndDisplacementsAgree) {
  expect_places_and_displacements_to_agree<1>();
  expect_places_and_displacements_to_agree<4>();
  expect_places_and_displacements_to_agree<16>();
}

}  // namespace
}  // namespace ar::test
