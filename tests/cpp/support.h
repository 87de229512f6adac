// What the tests share: random numbers, differences, covariances, a camera.
#pragma once

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>
#include <vector>

#include "core/camera.h"
#include "models.h"

namespace ar::test {

/// Rounding error of one operation, relative.
template <typename T> inline constexpr T kEps = std::numeric_limits<T>::epsilon() / 2;

#if defined(AR_SANITIZED)
inline constexpr bool kSanitized = true;
#else
inline constexpr bool kSanitized = false;
#endif

/// How many trials a long search for a wrong number has. Under sanitizers, which are ten times as slow and look at
/// memory rather than at numbers, a tenth.
constexpr int search_trials(int trials) { return kSanitized ? trials / 10 : trials; }

struct Random {
  std::mt19937_64 engine;
  explicit Random(uint64_t seed) : engine(seed) {}
  double uniform(double lo, double hi) { return lo + (hi - lo) * std::generate_canonical<double, 53>(engine); }
  double log_uniform(double lo, double hi) { return std::exp(uniform(std::log(lo), std::log(hi))); }
  double normal() { return std::normal_distribution<double>()(engine); }
  int below(int n) { return int(uniform(0, n)); }
};

/// f'(0) from five points: error h^4 f^(5) / 30 and rounding eps |f| / h.
template <class Function> double derivative(const Function& f, double h) {
  return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h);
}

/// Sum over the samples of g[s] alpha at d; g null: their mean.
template <typename T>
T weight(const Footprint& footprint, Cov2d<T> cov, Vec2<T> d, T opacity = T(1), const T* g = nullptr) {
  T alphas[16], total = 0;
  footprint.model<T>().alphas(footprint.row(cov, opacity), d, alphas);
  for (int s = 0; s < footprint.samples; ++s) total += (g ? g[s] : T(1) / footprint.samples) * alphas[s];
  return total;
}

template <typename T> void add(const ShapeGrad<T>& one, ShapeGrad<T>& sums) {
  sums.offset = sums.offset + one.offset;
  sums.shape = {sums.shape.xx + one.shape.xx, sums.shape.xy + one.shape.xy, sums.shape.yy + one.shape.yy};
}

/// [l1 l12; l12 l2] turned by an angle, its determinant without cancellation.
inline Cov2d<double> turned(double l1, double l12, double l2, double angle) {
  const double c = std::cos(angle), s = std::sin(angle);
  return {c * c * l1 - 2 * c * s * l12 + s * s * l2, c * s * (l1 - l2) + (c * c - s * s) * l12,
          s * s * l1 + 2 * c * s * l12 + c * c * l2, l1 * l2 - l12 * l12};
}

/// A needle or a disc of standard deviations s1, s2 along the axes of an angle.
inline Cov2d<double> covariance(double s1, double s2, double angle) { return turned(s1 * s1, 0, s2 * s2, angle); }

template <typename T> Cov2d<T> rounded(Cov2d<double> c) { return {T(c.xx), T(c.xy), T(c.yy), T(c.det)}; }

/// d with w d = z.
template <typename T> Vec2<T> unwhiten(const Mat2<T>& w, Vec2<T> z) {
  const T det = w.xx * w.yy - w.xy * w.yx;
  return {(w.yy * z.x - w.xy * z.y) / det, (w.xx * z.y - w.yx * z.x) / det};
}
template <typename T> Vec2<T> unwhiten(const Lower2<T>& w, Vec2<T> z) { return unwhiten(all_of(w), z); }

inline Vec2<double> on_circle(double radius, double angle) {
  return {radius * std::cos(angle), radius * std::sin(angle)};
}

/// A lens that asks for nothing.
template <typename T> Lens<T> plain_lens(T tan_x, T tan_y) {
  Lens<T> lens = {};
  lens.tan_half_fov = {tan_x, tan_y};
  lens.focus = T(1);
  lens.near = T(kNear);
  lens.far = lens.reach = lens.fold = std::numeric_limits<T>::infinity();
  return lens;
}

