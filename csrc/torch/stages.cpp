// The stages of the pass as ops of their own, for one or several cameras: project, bin, blend. And the weight of a
// footprint by itself.
#include <ATen/ops/cat.h>
#include <ATen/ops/full_like.h>
#include <ATen/ops/stack.h>
#include <ATen/ops/zeros.h>
#include <ATen/ops/zeros_like.h>

#include <algorithm>
#include <array>
#include <vector>

#include "torch/checks.h"
#include "torch/ops.h"
#include "torch/scene_grads.h"

namespace ar::ops {
namespace {

/// The rows of camera `c` in a tensor that holds those of camera after camera.
Tensor rows_of(const Tensor& t, const Tensor& row_splits, int64_t c) {
  const int64_t* splits = row_splits.const_data_ptr<int64_t>();
  return t.slice(0, splits[c], splits[c + 1]);
}

/// Camera after camera in one tensor.
Tensor join(const std::vector<Tensor>& parts) { return parts.size() == 1 ? parts[0] : at::cat(parts); }

/// Room for `n` public rows.
RowTensors make_rows(int64_t n, bool with_colors, const at::TensorOptions& options) {
  RowTensors rows;
  rows.means2d = at::empty({n, 2}, options);
  rows.cov2d = at::empty({n, 3}, options);
  rows.dets = at::empty({n}, options);
  rows.opacities = at::empty({n}, options);
  rows.depths = at::empty({n}, options);
  rows.colors = at::empty({with_colors ? n : 0, 3}, options);
  return rows;
}

/// What one camera has of a blending.
struct CameraPart {
  ListTensors lists;
  RowTensors rows;
  ChannelTensors channels;

