// The ops prepare_cameras and prepare_lens (core/camera/prepare.h), and their adjoints. Numbers stay on the host,
// tensors on their device. A lens's limits are found once if the host knows its numbers, else by the device in every
// frame.
#include <ATen/Dispatch.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/empty_like.h>
#include <ATen/ops/zeros_like.h>
#include <c10/util/StringUtil.h>

#include <algorithm>
#include <array>
#include <cstddef>
#include <iterator>
#include <map>
#include <mutex>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "cpu/parallel.h"
#include "cpu/stages.h"
#include "torch/cameras.h"
#include "torch/check_tensors.h"
#include "torch/checks.h"
#include "torch/ops.h"
#include "torch/scene_grads.h"

namespace ar::ops {
namespace {

double number_of_model(const std::string& name) {
  const auto& names = kCameraModelNames;
  const auto found = std::find(names.begin(), names.end(), name);
  TORCH_CHECK_VALUE(found != names.end(), "model must be one of ", c10::Join(", ", names), ", got '", name, "'");
  return double(found - names.begin());
}

Lens<double> lens_of(const std::string& model, const std::vector<double>& distortion) {
  TORCH_CHECK_VALUE(distortion.size() == size_t(kDistortion), "coefficients must be ", kDistortion, " numbers, got ",
                    distortion.size());
  Lens<double> lens = {};
  lens.model = number_of_model(model);
  std::copy(distortion.begin(), distortion.end(), lens.distortion);
  return lens;
}

/// find(key), or what it found for the same key before.
template <size_t N> class Remembered {
 public:
  template <class Find> double operator()(const std::array<double, N>& key, const Find& find) {
    const std::lock_guard lock(mutex_);
    const auto known = values_.find(key);
    if (known != values_.end()) return known->second;
    if (values_.size() >= kMost) values_.clear();
    return values_[key] = find();
  }

 private:
  static constexpr size_t kMost = 4096;
  std::mutex mutex_;
  std::map<std::array<double, N>, double> values_;
};

std::array<double, kDistortion + 1> key_of_lens(const Lens<double>& lens) {
  std::array<double, kDistortion + 1> key;
  std::copy(lens.distortion, lens.distortion + kDistortion, key.begin());
  key.back() = lens.model;
  return key;
}

/// Raises for a lens that is no map.
double fold_of(const Lens<double>& lens) {
  const LimitKind kind = limit_kind(lens);
  if (kind == LimitKind::kLatitude) return kPi;
  for (int k = 0; k < kDistortion; ++k)
    TORCH_CHECK_VALUE(std::isfinite(lens.distortion[k]), "every number of coefficients must be finite, got ",
                      lens.distortion[k], " at ", k);
  static auto* folds = new Remembered<kDistortion + 1>;
  const double fold = (*folds)(key_of_lens(lens), [&] {
    const FullCamera<double> camera = bare_camera(lens);
    double least = widest_angle(kind);
    for (int direction = 0; direction < kLimitDirections; ++direction) {
      const auto find = [&](double first, double last) {
        int k = 0;
        while (k <= kLimitAngles && is_map_at(camera, limit_angle(first, last, k), direction)) ++k;
        return k;
      };
      least = std::min(least, fold_in_direction(kind, find));
    }
    return least;
  });
  if (fold > 0) return fold;
  std::ostringstream numbers;
  for (int k = 0; k < kDistortion; ++k) numbers << (k ? ", " : "") << lens.distortion[k];
  TORCH_CHECK_VALUE(false, "the ", kCameraModelNames.at(size_t(lens.model)), " lens with coefficients (", numbers.str(),
                    ") is no map at its axis");
}

/// The number that reach_of() takes, of a lens with center and tangents.
int seen_of(const Lens<double>& lens, double fold) {
  std::array<double, kDistortion + 2> key;
  const auto of_lens = key_of_lens(lens);
  std::copy(of_lens.begin(), of_lens.end(), key.begin());
  const double corner = key.back() = corner_distance(lens);
  if (!std::isfinite(corner)) return -1;
  static auto* seen = new Remembered<kDistortion + 2>;
  return int((*seen)(key, [&] {
    const FullCamera<double> camera = bare_camera(lens);
    for (int k = kLimitAngles; k >= 0; --k) {
      for (int direction = 0; direction < kLimitDirections; ++direction) {
        if (distance_seen(camera, limit_angle(0, fold, k), direction) <= corner) return double(k);
      }
    }
    return -1.0;
  }));
}

template <class Source> void prepare_on_cpu(const Source& source) {
  for (int c = 0; c < source.count; ++c) {
    const Lens<double> lens = source.lens(c);
    const double fold = finds_fold(source) ? fold_of(lens) : source.limits.fold;
    write_lens(source, c, fold, finds_reach(source) ? seen_of(lens, fold) : -1);
    source.write_matrices(c);
  }
}

template <class Source> void prepare(const Source& source, const Tensor& like) {
#if defined(AR_WITH_CUDA)
  if (like.is_cuda()) return prepare_on_cuda(source, like);
#endif
  prepare_on_cpu(source);
}

void check(PrepareCamerasArguments& a) {
  check_floating(a.views, "views");
  check_shape(a.views.dim() == 3 && a.views.size(1) == 4 && a.views.size(2) == 4, a.views, "views", "(C, 4, 4)");
  a.views = a.views.contiguous();
  const Like like{a.views, "views"};
  like.check_type(a.intrinsics, "intrinsics");
  check_rows(a.intrinsics, "intrinsics", a.views.size(0), {3, 3}, "(C, 3, 3)");
  a.intrinsics = a.intrinsics.contiguous();
  like.check_rows_of(a.coefficients, "coefficients", {kDistortion}, "(C, 12)");
  check_image_size(a.height, a.width);
  const bool has_map = may_fold(limit_kind(lens_of(a.model, std::vector<double>(kDistortion))));
  TORCH_CHECK_VALUE(a.far > a.near, "far must be above near, ", a.near, ", got ", a.far);
  TORCH_CHECK_VALUE(has_map == a.coefficients.has_value(), "coefficients must be given for a lens, and only then; got ",
                    a.coefficients ? "some" : "none", " for the model ", a.model);
}

template <typename T> CameraSource<T> source_of(const PrepareCamerasArguments& a) {
  CameraSource<T> source = {};
  source.count = int(a.views.size(0));
  source.views = const_pointer<T>(a.views);
  source.intrinsics = const_pointer<T>(a.intrinsics);
  source.coefficients = const_pointer<T>(a.coefficients);
  source.width = int(a.width);
  source.height = int(a.height);
  source.off_center = a.off_center;
  source.numbers.focus = 1;
  source.numbers.near = a.near;
  source.numbers.far = a.far;
  source.numbers.model = number_of_model(a.model);
  source.limits.height = int(a.height);
  return source;
}

}  // namespace

Results prepare_cameras(PrepareCamerasArguments a) {
  check(a);
  const int64_t count = a.views.size(0);
  const at::TensorOptions options = a.views.options();
  const Tensor view = at::empty({count, 4, 4}, options), proj = at::empty({count, 4, 4}, options);
  const Tensor position = at::empty({count, 3}, options), lens = at::empty({count, kLensWidth}, options);
  AT_DISPATCH_FLOATING_TYPES(a.views.scalar_type(), "prepare_cameras", [&] {
    auto source = source_of<scalar_t>(a);
    source.viewmatrix = pointer<scalar_t>(view);
    source.projmatrix = pointer<scalar_t>(proj);
    source.position = pointer<scalar_t>(position);
    source.out = pointer<scalar_t>(lens);
    if (count == 0) return;
    for (int c = 0; c < source.count && a.views.is_cpu(); ++c)
      TORCH_CHECK(typename CameraSource<scalar_t>::Inverse(source.pose(c)).det != 0,
                  "views must be invertible, got a singular one at ", c);
    prepare(source, a.views);
  });
  return {view, proj, position, lens};
}

Results prepare_cameras_vjp(VjpArguments<PrepareCamerasArguments> arguments) {
  PrepareCamerasArguments& a = arguments.of_op;
  check(a);
  check_needs(arguments.needs, 3);
  const int64_t count = a.views.size(0);
  const auto gradient = [&](size_t k, const char* name, at::IntArrayRef sizes) {
    return gradient_of(arguments.dL_doutputs, k, name, a.views, sizes);
  };
  const Tensor by_view = gradient(0, "dL_dviewmatrix", {count, 4, 4});
  const Tensor by_proj = gradient(1, "dL_dprojmatrix", {count, 4, 4});
  const Tensor by_position = gradient(2, "dL_dcampos", {count, 3});
  const Tensor by_lens = gradient(3, "dL_dlens", {count, kLensWidth});
  const Tensor views = at::empty_like(a.views), intrinsics = at::empty_like(a.intrinsics);
  Tensor coefficients;
  if (a.coefficients)
    coefficients = by_lens.defined() ? at::empty_like(*a.coefficients) : at::zeros_like(*a.coefficients);
  AT_DISPATCH_FLOATING_TYPES(a.views.scalar_type(), "prepare_cameras_vjp", [&] {
    const auto source = source_of<scalar_t>(a);
    CameraSourceGrads<scalar_t> grads = {};
    grads.viewmatrix = const_pointer<scalar_t>(by_view);
    grads.projmatrix = const_pointer<scalar_t>(by_proj);
    grads.position = const_pointer<scalar_t>(by_position);
    grads.lens = const_pointer<scalar_t>(by_lens);
    grads.views = pointer<scalar_t>(views);
    grads.intrinsics = pointer<scalar_t>(intrinsics);
    grads.coefficients = pointer<scalar_t>(coefficients);
    if (count == 0) return;
#if defined(AR_WITH_CUDA)
    if (a.views.is_cuda()) return prepare_vjp_on_cuda(source, grads, a.views);
#endif
    for (int c = 0; c < source.count; ++c) camera_source_vjp(source, grads, c);
  });
  const auto wanted = [&](size_t k, const Tensor& t) { return or_empty(arguments.needs[k] ? t : Tensor(), a.views); };
  return {std::vector<Tensor>{wanted(0, views), wanted(1, intrinsics), wanted(2, coefficients)}};
}

namespace {

using L = Lens<float>;
/// Numbers of a lens, and of each argument, as in PrepareLensArguments::each_part().
struct LensPart {
  size_t offset;
  int64_t count;

