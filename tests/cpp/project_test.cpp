// Projection and its adjoint: the whole chain from a Gaussian's parameters to alphas and colour.
#include <algorithm>
#include <cstring>

#include "core/project.h"
#include "support.h"

namespace ar::test {
namespace {

constexpr int kStride = sh_count(kMaxShDegree);

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

  /// Gaussians or their gradients, of the parameters that the form has.
  template <class Self, class Pointers> static void point_to(Self& self, Form form, Pointers& g) {
    g.means = &self.mean;
    if (form.with_cov3d) {
      g.cov3ds = &self.cov3d;
    } else {
      g.scales = &self.scale;
      g.rotations = &self.rotation;
    }
    g.opacities = &self.opacity;
    (form.sh_degree < 0 ? g.colors : g.shs) = form.sh_degree < 0 ? &self.color : self.sh;
  }

  Gaussians<T> view(Form form, T scale_modifier = T(1)) const {
    Gaussians<T> g = {};
    g.n = 1;
    point_to(*this, form, g);
    g.sh_stride = kStride;
    g.sh_degree = std::max(form.sh_degree, 0);
    g.scale_modifier = scale_modifier;
    return g;
  }

  /// As the destination of gradients.
  GaussianGrads<T> targets(Form form, T* means2d) {
    GaussianGrads<T> g = {};
    point_to(*this, form, g);
    g.means2d = means2d;
    g.means2d_stride = 3;
    return g;
  }
};

/// core's adjoint of Gaussian 0 from the sums over its pairs.
template <class Cam, typename T>
void vjp_from_sums(const Footprint& f, const Cam& camera, const Gaussians<T>& g, const PairGrad<T>& sums,
                   ShownGrad<T> shown, const GaussianGrads<T>& out, CameraGrad<T>* by_camera = nullptr) {
  const auto grad_of = [&](const Cov2d<T>& cov, T) { return projected_grad(f.choice(), cov, sums); };
  project_vjp(camera, g, 0, grad_of, shown, g.shs, out.shs, out, by_camera);
}

/// A run of numbers in Parameters.
struct Field {
  const char* name;
  int first, count;
};
constexpr Field kMean = {"mean", 0, 3}, kScale = {"scale", 3, 3}, kRotation = {"rotation", 6, 4},
                kCov3d = {"cov3d", 10, 6}, kOpacity = {"opacity", 16, 1}, kColor = {"color", 17, 3},
                kSh = {"sh", 20, 3 * kStride};

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

constexpr Field kCameraFields[] = {
    {"view_x", 0, 4},  {"view_y", 4, 4},    {"view_z", 8, 4}, {"clip_x", 12, 4}, {"clip_y", 16, 4},
    {"clip_w", 20, 4}, {"position", 24, 3}, {"tan", 27, 2},   {"center", 29, 2}, {"aperture", 31, 1},
    {"focus", 32, 1},  {"shift", 33, 3},    {"turn", 36, 3},  {"screen", 39, 2}, {"distortion", 41, kDistortion}};
constexpr int kFirstFixed = kCameraGradWidth - kLensFixed;

/// Each effect alone, then none, then together.
int effects_of(int trial) { return trial % 8 < 5 ? 1 << (trial % 8) : trial % 8 == 5 ? 0 : int(kAllEffects); }

/// Widths of a splat along its axes.
struct Axes {
  double gap, wide, narrow;  ///< gap: difference of the eigenvalues of Sigma

