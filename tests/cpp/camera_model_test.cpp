// Every camera model against the contract of core/camera/contract.h: its Jacobian and its velocity are derivatives of
// its map, its bound holds, and its adjoints are those of its functions. What they give for the numbers of a camera is
// examined in project_test.cpp.
#include "support.h"

namespace ar::test {
namespace {

template <class Model> class CameraModelTest : public ::testing::Test {};

template <class List> struct TypesOf;
template <class... M> struct TypesOf<CameraModelList<M...>> {
  using type = ::testing::Types<M...>;
};
struct NameOfModel {
  template <class Model> static std::string GetName(int) { return Model::kName; }
};
using EveryModel = TypesOf<CameraModels>::type;
TYPED_TEST_SUITE(CameraModelTest, EveryModel, NameOfModel);

double& number(Vec3<double>& v, int k) { return k == 0 ? v.x : k == 1 ? v.y : v.z; }
double number(Vec2<double> v, int k) { return k == 0 ? v.x : v.y; }

/// A camera of the model with all effects, a point in its camera space, a velocity, and a gradient in the image.
struct Trial {
  View<double> at;
  FullCamera<double> camera;
  Vec3<double> p, w;
  Vec2<double> g;

  /// `reach`: how far from the axis the point is, as a share of what the camera sees.
  Trial(Random& random, int model, double reach)
      : at(random_view<double>(random, kAllEffects, model)), camera(at.load<FullCamera<double>>()) {
    const double z = random.uniform(1, 6), side = reach * at.scale(z);
    p = {side * random.uniform(-1, 1), side * random.uniform(-1, 1), z};
    w = {random.normal(), random.normal(), random.normal()};
    g = {random.normal(), random.normal()};
  }
  Vec2<double> pixel(Vec3<double> point) const {
    return project_mean(camera, at.test.world(point.x, point.y, point.z)).pixel;
  }
  double scalar(Vec2<double> v) const { return g.x * v.x + g.y * v.y; }
};

constexpr double kStep = 1e-3;

/// derivative() errs by kStep^4 f^(5) / 30: for f = 1/z^3 at z = 1, the worst here, by 1e-10 f. Rounding is
/// eps f / kStep = 1e-13 f.
void expect_near(double actual, double expected, double size) {
  EXPECT_NEAR(actual, expected, 1e-9 * (std::abs(expected) + size));
}

/// Gradient `actual` of f(point) at `point` against differences.
template <class Function>
void expect_gradient(const Vec3<double>& actual, Vec3<double> point, const Function& f, double size) {
  for (int k = 0; k < 3; ++k) {
    Vec3<double> gradient = actual;
    const auto moved = [&](double t) {
      Vec3<double> q = point;
      number(q, k) += t;
      return f(q);
    };
    expect_near(number(gradient, k), derivative(moved, kStep), size);
  }
}

/// The same by every number of a lens that has a gradient. `f` takes the camera.
template <class Function>
void expect_lens_gradient(Lens<double> actual, const FullCamera<double>& camera, const Function& f, double size) {
  for (int k = 0; k < kLensWidth - kLensFixed; ++k) {
    const auto moved = [&](double t) {
      FullCamera<double> other = camera;
      reinterpret_cast<double*>(&other.lens)[k] += t;
      return f(other);
    };
    expect_near(reinterpret_cast<double*>(&actual)[k], derivative(moved, kStep), size);
  }
}

constexpr int kTrials = 200;
constexpr double kNearAxis = 0.1, kFarFromAxis = 1;

TYPED_TEST(CameraModelTest, TheJacobianIsTheDerivativeOfTheMapNearTheAxis) {
  Random random(1);
  for (int trial = 0; trial < kTrials; ++trial) {
    Trial t(random, kCameraModel<TypeParam>, kNearAxis);
    t.camera.lens.center = {0, 0};  // which may clamp a point near the axis
    const Vec3<double> mean = t.at.test.world(t.p.x, t.p.y, t.p.z);
    const Jacobian<double> j = make_jacobian(t.camera, t.p);
    const double size = std::max(std::abs(j.x.x), std::abs(j.y.y));
    for (int row = 0; row < 2; ++row) {
      expect_gradient(
          row == 0 ? j.x : j.y, mean, [&](Vec3<double> q) { return number(project_mean(t.camera, q).pixel, row); },
          size);
    }
  }
}

TYPED_TEST(CameraModelTest, TheVelocityIsTheDerivativeOfTheMapEverywhere) {
  Random random(2);
  for (int trial = 0; trial < kTrials; ++trial) {
    const Trial t(random, kCameraModel<TypeParam>, kFarFromAxis);
    const Vec2<double> v = TypeParam::velocity(t.camera, t.p, t.w);
    for (int k = 0; k < 2; ++k) {
      expect_near(number(v, k), derivative([&](double s) { return number(t.pixel(t.p + s * t.w), k); }, kStep),
                  t.camera.focal.x);
    }
  }
}

TYPED_TEST(CameraModelTest, NoJacobianIsLargerThanTheBound) {
  Random random(3);
  double tightest = 0;
  for (int trial = 0; trial < 20 * kTrials; ++trial) {
    const Trial t(random, kCameraModel<TypeParam>, 3);
    const Jacobian<double> j = make_jacobian(t.camera, t.p);
    const double xx = dot(j.x, j.x), xy = dot(j.x, j.y), yy = dot(j.y, j.y);
    const double norm = std::sqrt((xx + yy) / 2 + std::hypot((xx - yy) / 2, xy));
    const double bound = std::sqrt(largest_zoom2(t.camera)) * largest_stretch(t.camera, t.p);
    ASSERT_LE(norm, bound * (1 + 1e-12));
    tightest = std::max(tightest, norm / bound);
  }
  EXPECT_GT(tightest, 0.5);  // a bound that is too large culls nothing
}

TYPED_TEST(CameraModelTest, AdjointsOfThePointMatchDifferences) {
  Random random(4);
  for (int trial = 0; trial < kTrials; ++trial) {
    Trial t(random, kCameraModel<TypeParam>, kNearAxis);
    t.camera.lens.center = {0, 0};
    const FullCamera<double>& camera = t.camera;
    const double f = camera.focal.x;

    const Vec3<double> mean = t.at.test.world(t.p.x, t.p.y, t.p.z);
    Vec3<double> by_view = TypeParam::depth_vjp(t.p, 0.7);
    const Vec3<double> by_mean = project_mean_vjp(camera, project_mean(camera, mean), t.g, by_view);
    expect_gradient(
        by_mean, mean,
        [&](Vec3<double> q) { return t.scalar(project_mean(camera, q).pixel) + 0.7 * depth_of(camera, q); }, f);

    const JacobianGrad<double> grad = [&] {
      const Jacobian<double> j = make_jacobian(camera, t.p);
      const Vec3<double> x = {random.normal(), random.normal(), random.normal()};
      const Vec3<double> y = {random.normal(), random.normal(), random.normal()};
      return JacobianGrad<double>{x, y, dot(x, j.x) + dot(y, j.y)};
    }();
    expect_gradient(
        jacobian_vjp(camera, make_jacobian(camera, t.p), t.p, grad), t.p,
        [&](Vec3<double> q) {
          const Jacobian<double> j = make_jacobian(camera, q);
          return dot(grad.x, j.x) + dot(grad.y, j.y);
        },
        f);

    Lens<double> by_lens = {};
    Vec2<double> by_focal = {0, 0};
    const VelocityGrad<double> by = TypeParam::velocity_vjp(camera, t.p, t.w, t.g, by_lens, by_focal);
    const auto speed = [&](const FullCamera<double>& c, Vec3<double> p, Vec3<double> w) {
      return t.scalar(TypeParam::velocity(c, p, w));
    };
    expect_gradient(by.p, t.p, [&](Vec3<double> q) { return speed(camera, q, t.w); }, f);
    expect_gradient(by.w, t.w, [&](Vec3<double> q) { return speed(camera, t.p, q); }, f);
    expect_lens_gradient(by_lens, camera, [&](const auto& c) { return speed(c, t.p, t.w); }, f);
    for (int k = 0; k < 2; ++k) {
      const auto zoomed = [&](double s) {
        FullCamera<double> c = camera;
        (k == 0 ? c.focal.x : c.focal.y) += s;
        return speed(c, t.p, t.w);
      };
      expect_near(number(by_focal, k), derivative(zoomed, kStep), f);
    }

    Vec3<double> by_p = {0, 0, 0};
    by_lens = {};
    TypeParam::defocus_vjp(camera.lens, t.p, 0.9, by_p, by_lens);
    expect_gradient(by_p, t.p, [&](Vec3<double> q) { return 0.9 * TypeParam::defocus(camera.lens, q); }, 1);
    expect_lens_gradient(by_lens, camera, [&](const auto& c) { return 0.9 * TypeParam::defocus(c.lens, t.p); }, 1);

    Vec3<double> by_ray = {0, 0, 0};
    ray_vjp(camera, t.w, by_ray);
    expect_gradient(by_ray, mean, [&](Vec3<double> q) { return dot(t.w, TypeParam::ray(camera, q)); }, 1);
  }
}

// Nearer to a pole than Lens::reach says, and on it.
TEST(EquirectangularTest, NothingIsLargerAtThePolesThanAtTheReach) {
  Random random(5);
  for (const double across : {0.0, 1e-300, 1e-20, 1e-9, 1e-3, 0.5, 0.999}) {
    for (const double up : {-1.0, 1.0}) {
      const Trial t(random, kCameraModel<Equirectangular>, kNearAxis);
      const FullCamera<double>& camera = t.camera;
      const double angle = random.uniform(-kPi, kPi), n = 3, cap = across / camera.lens.reach;
      const Vec3<double> p = {n * cap * std::sin(angle), n * up * std::sqrt(1 - cap * cap), n * cap * std::cos(angle)};
      const ProjectedMean<double> seen = project_mean(camera, t.at.test.world(p.x, p.y, p.z));
      ASSERT_TRUE(seen.valid);
      const double largest = camera.lens.reach * std::max(camera.focal.x, camera.focal.y) / n;
      const Vec2<double> v = Equirectangular::velocity(camera, p, t.w);
      Vec3<double> by_view = {0, 0, 0};
      Equirectangular::map_vjp(camera, seen, {1, 0}, by_view);
      EXPECT_LE(std::sqrt(dot(by_view, by_view)), largest * (1 + 1e-9));
      EXPECT_LE(std::abs(v.x), largest * std::sqrt(dot(t.w, t.w)) * (1 + 1e-9));
      const Jacobian<double> j = make_jacobian(camera, p);
      EXPECT_NEAR(std::sqrt(dot(j.x, j.x)), camera.lens.reach * camera.focal.x / n, 1e-9 * largest);
      EXPECT_NEAR(std::sqrt(dot(j.y, j.y)), camera.focal.y / n, 1e-9 * largest);
      const Vec3<double> g = jacobian_vjp(camera, j, p, {j.x, j.y, dot(j.x, j.x) + dot(j.y, j.y)});
      EXPECT_LE(std::sqrt(dot(g, g)), 4 * largest * largest * camera.lens.reach);
    }
  }
}

// A splat is shown where it is nearest to the middle of the picture, which may lie on the seam.
TEST(EquirectangularTest, ThePixelIsLessThanHalfATurnFromTheMiddle) {
  Random random(6);
  for (int trial = 0; trial < kTrials; ++trial) {
    Trial t(random, kCameraModel<Equirectangular>, kNearAxis);
    t.camera.lens.center = {random.uniform(-4, 4), 0};
    const double longitude = random.uniform(-kPi, kPi), turn = 2 * kPi * t.camera.focal.x;
    const double x = t.pixel({2 * std::sin(longitude), 0.3, 2 * std::cos(longitude)}).x - 31.5;
    EXPECT_LE(std::abs(x), turn / 2 * (1 + 1e-12));
    const double turns = (x - t.camera.focal.x * (longitude - t.camera.lens.center.x)) / turn;
    EXPECT_NEAR(turns, std::round(turns), 1e-9);
  }
}

}  // namespace
}  // namespace ar::test