/// Matrices of a camera turned about x and y, moved, and with its principal point off the centre. `fov_tan` of an
/// orthographic one is half its width in world units.
template <typename T> struct TestCamera {
  int width, height;
  T tan_x, tan_y;
  T view[16], proj[16], position[3];

  TestCamera(int w, int h, double fov_tan, Vec3<double> turn_and_shift, Vec2<double> principal,
             bool orthographic = false)
      : width(w), height(h), tan_x(T(fov_tan)), tan_y(T(fov_tan * h / w)) {
    const double a = turn_and_shift.x, b = turn_and_shift.y, shift = turn_and_shift.z;
    const double near = 0.01, far = 100;
    const double m[4][4] = {{std::cos(b), 0, std::sin(b), shift},
                            {std::sin(a) * std::sin(b), std::cos(a), -std::sin(a) * std::cos(b), -shift},
                            {-std::cos(a) * std::sin(b), std::sin(a), std::cos(a) * std::cos(b), 0.5 * shift},
                            {0, 0, 0, 1}};
    const double by_z = orthographic ? 0 : 1, by_one = 1 - by_z;  // what takes the principal point away, and w
    const double p[4][4] = {{1 / double(tan_x), 0, by_z * principal.x, by_one * principal.x},
                            {0, 1 / double(tan_y), by_z * principal.y, by_one * principal.y},
                            {0, 0, far / (far - near), -far * near / (far - near)},
                            {0, 0, by_z, by_one}};
    for (int r = 0; r < 4; ++r) {
      for (int c = 0; c < 4; ++c) {
        double sum = 0;
        for (int k = 0; k < 4; ++k) sum += p[r][k] * m[k][c];
        view[4 * c + r] = T(m[r][c]);
        proj[4 * c + r] = T(sum);
      }
    }
    for (int c = 0; c < 3; ++c) position[c] = T(-(m[0][c] * m[0][3] + m[1][c] * m[1][3] + m[2][c] * m[2][3]));
  }

  CameraView<T> camera_view() const { return {view, proj, position, width, height, tan_x, tan_y, nullptr}; }
  /// Through a lens, which must outlive what is returned.
  CameraView<T> camera_view(const Lens<T>& lens) const {
    return {view, proj, position, width, height, tan_x, tan_y, reinterpret_cast<const T*>(&lens)};
  }

  /// The world point at camera-space x, y, z.
  Vec3<T> world(double x, double y, double z) const {
    const double v[3] = {x - view[12], y - view[13], z - view[14]};
    const auto at = [&](int c) { return T(view[4 * c] * v[0] + view[4 * c + 1] * v[1] + view[4 * c + 2] * v[2]); };
    return {at(0), at(1), at(2)};
  }
};

template <typename T> TestCamera<T> test_camera() { return {64, 48, 0.5, {0.3, -0.4, 0.7}, {0.1, -0.2}}; }

/// What a camera is loaded from.
template <typename T> struct View {
  TestCamera<T> test = test_camera<T>();
  Lens<T> lens = plain_lens<T>(test.tan_x, test.tan_y);

  template <class Cam> Cam load() const { return load_camera_as<Cam>(test.camera_view(lens)); }

  /// World units across what the camera sees at depth z, or so.
  double scale(double z) const { return lens.model == kCameraModel<Orthographic> ? 4 : z; }

  /// What number k of CameraGrad is the derivative by.
  T& number(int k) {
    constexpr int kRows[] = {0, 1, 3};  // of a clip matrix
    if (k < 12) return test.view[4 * (k % 4) + k / 4];
    if (k < 24) return test.proj[4 * (k % 4) + kRows[k / 4 - 3]];
    return k < 27 ? test.position[k - 24] : reinterpret_cast<T*>(&lens)[k - 27];
  }
};
enum Effect { kOffCenter = 1, kDefocus = 2, kShift = 4, kTurn = 8, kScreen = 16, kAllEffects = 31 };

/// Through camera model number `model`, with these effects, as large as a splat or so.
template <typename T> View<T> random_view(Random& random, int effects, int model) {
  View<T> view;
  if (model == kCameraModel<Orthographic>) {
    view.test = {64, 48, 2, {0.3, -0.4, 0.7}, {0.1, -0.2}, true};
    view.lens = plain_lens<T>(view.test.tan_x, view.test.tan_y);
  }
  view.lens.model = T(model);
  if (model == kCameraModel<Fov>) {
    view.lens.distortion[0] = T(random.uniform(0.2, 1.5));
  } else if (model != kCameraModel<Pinhole> && model != kCameraModel<Orthographic>) {
    for (T& k : view.lens.distortion) k = T(0.02 * random.normal());
  }
  const bool equirectangular = model == kCameraModel<Equirectangular>;
  view.lens.reach = T(equirectangular ? random.uniform(10, 100) : random.uniform(0.5, 1));
  const auto normal = [&](double size) { return T(size * random.normal()); };
  if (effects & kOffCenter) view.lens.center = {normal(0.5), normal(0.5)};
  if (effects & kDefocus) {
    view.lens.aperture = T(random.log_uniform(0.01, 1));
    view.lens.focus = T(random.uniform(1, 6));
  }
  if (effects & kShift) view.lens.shift = {normal(0.2), normal(0.2), normal(0.2)};
  if (effects & kTurn) view.lens.turn = {normal(0.1), normal(0.1), normal(0.1)};
  if (effects & kScreen) view.lens.screen = {normal(5), normal(5)};
  return view;
}

}  // namespace ar::test
