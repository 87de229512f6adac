// The op `composite`, rows to images: `bin` and `blend` (stages.cpp) in one, channels last. And its adjoint.
#include <ATen/ops/where.h>
#include <ATen/ops/zeros_like.h>

#include <utility>
#include <vector>

#include "torch/camera_rows.h"
#include "torch/checks.h"
#include "torch/ops.h"
#include "torch/scene_grads.h"

namespace ar::ops {
namespace {

constexpr double kSmallestAlpha = 1e-10;  // That an accumulated depth is divided by, as in gsplat.
constexpr size_t kOfCamera = ListTensors::kMembers + BlendState::kMembers;

struct CameraRows {
  RowTensors rows;
  ChannelTensors channels;

  CameraRows(const CompositeArguments& a, int64_t c)
      : rows(shapes_of(a, c)),
        channels(row_channels(rows_of(a.features, a.row_splits, c), a.background->select(0, c))) {
    rows.depths = rows_of(a.depths, a.row_splits, c);
    if (a.slopes) rows.slopes = rows_of(*a.slopes, a.row_splits, c);
    rows.center = a.center;
    if (channels.count == 3) {  // In the splats themselves, where they take least time.
      std::swap(rows.colors, channels.rows);
      rows.any_color = true;
    }
  }
};

/// What an accumulated depth is divided by.
Tensor seen_alpha(const Tensor& alpha) { return alpha.clamp_min(kSmallestAlpha); }

}  // namespace

Results composite(CompositeArguments a) {
  Pass pass(a, a.means2d);
  pass.keep = a.keep;
  check(a, pass);
  const std::unique_ptr<Backend> backend = make_backend(a.means2d);
  const int64_t cameras = a.row_splits.numel() - 1, channels = a.features.size(1);
  const int64_t height = a.image_height, width = a.image_width;
  const at::TensorOptions options = a.means2d.options();
  const Tensor image = at::empty({cameras, height, width, channels}, options);
  const Tensor alpha = at::empty({cameras, height, width, 1}, options);
  std::vector<Tensor> saved;
  for (int64_t c = 0; c < cameras; ++c) {
    const CameraRows part(a, c);
    const ListTensors lists = backend->bin(backend->shape_rows(part.rows, pass), pass);
    ImageTensors made;
    made.color = at::empty({channels, height, width}, options);
    made.others[kAlpha] = alpha[c].squeeze(2);
    BlendState state = make_state(pass, a.means2d);
    backend->blend(lists, pass, part.channels, made, state);
    image[c].copy_(made.color.permute({1, 2, 0}));
    if (!a.keep) continue;
    append_to(saved, lists);
    append_to(saved, state);
  }
  if (a.expected) {
    Tensor depth = image.select(3, channels - 1);
    depth.div_(seen_alpha(alpha.squeeze(3)));
    if (a.keep) saved.insert(saved.end(), {alpha.squeeze(3).clone(), depth.clone()});
  }
  return {image, alpha, saved};
}

Results composite_vjp(VjpArguments<CompositeArguments> arguments) {
  CompositeArguments& a = arguments.of_op;
  const Pass pass(a, a.means2d);
  check(a, pass);
  const std::vector<bool>& needs = arguments.needs;
  check_needs(needs, 10);
  const int64_t cameras = a.row_splits.numel() - 1, channels = a.features.size(1), n = a.means2d.size(0);
  const int64_t height = a.image_height, width = a.image_width;
  const size_t members = size_t(cameras) * kOfCamera + (a.expected ? 2 : 0);
  TORCH_CHECK_VALUE(arguments.saved.size() == members, "saved must be what composite saved with keep=True, got ",
                    arguments.saved.size(), " tensors");
  Tensor dL_dimage = gradient_of(arguments.dL_doutputs, 0, "dL_dimage", a.means2d, {cameras, height, width, channels});
  Tensor dL_dalpha = gradient_of(arguments.dL_doutputs, 1, "dL_dalpha", a.means2d, {cameras, height, width, 1});
  if (dL_dimage.defined()) dL_dimage = dL_dimage.permute({0, 3, 1, 2}).clone(at::MemoryFormat::Contiguous);
  if (dL_dimage.defined() && a.expected) {
    const Tensor alpha = arguments.saved[members - 2], depth = arguments.saved[members - 1];
    Tensor dL_ddepth = dL_dimage.select(1, channels - 1);
    dL_ddepth.div_(seen_alpha(alpha));
    const Tensor by_alpha = at::where(alpha.ge(kSmallestAlpha), dL_ddepth.mul(depth).neg_(), 0).unsqueeze(3);
    dL_dalpha = dL_dalpha.defined() ? dL_dalpha.add(by_alpha) : by_alpha;
  }
  const std::unique_ptr<Backend> backend = make_backend(a.means2d);
  const bool absolute = needs[5] && a.means2d_abs;
  const at::TensorOptions options = a.means2d.options();
  RowTensors all;
  all.means2d = at::empty({n, 2}, options);
  all.cov2d = at::empty({n, 3}, options);
  all.opacities = at::empty({n}, options);
  if (absolute) all.absolute = at::empty({n, 2}, options);
  if (channels == 3 || cameras != 1) all.colors = at::empty({n, channels}, options);
  Tensor dL_dfeatures = all.colors, dL_dbackground;
  if (needs[4] && a.background) dL_dbackground = at::empty({cameras, channels}, options);
  for (int64_t c = 0; c < cameras; ++c) {
    const CameraRows part(a, c);
    const auto lists = from_list<ListTensors>(arguments.saved, size_t(c) * kOfCamera);
    const auto state = from_list<BlendState>(arguments.saved, size_t(c) * kOfCamera + ListTensors::kMembers);
    check_saved(lists, state, a.means2d, pass);
    TORCH_CHECK_VALUE(lists.splats.size(0) == part.rows.means2d.size(0), "saved must be what composite saved");
    ImageTensors gradient;
    if (dL_dimage.defined()) gradient.color = dL_dimage[c];
    if (dL_dalpha.defined()) gradient.others[kAlpha] = dL_dalpha[c].squeeze(2);
    const PairSums sums = backend->blend_vjp(lists, state, pass, part.channels, gradient,
                                             absolute ? MeanSums::kAbsolute : MeanSums::kNone);
    const auto part_of = [&](const Tensor& t) { return rows_of(t, a.row_splits, c); };
    RowTensors grads;
    grads.means2d = part_of(all.means2d);
    grads.cov2d = part_of(all.cov2d);
    grads.opacities = part_of(all.opacities);
    grads.absolute = part_of(all.absolute);
    if (channels == 3) grads.colors = part_of(all.colors);
    backend->row_grads(part.rows, lists, pass, sums, grads);
    if (channels != 3 && cameras == 1) dL_dfeatures = sums.dL_dchannels;
    if (channels != 3 && cameras != 1) part_of(all.colors).copy_(sums.dL_dchannels);
    if (dL_dbackground.defined())
      dL_dbackground[c].copy_(background_grad(gradient.color, part.channels.background, state, pass.grid));
  }
  if (dL_dbackground.defined()) dL_dbackground = dL_dbackground.narrow(1, 0, a.background_channels);
  const auto wanted = [&](size_t k, const Tensor& t) { return or_empty(needs[k] ? t : Tensor(), a.means2d); };
  // The gradient through dets is in that of cov2d; depths order rows, which has none.
  std::vector<Tensor> out = {wanted(0, all.means2d),  wanted(1, all.cov2d),      wanted(2, all.opacities),
                             wanted(3, dL_dfeatures), wanted(4, dL_dbackground), or_empty(all.absolute, a.means2d)};
  out.push_back(needs[6] ? at::zeros_like(a.dets) : at::empty({0}, options));
  out.push_back(needs[7] ? at::zeros_like(a.depths) : at::empty({0}, options));
  out.push_back(at::empty({0}, options));                                         // row_splits
  out.push_back(needs[9] ? at::zeros_like(*a.slopes) : at::empty({0}, options));  // Which order rows, too.
  return {out};
}

}  // namespace ar::ops