  int64_t first() const { return int64_t(offset / sizeof(float)); }
};
constexpr LensPart kLensParts[] = {
    {offsetof(L, tan_half_fov), 1}, {offsetof(L, tan_half_fov) + sizeof(float), 1},
    {offsetof(L, aperture), 1},     {offsetof(L, focus), 1},
    {offsetof(L, shift), 3},        {offsetof(L, turn), 3},
    {offsetof(L, screen), 2},       {offsetof(L, distortion), kDistortion},
};

void check(PrepareLensArguments& a) {
  check_floating(a.viewmatrix, "viewmatrix");
  const Like like{a.viewmatrix, "viewmatrix"};
  like.check_matrix(a.viewmatrix, "viewmatrix");
  like.check_matrix(a.projmatrix, "projmatrix");
  TORCH_CHECK_VALUE(a.numbers.size() == size_t(kLensWidth), "numbers must be ", kLensWidth, " numbers, got ",
                    a.numbers.size());
  const LensPart* part = kLensParts;
  a.each_part([&](const char* name, OptionalTensor& t) {
    const int64_t count = part++->count;
    if (!t) return;
    like.check_type(*t, name);
    TORCH_CHECK_VALUE(t->numel() == count, name, " must have ", count, " numbers, got shape ", shape_of(*t));
    t = t->contiguous();
  });
}

/// `out` may be undefined.
template <typename T> LensSource<T> source_of(PrepareLensArguments& a, const Tensor& out) {
  LensSource<T> source = {};
  std::copy(a.numbers.begin(), a.numbers.end(), &source.numbers.tan_half_fov.x);
  source.limits = {source.numbers.fold, source.numbers.reach, int(a.height)};
  LensTensors<T>& t = source.tensors;
  t.tan_half_fov_x = const_pointer<T>(a.tanfovx);
  t.tan_half_fov_y = const_pointer<T>(a.tanfovy);
  t.aperture = const_pointer<T>(a.aperture);
  t.focus = const_pointer<T>(a.focus);
  t.shift = const_pointer<T>(a.shift);
  t.turn = const_pointer<T>(a.turn);
  t.screen = const_pointer<T>(a.screen);
  t.distortion = const_pointer<T>(a.distortion);
  const LimitKind kind = limit_kind(source.numbers);
  if (a.centered || kind != LimitKind::kNone) {
    t.view = const_pointer<T>(a.viewmatrix);
    t.proj = const_pointer<T>(a.projmatrix);
  }
  if (finds_fold(source) && !a.distortion) source.limits.fold = fold_of(source.numbers);
  source.out = pointer<T>(out);
  return source;
}

}  // namespace

Results prepare_lens(PrepareLensArguments a) {
  check(a);
  const Tensor lens = at::empty({kLensWidth}, a.viewmatrix.options());
  AT_DISPATCH_FLOATING_TYPES(a.viewmatrix.scalar_type(), "prepare_lens",
                             [&] { prepare(source_of<scalar_t>(a, lens), a.viewmatrix); });
  return {lens};
}

Results prepare_lens_vjp(VjpArguments<PrepareLensArguments> arguments) {
  PrepareLensArguments& a = arguments.of_op;
  check(a);
  check_needs(arguments.needs, 2 + std::size(kLensParts));
  const Tensor by_lens = only_gradient_of(arguments.dL_doutputs, "lens", a.viewmatrix, {kLensWidth});
  Tensor by_view, by_proj;
  AT_DISPATCH_FLOATING_TYPES(a.viewmatrix.scalar_type(), "prepare_lens_vjp", [&] {
    const bool has_middle = source_of<scalar_t>(a, Tensor()).tensors.view != nullptr;
    if (!(arguments.needs[0] || arguments.needs[1])) return;
    by_view = has_middle ? at::empty_like(a.viewmatrix) : at::zeros_like(a.viewmatrix);
    by_proj = has_middle ? at::empty_like(a.projmatrix) : at::zeros_like(a.projmatrix);
    if (!has_middle) return;
#if defined(AR_WITH_CUDA)
    if (by_lens.is_cuda()) return middle_vjp_on_cuda(a.viewmatrix, a.projmatrix, by_lens, by_view, by_proj);
#endif
    write_middle_vjp(const_pointer<scalar_t>(a.viewmatrix), const_pointer<scalar_t>(a.projmatrix),
                     const_pointer<scalar_t>(by_lens), pointer<scalar_t>(by_view), pointer<scalar_t>(by_proj));
  });
  std::vector<Tensor> out = {or_empty(arguments.needs[0] ? by_view : Tensor(), by_lens),
                             or_empty(arguments.needs[1] ? by_proj : Tensor(), by_lens)};
  const LensPart* part = kLensParts;
  a.each_part([&](const char*, const OptionalTensor& t) {
    Tensor grad;
    if (arguments.needs[out.size()] && t) grad = by_lens.narrow(0, part->first(), part->count).clone().view(t->sizes());
    out.push_back(or_empty(grad, by_lens));
    ++part;
  });
  return {out};
}

double lens_fold(const std::string& model, const std::vector<double>& distortion) {
  return fold_of(lens_of(model, distortion));
}

double lens_reach(const std::string& model, const std::vector<double>& distortion, double tan_x, double tan_y, double x,
                  double y, int height) {
  Lens<double> lens = lens_of(model, distortion);
  lens.tan_half_fov = {tan_x, tan_y};
  lens.center = {x, y};
  const LimitKind kind = limit_kind(lens);
  TORCH_CHECK_VALUE(kind != LimitKind::kLatitude || height > 0, "height must be positive for the ", model,
                    " lens, got ", height);
  const double fold = fold_of(lens);
  return reach_of(kind, lens, fold, may_fold(kind) ? seen_of(lens, fold) : -1, height);
}

std::pair<Tensor, Tensor> lens_points(const std::string& model, std::vector<double> distortion, const Tensor& points) {
  TORCH_CHECK(points.dim() == 2 && points.size(1) == 3 && points.scalar_type() == at::kDouble && points.is_cpu());
  const FullCamera<double> camera = bare_camera(lens_of(model, distortion));
  const int64_t n = points.size(0);
  const Tensor read = points.contiguous(), seen = at::empty({n, 2}, read.options());
  const Tensor slopes = at::empty({n, 2, 3}, read.options());
  const auto* p = reinterpret_cast<const Vec3<double>*>(read.const_data_ptr<double>());
  auto* u = reinterpret_cast<Vec2<double>*>(seen.mutable_data_ptr<double>());
  auto* j = reinterpret_cast<Vec3<double>*>(slopes.mutable_data_ptr<double>());
  const int64_t parts = cpu::chunks_of(n);
  cpu::parallel_for(parts, thread_count(), [&](int64_t k) {
    const cpu::Part part = cpu::part_of(n, parts, k);
    for (int64_t i = part.begin; i < part.end; ++i) {
      u[i] = project_mean(camera, p[i]).pixel;
      const Jacobian<double> rows = make_jacobian(camera, p[i]);
      j[2 * i] = rows.x;
      j[2 * i + 1] = rows.y;
    }
  });
  return {seen, slopes};
}

}  // namespace ar::ops
