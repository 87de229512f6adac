// Registers the ops of ops.h with torch: a schema made from the arguments, and one kernel for all devices. And makes
// the Python module _C.
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>
#include <torch/library.h>

#include <algorithm>
#include <cstddef>
#include <new>
#include <string>
#include <utility>
#include <vector>

#include "core/footprint/registry.h"
#include "core/sh.h"
#include "core/ssim.h"
#include "cpu/stages.h"
#include "torch/backend.h"
#include "torch/call.h"
#include "torch/cameras.h"
#include "torch/ops.h"

namespace ar::ops {
namespace {

using torch::jit::Stack;

/// A failed allocation on the CPU raises torch.OutOfMemoryError, as on CUDA. Its message tells it from others.
template <class Work> auto with_memory_errors(const Work& work) {
  try {
    return work();
  } catch (const std::bad_alloc&) {
    TORCH_CHECK_WITH(OutOfMemoryError, false, "Not enough memory on the CPU");
  } catch (const c10::Error& error) {
    const std::string message = error.what_without_backtrace();
    const bool is_of_memory = message.find("DefaultCPUAllocator: can't allocate memory") != std::string::npos;
    if (!is_of_memory) throw;
    TORCH_CHECK_WITH(OutOfMemoryError, false, message);
  }
}

template <class A, Results (*kRun)(A)> struct Op {
  using Arguments = A;
  static void kernel(const c10::OperatorHandle&, Stack* stack) {
    Results results = with_memory_errors([&] { return kRun(take<A>(*stack)); });
    for (IValue& result : results) stack->push_back(std::move(result));
  }
};

/// visit(op, name, results) for every op.
template <class Visit> void each_op(const Visit& visit) {
  const char *rasterized = "Tensor color, Tensor[] images, Tensor radii, Tensor[] summary, Tensor[] saved",
             *timed = "Tensor color, Tensor[] images, Tensor radii, Tensor[] summary, Tensor[] saved, Tensor seconds",
             *projected =
                 "Tensor means2d, Tensor cov2d, Tensor opacities, Tensor depths, Tensor features, Tensor radii, "
                 "Tensor gaussian_ids, Tensor camera_ids, Tensor row_splits, Tensor dets, Tensor conics, "
                 "Tensor shown_opacities, Tensor slopes, Tensor[] saved",
             *blended = "Tensor image, Tensor alpha, Tensor[] saved", *gradients = "Tensor[] gradients";
  visit(Op<RasterizeArguments, rasterize>{}, "rasterize", rasterized);
  visit(Op<RasterizeArguments, rasterize_timed>{}, "rasterize_timed", timed);
  visit(Op<VjpArguments<RasterizeArguments>, rasterize_vjp>{}, "rasterize_vjp", gradients);
  visit(Op<PrepareCamerasArguments, prepare_cameras>{}, "prepare_cameras",
        "Tensor viewmatrix, Tensor projmatrix, Tensor campos, Tensor lens");
  visit(Op<VjpArguments<PrepareCamerasArguments>, prepare_cameras_vjp>{}, "prepare_cameras_vjp", gradients);
  visit(Op<PrepareLensArguments, prepare_lens>{}, "prepare_lens", "Tensor lens");
  visit(Op<VjpArguments<PrepareLensArguments>, prepare_lens_vjp>{}, "prepare_lens_vjp", gradients);
  visit(Op<ProjectArguments, project>{}, "project", projected);
  visit(Op<VjpArguments<ProjectArguments>, project_vjp>{}, "project_vjp", gradients);
  visit(Op<CompositeArguments, composite>{}, "composite", blended);
  visit(Op<VjpArguments<CompositeArguments>, composite_vjp>{}, "composite_vjp", gradients);
  visit(Op<SeamArguments, repeat_at_seam>{}, "repeat_at_seam",
        "Tensor means2d, Tensor cov2d, Tensor opacities, Tensor depths, Tensor colors, Tensor beside, Tensor radii, "
        "Tensor gaussian_ids, Tensor camera_ids, Tensor dets, Tensor row_splits, Tensor[] saved");
  visit(Op<VjpArguments<SeamArguments>, repeat_at_seam_vjp>{}, "repeat_at_seam_vjp", gradients);
  visit(Op<BatchArguments, count_rows>{}, "count_rows", "Tensor ends");
  visit(Op<PackArguments, pack_rows>{}, "pack_rows_", "");
  visit(Op<PackVjpArguments, pack_rows_vjp>{}, "pack_rows_vjp", gradients);
  visit(Op<BlendRowsArguments, blend_rows>{}, "blend_rows", blended);
  visit(Op<BlendRowsVjpArguments, blend_rows_vjp>{}, "blend_rows_vjp_", "Tensor dL_dbackground");
  visit(Op<BinArguments, bin>{}, "bin", "Tensor[] lists");
  visit(Op<BlendArguments, blend>{}, "blend", blended);
  visit(Op<VjpArguments<BlendArguments>, blend_vjp>{}, "blend_vjp", gradients);
  visit(Op<InspectArguments, inspect>{}, "inspect", "Tensor[] summary");
  visit(Op<WeightArguments, footprint_weight>{}, "footprint_weight", "Tensor weight");
  visit(Op<VjpArguments<WeightArguments>, footprint_weight_vjp>{}, "footprint_weight_vjp", gradients);
  visit(Op<SsimArguments, ssim_map>{}, "ssim_map", "Tensor map, Tensor[] saved");
  visit(Op<VjpArguments<SsimArguments>, ssim_map_vjp>{}, "ssim_map_vjp", gradients);
  visit(Op<L1SsimArguments, l1_ssim>{}, "l1_ssim", "Tensor loss, Tensor[] saved");
  visit(Op<VjpArguments<L1SsimArguments>, l1_ssim_vjp>{}, "l1_ssim_vjp", gradients);
  visit(Op<ActivateArguments, activate>{}, "activate",
        "Tensor scales, Tensor rotations, Tensor opacities, Tensor penalty");
  visit(Op<VjpArguments<ActivateArguments>, activate_vjp>{}, "activate_vjp", gradients);
  visit(Op<FilterArguments, apply_3d_filter>{}, "apply_3d_filter", "Tensor filtered_scales, Tensor filtered_opacities");
  visit(Op<VjpArguments<FilterArguments>, apply_3d_filter_vjp>{}, "apply_3d_filter_vjp", gradients);
  visit(Op<CorrectArguments, correct_colors>{}, "correct_colors", "Tensor corrected");
  visit(Op<VjpArguments<CorrectArguments>, correct_colors_vjp>{}, "correct_colors_vjp", gradients);
  visit(Op<PictureArguments, picture_gradients>{}, "picture_gradients",
        "Tensor loss, Tensor image, Tensor radii, Tensor[] gradients");
  visit(Op<RowsPictureArguments, rows_picture_gradients>{}, "rows_picture_gradients",
        "Tensor loss, Tensor image, Tensor dL_drows");
  visit(Op<ObserveArguments, observe>{}, "observe_", "");
  visit(Op<NoiseArguments, add_noise>{}, "add_noise_", "");
  visit(Op<AdamArguments, adam>{}, "adam_", "");
}

void register_kernels(torch::Library& m) {
  each_op([&](auto op, const char* name, const char*) {
    m.impl(name, torch::CppFunction::makeFromBoxedFunction<&decltype(op)::kernel>());
  });
}

TORCH_LIBRARY(analytic_rasterizer, m) {
  each_op([&](auto op, const std::string& name, const std::string& results) {
    m.def((name + "(" + schema_of<typename decltype(op)::Arguments>() + ") -> (" + results + ")").c_str());
  });
}
TORCH_LIBRARY_IMPL(analytic_rasterizer, CPU, m) { register_kernels(m); }
#if defined(AR_WITH_CUDA)
TORCH_LIBRARY_IMPL(analytic_rasterizer, CUDA, m) { register_kernels(m); }
#endif

template <class F> pybind11::dict describe() {
  constexpr Option option = F::kOption;
  const auto or_none = [](const char* text) -> pybind11::object {
    if (text) return pybind11::str(text);
    return pybind11::none();
  };
  pybind11::dict d;
  d["key"] = key_of<F>();
  d["name"] = F::kName;
  d["option"] = or_none(option.name);
  d["value"] = or_none(option.value);
  d["number"] = option.number;
  d["is_default"] = option.is_default;
  d["samples"] = F::kSamples;
  d["reference"] = F::kReference;
  d["along_rays"] = F::kAlongRays;
  d["page"] = or_none(F::kPage);
  d["variance"] = F::support_variance({option.number});
  return d;
}

template <class Members> std::vector<std::string> member_names() {
  std::vector<std::string> names;
  Members().each([&](const char* name, Tensor&) { names.emplace_back(name); });
  return names;
}

template <size_t kCount> std::vector<std::string> names_of(const std::array<const char*, kCount>& switches) {
  std::vector<std::string> names;
  for (const char* declaration : switches) names.emplace_back(name_of(declaration));
  return names;
}

/// (name, size) of the members of Lens.
std::vector<std::pair<std::string, int>> lens_members() {
  std::vector<std::pair<std::string, int>> members;
  for (const LensMember& member : kLensMembers) members.emplace_back(member.name, member.size);
  return members;
}

/// As Python indexes them.
pybind11::object columns_at(int64_t first, int64_t count) {
  if (count == 1) return pybind11::int_(first);
  return pybind11::slice(first, first + count, 1);
}

/// Columns of PackedRow, by members of Python's Splats.
pybind11::dict row_columns() {
  using Row = PackedRow<float>;
  pybind11::dict columns;
  const auto add = [&](const char* name, size_t offset, size_t size) {
    columns[name] = columns_at(offset / sizeof(float), size / sizeof(float));
  };
  add("means2d", offsetof(Row, mean), sizeof(Row::mean));
  add("cov2d", offsetof(Row, cov), sizeof(Row::cov));
  add("opacities", offsetof(Row, opacity), sizeof(Row::opacity));
  add("depths", offsetof(Row, depth), sizeof(Row::depth));
  add("colors", offsetof(Row, color), sizeof(Row::color));
  add("dets", offsetof(Row, det), sizeof(Row::det));
  add("gaussian_ids", offsetof(Row, id), sizeof(Row::id));
  return columns;
}

/// Widths of tensors that ops save, on CUDA where devices differ.
pybind11::dict saved_widths() {
  pybind11::dict widths;
  widths["splats"] = kSplatWidth;
  widths["pairs"] = ListTensors::kPairWidth;
  widths["splat_offsets"] = ListTensors::kRangeWidth;
  widths["counts"] = ListTensors::kCountsWidth;
  widths["rays"] = ListTensors::kRayWidth;
  widths["chunks"] = BlendState::kChunkWidth;
  widths["covs"] = KeptRows::kCovWidth;
  widths["partials"] = kSsimPartials;
  return widths;
}

pybind11::dict row_grad_columns() {
  pybind11::dict columns;
  columns["means2d"] = columns_at(kPackedMean, 2);
  columns["means2d_abs"] = columns_at(kPackedAbsolute, 2);
  return columns;
}

#define AR_QUOTED(text) #text
#define AR_TEXT(macro) AR_QUOTED(macro)
/// installation.py searches the file for it if another torch does not load the extension.
constexpr const char* kBuiltFor = "analytic_rasterizer was built for torch " AR_TEXT(AR_TORCH);

}  // namespace

#if defined(AR_WITH_CUDA)
void force_pair_capacity(int64_t capacity);
void record_kernels(bool on);
std::vector<std::string> launched_kernels();
std::pair<std::vector<std::string>, std::vector<std::string>> blend_route(const std::string& key, int64_t channels,
                                                                          int64_t width, int64_t height,
                                                                          int64_t capacity);
#endif
}  // namespace ar::ops

