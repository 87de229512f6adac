// Projection and its adjoint: the whole chain from a Gaussian's parameters to alphas and colour.
#include <algorithm>
#include <cstring>

#include "support.h"

namespace ar::test {
namespace {

constexpr int kStride = 16;

/// Which of the alternative inputs describe a Gaussian. A degree of -1: a colour.
struct Form {
  bool with_cov3d;
  int sh_degree;
};

/// Every input of one Gaussian, scalars only, so that it is also an array of numbers.
template <typename T> struct Parameters {
  Vec3<T> mean, scale;
  Vec4<T> rotation;
  Sym3<T> cov3d;
  T opacity;
  Vec3<T> color, sh[kStride];

  T& number(int k) { return reinterpret_cast<T*>(this)[k]; }

  Gaussians<T> view(Form form, T scale_modifier = T(1)) const {
    const bool colored = form.sh_degree < 0;
    return {1,
            &mean,
            form.with_cov3d ? nullptr : &scale,
            form.with_cov3d ? nullptr : &rotation,
            form.with_cov3d ? &cov3d : nullptr,
            &opacity,
            colored ? nullptr : sh,
            colored ? &color : nullptr,
            kStride,
            std::max(form.sh_degree, 0),
            scale_modifier};
  }

  /// As the destination of gradients.
  GaussianGrads<T> targets(Form form, T* means2d) {
    const bool colored = form.sh_degree < 0;
    return {&mean,
            form.with_cov3d ? nullptr : &scale,
            form.with_cov3d ? nullptr : &rotation,
            form.with_cov3d ? &cov3d : nullptr,
            &opacity,
            colored ? nullptr : sh,
            colored ? &color : nullptr,
            means2d,
            3};
  }
};

/// A run of numbers in Parameters.
struct Field {
  const char* name;
  int first, count;
};
constexpr Field kMean = {"mean", 0, 3}, kScale = {"scale", 3, 3}, kRotation = {"rotation", 6, 4},
                kCov3d = {"cov3d", 10, 6}, kOpacity = {"opacity", 16, 1}, kColor = {"color", 17, 3},
                kSh = {"sh", 20, 48};

std::vector<Field> fields_of(Form form) {
  std::vector<Field> fields = {kMean, kOpacity, form.sh_degree < 0 ? kColor : kSh};
  if (form.with_cov3d) {
    fields.push_back(kCov3d);
  } else {
    fields.insert(fields.end(), {kScale, kRotation});
  }
  return fields;
}

template <typename T> Sym3<T> cov3d_of(Vec4<T> rotation, Vec3<T> s) {
  const Mat3<T> r = rotation_matrix(normalize_quaternion(rotation));
  const auto at = [&](int i, int j) { return dot(mul(r.row[i], s), mul(r.row[j], s)); };
  return {at(0, 0), at(0, 1), at(0, 2), at(1, 1), at(1, 2), at(2, 2)};
}

template <typename T> TestCamera<T> test_camera() { return {64, 48, 0.5, {0.3, -0.4, 0.7}, {0.1, -0.2}}; }

/// L = sum_k g_k alpha(at pixel k) + c . color, differentiable wherever the Gaussian is kept.
template <class F> struct Loss {
  Camera<double> camera;
  Form form;
  double scale_modifier = 1.3;
  Vec2<double> pixels[3] = {};
  double g[3] = {};
  Vec3<double> c = {};

  int project_to(const Parameters<double>& p, Splat<F, double>& splat) const {
    double depth;
    return project(camera, p.view(form, scale_modifier), 0, options_of<F>(), splat, depth);
  }
  Vec2<double> offset(int k, const Splat<F, double>& splat) const {
    return {pixels[k].x - splat.mean.x, pixels[k].y - splat.mean.y};
  }

  double operator()(const Parameters<double>& p) const {
    Splat<F, double> splat = {};
    EXPECT_GT(project_to(p, splat), 0);
    const auto terms = F::terms(splat.shape, splat.opacity);
    double loss = dot(c, splat.color);
    for (int k = 0; k < 3; ++k) {
      for (int s = 0; s < F::kSamples; ++s) loss += g[k] * F::alpha(terms, offset(k, splat), s);
    }
    return loss;
  }

  /// `gap`: difference of the eigenvalues of Sigma.
  Parameters<double> gradient(const Parameters<double>& p, double gap, double* means2d) const {
    Splat<F, double> splat = {};
    project_to(p, splat);
    const auto terms = F::terms(splat.shape, splat.opacity);
    PairGrad<double> sums = {{}, 0, c};
    for (int k = 0; k < 3; ++k) {
      const Vec2<double> d = offset(k, splat);
      for (int s = 0; s < F::kSamples; ++s) {
        const double alpha = F::alpha(terms, d, s);
        ShapeGrad<double> one = {};
        F::add_alpha_vjp(terms, d, s, alpha, g[k], one);
        // A frozen adjoint is deliberately not the formula's. Give it the formula's own frame term.
        if constexpr (std::is_same_v<F, Erf>) {
          // (dI/du v - dI/dv u) / gap, whitened
          const Vec2<double> z = transform(terms.w, d), r = splat.shape.inv_sigma;
          one.shape.xy = (r.y / r.x * one.offset.y * z.x - r.x / r.y * one.offset.x * z.y) / (gap * r.x * r.y);
        } else if constexpr (kIsFrozen<F>) {
          using Paper = Analytic<FrameGradient::kPaper>;
          const auto paper = Paper::terms(
              Paper::Shape<double>{splat.shape.inv_sigma, splat.shape.axis, splat.shape.mass}, splat.opacity);
          ShapeGrad<double> turned = {};
          Paper::add_alpha_vjp(paper, d, s, alpha, g[k], turned);
          one.shape.xy = turned.shape.xy / (gap * splat.shape.inv_sigma.x * splat.shape.inv_sigma.y);
        }
        add(F::collect(terms, one, g[k] * alpha), sums.shape);
        sums.weighted += g[k] * alpha;
      }
    }
    Parameters<double> out = {};
    project_vjp<F>(camera, p.view(form, scale_modifier), 0, options_of<F>(), sums, out.targets(form, means2d));
    return out;
  }
};

template <class F> class ProjectTest : public ::testing::Test {};
TYPED_TEST_SUITE(ProjectTest, AllFootprints, FootprintName);

// Gaussians in and around the frustum, those beyond the clamp of x/z large enough to reach back.
TYPED_TEST(ProjectTest, GradientsMatchDifferences) {
  using F = TypeParam;
  const TestCamera<double> test = test_camera<double>();
  Random random(1);
  int clamped = 0, checked = 0;
  for (int trial = 0; checked < 120; ++trial) {
    const double z = random.uniform(1, 6), size = z * random.log_uniform(0.01, 0.5);
    Parameters<double> p;
    p.mean = test.world(z * random.uniform(-1, 1), z * random.uniform(-0.8, 0.8), z);
    p.scale = {size * random.uniform(0.2, 1), size * random.uniform(0.2, 1), size * random.uniform(0.2, 1)};
    p.rotation = {random.normal(), random.normal(), random.normal(), random.normal()};
    p.cov3d = cov3d_of(p.rotation, p.scale);
    p.opacity = random.uniform(0.05, 1);
    p.color = {random.uniform(0.1, 1), random.uniform(0.1, 1), random.uniform(0.1, 1)};
    for (auto& c : p.sh) c = {0.5 * random.normal(), 0.5 * random.normal(), 0.5 * random.normal()};

    Loss<F> loss = {load_camera(test.look()), {trial % 2 == 1, trial % 5 - 1}};
    Splat<F, double> splat = {};
    if (loss.project_to(p, splat) == 0 || splat.level <= 0) continue;
    const Vec3<double> view = project_mean(loss.camera, p.mean).view;
    const auto factors = project_covariance(loss.camera, p.view(loss.form, loss.scale_modifier), 0, view);
    const Cov2d<double>& cov = factors.cov;
    const double gap = std::hypot(cov.xx - cov.yy, 2 * cov.xy), wide = std::sqrt((cov.xx + cov.yy + gap) / 2);
    const double narrow = std::sqrt(cov.det) / wide;
    // Differences may straddle no kink: not where a colour or a ratio is clamped, nor near circles.
    const auto near_zero = [](double color) { return color > 0 && color < 0.02; };
    const auto near_edge = [](double ratio, double limit) { return std::abs(std::abs(ratio) - limit) < 0.01; };
    if (near_zero(splat.color.x) || near_zero(splat.color.y) || near_zero(splat.color.z) ||
        near_edge(view.x / view.z, loss.camera.limit.x) || near_edge(view.y / view.z, loss.camera.limit.y) ||
        gap < 0.1 * wide * wide) {
      continue;
    }
    ++checked;
    clamped += factors.jacobian.clamped_x || factors.jacobian.clamped_y;
    for (int k = 0; k < 3; ++k) {
      const Vec2<double> z = on_circle(random.uniform(0, 2), random.uniform(0, 2 * kPi));
      loss.pixels[k] = splat.mean + unwhiten(F::ellipse(splat.shape), z);
      loss.g[k] = random.uniform(0.5, 1);
    }
    loss.c = {random.normal(), random.normal(), random.normal()};
    double means2d[3];
    Parameters<double> actual = loss.gradient(p, gap, means2d);

    // A step moves the splat by 1e-3 of its narrow width, so that h^4 f^(5) is below 1e-9.
    const double turn = 1e-3 * narrow / wide, least = std::min({p.scale.x, p.scale.y, p.scale.z});
    const auto step_of = [&](const Field& field) {
      return field.first == kMean.first       ? 1e-3 * narrow * z / loss.camera.focal.x
             : field.first == kScale.first    ? turn * least
             : field.first == kRotation.first ? turn * p.rotation.w
             : field.first == kCov3d.first    ? turn * least * least
                                              : 1e-3 * p.opacity;
    };
    for (const Field& field : fields_of(loss.form)) {
      const double h = step_of(field);
      std::vector<double> expected(field.count);
      double largest = 0;
      for (int k = 0; k < field.count; ++k) {
        expected[k] = derivative(
            [&](double t) {
              Parameters<double> q = p;
              q.number(field.first + k) += t;
              return loss(q);
            },
            h);
        largest = std::max(largest, std::abs(expected[k]));
      }
      for (int k = 0; k < field.count; ++k) {  // rounding: eps L / h, L of order one
        ASSERT_NEAR(actual.number(field.first + k), expected[k], 1e-6 * largest + 1e-15 / std::abs(h))
            << field.name << " " << k << " trial " << trial;
      }
    }
    // means2d: what moving the pixels the other way does, in units of half the image.
    const auto shifted = [&](double x, double y) {
      Loss<F> moved = loss;
      for (auto& pixel : moved.pixels) pixel = {pixel.x - x, pixel.y - y};
      return moved(p);
    };
    const double h = 1e-3 * narrow;
    const double by_x = 32 * derivative([&](double t) { return shifted(t, 0); }, h);
    const double by_y = 24 * derivative([&](double t) { return shifted(0, t); }, h);
    ASSERT_NEAR(means2d[0], by_x, 1e-6 * std::abs(by_x) + 32e-15 / h);
    ASSERT_NEAR(means2d[1], by_y, 1e-6 * std::abs(by_y) + 32e-15 / h);
    ASSERT_EQ(means2d[2], 0);
  }
  EXPECT_GE(clamped, 10);
}

template <typename T> Parameters<T> visible_gaussian() {
  Parameters<T> p = {};
  p.mean = test_camera<T>().world(0.1, 0.05, 2);
  p.scale = {T(0.1), T(0.05), T(0.2)};
  p.rotation = {T(1), T(0.5), T(-0.25), T(0.75)};
  p.opacity = T(0.8);
  p.color = {T(0.5), T(0.25), T(1)};
  p.cov3d = cov3d_of(p.rotation, p.scale);
  return p;
}

// Powers of two scale a quaternion without rounding, so nothing but its gradient changes.
TYPED_TEST(ProjectTest, QuaternionsOfAnyLengthSurvive) {
  using F = TypeParam;
  const TestCamera<float> test = test_camera<float>();
  const Camera<float> camera = load_camera(test.look());
  const Form form = {false, -1};
  const PairGrad<float> sums = {{{0.5f, 0.25f}, {1, 0.5f, 0.75f}}, 1, {1, 1, 1}};
  const auto run = [&](Vec4<float> rotation, Splat<F, float>& splat) {
    Parameters<float> p = visible_gaussian<float>();
    p.rotation = rotation;
    float depth;
    Vec4<float> gradient;
    GaussianGrads<float> out = {};
    out.rotations = &gradient;
    EXPECT_GT(project(camera, p.view(form), 0, options_of<F>(), splat, depth), 0);
    project_vjp<F>(camera, p.view(form), 0, options_of<F>(), sums, out);
    return gradient;
  };
  const Vec4<float> q = visible_gaussian<float>().rotation;
  Splat<F, float> expected = {}, splat = {};
  const Vec4<float> g = run(q, expected);
  for (const float length :
       {std::ldexp(1.0f, -120), std::ldexp(1.0f, -30), std::ldexp(1.0f, 30), std::ldexp(1.0f, 100)}) {
    const Vec4<float> gradient = run({length * q.x, length * q.y, length * q.z, length * q.w}, splat);
    EXPECT_EQ(std::memcmp(&splat, &expected, sizeof splat), 0) << length;
    EXPECT_FLOAT_EQ(length * gradient.x, g.x) << length;
    EXPECT_FLOAT_EQ(length * gradient.w, g.w) << length;
  }
  run({1, 0, 0, 0}, expected);
  const Vec4<float> none = run({0, 0, 0, 0}, splat);
  EXPECT_EQ(std::memcmp(&splat, &expected, sizeof splat), 0);
  for (const float x : {none.x, none.y, none.z, none.w}) EXPECT_EQ(x, 0);
}

template <class F, typename T> void expect_culled_unless_finite() {
  const TestCamera<T> test = test_camera<T>();
  const auto radius = [&](const Parameters<T>& p, Form form) {
    Splat<F, T> splat = {};
    T depth;
    const int r = project(load_camera(test.look()), p.view(form), 0, options_of<F>(), splat, depth);
    EXPECT_TRUE(r > 0 || splat.level <= 0);
    return r;
  };
  const T inf = std::numeric_limits<T>::infinity(), nan = std::numeric_limits<T>::quiet_NaN();
  for (const Form form : {Form{false, -1}, Form{true, 1}}) {
    ASSERT_GT(radius(visible_gaussian<T>(), form), 0);
    for (const Field& field : fields_of(form)) {
      const int count = std::min(field.count, 3 * sh_count(std::max(form.sh_degree, 0)));
      for (int k = 0; k < std::max(count, std::min(field.count, 6)); ++k) {
        for (const T bad : {nan, inf, -inf}) {
          Parameters<T> p = visible_gaussian<T>();
          p.number(field.first + k) = bad;
          EXPECT_EQ(radius(p, form), 0) << field.name << " " << k << " = " << bad;
        }
      }
    }
  }
  for (const double z : {-1.0, 0.0, 0.199}) {  // the near plane is at 0.2
    Parameters<T> p = visible_gaussian<T>();
    p.mean = test.world(0, 0, z);
    EXPECT_EQ(radius(p, {false, -1}), 0) << z;
  }
}
TYPED_TEST(ProjectTest, CullsWhatIsNotFiniteOrBehind) {
  expect_culled_unless_finite<TypeParam, float>();
  expect_culled_unless_finite<TypeParam, double>();
}

TYPED_TEST(ProjectTest, NeverKeepsWhatMayNotBeVisible) {
  using F = TypeParam;
  const TestCamera<float> test = test_camera<float>();
  const Camera<float> camera = load_camera(test.look());
  Random random(2);
  int kept = 0;
  for (int trial = 0; trial < 200000; ++trial) {
    const double z = random.log_uniform(0.15, 100), size = z * random.log_uniform(1e-4, 3);
    const auto scale = [&] { return float(size * random.log_uniform(0.01, 1) * (random.below(2) ? 1 : -1)); };
    Parameters<float> p = {};
    p.mean = test.world(z * random.uniform(-3, 3), z * random.uniform(-3, 3), z);
    p.scale = {scale(), scale(), scale()};
    p.rotation = {float(random.normal()), float(random.normal()), float(random.normal()), float(random.normal())};
    p.opacity = float(random.log_uniform(0.003, random.below(10) ? 1 : 50));
    const FootprintOptions options = {random.below(2) ? options_of<F>().variance : random.log_uniform(1e-3, 30)};
    Splat<F, float> splat = {};
    float depth;
    if (project(camera, p.view({false, -1}), 0, options, splat, depth) == 0) continue;
    ++kept;
    const float blur = float(std::max(options.variance, kPixelVariance));
    ASSERT_TRUE(may_be_visible(camera, p.view({false, -1}), 0, blur)) << trial;
  }
  EXPECT_GT(kept, 1000);
}

}  // namespace
}  // namespace ar::test