  CameraPart(const BlendArguments& a, int64_t c) : lists(from_list<ListTensors>(a.lists, c * ListTensors::kMembers)) {
    rows.means2d = rows_of(a.means2d, a.row_splits, c);
    rows.cov2d = rows_of(a.cov2d, a.row_splits, c);
    rows.dets = rows_of(a.dets, a.row_splits, c);
    rows.opacities = rows_of(a.opacities, a.row_splits, c);
    channels.rows = rows_of(a.features, a.row_splits, c);
    channels.by_gaussian = false;
    channels.count = channels.color_channels = a.features.size(1);
    channels.background = a.background[c];
  }
};

}  // namespace

Results project(ProjectArguments a) {
  const Pass pass(a, a.means3D);
  const int64_t cameras = check_cameras(a);
  const bool with_colors = a.shs || a.colors_precomp;
  const at::TensorOptions options = a.means3D.options(), ints = options.dtype(at::kInt);
  const Tensor row_splits = at::zeros({cameras + 1}, at::kLong);
  int64_t* splits = row_splits.data_ptr<int64_t>();
  std::array<std::vector<Tensor>, 9> parts;  // of every camera: the results that are rows, and dets
  const auto add = [&](const RowTensors& r, const Tensor& radii, const Tensor& ids, const Tensor& camera_ids) {
    const Tensor rows[] = {r.means2d, r.cov2d, r.opacities, r.depths, r.colors, radii, ids, camera_ids, r.dets};
    for (size_t k = 0; k < parts.size(); ++k) parts[k].push_back(rows[k]);
  };
  for (int64_t c = 0; c < cameras; ++c) {
    Inputs in = inputs_of(a, c);
    check(in);
    check_values(in, false);
    const std::unique_ptr<Backend> backend = make_backend(in.means3D);
    RowTensors rows = make_rows(in.count(), with_colors, options);
    const Tensor radii = at::empty({in.count()}, ints);
    backend->project_rows(in, pass, rows, radii);
    const Tensor kept = radii.gt(0).nonzero().select(1, 0), ids = kept.to(at::kInt);
    splits[c + 1] = splits[c] + kept.size(0);
    check_row_count(splits[c + 1], "means2d");
    for (Tensor* t : rows.numbers()) *t = t->index_select(0, kept);
    if (with_colors) rows.colors = rows.colors.index_select(0, kept);
    add(rows, radii.index_select(0, kept), ids, at::full_like(ids, c));
  }
  if (cameras == 0) {
    const Tensor none = at::empty({0}, ints);
    add(make_rows(0, with_colors, options), none, none, none);
  }
  Results out;
  for (size_t k = 0; k < 8; ++k) out.push_back(join(parts[k]));
  out.push_back(row_splits);
  // The ids again for the adjoint, which takes what was saved.
  out.push_back(std::vector<Tensor>{join(parts[8]), out[6].toTensor().clone(), row_splits.clone()});
  return out;
}

Results project_vjp(VjpArguments<ProjectArguments> arguments) {
  const ProjectArguments& a = arguments.of_op;
  const int64_t cameras = check_cameras(a);
  TORCH_CHECK_VALUE(arguments.saved.size() == 3, "saved must be what project saved, got ", arguments.saved.size(),
                    " tensors");
  const Tensor ids = arguments.saved[1], splits = arguments.saved[2];
  const int64_t n = ids.numel(), count = a.count();
  const bool are_splits = splits.device().is_cpu() && splits.scalar_type() == at::kLong && splits.dim() == 1 &&
                          splits.size(0) == cameras + 1 && splits.is_contiguous() && rises_to(splits, n);
  TORCH_CHECK_VALUE(are_splits && ids.dim() == 1 && ids.scalar_type() == at::kInt && may_be_rows_of(ids, count),
                    "saved must be what project saved for the same arguments");
  const auto options = a.means3D.options();
  const auto gradient = [&](size_t place, const char* name, std::vector<int64_t> sizes) {
    const Tensor given = gradient_of(arguments.dL_doutputs, place, name, a.means3D, sizes);
    return given.defined() ? given : at::zeros(sizes, options);
  };
  RowTensors dL_drows;
  dL_drows.means2d = gradient(0, "dL_dmeans2d", {n, 2});
  dL_drows.cov2d = gradient(1, "dL_dcov2d", {n, 3});
  dL_drows.opacities = gradient(2, "dL_dopacities", {n});
  dL_drows.depths = gradient(3, "dL_ddepths", {n});
  if (a.shs || a.colors_precomp) dL_drows.colors = gradient(4, "dL_dcolors", {n, 3});
  return {gradients_of(a, arguments.needs, [&](int64_t c, const Inputs& in, const Grads& grads) {
    const int64_t first = splits[c].item<int64_t>(), last = splits[c + 1].item<int64_t>();
    const Tensor rows = places_of(ids.slice(0, first, last), count, first);
    return make_backend(in.means3D)->project_rows_vjp(in, rows, dL_drows, grads);
  })};
}

Results bin(BinArguments a) {
  Pass pass(a, a.means2d);
  pass.keep = a.keep;
  check(a);
  const std::unique_ptr<Backend> backend = make_backend(a.means2d);
  std::vector<Tensor> out;
  for (int64_t c = 0; c + 1 < a.row_splits.size(0); ++c) {
    RowTensors rows = {a.means2d, a.cov2d, a.dets, a.opacities, a.depths, Tensor()};
    for (Tensor* t : rows.numbers()) *t = rows_of(*t, a.row_splits, c);
    append_to(out, backend->bin(backend->shape_rows(rows, pass), pass));
  }
  return {out};
}

Results blend(BlendArguments a) {
  Pass pass(a, a.means2d);
  pass.keep = a.keep;
  check(a, pass);
  const std::unique_ptr<Backend> backend = make_backend(a.means2d);
  const int64_t cameras = a.row_splits.size(0) - 1;
  std::vector<Tensor> images, alphas, saved;
  for (int64_t c = 0; c < cameras; ++c) {
    const CameraPart part(a, c);
    ImageSwitches wanted = {};
    wanted[kAlpha] = true;
    const ImageTensors image = make_images(part.channels, wanted, pass.grid);
    BlendState state = make_state(pass, a.means2d);
    backend->blend(part.lists, pass, part.channels, image, state);
    images.push_back(image.color);
    alphas.push_back(image.others[kAlpha]);
    if (a.keep) append_to(saved, state);
  }
  const auto options = a.means2d.options();
  return {cameras ? at::stack(images) : at::empty({0, a.features.size(1), a.image_height, a.image_width}, options),
          cameras ? at::stack(alphas) : at::empty({0, a.image_height, a.image_width}, options), saved};
}

Results blend_vjp(VjpArguments<BlendArguments> arguments) {
  BlendArguments& a = arguments.of_op;
  const Pass pass(a, a.means2d);
  check(a, pass);
  const std::vector<bool>& needs = arguments.needs;
  check_needs(needs, 8);
  const int64_t cameras = a.row_splits.size(0) - 1, channels = a.features.size(1);
  TORCH_CHECK_VALUE(int64_t(arguments.saved.size()) == cameras * int64_t(BlendState::kMembers),
                    "saved must be what blend saved with keep=True, got ", arguments.saved.size(), " tensors");
  const int64_t height = a.image_height, width = a.image_width;
  const Tensor dL_dimage =
      gradient_of(arguments.dL_doutputs, 0, "dL_dimage", a.means2d, {cameras, channels, height, width});
  const Tensor dL_dalpha = gradient_of(arguments.dL_doutputs, 1, "dL_dalpha", a.means2d, {cameras, height, width});
  const std::unique_ptr<Backend> backend = make_backend(a.means2d);
  const auto options = a.means2d.options();
  const bool absolute = needs[5] && a.means2d_abs;
  // With respect to means2d, cov2d, opacities, features, background and means2d_abs.
  const Tensor like[] = {a.means2d, a.cov2d, a.opacities, a.features, a.background, a.means2d};
  const bool wanted[] = {needs[0], needs[1], needs[2], needs[3], needs[4], absolute};
  std::array<std::vector<Tensor>, 6> parts;
  for (int64_t c = 0; c < cameras; ++c) {
    const CameraPart part(a, c);
    const auto state = from_list<BlendState>(arguments.saved, c * BlendState::kMembers);
    check_saved(part.lists, state, a.means2d, pass);
    ImageTensors gradient;
    if (dL_dimage.defined()) gradient.color = dL_dimage[c];
    if (dL_dalpha.defined()) gradient.others[kAlpha] = dL_dalpha[c];
    const PairSums sums = backend->blend_vjp(part.lists, state, pass, part.channels, gradient,
                                             absolute ? MeanSums::kAbsolute : MeanSums::kNone);
    const int64_t n = part.rows.means2d.size(0);
    RowTensors rows;
    rows.means2d = at::empty({n, 2}, options);
    rows.cov2d = at::empty({n, 3}, options);
    rows.opacities = at::empty({n}, options);
    if (absolute) rows.absolute = at::empty({n, 2}, options);
    backend->row_grads(part.rows, part.lists, pass, sums, rows);
    Tensor background;
    if (needs[4]) background = background_grad(gradient.color, part.channels.background, state, pass.grid).unsqueeze(0);
    const Tensor grads[] = {rows.means2d, rows.cov2d, rows.opacities, sums.dL_dchannels, background, rows.absolute};
    for (size_t k = 0; k < parts.size(); ++k) parts[k].push_back(grads[k]);
  }
  std::vector<Tensor> out;
  for (size_t k = 0; k < parts.size(); ++k)
    out.push_back(!wanted[k] ? at::empty({0}, options) : parts[k].empty() ? at::zeros_like(like[k]) : join(parts[k]));
  out.push_back(needs[6] ? at::zeros_like(a.dets) : at::empty({0}, options));  // what depends on dets is in cov2d's
  out.push_back(at::empty({0}, options));                                      // row_splits
  return {out};
}

Results footprint_weight(WeightArguments a) {
  const FootprintSpec footprint = find_footprint(a.footprint, a.option);
  check(a);
  WeightTensors tensors = {a.offset, a.cov2d};
  tensors.weight = at::empty(a.offset.sizes().slice(0, a.offset.dim() - 1), a.offset.options());
  make_backend(a.offset)->weight(tensors, footprint);
  return {tensors.weight};
}

Results footprint_weight_vjp(VjpArguments<WeightArguments> arguments) {
  WeightArguments& a = arguments.of_op;
  const FootprintSpec footprint = find_footprint(a.footprint, a.option);
  check(a);
  check_needs(arguments.needs, 2);
  WeightTensors tensors = {a.offset, a.cov2d};
  const at::IntArrayRef sizes = a.offset.sizes().slice(0, a.offset.dim() - 1);
  tensors.dL_dweight = only_gradient_of(arguments.dL_doutputs, "weight", a.offset, sizes);
  tensors.dL_doffset = at::empty(a.offset.sizes(), a.offset.options());
  tensors.dL_dcov2d = at::empty(a.cov2d.sizes(), a.offset.options());
  make_backend(a.offset)->weight(tensors, footprint);
  return {std::vector<Tensor>{tensors.dL_doffset, tensors.dL_dcov2d}};
}

}  // namespace ar::ops
