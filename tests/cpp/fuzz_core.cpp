// Any bytes as a scene: project -> bin -> blend and back must neither fault nor let a bad number spread.
//
// LLVMFuzzerTestOneInput is libFuzzer's entry point (CMake: AR_FUZZ=ON with clang). Without libFuzzer, main() feeds it
// pseudo-random bytes: fuzz_core [first seed] [number of seeds].
//
// Whatever the bytes: no fault, no undefined behaviour, what is not finite is culled, without the culled the image has
// the same bits, and it is finite. With a camera that occurs, moreover: gradients are finite, and those of the culled
// are zero. Half of the cameras are full ones, a few of them with a lens of any numbers.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <random>
#include <string>
#include <type_traits>
#include <vector>

#include "core/footprint/registry.h"
#include "core/project.h"
#include "instruction_sets.h"
#include "stages.h"
#include "support.h"

namespace ar::test {
namespace {

/// Reads numbers from bytes; zeros once they are used up.
class Bytes {
 public:
  Bytes(const uint8_t* data, size_t size) : data_(data), size_(size) {}

  uint8_t byte() { return at_ < size_ ? data_[at_++] : 0; }
  int below(int n) { return byte() % n; }
  bool one_in(int n) { return byte() % n == n - 1; }

  /// In [lo, hi].
  template <typename T> T between(double lo, double hi) {
    const int n = byte() * 256 + byte();
    return T(lo + (hi - lo) * n / 65535);
  }
  template <typename T> T log_between(double lo, double hi) {
    return T(std::exp(between<double>(std::log(lo), std::log(hi))));
  }

  /// Any bit pattern, or a number of the kind that breaks formulas.
  template <typename T> T any() {
    using Limits = std::numeric_limits<T>;
    static const T kinds[] = {T(0),
                              -T(0),
                              Limits::quiet_NaN(),
                              Limits::infinity(),
                              -Limits::infinity(),
                              Limits::denorm_min(),
                              -Limits::denorm_min(),
                              Limits::min(),
                              Limits::max(),
                              Limits::lowest(),
                              Limits::epsilon(),
                              T(1),
                              T(-1),
                              T(0.2),
                              T(1e-18),
                              T(1e18),
                              T(-1e18),
                              T(1e9),
                              T(1.0 / 255),
                              T(0.99),
                              T(16)};
    constexpr int kKinds = sizeof(kinds) / sizeof(kinds[0]);
    if (const int kind = below(2 * kKinds); kind < kKinds) return kinds[kind];
    uint8_t raw[sizeof(T)];
    for (uint8_t& b : raw) b = byte();
    T value;
    std::memcpy(&value, raw, sizeof(T));
    return value;
  }
  template <typename T> T any_finite() {
    const T value = any<T>();
    return std::isfinite(value) ? value : T(0);
  }

