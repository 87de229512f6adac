// The checks of checks.h for rendering with one camera, of a footprint's name (find_footprint()) and a picture's size
// (grid_of()).
#include "torch/checks.h"

#include <ATen/Dispatch.h>
#include <ATen/ops/constant_pad_nd.h>
#include <ATen/ops/isfinite.h>
#include <ATen/ops/zeros.h>

#include <algorithm>
#include <charconv>
#include <cmath>

#include "core/camera.h"
#include "core/footprint/registry.h"
#include "core/order.h"
#include "core/sh.h"
#include "torch/check_tensors.h"

namespace ar::ops {
namespace {

void check_positive(double value, const char* name) {
  // As a float, which the projection computes with.
  TORCH_CHECK_VALUE(std::isfinite(float(value)) && float(value) > 0, name, " must be positive and finite, got ", value);
}

/// The message says the first invalid number and its index.
void check_values(const Tensor& t, const char* name, const Tensor& valid, const char* expected) {
  if (valid.all().item<bool>()) return;
  int64_t position = valid.logical_not().reshape(-1).nonzero()[0].item<int64_t>();
  const double value = t.reshape(-1)[position].item<double>();
  std::string index = t.dim() == 1 ? ",)" : ")";
  for (int64_t d = t.dim() - 1; d >= 0; position /= t.size(d), --d)
    index = (d > 0 ? ", " : "(") + std::to_string(position % t.size(d)) + index;
  TORCH_CHECK_VALUE(false, name, " must ", expected, ", got ", value, " at ", index);
}

/// at::isfinite takes a third of the time of a small picture.
bool are_few_and_finite(const Tensor& t) {
  constexpr int64_t kFew = 64;
  if (!t.is_cpu() || !t.is_contiguous() || t.numel() > kFew) return false;
  return AT_DISPATCH_FLOATING_TYPES(t.scalar_type(), "check_finite", [&] {
    const scalar_t* numbers = t.const_data_ptr<scalar_t>();
    return std::all_of(numbers, numbers + t.numel(), [](scalar_t x) { return std::isfinite(x); });
  });
}

void check_finite(const Tensor& t, const char* name) {
  if (!are_few_and_finite(t)) check_values(t, name, at::isfinite(t), "be finite");
}

void check_device(const Tensor& t, const char* name) {
  check_floating(t, name);
  if (!t.is_cuda()) return;
  TORCH_CHECK_TYPE(t.scalar_type() != at::kDouble, name,
                   " must have dtype float32 on CUDA, got Double; float64 runs on the CPU");
}

void check_projected(Tensor& means2d, Tensor& cov2d, Tensor& opacities, Tensor& dets, const Tensor& row_splits) {
  check_device(means2d, "means2d");
  check_shape(means2d.dim() == 2 && means2d.size(1) == 2, means2d, "means2d", "(N, 2)");
  check_row_count(means2d.size(0), "means2d");
  means2d = means2d.contiguous();
  const int64_t n = means2d.size(0);
  const Like like{means2d, "means2d"};
  like.check_rows_of(cov2d, "cov2d", {3}, "(N, 3)");
  like.check_rows_of(opacities, "opacities", {}, "(N,)");
  like.check_rows_of(dets, "dets", {}, "(N,)");
  TORCH_CHECK_TYPE(row_splits.scalar_type() == at::kLong, "row_splits must have dtype int64, got ",
                   row_splits.scalar_type());
  TORCH_CHECK_VALUE(
      row_splits.device().is_cpu() && row_splits.dim() == 1 && row_splits.size(0) >= 1 && row_splits.is_contiguous(),
      "row_splits must be a vector on the CPU, of one number more than there are cameras, got shape ",
      shape_of(row_splits), " on ", row_splits.device());
  TORCH_CHECK_VALUE(rises_to(row_splits, n), "row_splits must rise from 0 to the number of rows, ", n);
}

void check_slopes(OptionalTensor& slopes, const Like& like, const Pass& pass) {
  TORCH_CHECK_VALUE(slopes || !pass.footprint.along_rays(),
                    "slopes must have shape (N, 2) in order 'ray', got none: `project` returns them for settings with "
                    "this order");
  like.check_rows_of(slopes, "slopes", {2}, "(N, 2)");
}

/// Pixels of a Gaussian are counted in int32.
void check_countable(const SummarySwitches& wanted, int64_t height, int64_t width) {
  constexpr int64_t kMostPixels = int64_t(1) << 31;
  TORCH_CHECK_VALUE(!any_of(wanted) || height * width < kMostPixels,
                    "gaussian_stats and dominant Gaussians need an image of fewer than ", kMostPixels, " pixels, got ",
                    height, " x ", width);
}

/// Without debug such Gaussians are culled, or rendered.
void check_gaussians(Inputs in) {
  size_t k = 0;
  in.each_tensor([&](const char* name, const OptionalTensor& t) {
    const bool is_read = k != 1 && k < kGaussianTensors;  // 1: means2D.
    if (t && is_read) check_finite(*t, name);
    ++k;
  });
  check_values(in.opacities, "opacities", in.opacities.ge(0).logical_and(in.opacities.le(1)), "be in [0, 1]");
  if (in.scales) check_values(*in.scales, "scales", in.scales->ge(0), "not be negative");
  if (in.cov3D_precomp) {
    Tensor valid = in.cov3D_precomp->ge(0);
    for (const int64_t off_diagonal : {1, 2, 4}) valid.select(1, off_diagonal).fill_(true);
    check_values(*in.cov3D_precomp, "cov3D_precomp", valid, "not have negative variances");
  }
}

}  // namespace

FootprintSpec find_footprint(const std::string& key, double option) {
  const size_t end = std::min(key.find(kRayMark), key.size());
  const int index = ar::find_footprint(std::string_view(key).substr(0, end));
  TORCH_CHECK_VALUE(index >= 0, "footprint must be one of those in csrc/core/footprint/registry.h, got '", key, "'");
  TORCH_CHECK_VALUE(std::isfinite(option) && option >= 0, "option must be finite and not negative, got ", option);
  FootprintSpec spec = {};
  bool along_rays = false;
  spec.choice = {index, {option}};
  visit_footprint(index, Footprints{}, [&](auto f) {
    spec.samples = decltype(f)::kSamples;
    spec.moves = decltype(f)::kMoves;
    spec.lanes = spread_lanes<decltype(f)>();
    along_rays = decltype(f)::kAlongRays;
  });
  if (end == key.size()) return spec;
  TORCH_CHECK_VALUE(along_rays, "order 'ray' cannot be combined with footprint ", key.substr(0, end));
  const char* const digits = key.data() + end + kRayMark.size();
  const auto [stop, error] = std::from_chars(digits, key.data() + key.size(), spec.window);
  TORCH_CHECK_VALUE(
      error == std::errc() && stop == key.data() + key.size() && spec.window >= 1 && spec.window <= kMaxRayWindow,
      "the window of order 'ray' must be 1 to ", kMaxRayWindow, ", got '", digits, "'");
  return spec;
}

void refuse_rays(const Pass& pass, const char* what) {
  TORCH_CHECK_VALUE(!pass.footprint.along_rays(), what, " cannot be combined with order 'ray'");
}

TileGrid grid_of(const FootprintSpec& footprint, int64_t width, int64_t height, bool cuda) {
  if (cuda && footprint.along_rays()) return ray_grid(int(width), int(height));
  if (cuda && footprint.moves) return moving_grid(footprint.samples, int(width), int(height));
  if (cuda) return spread_grid(footprint.lanes, int(width), int(height));
  return {int(width), int(height)};
}

bool rises_to(const Tensor& row_splits, int64_t rows) {
  const int64_t *begin = row_splits.const_data_ptr<int64_t>(), *end = begin + row_splits.numel();
  return *begin == 0 && end[-1] == rows && std::is_sorted(begin, end);
}

void check_row_count(int64_t rows, const char* name) {
  constexpr int64_t kMost = int64_t(1) << 31;
  TORCH_CHECK_VALUE(rows < kMost, name, " must have fewer than ", kMost, " rows, got ", rows);
}

void check_image_size(int64_t height, int64_t width) {
  // Of the 24 bits of float32, 20 are for the pixel and 4 for the position in it.
  constexpr int64_t kMax = int64_t(1) << 20;
  TORCH_CHECK_VALUE(height >= 1 && height <= kMax, "image_height must be in [1, ", kMax, "], got ", height);
  TORCH_CHECK_VALUE(width >= 1 && width <= kMax, "image_width must be in [1, ", kMax, "], got ", width);
}

void check(Inputs& in) {
  Tensor& means3D = in.means3D;
  check_device(means3D, "means3D");
  check_shape(means3D.dim() == 2 && means3D.size(1) == 3, means3D, "means3D", "(P, 3)");
  const int64_t p = in.count(), most = int64_t(1) << (means3D.is_cuda() ? 30 : 31);
  TORCH_CHECK_VALUE(p < most, "means3D must have fewer than ", most, " rows on ", means3D.device().type(), ", got ", p);

  means3D = means3D.contiguous();
  const Like like{means3D, "means3D"};
  if (in.opacities.dim() == 1) {
    like.check_rows_of(in.opacities, "opacities", {}, "(P, 1) or (P,)");
  } else {
    like.check_rows_of(in.opacities, "opacities", {1}, "(P, 1) or (P,)");
  }
  const int64_t columns = in.means2D && in.means2D->dim() == 2 && in.means2D->size(1) == 4 ? 4 : 3;
  like.check_rows_of(in.means2D, "means2D", {columns}, "(P, 3) or (P, 4)");
  const bool with_lens = in.lens || in.sh_degree < 0;
  const int degrees = with_lens ? FullCamera<float>::kShDegree : Camera<float>::kShDegree;
  TORCH_CHECK_VALUE(in.sh_degree >= 0 && in.sh_degree <= degrees, "sh_degree must be 0 to ", degrees, ", got ",
                    in.sh_degree);
  if (in.shs) {
    const int64_t needed = sh_count(int(in.sh_degree));
    const bool ok = in.shs->dim() == 3 && in.shs->size(0) == p && in.shs->size(1) >= needed && in.shs->size(2) == 3;
    check_shape(ok, *in.shs, "shs", "(P, M, 3) with P = ", p, " and M >= ", needed, " for sh_degree ", in.sh_degree);
    // Kernels address the rows of a warp's 32 Gaussians in 32 bits.
    constexpr int64_t kMostCoefficients = int64_t(1) << 20;
    TORCH_CHECK_VALUE(in.shs->size(1) <= kMostCoefficients, "shs must have at most ", kMostCoefficients,
                      " coefficients per Gaussian, got shape ", shape_of(*in.shs));
    like.check_type(*in.shs, "shs");
    in.shs = in.shs->contiguous();
  }
  if (in.colors_precomp) like.check_channels(*in.colors_precomp, "colors_precomp", 'P', 'C', kMaxChannels);
  TORCH_CHECK_VALUE(in.scales.has_value() == in.rotations.has_value(),
                    "scales and rotations must be given together, got only ", in.scales ? "scales" : "rotations");
  TORCH_CHECK_VALUE(in.scales.has_value() != in.cov3D_precomp.has_value(),
                    "exactly one of scales with rotations and cov3D_precomp must be given, got ",
                    in.scales ? "both" : "neither");
  like.check_rows_of(in.scales, "scales", {3}, "(P, 3)");
  like.check_rows_of(in.rotations, "rotations", {4}, "(P, 4)");
  like.check_rows_of(in.cov3D_precomp, "cov3D_precomp", {6}, "(P, 6)");
  like.check_matrix(in.viewmatrix, "viewmatrix");
  like.check_matrix(in.projmatrix, "projmatrix");
  like.check_vector(in.campos, "campos", 3);
  if (in.lens) {
    like.check_type(*in.lens, "lens");
    check_shape(in.lens->dim() == 1 && in.lens->size(0) == kLensWidth, *in.lens, "lens", "(", kLensWidth, ",)");
    in.lens = in.lens->contiguous();
  }
  check_image_size(in.image_height, in.image_width);
  check_positive(in.tanfovx, "tanfovx");
  check_positive(in.tanfovy, "tanfovy");
  check_positive(in.scale_modifier, "scale_modifier");
}

void check_values(const Inputs& in, bool debug) {
  if (!debug && in.means3D.is_cuda()) return;
  check_finite(in.viewmatrix, "viewmatrix");
  check_finite(in.projmatrix, "projmatrix");
  check_finite(in.campos, "campos");
  // Only up to `far`, which may be infinite.
  if (in.lens) check_finite(in.lens->narrow(0, 0, offsetof(Lens<float>, far) / sizeof(float)), "lens");
}

void check(RasterizeArguments& a) {
  check(static_cast<Inputs&>(a));
  TORCH_CHECK_VALUE(a.shs.has_value() != a.colors_precomp.has_value(),
                    "exactly one of shs and colors_precomp must be given, got ", a.shs ? "both" : "neither");
  const Like like{a.means3D, "means3D"};
  like.check_vector(a.bg, "bg", a.shs ? 3 : a.colors_precomp->size(1));
  if (a.features) {
    const int64_t colors = a.bg.size(0), most = kMaxChannels - 3;
    TORCH_CHECK_VALUE(colors == 3, "features must come with shs or colors_precomp (P, 3), got (P, ", colors, ")");
    like.check_channels(*a.features, "features", 'P', 'K', most);
  }
  TORCH_CHECK_VALUE(a.means2d_z == "zero" || a.means2d_z == "sum_abs" || a.means2d_z == "sum_norm",
                    "means2d_z must be zero, sum_abs or sum_norm, got ", a.means2d_z);
  check_countable(a.summary, a.image_height, a.image_width);
}

void check_values(const RasterizeArguments& a) {
  check_values(a, a.debug);
  if (a.debug) check_gaussians(a);
  if (a.debug && a.features) check_finite(*a.features, "features");
  if (a.debug || !a.means3D.is_cuda()) check_finite(a.bg, "bg");
}

void check(BinArguments& a, const Pass& pass) {
  check_projected(a.means2d, a.cov2d, a.opacities, a.dets, a.row_splits);
  const Like like{a.means2d, "means2d"};
  like.check_rows_of(a.depths, "depths", {}, "(N,)");
  check_slopes(a.slopes, like, pass);
  check_image_size(a.image_height, a.image_width);
}

void check(BlendArguments& a, const Pass& pass) {
  check_projected(a.means2d, a.cov2d, a.opacities, a.dets, a.row_splits);
  const Like like{a.means2d, "means2d"};
  const int64_t cameras = a.row_splits.size(0) - 1;
  like.check_channels(a.features, "features", 'N', 'K', kMaxChannels);
  const int64_t channels = a.features.size(1);
  like.check_type(a.background, "background");
  check_shape(a.background.sizes() == at::IntArrayRef({cameras, channels}), a.background, "background", "(", cameras,
              ", ", channels, ")");
  a.background = a.background.contiguous();
  like.check_rows_of(a.means2d_abs, "means2d_abs", {2}, "(N, 2)");
  check_image_size(a.image_height, a.image_width);
  const int64_t members = ListTensors::kMembers;
  TORCH_CHECK_VALUE(int64_t(a.lists.size()) == members * cameras, "lists must be the output of list_tiles for ",
                    cameras, " cameras, got ", a.lists.size(), " tensors");
  for (int64_t c = 0; c < cameras; ++c) {
    const ListTensors lists = from_list<ListTensors>(a.lists, size_t(members * c));
    check_lists(lists, a.means2d, pass);
    const int64_t rows = a.row_splits.const_data_ptr<int64_t>()[c + 1] - a.row_splits.const_data_ptr<int64_t>()[c];
    TORCH_CHECK_VALUE(lists.splats.size(0) == rows, "lists must be the output of list_tiles for these splats, got ",
                      lists.splats.size(0), " splats of camera ", c, " and not ", rows);
  }
}

void check(CompositeArguments& a, const Pass& pass) {
  // Of a table, whose rows are those of a matrix.
  for (Tensor* t : {&a.means2d, &a.cov2d}) {
    if (t->dim() > 2) *t = t->reshape({-1, t->size(-1)});
  }
  for (Tensor* t : {&a.opacities, &a.dets, &a.depths}) {
    if (t->dim() > 1) *t = t->reshape({-1});
  }
  if (a.means2d_abs && a.means2d_abs->dim() > 2) a.means2d_abs = a.means2d_abs->reshape({-1, 2});
  if (a.slopes && a.slopes->dim() > 2) a.slopes = a.slopes->reshape({-1, 2});
  check_projected(a.means2d, a.cov2d, a.opacities, a.dets, a.row_splits);
  const Like like{a.means2d, "means2d"};
  const int64_t cameras = a.row_splits.size(0) - 1;
  like.check_rows_of(a.depths, "depths", {}, "(N,)");
  check_slopes(a.slopes, like, pass);
  like.check_channels(a.features, "features", 'N', 'K', kMaxChannels);
  like.check_rows_of(a.means2d_abs, "means2d_abs", {2}, "(N, 2)");
  check_image_size(a.image_height, a.image_width);
  const int64_t channels = a.features.size(1);
  if (!a.background) {
    a.background = at::zeros({cameras, channels}, a.means2d.options());
    return;
  }
  Tensor& background = *a.background;
  like.check_type(background, "background");
  if (background.dim() > 2) background = background.reshape({-1, background.size(-1)});
  const int64_t given = background.size(-1);
  check_shape(background.dim() == 2 && background.size(0) == cameras && given <= channels, background, "background",
              "(", cameras, ", K) with K at most ", channels);
  a.background_channels = given;
  background = given < channels ? at::constant_pad_nd(background, {0, channels - given}) : background.contiguous();
}

void check(SeamArguments& a) {
  check_projected(a.means2d, a.cov2d, a.opacities, a.dets, a.row_splits);
  const int64_t n = a.means2d.size(0), cameras = a.row_splits.size(0) - 1;
  const Like like{a.means2d, "means2d"};
  like.check_rows_of(a.depths, "depths", {}, "(N,)");
  like.check_type(a.colors, "colors");
  check_shape(a.colors.dim() == 2 && (a.colors.size(0) == n || a.colors.size(0) == 0), a.colors, "colors",
              "(N, K) or (0, K) with N = ", n);
  like.check_vector(a.turns, "turns", cameras);
  if (a.beside) {
    like.check_type(*a.beside, "beside");
    check_shape(a.beside->dim() == 2 && a.beside->size(0) == n, *a.beside, "beside", "(N, K) with N = ", n);
  }
  const std::pair<Tensor*, const char*> whole[] = {
      {&a.radii, "radii"}, {&a.gaussian_ids, "gaussian_ids"}, {&a.camera_ids, "camera_ids"}};
  for (const auto& [t, name] : whole) {
    TORCH_CHECK_TYPE(t->scalar_type() == at::kInt, name, " must have dtype int32, got ", t->scalar_type());
    check_rows(*t, name, n, {}, "(N,)");
  }
  check_image_size(a.image_height, a.image_width);
}

void check(InspectArguments& a, const ListTensors& lists, const Pass& pass) {
  check_device(lists.splats, "splats");
  check_image_size(a.image_height, a.image_width);
  check_countable(a.summary, a.image_height, a.image_width);
  check_lists(lists, lists.splats, pass);
  // Results are indexed by ids on the CPU, by splats on CUDA.
  const int64_t n = lists.splats.size(0);
  const bool by_id = !lists.splats.is_cuda() && n > 0;
  TORCH_CHECK_VALUE(!by_id || lists.ids.min().item<int64_t>() >= 0, "ids must not be negative");
  const int64_t needed = by_id ? lists.ids.max().item<int64_t>() + 1 : n;
  Like{lists.splats, "lists"}.check_type(a.depths, "depths");
  const bool fits = a.depths.dim() == 1 && a.depths.size(0) >= needed && a.depths.size(0) < (int64_t(1) << 31);
  check_shape(fits, a.depths, "depths", "(N,) with N the number of rows, at least ", needed);
  a.depths = a.depths.contiguous();
}

void check(WeightArguments& a) {
  check_floating(a.offset, "offset");
  check_shape(a.offset.dim() >= 1 && a.offset.size(-1) == 2, a.offset, "offset", "(..., 2)");
  Like{a.offset, "offset"}.check_type(a.cov2d, "cov2d");
  const bool ok = a.cov2d.dim() == a.offset.dim() && a.cov2d.size(-1) == 3 &&
                  a.cov2d.sizes().slice(0, a.cov2d.dim() - 1) == a.offset.sizes().slice(0, a.offset.dim() - 1);
  TORCH_CHECK_VALUE(ok, "cov2d must have shape (..., 3) with the leading sizes of offset ", shape_of(a.offset),
                    ", got ", shape_of(a.cov2d));
  a.offset = a.offset.contiguous();
  a.cov2d = a.cov2d.contiguous();
}

Tensor gradient_of(const std::vector<OptionalTensor>& dL_doutputs, size_t output, const char* name, const Tensor& like,
                   at::IntArrayRef sizes) {
  if (output >= dL_doutputs.size() || !dL_doutputs[output]) return Tensor();
  const Tensor& gradient = *dL_doutputs[output];
  Like{like, "the arguments"}.check_type(gradient, name);
  TORCH_CHECK_VALUE(gradient.sizes() == sizes, name, " must have shape ", text_of(sizes), ", got ", shape_of(gradient));
  return gradient.resolve_neg().contiguous();  // The dispatcher resolves none in lists of optional tensors.
}

Tensor only_gradient_of(const std::vector<OptionalTensor>& dL_doutputs, const std::string& output, const Tensor& like,
                        at::IntArrayRef sizes) {
  const Tensor gradient = gradient_of(dL_doutputs, 0, ("dL_d" + output).c_str(), like, sizes);
  TORCH_CHECK_VALUE(gradient.defined(), "dL_doutputs must hold the gradient with respect to the ", output,
                    ", got none");
  return gradient;
}

void check_needs(const std::vector<bool>& needs, size_t count) {
  TORCH_CHECK_VALUE(needs.size() == count, "needs must have ", count, " members, got ", needs.size());
}

void check_lists(const ListTensors& lists, const Tensor& like, const Pass& pass) {
  const TileGrid grid = pass.grid;
  const Tensor &splats = lists.splats, &pairs = lists.pairs;
  const int64_t n = splats.dim() == 2 ? splats.size(0) : -1;
  bool ok = n >= 0 && splats.size(1) == kSplatWidth && splats.scalar_type() == like.scalar_type() &&
            lists.ids.numel() == n && lists.tile_offsets.numel() == grid.tiles() + 1;
  if (like.is_cuda()) {
    ok = ok && pairs.dim() == 2 && pairs.size(0) >= 1 && (pairs.size(1) == 1 || pairs.size(1) == 2);
  } else {
    ok = ok && pairs.dim() == 1 && lists.tile_offsets.scalar_type() == at::kLong &&
         lists.tile_offsets.is_contiguous() && lists.tile_offsets.device().is_cpu() &&
         lists.tile_offsets.const_data_ptr<int64_t>()[grid.tiles()] == pairs.numel();
  }
  const bool along_rays = pass.footprint.along_rays();
  ok = ok && lists.rays.numel() == (along_rays ? n * ListTensors::kRayWidth : 0);
  const auto fits = [&](const Tensor& t, at::ScalarType dtype) {
    return t.is_contiguous() && t.device() == like.device() && (t.numel() == 0 || t.scalar_type() == dtype);
  };
  ok = ok && fits(splats, like.scalar_type()) && fits(lists.rays, like.scalar_type()) && fits(lists.ids, at::kInt) &&
       fits(pairs, at::kInt) && fits(lists.tile_offsets, at::kLong) && fits(lists.positions, at::kLong) &&
       fits(lists.counts, at::kLong) && fits(lists.splat_offsets, like.is_cuda() ? at::kInt : at::kLong);
  TORCH_CHECK_VALUE(ok,
                    "splats ... rays must be what the forward pass saved for the same arguments, got splats of "
                    "shape ",
                    shape_of(splats), " and tile_offsets of shape ", shape_of(lists.tile_offsets));
}

void check_saved(const ListTensors& lists, const BlendState& state, const Tensor& like, const Pass& pass) {
  check_lists(lists, like, pass);
  const std::vector<int64_t> image = {pass.footprint.samples, pass.grid.height, pass.grid.width};
  const int64_t n = lists.splats.size(0), pairs = lists.pairs.size(0);
  const bool slots = like.is_cuda() ? lists.pairs.size(1) == 2 && lists.splat_offsets.numel() == 2 * n
                                    : lists.splat_offsets.numel() == n + 1 && lists.positions.numel() == pairs;
  bool ok = slots && state.transmittance.sizes() == image && state.last.sizes() == image &&
            state.transmittance.scalar_type() == like.scalar_type() && state.last.scalar_type() == at::kInt;
  for (const Tensor* t : {&state.transmittance, &state.last, &state.checkpoints, &state.chunks})
    ok = ok && t->is_contiguous() && t->device() == like.device();
  TORCH_CHECK_VALUE(
      ok,
      "transmittance ... chunks must be what the forward pass saved with keep=True for the same arguments, "
      "got transmittance of shape ",
      shape_of(state.transmittance));
}

}  // namespace ar::ops