  explicit Axes(const Cov2d<double>& c)
      : gap(eigenvalue_gap(c)), wide(std::sqrt((c.xx + c.yy + gap) / 2)), narrow(std::sqrt(c.det) / wide) {}
};

/// L = sum_k g_k alpha(at pixel k) + c . color + e depth, differentiable wherever the Gaussian is kept.
template <class Cam> struct Loss {
  const Footprint& f;
  Cam camera;
  Form form;
  double scale_modifier = 1.3;
  Vec2<double> pixels[3] = {};
  double g[3] = {};
  Vec3<double> c = {};
  double e = 0;

  int project_to(const Parameters<double>& p, SplatRow<double>& splat, double& depth) const {
    return project(camera, p.view(form, scale_modifier), 0, f.choice(), splat, depth);
  }
  Vec2<double> offset(int k, const SplatRow<double>& splat) const {
    return {pixels[k].x - splat.mean.x, pixels[k].y - splat.mean.y};
  }

  double operator()(const Parameters<double>& p) const {
    SplatRow<double> splat = {};
    double depth = 0, alphas[16];
    EXPECT_GT(project_to(p, splat, depth), 0);
    // Asked for apart: project() leaves it out where a step has taken the splat off the image.
    Vec3<double> color;
    EXPECT_TRUE(splat_color(camera, p.view(form, scale_modifier), 0, p.sh, color));
    double loss = dot(c, color) + e * depth;
    for (int k = 0; k < 3; ++k) {
      f.in_double.alphas(splat, offset(k, splat), alphas);
      for (int s = 0; s < f.samples; ++s) loss += g[k] * alphas[s];
    }
    return loss;
  }

  /// `gap`: of the covariance that the footprint sees.
  Parameters<double> gradient(const Parameters<double>& p, double gap, double* means2d,
                              CameraGrad<double>* by_camera) const {
    SplatRow<double> splat = {};
    double depth = 0, alphas[16], gs[16];
    project_to(p, splat, depth);
    PairGrad<double> sums = {};
    for (int k = 0; k < 3; ++k) {
      const Vec2<double> d = offset(k, splat);
      f.in_double.alphas(splat, d, alphas);
      double weighted = 0;
      for (int s = 0; s < f.samples; ++s) weighted += (gs[s] = g[k]) * alphas[s];
      ShapeGrad<double> one = f.in_double.sums(splat, d, gs);
      // A frozen adjoint is deliberately not the formula's. Give it the formula's own frame term.
      const Vec2<double> r = {splat.shape[0], splat.shape[1]};  // 1 / standard deviations, of erf and of analytic
      if (f.is("erf")) {
        // (dI/du v - dI/dv u) / gap, whitened
        const Vec2<double> z = transform(f.in_double.mean_map(splat), d);
        one.shape.xy = (r.y / r.x * one.offset.y * z.x - r.x / r.y * one.offset.x * z.y) / (gap * r.x * r.y);
      } else if (f.is("analytic")) {
        const Footprint& paper = footprint_named("analytic_paper");
        one.shape.xy = paper.in_double.sums(splat, d, gs).shape.xy / (gap * r.x * r.y);
      }
      add(one, sums.shape);
      sums.weighted += weighted;
    }
    Parameters<double> out = {};
    vjp_from_sums(f, camera, p.view(form, scale_modifier), sums, {c, e}, out.targets(form, means2d), by_camera);
    return out;
  }
};

class ProjectTest : public ::testing::TestWithParam<Footprint> {};
AR_ALL_FOOTPRINTS(ProjectTest);

/// Compares a field of gradients with differences of `loss_at`, the loss with number k of the field t larger.
template <class Function>
void expect_derivatives(const Field& field, double h, const double* actual, const Function& loss_at, int trial) {
  std::vector<double> expected(field.count);
  double largest = 0;
  for (int k = 0; k < field.count; ++k) {
    expected[k] = derivative([&](double t) { return loss_at(k, t); }, h);
    largest = std::max(largest, std::abs(expected[k]));
  }
  for (int k = 0; k < field.count; ++k) {  // rounding: 1.5 eps L / h, the differences' weights times L of up to 6
    ASSERT_NEAR(actual[k], expected[k], 1e-6 * largest + 2e-15 / std::abs(h))
        << field.name << " " << k << " trial " << trial;
  }
}

/// That of the harmonics of Gaussian 0 before it is clamped at zero.
template <class Cam> Vec3<double> unclamped_color(const Cam& camera, const Gaussians<double>& g) {
  if (!g.shs) return g.colors ? g.colors[0] : Vec3<double>{1, 1, 1};
  double basis[sh_count(Cam::kShDegree)] = {};
  sh_basis<Cam::kShDegree>(g.sh_degree, view_direction(camera, g.means[0]).unit, basis);
  return sh_color<Cam::kShDegree>(g.sh_degree, basis, g.shs);
}

// Gaussians in and around the frustum, those beyond the clamp of x/z large enough to reach back. By everything that
// describes them and, of a full camera, by all of its numbers.
template <class Cam> void expect_gradients_match_differences(const Footprint& f, int count) {
  constexpr int kDegrees = Cam::kShDegree + 2;  // a colour too
  Random random(1);
  int clamped = 0, blurred = 0, checked = 0;
  for (int trial = 0; checked < count; ++trial) {
    const int model = Cam::kFull ? random.below(kCameraModels) : 0;
    const View<double> at = Cam::kFull ? random_view<double>(random, effects_of(trial), model) : View<double>();
    const double z = random.uniform(1, 6), scale = at.scale(z), size = scale * random.log_uniform(0.01, 0.5);
    Parameters<double> p;
    p.mean = at.test.world(scale * random.uniform(-1, 1), scale * random.uniform(-0.8, 0.8), z);
    p.scale = {size * random.uniform(0.2, 1), size * random.uniform(0.2, 1), size * random.uniform(0.2, 1)};
    p.rotation = {random.normal(), random.normal(), random.normal(), random.normal()};
    p.cov3d = cov3d_of(p.rotation, p.scale);
    p.opacity = random.uniform(0.05, 1);
    p.color = {random.uniform(0.1, 1), random.uniform(0.1, 1), random.uniform(0.1, 1)};
    for (auto& c : p.sh) c = {0.5 * random.normal(), 0.5 * random.normal(), 0.5 * random.normal()};

    Loss<Cam> loss = {f, at.load<Cam>(), {trial % 2 == 1, trial / 2 % kDegrees - 1}};
    SplatRow<double> splat = {};
    double depth;
    if (loss.project_to(p, splat, depth) == 0 || splat.level <= 0) continue;
    const Vec3<double> view = project_mean(loss.camera, p.mean).view;
    const Gaussians<double> g = p.view(loss.form, loss.scale_modifier);
    const auto factors = project_covariance(loss.camera, g, 0, view);
    const Axes own(factors.cov), seen(seen_covariance(loss.camera, g, 0, view, factors).cov);
    // Differences may straddle no kink: not where a colour or a ratio is clamped, nor near circles.
    const Vec3<double> color = unclamped_color(loss.camera, g);
    const auto near_zero = [](double c) { return std::abs(c) < 0.02; };
    const auto near_edge = [](double ratio, double center, double limit) {
      return std::abs(std::abs(ratio - center) - limit) < 0.01;
    };
    const Vec2<double> center = at.lens.center;
    if (near_zero(color.x) || near_zero(color.y) || near_zero(color.z) ||
        near_edge(view.x / view.z, center.x, loss.camera.limit.x) ||
        near_edge(view.y / view.z, center.y, loss.camera.limit.y) ||
        near_edge(std::hypot(view.x, view.y) / view.z, 0, at.lens.reach) ||
        near_edge(std::atan2(std::hypot(view.x, view.y), view.z), 0, at.lens.reach) ||
        near_edge(std::hypot(view.x, view.z) / std::sqrt(dot(view, view)), 0, 1 / at.lens.reach) ||
        seen.gap < 0.1 * seen.wide * seen.wide) {
      continue;
    }
    ++checked;
    const bool orthographic = model == kCameraModel<Orthographic>;
    const bool lens = !orthographic && model != kCameraModel<Pinhole>;
    clamped += !orthographic && (factors.jacobian.clamped_x || factors.jacobian.clamped_y);
    blurred += seen.wide > 1.1 * own.wide;
    for (int k = 0; k < 3; ++k) {
      const Vec2<double> z = on_circle(random.uniform(0, 2), random.uniform(0, 2 * kPi));
      loss.pixels[k] = splat.mean + unwhiten(f.in_double.ellipse(splat), z);
      loss.g[k] = random.uniform(0.5, 1);
    }
    loss.c = {random.normal(), random.normal(), random.normal()};
    loss.e = 0.1 * (trial % 5 - 2);
    double means2d[3];
    CameraGrad<double> by_camera = {};
    Parameters<double> actual = loss.gradient(p, seen.gap, means2d, Cam::kFull ? &by_camera : nullptr);

    // A step moves the splat by 1e-3 of its narrow width, so that h^4 f^(5) is below 1e-9.
    const double turn = 1e-3 * own.narrow / own.wide, least = std::min({p.scale.x, p.scale.y, p.scale.z});
    const double move = 1e-3 * own.narrow * (orthographic ? 1 : z) / loss.camera.focal.x;
    const auto step_of = [&](const Field& field) {
      return field.first == kMean.first       ? move
             : field.first == kScale.first    ? turn * least
             : field.first == kRotation.first ? turn * p.rotation.w
             : field.first == kCov3d.first    ? turn * least * least
                                              : 1e-3 * p.opacity;
    };
    for (const Field& field : fields_of(loss.form)) {
      const auto loss_at = [&](int k, double t) {
        Parameters<double> q = p;
        q.number(field.first + k) += t;
        return loss(q);
      };
      expect_derivatives(field, step_of(field), &actual.number(field.first), loss_at, trial);
    }
    // means2d: what moving the pixels the other way does, in units of half the image.
    const auto shifted = [&](double x, double y) {
      Loss<Cam> moved = loss;
      for (auto& pixel : moved.pixels) pixel = {pixel.x - x, pixel.y - y};
      return moved(p);
    };
    const double h = 1e-3 * own.narrow;
    const double by_x = 32 * derivative([&](double t) { return shifted(t, 0); }, h);
    const double by_y = 24 * derivative([&](double t) { return shifted(0, t); }, h);
    ASSERT_NEAR(means2d[0], by_x, 1e-6 * std::abs(by_x) + 32e-15 / h);
    ASSERT_NEAR(means2d[1], by_y, 1e-6 * std::abs(by_y) + 32e-15 / h);
    ASSERT_EQ(means2d[2], 0);
    if constexpr (Cam::kFull) {
      const double* grads = reinterpret_cast<const double*>(&by_camera);
      const double reach = 1 + std::max({std::abs(p.mean.x), std::abs(p.mean.y), std::abs(p.mean.z)});
      const double focus = at.lens.focus, disc = loss.camera.focal.x * at.lens.aperture;
      const double refocus =
          1e-3 * std::min(1.0, own.narrow / std::max(disc, 1e-9)) * (orthographic ? 1 : focus * focus);
      const auto camera_step = [&](const Field& field) {
        return field.first < 24    ? std::min(move, turn) / reach
               : field.first < 27  ? 1e-3 * z
               : field.first < 31  ? (lens ? std::min(move / z, turn) : turn)  // these move what is seen through a lens
               : field.first == 31 ? 1e-3 * std::max(at.lens.aperture, 0.01)
               : field.first == 32 ? refocus
               : field.first < 36  ? move
               : field.first < 39  ? move / (1 + scale)
               : field.first < 41  ? 1e-3 * own.narrow
                                   : std::min(move, turn) / (1 + 15 * scale);  // up to r^7 of the focal length
      };
      for (const Field& field : kCameraFields) {
        const auto loss_at = [&](int k, double t) {
          View<double> moved = at;
          moved.number(field.first + k) += t;
          Loss<Cam> other = loss;
          other.camera = moved.load<Cam>();
          return other(p);
        };
        expect_derivatives(field, camera_step(field), grads + field.first, loss_at, trial);
      }
      for (int k = kFirstFixed; k < kCameraGradWidth; ++k) ASSERT_EQ(grads[k], 0) << k;
    }
    if (::testing::Test::HasFatalFailure()) return;
  }
  EXPECT_GE(clamped, 10);
  if constexpr (Cam::kFull) {
    EXPECT_GE(blurred, 20);
  }
}
TEST_P(ProjectTest, GradientsMatchDifferences) { expect_gradients_match_differences<Camera<double>>(GetParam(), 120); }
TEST_P(ProjectTest, GradientsOfAFullCameraMatchDifferences) {
  expect_gradients_match_differences<FullCamera<double>>(GetParam(), 160);
}

/// Compares what both cameras make of random Gaussians, there and back.
template <typename T> void expect_a_plain_lens_changes_no_bit(const Footprint& f) {
  const View<T> at;
  const auto plain = at.template load<Camera<T>>();
  const auto full = at.template load<FullCamera<T>>();
  Random random(3);
  int drawn = 0;
  for (int trial = 0; trial < 2000; ++trial) {
    const double z = random.uniform(-0.5, 6), size = std::abs(z) * random.log_uniform(1e-3, 1);
    Parameters<T> p = {};
    p.mean = at.test.world(z * random.uniform(-1, 1), z * random.uniform(-1, 1), z);
    p.scale = {T(size * random.uniform(0.01, 1)), T(size * random.uniform(0.01, 1)), T(size)};
    p.rotation = {T(random.normal()), T(random.normal()), T(random.normal()), T(random.normal())};
    p.cov3d = cov3d_of(p.rotation, p.scale);
    p.opacity = T(random.uniform(0, 1));
    for (auto& c : p.sh) c = {T(random.normal()), T(random.normal()), T(random.normal())};
    const auto number = [&] { return T(random.normal()); };
    const PairGrad<T> sums = {{{number(), number()}, {number(), number(), number()}}, number()};
    const ShownGrad<T> shown = {{number(), number(), number()}, number()};
    const Form form = {trial % 2 == 1, trial / 2 % 5 - 1};
    struct Result {
      SplatRow<T> splat;
      Parameters<T> grads;
      T means2d[3], depth;
      int radius, candidate;
    };
    const auto run = [&](const auto& camera, CameraGrad<T>* to, Result& out) {
      std::memset(static_cast<void*>(&out), 0, sizeof out);
      const Gaussians<T> g = p.view(form);
      out.candidate = may_be_visible(camera, g, 0, cull_bounds<T>(f.choice()));
      out.radius = project(camera, g, 0, f.choice(), out.splat, out.depth);
      if (out.radius > 0 && out.splat.level > T(0))
        vjp_from_sums(f, camera, g, sums, shown, out.grads.targets(form, out.means2d), to);
    };
    Result a, b;
    CameraGrad<T> by_camera = {};
    run(plain, nullptr, a);
    run(full, &by_camera, b);
    ASSERT_EQ(std::memcmp(&a, &b, sizeof a), 0) << trial;
    drawn += a.radius > 0;
  }
  EXPECT_GT(drawn, 200);
}
TEST_P(ProjectTest, ALensThatAsksForNothingChangesNoBit) {
  expect_a_plain_lens_changes_no_bit<float>(GetParam());
  expect_a_plain_lens_changes_no_bit<double>(GetParam());
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
TEST_P(ProjectTest, QuaternionsOfAnyLengthSurvive) {
  const Footprint& f = GetParam();
  const TestCamera<float> test = test_camera<float>();
  const Camera<float> camera = load_camera(test.camera_view());
  const Form form = {false, -1};
  const PairGrad<float> sums = {{{0.5f, 0.25f}, {1, 0.5f, 0.75f}}, 1};
  const auto run = [&](Vec4<float> rotation, SplatRow<float>& splat) {
    Parameters<float> p = visible_gaussian<float>();
    p.rotation = rotation;
    float depth;
    Vec4<float> gradient;
    GaussianGrads<float> out = {};
    out.rotations = &gradient;
    EXPECT_GT(project(camera, p.view(form), 0, f.choice(), splat, depth), 0);
    vjp_from_sums(f, camera, p.view(form), sums, {{1, 1, 1}, 0}, out);
    return gradient;
  };
  const Vec4<float> q = visible_gaussian<float>().rotation;
  SplatRow<float> expected = {}, splat = {};
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

template <class Cam, typename T> void expect_culled_unless_finite(const Footprint& f, const View<T>& at) {
  const TestCamera<T>& test = at.test;
  const auto radius = [&](const Parameters<T>& p, Form form) {
    SplatRow<T> splat = {};
    T depth;
    const int r = project(at.template load<Cam>(), p.view(form), 0, f.choice(), splat, depth);
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
  for (const double z : {-1.0, 0.0, 0.199 / kNear * at.lens.near, 1.001 * at.lens.far}) {
    Parameters<T> p = visible_gaussian<T>();
    p.mean = test.world(0, 0, z);
    EXPECT_EQ(radius(p, {false, -1}), 0) << z;
  }
}
TEST_P(ProjectTest, CullsWhatIsNotFiniteOrBehind) {
  expect_culled_unless_finite<Camera<float>>(GetParam(), View<float>());
  expect_culled_unless_finite<Camera<double>>(GetParam(), View<double>());
  Random random(4);
  for (int model = 0; model < kCameraModels; ++model) {
    View<float> at = random_view<float>(random, kAllEffects, model);
    at.lens.near = 0.3f;
    at.lens.far = 5;
    expect_culled_unless_finite<FullCamera<float>>(GetParam(), at);
  }
}

// A covariance that is negative definite has a positive determinant, which a blur must not turn into a splat.
TEST_P(ProjectTest, ABlurDrawsNoNegativeCovariance) {
  const Footprint& f = GetParam();
  View<float> at;
  at.lens.aperture = 1;
  at.lens.focus = 1;
  at.lens.screen = {30, 20};
  for (const float variance : {-1e-2f, -1e-4f, -1e-6f}) {
    Parameters<float> p = visible_gaussian<float>();
    p.cov3d = {variance, 0, 0, variance, 0, variance};
    SplatRow<float> splat = {};
    float depth;
    EXPECT_EQ(project(at.load<FullCamera<float>>(), p.view({true, -1}), 0, f.choice(), splat, depth), 0);
  }
}

/// The view of a world whose axes are stretched by these factors: its upper left 3x3 is no rotation.
View<float> of_stretched_world(View<float> view, Vec3<double> by) {
  const double factors[3] = {by.x, by.y, by.z};
  for (int c = 0; c < 3; ++c) {
    for (int r = 0; r < 4; ++r) {
      view.test.view[4 * c + r] *= float(factors[c]);
      view.test.proj[4 * c + r] *= float(factors[c]);
    }
  }
  return view;
}

/// `view_of`: the camera of a trial. Every other trial stretches the world.
template <class Cam, class Function>
void expect_nothing_kept_that_may_not_be_visible(const Footprint& f, const Function& view_of) {
  Random random(2);
  int kept = 0;
  for (int trial = 0; trial < search_trials(200000); ++trial) {
    const View<float>& at = view_of(trial);
    Vec3<double> by = {1, 1, 1};
    if (trial % 2) by = {random.log_uniform(0.1, 10), random.log_uniform(0.1, 10), random.log_uniform(0.1, 10)};
    const View<float> stretched = of_stretched_world(at, by);
    const auto camera = stretched.template load<Cam>();
    const double z = random.log_uniform(0.15, 100), scale = at.scale(z), size = scale * random.log_uniform(1e-4, 3);
    const auto length = [&] { return float(size * random.log_uniform(0.01, 1) * (random.below(2) ? 1 : -1)); };
    Parameters<float> p = {};
    p.mean = at.test.world(scale * random.uniform(-3, 3), scale * random.uniform(-3, 3), z);
    p.mean = {float(p.mean.x / by.x), float(p.mean.y / by.y), float(p.mean.z / by.z)};
    p.scale = {length(), length(), length()};
    p.rotation = {float(random.normal()), float(random.normal()), float(random.normal()), float(random.normal())};
    p.opacity = float(random.log_uniform(0.003, random.below(10) ? 1 : 50));
    const FootprintOptions options = {random.below(2) ? f.options.number : random.log_uniform(1e-3, 30)};
    SplatRow<float> splat = {};
    float depth;
    if (project(camera, p.view({false, -1}), 0, {f.index, options}, splat, depth) == 0) continue;
    ++kept;
    ASSERT_TRUE(may_be_visible(camera, p.view({false, -1}), 0, cull_bounds<float>({f.index, options}))) << trial;
  }
  EXPECT_GT(kept, search_trials(1000));
}
TEST_P(ProjectTest, NeverKeepsWhatMayNotBeVisible) {
  const View<float> plain;
  expect_nothing_kept_that_may_not_be_visible<Camera<float>>(GetParam(),
                                                             [&](int) -> const View<float>& { return plain; });
  std::vector<View<float>> views;
  Random random(5);
  for (int k = 0; k < 64; ++k) views.push_back(random_view<float>(random, effects_of(k), random.below(kCameraModels)));
  expect_nothing_kept_that_may_not_be_visible<FullCamera<float>>(
      GetParam(), [&](int trial) -> const View<float>& { return views[trial % views.size()]; });
}

// A speck 3 px off the image, far beyond the reach of a pixel's own variance, is drawn by a footprint that widens it to
// two pixels.
TEST(Culling, KeepsWhatAWideFootprintDraws) {
  const Footprint& mip = footprint_named("mip");
  const View<float> at;
  const auto camera = at.load<Camera<float>>();
  Parameters<float> p = visible_gaussian<float>();
  p.scale = {0.02f, 0.02f, 0.02f};
  p.opacity = 1;
  SplatRow<float> splat = {};
  float depth;
  // The principal point is off the centre: found along x.
  for (float x = -2; x < 2; x += 0.005f) {
    p.mean = at.test.world(x, 0.05, 2);
    const float left = project_mean(camera, p.mean).pixel.x;
    if (left > -2.9f) break;
    if (left < -3.1f) continue;
    EXPECT_TRUE(may_be_visible(camera, p.view({false, -1}), 0, cull_bounds<float>({mip.index, {4}})));
    EXPECT_GT(project(camera, p.view({false, -1}), 0, {mip.index, {4}}, splat, depth), 0);
    EXPECT_GT(splat.level, 0);
    return;
  }
  FAIL() << "no mean is 3 px off the image";
}

/// Quaternions of the same direction are normalised to the same bits, however long they are, as long as none of their
/// numbers is below the smallest normal one.
TEST(NormalizeQuaternion, OfAnyLength) {
  const Vec4<float> direction = {0.8f, -0.31f, 0.47f, 0.11f};
  const UnitQuaternion<float> expected = normalize_quaternion(direction);
  EXPECT_NEAR(expected.w * expected.w + expected.x * expected.x + expected.y * expected.y + expected.z * expected.z, 1,
              1e-6);
  for (int power = -120; power <= 127; ++power) {
    const float f = std::ldexp(1.0f, power);
    const UnitQuaternion<float> q =
        normalize_quaternion<float>({f * direction.x, f * direction.y, f * direction.z, f * direction.w});
    ASSERT_EQ(q.w, expected.w) << power;
    ASSERT_EQ(q.x, expected.x) << power;
    ASSERT_EQ(q.y, expected.y) << power;
    ASSERT_EQ(q.z, expected.z) << power;
    ASSERT_EQ(q.inv_norm, std::min(std::ldexp(expected.inv_norm, -power), float(kMaxQuaternionGrad))) << power;
  }
  // The smallest and the largest floats.
  for (const float f : {std::numeric_limits<float>::denorm_min(), 1e-40f, std::numeric_limits<float>::max()}) {
    const UnitQuaternion<float> q = normalize_quaternion<float>({f, 0, -f, 0});
    EXPECT_EQ(q.w, -q.y) << f;
    EXPECT_NEAR(q.w, std::sqrt(0.5), 1e-7) << f;
    EXPECT_EQ(q.x, 0) << f;
  }
}

}  // namespace
}  // namespace ar::test
