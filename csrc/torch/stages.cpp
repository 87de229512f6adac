// The stages after `project` as separate ops, for one or several cameras: bin, blend and its adjoint. And
// footprint_weight.
#include <ATen/ops/cat.h>
#include <ATen/ops/stack.h>
#include <ATen/ops/zeros_like.h>

#include <algorithm>
#include <array>
#include <vector>

#include "torch/camera_rows.h"
#include "torch/checks.h"
#include "torch/ops.h"
#include "torch/scene_grads.h"

namespace ar::ops {
namespace {

Tensor join(const std::vector<Tensor>& parts) { return parts.size() == 1 ? parts[0] : at::cat(parts); }

/// Of one alone no copy is made.
Tensor stack(const std::vector<Tensor>& parts) { return parts.size() == 1 ? parts[0].unsqueeze(0) : at::stack(parts); }

struct CameraPart {
  ListTensors lists;
  RowTensors rows;
  ChannelTensors channels;

  CameraPart(const BlendArguments& a, int64_t c)
      : lists(from_list<ListTensors>(a.lists, c * ListTensors::kMembers)),
        rows(shapes_of(a, c)),
        channels(row_channels(rows_of(a.features, a.row_splits, c), a.background[c])) {}
};

}  // namespace

Results bin(BinArguments a) {
  Pass pass(a, a.means2d);
  pass.keep = a.keep;
  check(a, pass);
  const std::unique_ptr<Backend> backend = make_backend(a.means2d);
  std::vector<Tensor> out;
  for (int64_t c = 0; c + 1 < a.row_splits.size(0); ++c) {
    RowTensors rows = shapes_of(a, c);
    rows.depths = rows_of(a.depths, a.row_splits, c);
    if (a.slopes) rows.slopes = rows_of(*a.slopes, a.row_splits, c);
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
    const ImageTensors image = make_images(*backend, part.channels, wanted, pass.grid);
    BlendState state = make_state(pass, a.means2d);
    backend->blend(part.lists, pass, part.channels, image, state);
    images.push_back(image.color);
    alphas.push_back(image.others[kAlpha]);
    if (a.keep) append_to(saved, state);
  }
  const auto options = a.means2d.options();
  return {cameras ? stack(images) : at::empty({0, a.features.size(1), a.image_height, a.image_width}, options),
          cameras ? stack(alphas) : at::empty({0, a.image_height, a.image_width}, options), saved};
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
  // The last is for means2d_abs.
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
  // The gradient through dets is in that of cov2d. The last is for row_splits.
  out.push_back(needs[6] ? at::zeros_like(a.dets) : at::empty({0}, options));
  out.push_back(at::empty({0}, options));
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
