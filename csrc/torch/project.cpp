// The op `project`, Gaussians and cameras to rows, and its adjoint. Rows are packed, one for every Gaussian that a
// camera may see, and the host waits once for their number; or a table of all Gaussians in all cameras.
#include <ATen/ops/zeros.h>
#include <ATen/ops/zeros_like.h>

#include <algorithm>
#include <array>
#include <vector>

#include "torch/camera_rows.h"
#include "torch/check_tensors.h"
#include "torch/checks.h"
#include "torch/ops.h"
#include "torch/scene_grads.h"

namespace ar::ops {
namespace {

DepthKind depth_kind_of(const std::string& name, const char* argument) {
  constexpr std::array<const char*, 4> kNames = {"none", "model", "z", "distance"};
  for (size_t k = 0; k < kNames.size(); ++k) {
    if (name == kNames[k]) return DepthKind(k);
  }
  TORCH_CHECK_VALUE(false, argument, " must be none, model, z or distance, got ", name);
}

RowRules<double> rules_of(const ProjectArguments& a) {
  RowRules<double> rules;
  rules.order = depth_kind_of(a.order, "order");
  TORCH_CHECK_VALUE(rules.order != DepthKind::kNone, "order must be model, z or distance, got none");
  rules.shown = depth_kind_of(a.shown, "shown");
  rules.measured = a.measured;
  if (!a.measured) return rules;
  rules.variance = a.variance;
  rules.compensated = a.compensated;
  rules.radius_clip = a.radius_clip;
  rules.near = a.near;
  rules.far = a.far;
  return rules;
}

/// (n, row...), or with the sizes of the table in place of n.
std::vector<int64_t> sizes_of(const ProjectArguments& a, int64_t n, std::initializer_list<int64_t> row) {
  std::vector<int64_t> sizes = a.is_table() ? a.table : std::vector<int64_t>{n};
  sizes.insert(sizes.end(), row);
  return sizes;
}

/// What features consist of, in order: colours, values, a depth.
struct Columns {
  int64_t colors, values, depth;

