// Every footprint against differences, integrals and its own stated bounds.
#include <algorithm>

#include "core/footprint/registry.h"
#include "support.h"

namespace ar::test {
namespace {

class FootprintTest : public ::testing::TestWithParam<Footprint> {};
AR_ALL_FOOTPRINTS(FootprintTest);

template <typename T> struct Adjoint {
  SplatGrad<T> splat;
  T weighted;
};

template <typename T> Adjoint<T> weight_vjp(const Footprint& f, Cov2d<T> cov, Vec2<T> d, T opacity, const T* g) {
  const Model<T>& model = f.model<T>();
  const SplatRow<T> row = f.row(cov, opacity);
  T alphas[16], weighted = 0;
  model.alphas(row, d, alphas);
  for (int s = 0; s < f.samples; ++s) weighted += g[s] * alphas[s];
  const ShapeGrad<T> sums = model.sums(row, d, g);
  const SplatGrad<T> grad = model.prepare_vjp(cov, row, sums, weighted, f.options);
  // mean_map says the same; the two columns of a needle's map cancel, hence the norms.
  const Mat2<T> m = model.mean_map(row);
  const Vec2<T> by_mean = transform_transposed(m, sums.offset);
  const T size = std::hypot(std::hypot(m.xx, m.xy), std::hypot(m.yx, m.yy)) * std::hypot(sums.offset.x, sums.offset.y);
  EXPECT_NEAR(by_mean.x, grad.dL_dmean.x, 8 * kEps<T> * size + std::numeric_limits<T>::min());
  EXPECT_NEAR(by_mean.y, grad.dL_dmean.y, 8 * kEps<T> * size + std::numeric_limits<T>::min());
  return {grad, weighted};
}

// In the eigenframe of Sigma, in units of l1, s1 s2 and l2, where every derivative is of the order
// of the weight. The differences are good to 1e-10 of it.
TEST_P(FootprintTest, GradientsMatchDifferences) {
  const Footprint& f = GetParam();
  Random random(1);
  for (int trial = 0; trial < 500; ++trial) {
    const double s2 = random.log_uniform(0.05, 10), s1 = s2 * random.log_uniform(1.05, 30), l1 = s1 * s1, l2 = s2 * s2;
    const double angle = random.uniform(0, 2 * kPi), opacity = random.uniform(0.01, 1), h = 1e-3 * s2;
    const Mat2<double> axes = {std::cos(angle), -std::sin(angle), std::sin(angle), std::cos(angle)};  // in columns
    const Cov2d<double> cov = covariance(s1, s2, angle);
    // Within 3 standard deviations, where the kinks of cumulant's tail (q' > 23.6) are far.
    const Mat2<double> w = f.in_double.ellipse(f.row(cov));
    const Vec2<double> d = unwhiten(w, on_circle(random.uniform(0, 3), random.uniform(0, 2 * kPi)));
    double g[16];
    for (double& x : g) x = random.uniform(0.5, 1);

    const auto moved = [&](double u, double v) {
      return weight(f, cov, d + transform(axes, Vec2<double>{u, v}), opacity, g);
    };
    const auto changed = [&](double l11, double l12, double l22) {
      return weight(f, turned(l1 + l11, l12, l2 + l22, angle), d, opacity, g);
    };
    // Frozen: the window keeps still, so that d/dSigma12 is d2/du dv as for any convolution.
    const auto mixed = [&](double u) { return derivative([&](double v) { return moved(u, v); }, 2 * h); };
    const auto across = [&](double t) { return changed(0, t, 0); };
    const double expected[5] = {
        s2 * derivative([&](double t) { return -moved(t, 0); }, h),
        s2 * derivative([&](double t) { return -moved(0, t); }, h),
        l1 * derivative([&](double t) { return changed(t, 0, 0); }, h * s1),
        s1 * s2 * (f.is_frozen() ? derivative(mixed, 2e-3 * s1) : derivative(across, h * std::min(s1, (l1 - l2) / s1))),
        l2 * derivative([&](double t) { return changed(0, 0, t); }, h * s2)};

    const double value = weight(f, cov, d, opacity, g);
    const Adjoint<double> adjoint = weight_vjp(f, cov, d, opacity, g);
    const Vec2<double> by_mean = transform_transposed(axes, adjoint.splat.dL_dmean);
    const Sym2<double> by_cov = congruence_transposed(axes, cov_grad(cov, adjoint.splat));
    const double actual[5] = {s2 * by_mean.x, s2 * by_mean.y, l1 * by_cov.xx, s1 * s2 * 2 * by_cov.xy, l2 * by_cov.yy};
    EXPECT_NEAR(adjoint.weighted, value, 1e-14 * value);  // alpha is linear in opacity
    for (int k = 0; k < 5; ++k) {
      ASSERT_NEAR(actual[k], expected[k], 1e-6 * std::abs(expected[k]) + 1e-9 * value)
          << k << ": sigma " << s1 << " " << s2 << " turned " << angle;
    }
  }
}

// The trapezoidal rule with step h errs by exp(-2 pi^2 (sigma/h)^2) for a Gaussian and, for the
// logistic, whose poles lie 2.7 sigma off the real axis, by exp(-2 pi 2.7 sigma/h): both below 1e-7
// at h <= sigma. From sigma = 1 on, h = 1: the sum over the pixels themselves.
TEST_P(FootprintTest, MassIsConserved) {
  const Footprint& f = GetParam();
  const double sigmas[][2] = {{0.05, 0.05}, {0.2, 0.06}, {0.5, 0.3}, {1, 1}, {3, 1}, {8, 2}};
  for (const auto& [s1, s2] : sigmas) {
    for (const double angle : {0.0, 0.4, kPi / 4, kPi / 2, 2.2}) {
      if (kSanitized && angle != 0.4) continue;
      const Cov2d<double> cov = covariance(s1, s2, angle);
      const double step = 1 / std::ceil(1 / s2);
      const int n = int((1.5 + 8 * std::hypot(s1, 0.3)) / step);
      double total = 0;
      for (int y = -n; y <= n; ++y) {
        for (int x = -n; x <= n; ++x) total += step * step * weight(f, cov, {x * step, y * step}, 1.0);
      }
      // Without compensation the dilated Gaussian keeps its peak instead.
      const Cov2d<double> mass = f.is("point") ? blur(cov, f.options.number) : cov;
      const double expected = 2 * kPi * std::sqrt(mass.det);
      // `cumulant` truncates a series: 1/(240000 l^4) of the amplitude (docs/internals/numerics.md) in each of some
      // 2 pi 9 s1' s2' pixels, against a mass of 2 pi s1 s2; 6.6% in the limit sigma = 0 (measured).
      const double l = s2 * s2 + kPixelVariance;
      const double truncation =
          f.is("cumulant") ? std::min(0.066, 9 * (s1 * s1 + kPixelVariance) / (s1 * s2) / (240000 * l * l * l * l)) : 0;
      EXPECT_NEAR(total / expected, 1, 1e-6 + truncation) << s1 << " " << s2 << " " << angle;
    }
  }
}

// Widening by a variance v changes the weight by at most v/2 max|Laplacian| = v / l2; dilation,
// which keeps the peak, by less. The logistic's density is 1.6^2 2 pi / 16 - 1 = 5.3e-3 too high.
TEST_P(FootprintTest, WideSplatsAreTheGaussianItself) {
  const Footprint& f = GetParam();
  Random random(2);
  for (int trial = 0; trial < 2000; ++trial) {
    const double s2 = random.log_uniform(20, 1000), s1 = s2 * random.log_uniform(1, 100), u = random.uniform(0, 4),
                 turn = random.uniform(0, 2 * kPi);
    const Cov2d<double> cov = covariance(s1, s2, random.uniform(0, kPi));
    const Vec2<double> d = unwhiten(whiten(cov), on_circle(u, turn));
    const double v = std::max(f.options.number, kPixelVariance);
    ASSERT_NEAR(weight(f, cov, d, 1.0), std::exp(-u * u / 2), v / (s2 * s2) + (f.is_analytic() ? 5.4e-3 : 0));
  }
}

// The nodes have five digits: a coordinate below 1/2 is off by 5e-6 at most, its square by 5e-6.
template <int S> void expect_moments_of_the_pixel() {
  double sum_x = 0, sum_y = 0, sum_xx = 0, sum_xy = 0, sum_yy = 0;
  for (int s = 0; s < S; ++s) {
    const Vec2<double> n = box_node<S>(s);
    sum_x += n.x;
    sum_y += n.y;
    sum_xx += n.x * n.x;
    sum_xy += n.x * n.y;
    sum_yy += n.y * n.y;
    EXPECT_LE(std::max(std::abs(n.x), std::abs(n.y)), Box<S>::kReach);
    EXPECT_LT(Box<S>::kReach, 0.5);
  }
  EXPECT_NEAR(sum_x, 0, 1e-15);
  EXPECT_NEAR(sum_y, 0, 1e-15);
  EXPECT_NEAR(sum_xx / S + kBoxVariance<S>, kPixelVariance, 5e-6);
  EXPECT_NEAR(sum_yy / S + kBoxVariance<S>, kPixelVariance, 5e-6);
  EXPECT_NEAR(sum_xy / S, 0, 5e-6);
}
TEST(BoxNodes, HaveTheMomentsOfThePixel) {
  expect_moments_of_the_pixel<1>();
  expect_moments_of_the_pixel<4>();
  expect_moments_of_the_pixel<16>();
}

// What a sample that moves does behind a splat, by the displacement in front of it, the mean, Sigma and the opacity;
// also where alpha is capped and where a coordinate is held at its bound. The differences are good to 1e-9 of the
// largest.
TEST_P(FootprintTest, MovesMatchDifferences) {
  const Footprint& f = GetParam();
  if (f.move_reach == 0) return;
  Random random(31);
  int held = 0, capped = 0;
  for (int trial = 0; trial < 2000; ++trial) {
    const double s2 = random.log_uniform(0.05, 3), s1 = s2 * random.log_uniform(1.05, 10),
                 angle = random.uniform(0, kPi);
    const double opacity = trial % 4 ? random.uniform(0.1, 0.98) : random.uniform(1.0, 3.0), h = 1e-4;
    const int s = trial % f.samples;
    const Cov2d<double> cov = covariance(s1, s2, angle);
    const Vec2<double> at =
        unwhiten(f.in_double.ellipse(f.row(cov)), on_circle(random.uniform(0, 2), random.uniform(0, 7)));
    const Vec2<double> node = f.node(s), d = {at.x - node.x, at.y - node.y};
    const double reach = f.move_reach;
    const Vec2<double> moved = {random.uniform(-reach, reach), random.uniform(-reach, reach)};
    const double by_alpha = random.normal();
    const Vec2<double> by_moved = {random.normal(), random.normal()};
    // Of what is behind the splat: the derivative with respect to alpha as composited, and to where the node is then.
    const auto loss = [&](Vec2<double> step, Vec2<double> front, Cov2d<double> c, double o) {
      const SplatRow<double> row = f.row(c, o);
      const Vec2<double> p = {d.x + step.x + front.x, d.y + step.y + front.y};
      const double alpha = std::min(f.in_double.alpha(row, p, s), kAlphaMax);
      const Vec2<double> next = f.in_double.move(row, p, s, alpha, front);
      return by_alpha * alpha + by_moved.x * next.x + by_moved.y * next.y;
    };
    const SplatRow<double> row = f.row(cov, opacity);
    const Vec2<double> p = d + moved;
    const double raw = f.in_double.alpha(row, p, s), alpha = std::min(raw, kAlphaMax);
    const Vec2<double> next = f.in_double.move(row, p, s, alpha, moved);
    ASSERT_LE(std::max(std::abs(next.x), std::abs(next.y)), reach);
    const auto is_held = [&](Vec2<double> front, bool y) {
      const Vec2<double> at_front = d + front;
      const double a = std::min(f.in_double.alpha(row, at_front, s), kAlphaMax);
      const Vec2<double> after = f.in_double.move(row, at_front, s, a, front);
      return std::abs(y ? after.y : after.x) >= reach;
    };
    bool kink = std::abs(raw - kAlphaMax) < 0.02;  // within the steps of the differences
    for (const double t : {-0.02, 0.02}) {
      for (const bool y : {false, true}) {
        for (const Vec2<double> front : {Vec2<double>{moved.x + t, moved.y}, Vec2<double>{moved.x, moved.y + t}})
          kink |= is_held(front, y) != is_held(moved, y);
      }
    }
    if (kink) continue;
    held += is_held(moved, false) || is_held(moved, true);
    capped += raw > kAlphaMax;
    Vec2<double> dL_dmoved = by_moved;
    const MoveGrad<double> grad =
        f.in_double.alpha_and_move_vjp(row, p, s, alpha, raw <= kAlphaMax, by_alpha, moved, dL_dmoved);
    const SplatGrad<double> of_splat = f.in_double.prepare_vjp(cov, row, grad.sums, grad.weighted, f.options);
    const Sym2<double> by_cov = cov_grad(cov, of_splat);
    const Vec2<double> still = {0, 0};
    const auto changed = [&](double xx, double xy, double yy) {
      Cov2d<double> c = {cov.xx + xx, cov.xy + xy, cov.yy + yy, 0};
      c.det = c.xx * c.yy - c.xy * c.xy;
      return loss(still, moved, c, opacity);
    };
    const double step = h * s2, area = h * s2 * s2;
    const double actual[8] = {dL_dmoved.x,   dL_dmoved.y, -of_splat.dL_dmean.x,   -of_splat.dL_dmean.y, by_cov.xx,
                              2 * by_cov.xy, by_cov.yy,   grad.weighted / opacity};
    const double expected[8] = {
        derivative([&](double t) { return loss(still, {moved.x + t, moved.y}, cov, opacity); }, step),
        derivative([&](double t) { return loss(still, {moved.x, moved.y + t}, cov, opacity); }, step),
        derivative([&](double t) { return loss({t, 0}, moved, cov, opacity); }, step),
        derivative([&](double t) { return loss({0, t}, moved, cov, opacity); }, step),
        derivative([&](double t) { return changed(t, 0, 0); }, area),
        derivative([&](double t) { return changed(0, t, 0); }, area),
        derivative([&](double t) { return changed(0, 0, t); }, area),
        derivative([&](double t) { return loss(still, moved, cov, opacity * (1 + t)) / opacity; }, h)};
    // Rounding of the loss, of order 1, over the step.
    for (int k = 0; k < 8; ++k) {
      const double noise = 1e-14 / (k < 4 ? step : k < 7 ? area : h);
      ASSERT_NEAR(actual[k], expected[k], 1e-6 * std::abs(expected[k]) + 100 * noise)
          << k << ": sigma " << s1 << " " << s2 << " alpha " << raw;
    }
  }
  EXPECT_GT(held, 20);
  EXPECT_GT(capped, 20);
}

// Random search outside the ellipse.
TEST_P(FootprintTest, SupportIsConservative) {
  const Footprint& f = GetParam();
  Random random(3);
  for (int trial = 0; trial < search_trials(30000); ++trial) {
    const double s2 = random.log_uniform(0.01, 100), s1 = std::min(100.0, s2 * random.log_uniform(1, 1000));
    const double opacity = random.log_uniform(0.004, 1);
    const SplatRow<double> row = f.row(covariance(s1, s2, random.uniform(0, kPi)), opacity);
    const double level = f.in_double.level(row);
    for (int k = 0; k < 12; ++k) {
      const double beyond =
          std::max(level, 0.0) * (1 + random.log_uniform(1e-9, 2)) + (level > 0 ? 0 : random.uniform(0, 1));
      const Vec2<double> z =
          unwhiten(f.in_double.ellipse(row), on_circle(std::sqrt(beyond), random.uniform(0, 2 * kPi)));
      const int sample = (trial + k) % f.samples;
      const Vec2<double> node = f.node(sample);
      double alphas[16];
      f.in_double.alphas(row, {z.x - node.x, z.y - node.y}, alphas);
      ASSERT_LT(alphas[sample], kAlphaMin)
          << "sigma " << s1 << " " << s2 << " opacity " << opacity << " level " << level << " |w d|^2 " << beyond;
    }
  }
}

// What the contract says of support ellipses, and culling relies on: in no direction wider than that of Sigma +
// support_variance, and of no higher level.
TEST_P(FootprintTest, SupportStaysWithinItsBounds) {
  const Footprint& f = GetParam();
  Random random(6);
  for (int trial = 0; trial < search_trials(30000); ++trial) {
    const double s2 = random.log_uniform(1e-4, 100), s1 = std::min(100.0, s2 * random.log_uniform(1, 1e4));
    const double opacity = random.log_uniform(0.004, 100);
    const FootprintOptions options = {random.below(2) ? f.options.number : random.log_uniform(1e-3, 30)};
    const Cov2d<double> cov = covariance(s1, s2, random.uniform(0, kPi)),
                        bound = blur(cov, f.support_variance(options));
    SplatRow<double> row = {};
    f.in_double.prepare(cov, options, row);
    row.opacity = opacity;
    ASSERT_LE(f.in_double.level(row), 2 * std::log(opacity / kAlphaMin) + f.extra_level + 1e-9) << s1 << " " << s2;
    // Half the extent of |w d|^2 <= 1 along u is the length of w^-T u.
    const Mat2<double> w = f.in_double.ellipse(row);
    const double det = w.xx * w.yy - w.xy * w.yx;
    const Vec2<double> u = on_circle(1, random.uniform(0, 2 * kPi));
    const double extent = std::hypot(w.yy * u.x - w.yx * u.y, w.xx * u.y - w.xy * u.x) / std::abs(det);
    const double most = u.x * u.x * bound.xx + 2 * u.x * u.y * bound.xy + u.y * u.y * bound.yy;
    ASSERT_LE(extent * extent, most * (1 + 1e-6)) << s1 << " " << s2 << " " << options.number;
  }
}

// The bound in the comment of Analytic::level.
TEST(AnalyticLevel, HoldsAlongOneAxis) {
  for (double sigma = 0.005; sigma < 200; sigma *= 1.01) {
    const double ww = 1 / (sigma * sigma + kPixelVariance);
    const auto axis = LogisticAxis<double>::at(1 / sigma);
    const auto window = [&](double u) {
      const LogisticWindow<double> f(u / sigma, axis);
      return f.numerator / f.denominator;
    };
    for (double u = 0; u * u * ww < 40; u += 0.002 / std::sqrt(ww)) {
      const double ratio = window(u) / window(0);
      if (ratio <= kAlphaMin) break;
      ASSERT_GE(-2 * std::log(ratio), u * u * ww - ww * ww / 48 - 0.05) << "sigma " << sigma << " u " << u;
    }
  }
}

double correction(double t, double p, double unit = 1, double scale = 1) {
  const auto axis = CumulantAxis<double>::at(t, unit, scale);
  return CumulantAxis<double>::constant(t, unit, scale) - axis.subtract_from(0.0, axis.capped(p));
}

// The bound in the comment of Cumulant::level, per axis.
TEST(CumulantAxisTest, LowersTheExponentByItsBoundAtMost) {
  for (double t = 0.01; t < 12.005; t += 0.01) {
    for (double p = 0; p < 100; p += 0.01) {
      ASSERT_GE(2 * Cumulant::kOrder4 * correction(std::min(t, 12.0), p), -t * t / 124) << "t " << t << " p " << p;
    }
  }
}

// On both sides of the cap, where the second derivative jumps, and of the floor under 1 - x, where the first does.
TEST(CumulantAxisTest, DerivativesMatchDifferences) {
  Random random(4);
  for (int trial = 0; trial < search_trials(10000); ++trial) {
    const double t = random.log_uniform(0.01, 12.1), p = random.uniform(-30, 30);
    const auto axis = CumulantAxis<double>::at(t);
    if (std::abs(p * p / axis.cap - 1) < 0.01 || std::abs(t - 12) < 0.01) continue;
    const double by_p = derivative([&](double h) { return correction(t, p + h); }, 1e-3);
    const double by_t = derivative([&](double h) { return correction(t + h, p); }, 1e-4 * t);
    const double capped = axis.capped(p);
    // The terms stay below 10 c4 (p^2 + t)^2; the differences round them by eps / h.
    const double size = 10 * axis.c4 * (p * p + t) * (p * p + t);
    ASSERT_NEAR(2 * axis.half_by_p(p, capped), by_p, 1e-10 * size) << "t " << t << " p " << p;
    ASSERT_NEAR(axis.by_t(capped), by_t, 1e-10 * size / t) << "t " << t << " p " << p;
  }
}

// In other coordinates it is the same correction, with the derivatives of those coordinates.
TEST(CumulantAxisTest, Scales) {
  Random random(5);
  for (int trial = 0; trial < 1000; ++trial) {
    const double t = random.log_uniform(0.01, 11.9), p = random.uniform(-10, 10), unit = 0.3, scale = 1.7;
    const auto plain = CumulantAxis<double>::at(t), scaled = CumulantAxis<double>::at(t / scale, unit, scale);
    const double P = plain.capped(p), Q = scaled.capped(p / scale), tiny = 1e-13 * (1 + P * P * P * plain.c4);
    ASSERT_NEAR(correction(t / scale, p / scale, unit, scale), unit * correction(t, p), tiny);
    ASSERT_NEAR(scaled.half_by_p(p / scale, Q), unit * scale * plain.half_by_p(p, P), 10 * tiny);
    ASSERT_NEAR(scaled.by_t(Q), unit * scale * plain.by_t(P), 10 * tiny);
  }
}

/// A Gauss-Legendre rule of N nodes in double, against moments x^k: exact up to k = 2N - 1.
template <int N> void expect_rule() {
  using Rule = GaussLegendre<N, double>;
  for (int k = 0; k < 2 * N + 1; ++k) {
    double sum = 0;
    for (int i = 0; i < N; ++i) sum += Rule::weight(i) * std::pow(2 * Rule::node(i), k);
    const double exact = k % 2 ? 0 : 1.0 / (k + 1);
    if (k < 2 * N) {
      EXPECT_NEAR(sum, exact, 4 * kEps<double>) << N << " nodes, x^" << k;
    } else {
      EXPECT_GT(std::abs(sum - exact), 1e-8) << N;  // the check can fail
    }
  }
}
TEST(GaussLegendreRule, IntegratesPolynomials) {
  expect_rule<4>();
  expect_rule<6>();
  expect_rule<8>();
  expect_rule<12>();
}

// Against the closed form in long double, on both sides of the switch.
TEST(NormalMomentsTest, MatchTheClosedForm) {
  Random random(7);
  for (int trial = 0; trial < search_trials(100000); ++trial) {
    const double width = random.log_uniform(1e-3, 100), z = random.uniform(-4, 4) * std::max(1.0, width / 2);
    const NormalMoments<double> m =
        width <= 0.5 ? short_interval_moments(z, width) : interval_moments(z - width / 2, z + width / 2);
    const long double a = std::abs(z) - width / 2.0L, b = std::abs(z) + width / 2.0L;
    const long double ea = std::exp(-a * a / 2), eb = std::exp(-b * b / 2), root = std::sqrt(0.5L);
    const long double value = std::sqrt(acosl(-1) / 2) * (std::erfc(a * root) - std::erfc(b * root));
    const long double first = (z < 0 ? -1 : 1) * (ea - eb), second = value + a * ea - b * eb;
    // Roundings of the ends, which the exponent multiplies, and of differences that lose a factor of 3
    // at width 1/2. The six nodes err by (6!)^4 / (13 (12!)^3) = 1.9e-16 times width^13 and a twelfth
    // derivative: 10395 for the value, 12 times as much for the second moment.
    const double nodes = width <= 0.5 ? 1.9e-16 * 12 * 10395 * std::pow(width, 13) : 0;
    const double size = std::abs(z) + 1, bound = 16 * kEps<double> * std::max(double(value), 1e-30) * size * size;
    ASSERT_NEAR(m.value, double(value), bound) << "z " << z << " width " << width;
    ASSERT_NEAR(m.first, double(first), bound * size + nodes) << "z " << z << " width " << width;
    ASSERT_NEAR(m.second, double(second), bound * size * size + nodes) << "z " << z << " width " << width;
  }
}

const Footprint& exact() { return footprint_named("exact"); }

// box_excess() along one axis, and that it is not wildly loose: the ratio comes within a third.
TEST(BoxExcess, HoldsAlongOneAxis) {
  for (double sigma = 1e-3; sigma < 100; sigma *= 1.01) {
    const double t = 1 / (sigma * sigma + kPixelVariance), amp = sigma * std::sqrt(t);
    double most = -100;
    for (double u = 0; u * u * t < 40; u += 0.002 / std::sqrt(t)) {
      const double integral = sigma * interval_moments((u - 0.5) / sigma, (u + 0.5) / sigma).value;
      if (integral < 1e-280) break;
      most = std::max(most, 2 * std::log(integral / amp) + u * u * t);
    }
    ASSERT_LE(most, box_excess(t) + 1e-12) << sigma;
    if (sigma < 0.02) {
      ASSERT_GE(most, 2.0 / 3 * box_excess(t)) << sigma;
    }
  }
}

// The same for the pixel itself, in any direction.
TEST(BoxExcess, HoldsForThePixel) {
  Random random(8);
  for (int trial = 0; trial < search_trials(20000); ++trial) {
    const double s2 = random.log_uniform(1e-3, 3), s1 = s2 * random.log_uniform(1, 1000);
    const Cov2d<double> cov = covariance(s1, s2, random.uniform(0, kPi)), wide = blur(cov, kPixelVariance);
    const Lower2<double> w = whiten(wide);
    const double excess = box_excess(wide.yy / wide.det) + box_excess(wide.xx / wide.det);
    for (int k = 0; k < 20; ++k) {
      const double radius = random.uniform(0, 4);
      const Vec2<double> d = unwhiten(w, on_circle(radius, random.uniform(0, 2 * kPi)));
      const double bound = std::sqrt(cov.det / wide.det) * std::exp((excess - radius * radius) / 2);
      ASSERT_LE(weight(exact(), cov, d, 1.0), bound * (1 + 1e-9)) << s1 << " " << s2 << " d " << d.x << " " << d.y;
    }
  }
}

// From the matrix with x first follows that with the wide axis first, entry by entry, as nothing cancels: at most 15
// roundings, and up to five from the entries of the covariance, each of which is rounded for itself.
TEST(GaussianShapeTest, TurnsToTheWideAxis) {
  Random random(10);
  int turned = 0;
  for (int trial = 0; trial < search_trials(20000); ++trial) {
    const double s2 = random.log_uniform(1e-2, 100), s1 = s2 * random.log_uniform(1, 1e4);
    const Cov2d<float> cov = rounded<float>(blur(covariance(s1, s2, random.uniform(0, kPi)), kPixelVariance));
    const Mat2<double> expected = whiten_wide_first(Cov2d<double>{cov.xx, cov.xy, cov.yy, cov.det});
    const Mat2<float> w = wide_first(gaussian_shape(cov, 1.0f));
    turned += cov.yy > cov.xx;
    const double pairs[][2] = {{w.xx, expected.xx}, {w.xy, expected.xy}, {w.yx, expected.yx}, {w.yy, expected.yy}};
    for (const auto& [found, value] : pairs) ASSERT_NEAR(found, value, 20 * kEps<float> * std::abs(value));
  }
  EXPECT_GT(turned, search_trials(20000) / 3);
}

// The branches of `exact` meet: across each switch the weight changes by no more than it must.
TEST(ExactBranches, AgreeWhereTheyMeet) {
  Random random(9);
  for (int trial = 0; trial < search_trials(20000); ++trial) {
    const double across = random.below(2) ? 0.5 : 2.0, ratio = random.log_uniform(1, 100);
    const double angle = random.uniform(0, kPi);
    // The narrow deviation of which 1/across is what is left given the wide axis.
    const Cov2d<double> unit = covariance(ratio, 1, angle);
    const double s2 = std::sqrt(std::max(unit.xx, unit.yy) / unit.det) / across;
    const Vec2<double> at = on_circle(random.uniform(0, 3), random.uniform(0, 2 * kPi));
    double value[2];
    for (int side = 0; side < 2; ++side) {
      const double s = s2 * (side ? 1 + 1e-13 : 1 - 1e-13);
      const Cov2d<double> cov = covariance(ratio * s, s, angle);
      value[side] = weight(exact(), cov, unwhiten(whiten(blur(cov, kPixelVariance)), at), 1.0);
    }
    // 2e-13 of sigma, and of d with it, times a slope of at most 3 ratio per deviation.
    ASSERT_NEAR(value[0], value[1], 1e-12 * (1 + ratio)) << ratio << " " << angle;
  }
}

template <typename T> bool all_finite(const SplatGrad<T>& g) {
  return std::isfinite(g.dL_dmean.x) && std::isfinite(g.dL_dmean.y) && std::isfinite(g.dL_dwhite.xx) &&
         std::isfinite(g.dL_dwhite.xy) && std::isfinite(g.dL_dwhite.yy) && std::isfinite(g.dL_dlog_amp);
}

// Discs, needles along the axes and across them, invisible and immense ones, near and far.
TEST_P(FootprintTest, HardInputsStayFiniteInFloat) {
  const Footprint& f = GetParam();
  float g[16];
  std::fill(g, g + 16, 1.0f);
  for (double s1 = 1e-6; s1 < 2e6; s1 *= 10) {
    for (double s2 = std::max(1e-6, s1 * 1e-6); s2 <= s1 * 1.5; s2 *= 10) {
      for (const double angle : {0.0, kPi / 2, kPi / 4, 0.3, 1e-4}) {
        const Cov2d<float> cov = rounded<float>(covariance(s1, s2, angle));
        for (const double distance : {0.0, 0.5, s2, s1, 30.0, 1e3, 1e5}) {
          for (const double direction : {angle, angle + kPi / 2, 0.0, 1.0}) {
            const Vec2<double> d = on_circle(distance, direction);
            const Adjoint<float> a = weight_vjp(f, cov, {float(d.x), float(d.y)}, 1.0f, g);
            ASSERT_TRUE(std::isfinite(a.weighted) && all_finite(a.splat))
                << "sigma " << s1 << " " << s2 << " turned " << angle << " d " << d.x << " " << d.y;
            ASSERT_GE(a.weighted, 0);
            ASSERT_LE(a.weighted, 1.01f * f.samples);
          }
        }
      }
    }
  }
}

// To first order: every quantity that alpha depends on carries a few roundings, so the error is a
// few eps times |dI/dd| (|d| + half a pixel) + I. Twelve is the longest chain (eigenframe, window). Those
// that sum up a logarithm to base 2 round each partial sum, which lies between the peak's and the
// weight's, by half an eps of it: six sums at most (the peak, two squares, cumulant's constants and axes).
TEST_P(FootprintTest, FloatAgreesWithDouble) {
  const Footprint& f = GetParam();
  Random random(5);
  for (int trial = 0; trial < search_trials(20000); ++trial) {
    const double s2 = random.log_uniform(1e-2, 100), s1 = std::min(1000.0, s2 * random.log_uniform(1, 1e4));
    const Cov2d<float> cov = rounded<float>(covariance(s1, s2, random.uniform(0, kPi)));
    const Cov2d<double> same = {cov.xx, cov.xy, cov.yy, cov.det};
    const Mat2<double> w = f.in_double.ellipse(f.row(same));
    const Vec2<double> at = unwhiten(w, on_circle(random.uniform(0, 4), random.uniform(0, 2 * kPi)));
    const Vec2<float> d = {float(at.x), float(at.y)};
    const Vec2<double> dd = {d.x, d.y};
    // `exact` cuts the Gaussian off at 7 deviations, exp(-24.5) = 2.3e-11 of its peak.
    const double floor = f.is("exact") ? 5e-11 : 1e-37;
    for (int s = 0; s < f.samples; ++s) {
      float pick[16] = {};
      double pick_too[16] = {};
      pick[s] = 1;
      pick_too[s] = 1;
      const Adjoint<double> adjoint = weight_vjp(f, same, dd, 1.0, pick_too);
      const double condition =
          std::hypot(adjoint.splat.dL_dmean.x, adjoint.splat.dL_dmean.y) * (std::hypot(dd.x, dd.y) + 0.5) +
          adjoint.weighted;
      double peaks[16];
      f.in_double.alphas(f.row(same), {0, 0}, peaks);
      const double peak = peaks[0];
      const bool in_exponent = !f.is_analytic() && !f.is_normal();
      const double exponent = in_exponent ? std::abs(std::log(peak)) + std::abs(std::log(adjoint.weighted)) : 0;
      ASSERT_NEAR(weight(f, cov, d, 1.0f, pick), adjoint.weighted,
                  kEps<float> * (12 * condition + 3 * exponent * adjoint.weighted) + floor)
          << s1 << " " << s2;
    }
  }
}

}  // namespace
}  // namespace ar::test