PYBIND11_MODULE(_C, m) {
  m.doc() = "Loads the ops of analytic_rasterizer into torch.ops.analytic_rasterizer.";
  m.attr("BUILT_FOR") = ar::ops::kBuiltFor;
#if defined(_OPENMP)
  m.attr("has_openmp") = true;
#else
  m.attr("has_openmp") = false;
#endif
#if defined(AR_WITH_CUDA)
  m.attr("has_cuda") = true;
  m.def("force_pair_capacity", &ar::ops::force_pair_capacity,
        "For tests: room for so many pairs on CUDA, whatever comes; 0 to guess anew, from the frames that follow.");
  m.def("record_kernels", &ar::ops::record_kernels,
        "For tests: record launches from now on, beginning with none; or not.");
  m.def("launched_kernels", &ar::ops::launched_kernels, "For tests: mangled names of the kernels that were recorded.");
  m.def("blend_route", &ar::ops::blend_route,
        "For tests: kernels that blend (key, channels, width, height, room for pairs) forward and backward, by "
        "dispatch.h.");
#else
  m.attr("has_cuda") = false;
#endif
  m.def(
      "footprints",
      [] {
        std::vector<pybind11::dict> all;
        ar::for_each_footprint(ar::Footprints{}, [&](auto f) { all.push_back(ar::ops::describe<decltype(f)>()); });
        return all;
      },
      "What the headers say of every footprint, in the order of the registry.");
  ar::ops::define_call(m);
  m.def("gradient_was_required", &ar::ops::gradient_was_required,
        "Whether an op of this process has been called for which autograd will ask a gradient.");
  m.def("instruction_set", &ar::cpu::instruction_set, "Instruction set that the CPU path runs on.");
  m.attr("IMAGES") = ar::ops::names_of(ar::ops::kImageSwitches);
  m.attr("SUMMARIES") = ar::ops::names_of(ar::ops::kSummarySwitches);
  m.attr("LENS") = ar::ops::lens_members();
  m.def("lens_points", &ar::ops::lens_points,
        "Positions and derivatives of points through a lens (csrc/torch/cameras.cpp).");
  m.def("lens_fold", &ar::ops::lens_fold, "The angle up to which a lens is a map (csrc/torch/cameras.cpp).");
  m.def("lens_reach", &ar::ops::lens_reach, "The angle up to which a picture sees, and more (csrc/torch/cameras.cpp).",
        pybind11::arg("model"), pybind11::arg("distortion"), pybind11::arg("tan_x"), pybind11::arg("tan_y"),
        pybind11::arg("x"), pybind11::arg("y"), pybind11::arg("height") = 0);
  m.attr("CAMERA_MODELS") = ar::ops::names_of(ar::ops::kCameraModelNames);
  m.attr("LISTS") = ar::ops::member_names<ar::ops::ListTensors>();
  m.attr("STATE") = ar::ops::member_names<ar::ops::BlendState>();
  m.attr("KEPT_ROWS") = ar::ops::member_names<ar::ops::KeptRows>();
  m.attr("SUMMARY") = ar::ops::member_names<ar::ops::SummaryTensors>();
  m.attr("WIDTHS") = ar::ops::saved_widths();
  m.def(
      "withhold_output", [](const std::string& name) { ar::ops::withheld_output() = name; },
      "For tests: ops refuse this output as if no device made it; an empty name refuses none.");
  m.attr("TILE") = ar::kTile;
  m.attr("RAY_MARK") = std::string(ar::ops::kRayMark);
  m.def(
      "tile_size",
      [](const std::string& footprint, double option, int64_t width, int64_t height, bool cuda) {
        return ar::ops::grid_of(ar::ops::find_footprint(footprint, option), width, height, cuda).side();
      },
      "Edge of the tiles that a footprint is binned for in an image [px].");
  m.attr("ROW_WIDTH") = ar::kPackedWidth;
  m.attr("ROW_COLUMNS") = ar::ops::row_columns();
  m.attr("ROW_GRAD_WIDTHS") = std::make_pair(ar::kPackedGradWidth, ar::kPackedGradWidthAbsolute);
  m.attr("ROW_GRAD_COLUMNS") = ar::ops::row_grad_columns();
  m.attr("NEAR") = ar::kNear;
  m.attr("FRUSTUM_CLAMP") = ar::kFrustumClamp;
  m.attr("ALPHA_MIN") = ar::kAlphaMin;
  m.attr("MAX_SH_DEGREE") = ar::kMaxShDegree;
  m.attr("MAX_CHANNELS") = ar::kMaxChannels;
  m.attr("WEIGHT_UNIT") = ar::kWeightUnit;
}