 private:
  const uint8_t* data_;
  size_t size_, at_ = 0;
};

/// What the ops let through: the plain camera and the options are finite, everything else is not looked at.
template <typename T> struct AnyScene {
  TestCamera<T> camera;
  bool full = false;
  Lens<T> lens = {};
  bool sane = true;  ///< the camera and the image's gradient are such as occur: gradients must be finite
  int level = 0, threads = 1;
  FootprintChoice footprint = {};
  std::vector<T> background;  ///< [count]
  std::vector<T> given;       ///< [n, given_count] channels instead of three colours, or empty
  int given_count = 0, count = 3;
  bool depth = false, inverse_depth = false;  ///< as channels, behind the others
  std::vector<Vec3<T>> means, scales, colors, shs;
  std::vector<Vec4<T>> rotations;
  std::vector<Sym3<T>> cov3ds;
  std::vector<T> opacities, dL_dimage;
  int sh_degree = 0, sh_stride = 0;
  T scale_modifier = T(1);

  explicit AnyScene(const TestCamera<T>& c) : camera(c) {}

  CameraView<T> camera_view() const { return full ? camera.camera_view(lens) : camera.camera_view(); }

  Gaussians<T> gaussians() const {
    const auto given = [](const auto& v) { return v.empty() ? nullptr : v.data(); };
    Gaussians<T> g = {};
    g.n = int64_t(means.size());
    g.means = means.data();
    g.scales = given(scales);
    g.rotations = given(rotations);
    g.cov3ds = given(cov3ds);
    g.opacities = opacities.data();
    g.shs = given(shs);
    g.colors = given(colors);
    g.sh_stride = sh_stride;
    g.sh_degree = sh_degree;
    g.scale_modifier = scale_modifier;
    return g;
  }
};

/// What occurs: effects from far below a pixel to far above an image, some in focus or at a plane to the bit.
template <typename T> Lens<T> decode_lens(Bytes& in, const TestCamera<T>& camera, bool orthographic) {
  Lens<T> lens = plain_lens(camera.tan_x, camera.tan_y);
  lens.model = T(orthographic ? kCameraModel<Orthographic> : kCameraModel<Pinhole>);
  if (in.one_in(3)) lens.near = orthographic && in.one_in(2) ? T(0) : in.log_between<T>(1e-3, 3);
  if (in.one_in(3)) lens.far = lens.near + in.log_between<T>(1e-3, 30);
  if (in.one_in(2)) lens.center = {in.between<T>(-10, 10) * camera.tan_x, in.between<T>(-10, 10) * camera.tan_y};
  if (in.one_in(2)) {
    lens.aperture = in.log_between<T>(1e-9, 1e4);
    lens.focus = in.one_in(3) ? std::max(lens.near, T(1e-3)) : in.one_in(3) ? T(2) : in.log_between<T>(1e-2, 1e3);
  }
  const auto speed = [&](double most) { return (in.one_in(2) ? T(1) : T(-1)) * in.log_between<T>(1e-12, most); };
  if (in.one_in(3)) lens.shift = {speed(1e2), in.one_in(3) ? T(0) : speed(1e2), speed(1e2)};
  if (in.one_in(3)) lens.turn = {speed(10), speed(10), in.one_in(3) ? T(0) : speed(10)};
  if (in.one_in(3)) lens.screen = {speed(1e5), in.one_in(3) ? T(0) : speed(1e5)};
  return lens;
}

template <typename T> AnyScene<T> decode(Bytes& in) {
  const int most = in.one_in(8) ? 40 : 20;  // px; one tile or several
  const int width = 1 + in.below(most), height = 1 + in.below(most);
  const double tangent = in.log_between<double>(0.05, 3);
  const bool full = in.one_in(2), orthographic = full && in.one_in(3);
  AnyScene<T> scene(TestCamera<T>(width, height, tangent,
                                  {in.between<double>(-3, 3), in.between<double>(-3, 3), in.between<double>(-2, 2)},
                                  {in.between<double>(-0.3, 0.3), in.between<double>(-0.3, 0.3)}, orthographic));
  if (in.one_in(16)) {
    scene.sane = false;
    TestCamera<T>& c = scene.camera;
    for (T& x : c.view) x = in.one_in(4) ? in.any_finite<T>() : x;
    for (T& x : c.proj) x = in.one_in(4) ? in.any_finite<T>() : x;
    for (T& x : c.position) x = in.one_in(4) ? in.any_finite<T>() : x;
    c.tan_x = std::max(std::abs(in.any_finite<T>()), std::numeric_limits<T>::denorm_min());
  }
  scene.full = full;
  if (full) {
    scene.lens = decode_lens(in, scene.camera, orthographic);
    if (in.one_in(8)) {  // a tensor on a device may hold anything
      scene.sane = false;
      for (int k = 0; k < kLensWidth; ++k) {
        if (in.one_in(4)) reinterpret_cast<T*>(&scene.lens)[k] = in.any<T>();
      }
    }
  }
  scene.footprint.index = in.below(int(footprints().size()));
  scene.level = in.below(8);
  scene.threads = in.one_in(8) ? 2 : 1;
  const double option = in.one_in(8) ? std::abs(double(in.any_finite<float>())) : in.between<double>(0, 1);
  scene.footprint.options = {option};
  // Fewer channels than three, about as many as a window has, and with what the projection writes.
  if (in.one_in(3)) scene.given_count = in.one_in(2) ? 1 + in.below(5) : 30 + in.below(5);
  scene.depth = in.one_in(4);
  scene.inverse_depth = in.one_in(4);
  scene.count = (scene.given_count ? scene.given_count : 3) + scene.depth + scene.inverse_depth;
  scene.background.resize(scene.count);
  for (T& x : scene.background) x = in.one_in(16) ? T(in.between<double>(-1e6, 1e6)) : in.between<T>(0, 1);

  const int n = in.below(13);
  const bool by_cov3d = in.one_in(3), by_sh = in.one_in(2) && scene.given_count == 0;
  scene.sh_degree = by_sh ? in.below((full ? FullCamera<T>::kShDegree : Camera<T>::kShDegree) + 1) : 0;
  scene.sh_stride = by_sh ? sh_count(scene.sh_degree) + in.below(2) : 0;
  scene.scale_modifier = in.one_in(8) ? std::max(std::abs(in.any_finite<T>()), std::numeric_limits<T>::min()) : T(1);
  const bool tame = in.one_in(2);  // most numbers of a scene are such as occur
  for (int i = 0; i < n; ++i) {
    // One number in `wild` is any, 0: none. Often the same one again: one bad number may hide another.
    const int wild = in.one_in(tame ? 8 : 2) ? 1 + in.below(8) : 0;
    const T repeated = in.any<T>();
    const bool repeats = in.one_in(3);
    const auto number = [&](auto usual) {
      if (wild == 0 || !in.one_in(wild)) return T(usual());
      return repeats && !in.one_in(4) ? repeated : in.any<T>();
    };
    // Some just behind the near plane, or where many a lens is in focus.
    const double z =
        full && in.one_in(8) ? double(in.one_in(2) ? scene.lens.near : T(2)) * (1 + 1e-6) : in.between<double>(-0.5, 8);
    const double reach = (orthographic ? 1 : z) * tangent * 1.3;
    const Vec3<T> mean = scene.camera.world(in.between<double>(-reach, reach), in.between<double>(-reach, reach), z);
    scene.means.push_back(
        {number([&] { return mean.x; }), number([&] { return mean.y; }), number([&] { return mean.z; })});
    const auto size = [&] { return in.log_between<double>(1e-4, 3); };
    const auto unit = [&] { return in.between<double>(-1, 1); };
    const auto color = [&] { return in.between<double>(-0.5, 1.5); };
    if (by_cov3d) {
      const double a = size(), b = size(), c = size(), r = unit();
      scene.cov3ds.push_back({number([&] { return a * a; }), number([&] { return r * a * b; }),
                              number([] { return 0; }), number([&] { return b * b; }), number([] { return 0; }),
                              number([&] { return c * c; })});
    } else {
      scene.scales.push_back({number(size), number(size), number(size)});
      scene.rotations.push_back({number(unit), number(unit), number(unit), number(unit)});
    }
    if (by_sh) {
      for (int k = 0; k < scene.sh_stride; ++k) scene.shs.push_back({number(color), number(color), number(color)});
    } else if (scene.given_count == 0) {
      scene.colors.push_back({number(color), number(color), number(color)});
    }
    for (int c = 0; c < scene.given_count; ++c) scene.given.push_back(number(color));
    scene.opacities.push_back(number([&] { return in.between<double>(0, 1); }));
  }
  const bool any_gradient = in.one_in(16);
  if (any_gradient) scene.sane = false;
  for (int i = 0; i < scene.count * width * height; ++i)
    scene.dL_dimage.push_back(any_gradient && in.one_in(8) ? in.any<T>() : T(std::sin(1.7 * i)));
  return scene;
}

/// Says what is wrong and stops, so that a fuzzer keeps the input.
template <typename T>
[[noreturn]] void fail(const AnyScene<T>& scene, const char* what, int64_t gaussian, double value) {
  std::fprintf(stderr, "%s: %s, %zu bytes a number, level %d, %dx%d, Gaussian %lld of %zu, value %g\n", what,
               footprints()[scene.footprint.index].name.c_str(), sizeof(T), scene.level, scene.camera.width,
               scene.camera.height, static_cast<long long>(gaussian), scene.means.size(), value);
  std::fprintf(stderr, "option %g, scale modifier %g, background %g %g %g, tan %g %g\n", scene.footprint.options.number,
               double(scene.scale_modifier), double(scene.background[0]), double(scene.background[1]),
               double(scene.background[2]), double(scene.camera.tan_x), double(scene.camera.tan_y));
  const auto print = [](const char* name, const auto* numbers, int n) {
    std::fprintf(stderr, "  %s", name);
    for (int k = 0; k < n; ++k) std::fprintf(stderr, " %.9g", double(numbers[k]));
    std::fprintf(stderr, "\n");
  };
  if (scene.full) print("lens", reinterpret_cast<const T*>(&scene.lens), kLensWidth);
  print("view", scene.camera.view, 16);
  print("proj", scene.camera.proj, 16);
  for (size_t i = 0; i < scene.means.size(); ++i) {
    print("mean", &scene.means[i].x, 3);
    if (!scene.scales.empty()) print("scales", &scene.scales[i].x, 3);
    if (!scene.rotations.empty()) print("rotation", &scene.rotations[i].x, 4);
    if (!scene.cov3ds.empty()) print("cov3d", &scene.cov3ds[i].xx, 6);
    if (!scene.colors.empty()) print("color", &scene.colors[i].x, 3);
    if (!scene.shs.empty()) print("sh", &scene.shs[i * scene.sh_stride].x, 3 * scene.sh_stride);
    print("opacity", &scene.opacities[i], 1);
  }
  std::abort();
}

template <typename T> const cpu::Stages<T>& stages_of(const AnyScene<T>& scene) {
  if constexpr (std::is_same_v<T, float>) {
    const std::vector<InstructionSet>& sets = instruction_sets();
    const InstructionSet& set = sets[scene.level % sets.size()];
    if (set.supported) return set.stages(scene.footprint.index);
  }
  return cpu::stages_of<T>(scene.footprint.index);
}

template <typename T> Rendered<T> render(const AnyScene<T>& scene) {
  Pass<T> pass;
  pass.camera = scene.camera_view();
  pass.gaussians = scene.gaussians();
  pass.footprint = scene.footprint;
  pass.background = scene.background.data();
  pass.dL_dimage = scene.dL_dimage.data();
  pass.count = scene.count;
  if (scene.given_count) {
    pass.given = scene.given.data();
    pass.given_count = scene.given_count;
  } else if (scene.count > 3) {
    pass.color = 0;
  }
  const int first = scene.given_count ? scene.given_count : 3;
  if (scene.depth) pass.depth = first;
  if (scene.inverse_depth) pass.inverse_depth = scene.count - 1;
  pass.threads = scene.threads;
  return run_stages(stages_of(scene), pass);
}

/// Whether a number of Gaussian i that decides where it is drawn is not finite.
template <typename T> bool is_broken(const AnyScene<T>& scene, size_t i) {
  const auto broken = [&](const auto& rows) {
    if (rows.empty()) return false;
    const T* numbers = reinterpret_cast<const T*>(&rows[i]);
    for (size_t k = 0; k < sizeof(rows[i]) / sizeof(T); ++k) {
      if (!std::isfinite(numbers[k])) return true;
    }
    return false;
  };
  return broken(scene.means) || broken(scene.scales) || broken(scene.rotations) || broken(scene.cov3ds) ||
         broken(scene.opacities);
}

template <typename T> AnyScene<T> without_culled(const AnyScene<T>& scene, const std::vector<int32_t>& radii) {
  AnyScene<T> kept = scene;
  const auto keep = [&](auto& rows, size_t width) {
    if (rows.empty()) return;
    size_t next = 0;
    for (size_t k = 0; k < rows.size(); ++k) {
      if (radii[k / width] > 0) rows[next++] = rows[k];
    }
    rows.resize(next);
  };
  keep(kept.means, 1);
  keep(kept.scales, 1);
  keep(kept.rotations, 1);
  keep(kept.cov3ds, 1);
  keep(kept.colors, 1);
  keep(kept.opacities, 1);
  keep(kept.shs, std::max(scene.sh_stride, 1));
  keep(kept.given, std::max(scene.given_count, 1));
  return kept;
}

template <typename T> void check(Bytes& in) {
  const AnyScene<T> scene = decode<T>(in);
  const Gaussians<T> g = scene.gaussians();
  const Rendered<T> out = render(scene);
  const int64_t n = g.n;
  for (int64_t i = 0; i < n; ++i) {
    if (out.radii[i] < 0) fail(scene, "negative radius", i, out.radii[i]);
    if (out.radii[i] > 0 && is_broken(scene, i)) fail(scene, "not finite, but drawn", i, out.radii[i]);
  }
  const Rendered<T> clean = render(without_culled(scene, out.radii));
  if (std::memcmp(clean.image.data(), out.image.data(), out.image.size() * sizeof(T)) != 0) {
    fail(scene, "what is culled changes the image", -1, 0);
  }
  for (const T value : out.dL_dchannels) {
    if (scene.sane && !std::isfinite(value)) fail(scene, "not finite: gradient of channels", -1, value);
  }
  for (const T value : out.image) {
    if (!std::isfinite(value)) fail(scene, "the image is not finite", -1, value);
  }
  if (!scene.sane) return;
  for (size_t k = 0; k < out.camera_grad.size(); ++k) {
    const T value = out.camera_grad[k];
    if (!std::isfinite(value)) fail(scene, "not finite: gradient of the camera", int64_t(k), value);
  }
  // Start, numbers per Gaussian and name of each gradient that is written.
  struct Row {
    int64_t start, width;
    const char* name;
  };
  std::vector<Row> rows = {{0, 3, "mean"}, {10 * n, 1, "opacity"}, {14 * n, 4, "mean2d"}};
  if (g.scales) rows.insert(rows.end(), {{3 * n, 3, "scale"}, {6 * n, 4, "rotation"}});
  if (g.colors) rows.push_back({11 * n, 3, "colour"});
  if (g.cov3ds) rows.push_back({18 * n, 6, "cov3d"});
  if (g.shs) rows.push_back({(g.cov3ds ? 24 : 18) * n, 3 * g.sh_stride, "coefficient"});
  for (const Row& row : rows) {
    for (int64_t k = 0; k < n * row.width; ++k) {
      const T value = out.grads[row.start + k];
      const int64_t i = k / row.width;
      if (!std::isfinite(value)) fail(scene, (std::string("not finite: gradient of ") + row.name).c_str(), i, value);
      if (out.radii[i] == 0 && value != 0) {
        fail(scene, (std::string("culled, but has a gradient of ") + row.name).c_str(), i, value);
      }
    }
  }
}

}  // namespace
}  // namespace ar::test

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  ar::test::Bytes in(data, size);
  if (in.one_in(3)) {
    ar::test::check<double>(in);
  } else {
    ar::test::check<float>(in);
  }
  return 0;
}

#if !defined(AR_LIBFUZZER)
int main(int argc, char** argv) {
  const unsigned long first = argc > 1 ? std::strtoul(argv[1], nullptr, 10) : 0;
  const unsigned long count = argc > 2 ? std::strtoul(argv[2], nullptr, 10) : 1000;
  for (unsigned long seed = first; seed < first + count; ++seed) {
    if (seed % 100 == 0) std::fprintf(stderr, "seeds from %lu\n", seed);  // where a fault is to be looked for
    std::mt19937_64 random(seed);
    std::vector<uint8_t> bytes(4096);
    for (uint8_t& b : bytes) b = uint8_t(random());
    // Where the bytes end the scene does: its last Gaussians are zeros.
    bytes.resize(1 + random() % bytes.size());
    LLVMFuzzerTestOneInput(bytes.data(), bytes.size());
  }
  return 0;
}
#endif