  explicit Columns(const ProjectArguments& a)
      : colors(a.shs || a.colors_precomp ? 3 : 0),
        values(a.values ? a.values->size(-1) : 0),
        depth(a.shown == "none" ? 0 : 1) {}
  int64_t count() const { return colors + values + depth; }
};

ProjectedTensors make_rows(int64_t n, const Columns& columns, const ProjectArguments& a, bool along_rays) {
  const at::TensorOptions options = a.means3D.options(), ints = options.dtype(at::kInt);
  ProjectedTensors rows;
  rows.means2d = at::empty(sizes_of(a, n, {2}), options);
  rows.cov2d = at::empty({n, 3}, options);
  rows.dets = at::empty({n}, options);
  rows.opacities = at::empty(sizes_of(a, n, {}), options);
  rows.depths = at::empty(sizes_of(a, n, {}), options);
  if (along_rays) rows.slopes = at::empty(sizes_of(a, n, {2}), options);
  rows.features = at::empty({n, columns.count()}, options);
  rows.radii = a.measured ? at::empty(sizes_of(a, n, {2}), ints) : at::empty({n}, ints);
  if (a.measured) rows.conics = at::empty(sizes_of(a, n, {3}), options);
  if (a.measured && a.compensated) rows.shown_opacities = at::empty(sizes_of(a, n, {}), options);
  if (!a.is_table()) rows.gaussian_ids = at::empty({n}, ints);
  if (!a.is_table()) rows.camera_ids = at::empty({n}, ints);
  rows.colored = columns.colors > 0;
  rows.shows_depth = columns.depth > 0;
  rows.center = a.center;
  return rows;
}

}  // namespace

Results project(ProjectArguments a) {
  const Pass pass(a, a.means3D);
  const int64_t cameras = check_cameras(a);
  const RowRules<double> rules = rules_of(a);
  const Columns columns(a);
  const at::TensorOptions options = a.means3D.options(), ints = options.dtype(at::kInt);
  std::vector<Inputs> inputs;
  for (int64_t c = 0; c < cameras; ++c) {
    check(inputs.emplace_back(inputs_of(a, c)));
    check_values(inputs[c], false);
  }
  const int64_t p = cameras ? inputs[0].count() : 0;
  const std::unique_ptr<Backend> backend = make_backend(a.means3D);
  const Tensor row_splits = at::empty({cameras + 1}, at::kLong);
  int64_t* splits = row_splits.mutable_data_ptr<int64_t>();
  splits[0] = 0;
  Tensor ends;
  if (a.is_table()) {
    for (int64_t c = 0; c < cameras; ++c) splits[c + 1] = splits[c] + p;
  } else {
    ends = at::empty({cameras, p}, ints);
    for (int64_t c = 0; c < cameras; ++c) {
      ProjectedTensors counted;
      counted.flags = ends[c];
      counted.colored = columns.colors > 0;
      backend->project_rows(inputs[c], pass, rules, counted);
      counted.flags.cumsum_(0);  // By itself: a sum along rows of a matrix has a thread block a row.
    }
    const Tensor counts =
        p > 0 && cameras > 0 ? ends.select(1, p - 1).contiguous().cpu() : at::zeros({cameras}, at::kInt);
    for (int64_t c = 0; c < cameras; ++c) splits[c + 1] = splits[c] + counts.const_data_ptr<int32_t>()[c];
  }
  const int64_t n = splits[cameras];
  check_row_count(n, "means2d");
  ProjectedTensors rows = make_rows(n, columns, a, pass.footprint.along_rays());
  for (int64_t c = 0; c < cameras && n > 0; ++c) {
    rows.camera = c;
    rows.first = splits[c];
    rows.last = splits[c + 1];
    rows.ends = a.is_table() ? Tensor() : ends[c];
    backend->project_rows(inputs[c], pass, rules, rows);
    if (columns.values == 0) continue;
    const Tensor values = values_of(a, c, *a.values);
    const Tensor to = rows_of(rows.features, row_splits, c).narrow(1, columns.colors, columns.values);
    to.copy_(a.is_table() ? values : values.index_select(0, rows_of(rows.gaussian_ids, row_splits, c)));
  }
  const auto or_none = [&](const Tensor& t) { return or_empty(t, a.means3D); };
  const auto or_no_ints = [&](const Tensor& t) { return t.defined() ? t : at::empty({0}, ints); };
  std::vector<Tensor> saved;
  // Clones, because results of an op must not share memory.
  if (a.keep) saved = {a.is_table() ? rows.radii.clone() : ends, row_splits.clone()};
  if (a.keep && a.values && !a.is_table()) saved.push_back(rows.gaussian_ids.clone());
  return {rows.means2d,
          rows.cov2d,
          rows.opacities,
          rows.depths,
          rows.features,
          rows.radii,
          or_no_ints(rows.gaussian_ids),
          or_no_ints(rows.camera_ids),
          row_splits,
          rows.dets,
          or_none(rows.conics),
          or_none(rows.shown_opacities),
          or_none(rows.slopes),
          saved};
}

Results project_vjp(VjpArguments<ProjectArguments> arguments) {
  ProjectArguments& a = arguments.of_op;
  const int64_t cameras = check_cameras(a);
  const bool with_ids = a.values && !a.is_table();
  TORCH_CHECK_VALUE(arguments.saved.size() == (with_ids ? 3 : 2),
                    "saved must be what project saved with keep=True, got ", arguments.saved.size(), " tensors");
  const Tensor places = arguments.saved[0], splits = arguments.saved[1];
  const int64_t p = a.means3D.size(-2);
  const bool are_splits = splits.device().is_cpu() && splits.scalar_type() == at::kLong && splits.dim() == 1 &&
                          splits.size(0) == cameras + 1 && splits.is_contiguous();
  const int64_t n = are_splits ? splits.const_data_ptr<int64_t>()[cameras] : -1;
  const std::vector<int64_t> sizes = a.is_table() ? sizes_of(a, n, {2}) : std::vector<int64_t>{cameras, p};
  TORCH_CHECK_VALUE(are_splits && rises_to(splits, n) && places.sizes() == at::IntArrayRef(sizes) &&
                        places.scalar_type() == at::kInt && places.is_contiguous() &&
                        places.device() == a.means3D.device() && (!a.is_table() || n == cameras * p),
                    "saved must be what project saved for the same arguments");
  for (int64_t c = 0; c < cameras && !a.is_table() && places.is_cpu(); ++c) {
    const int32_t *begin = places.const_data_ptr<int32_t>() + c * p, *end = begin + p;
    const int64_t* rows = splits.const_data_ptr<int64_t>() + c;
    const bool counts = p == 0 || (*begin >= 0 && end[-1] == rows[1] - rows[0] && std::is_sorted(begin, end));
    TORCH_CHECK_VALUE(counts, "saved must be what project saved for the same arguments");
  }
  if (with_ids) {
    const Tensor& ids = arguments.saved[2];
    TORCH_CHECK_VALUE(ids.dim() == 1 && ids.numel() == n && ids.scalar_type() == at::kInt && may_be_rows_of(ids, p),
                      "saved must be what project saved for the same arguments");
  }
  const Columns columns(a);
  ProjectedGrads dL_drows;
  dL_drows.means2d = gradient_of(arguments.dL_doutputs, 0, "dL_dmeans2d", a.means3D, sizes_of(a, n, {2}));
  dL_drows.cov2d = gradient_of(arguments.dL_doutputs, 1, "dL_dcov2d", a.means3D, {n, 3});
  dL_drows.opacities = gradient_of(arguments.dL_doutputs, 2, "dL_dopacities", a.means3D, sizes_of(a, n, {}));
  dL_drows.depths = gradient_of(arguments.dL_doutputs, 3, "dL_ddepths", a.means3D, sizes_of(a, n, {}));
  dL_drows.features = gradient_of(arguments.dL_doutputs, 4, "dL_dfeatures", a.means3D, {n, columns.count()});
  dL_drows.colored = columns.colors > 0;
  dL_drows.shows_depth = columns.depth > 0;
  dL_drows.order = depth_kind_of(a.order, "order");
  dL_drows.shown = depth_kind_of(a.shown, "shown");
  std::vector<bool> needs = arguments.needs;
  check_needs(needs, kSceneTensors);  // values, but not means2D
  const bool of_values = needs.back() && a.values;
  needs.pop_back();
  const std::unique_ptr<Backend> backend = make_backend(a.means3D);
  std::vector<Tensor> out = gradients_of(*backend, a, needs, [&](int64_t c, const Inputs& in, const Grads& grads) {
    dL_drows.first = splits.const_data_ptr<int64_t>()[c];
    dL_drows.last = splits.const_data_ptr<int64_t>()[c + 1];
    if (!a.is_table()) dL_drows.ends = places[c];
    if (a.is_table()) dL_drows.radii = places;
    return backend->project_rows_vjp(in, dL_drows, grads);
  });
  Tensor dL_dvalues;
  if (of_values) {
    dL_dvalues = at::zeros_like(*a.values, at::MemoryFormat::Contiguous);
    for (int64_t c = 0; c < cameras && dL_drows.features.defined(); ++c) {
      const Tensor rows = rows_of(dL_drows.features, splits, c).narrow(1, columns.colors, columns.values);
      Tensor to = values_of(a, c, dL_dvalues);
      if (a.is_table()) {
        to.add_(rows);
      } else {  // Once for each Gaussian: in a fixed order.
        to.index_add_(0, rows_of(arguments.saved[2], splits, c), rows);
      }
    }
  }
  out.push_back(or_empty(dL_dvalues, a.means3D));
  return {out};
}

}  // namespace ar::ops
