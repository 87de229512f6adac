// The ops of rendering over several ranks. On the rank of the Gaussians, count_rows and pack_rows_ make PackedRows,
// which Python sends. On the rank of the camera, blend_rows bins and blends. Adjoints are blend_rows_vjp_ and
// pack_rows_vjp. Rows of all cameras are counted before memory is allocated, without waiting.
#include <ATen/ops/cumsum.h>
#include <ATen/ops/zeros.h>

#include <vector>

#include "torch/check_tensors.h"
#include "torch/checks.h"
#include "torch/ops.h"
#include "torch/scene_grads.h"

namespace ar::ops {
namespace {

constexpr const char* kRanks = "rendering over several ranks";  // Whose rows have no slopes.

void check_matrix_of(const Tensor& t, const char* name, const Tensor& like, int64_t width) {
  TORCH_CHECK_VALUE(t.dim() == 2 && t.size(1) == width && t.is_contiguous() && t.device() == like.device() &&
                        t.scalar_type() == like.scalar_type(),
                    name, " must be a contiguous matrix of ", width, " columns, of the dtype and device of the others");
  check_row_count(t.size(0), name);
}
/// PackedRows are read 16 bytes at a time.
void check_packed_rows(const Tensor& rows, const Tensor& like) {
  check_matrix_of(rows, "rows", like, kPackedWidth);
  TORCH_CHECK_VALUE(reinterpret_cast<uintptr_t>(rows.const_data_ptr()) % 16 == 0,
                    "rows must begin at a multiple of 16 bytes");
}
void check_ints(const Tensor& t, const char* name, at::ScalarType dtype, const std::vector<int64_t>& sizes,
                const Tensor& like) {
  TORCH_CHECK_VALUE(t.sizes() == at::IntArrayRef(sizes) && t.is_contiguous() && t.device() == like.device() &&
                        t.scalar_type() == dtype,
                    name, " must be contiguous ", dtype == at::kInt ? "int32" : "int64", " of shape ", text_of(sizes),
                    " on the device of the others, got shape ", shape_of(t));
}
void check_ranges(const PackedRanges& ranges, int64_t cameras, int64_t rows) {
  bool ok = int64_t(ranges.firsts.size()) == cameras && int64_t(ranges.counts.size()) == cameras;
  for (int64_t c = 0; ok && c < cameras; ++c) {
    const int64_t first = ranges.firsts[c], count = ranges.counts[c];
    ok = first >= 0 && count >= 0 && first <= rows && count <= rows - first;
  }
  TORCH_CHECK_VALUE(ok, "firsts and counts must be places of ", cameras, " cameras among ", rows, " rows");
}

void check_packed_gradient(const Tensor& dL_drows, const Tensor& like) {
  const bool absolute = dL_drows.dim() == 2 && dL_drows.size(1) == kPackedGradWidthAbsolute;
  check_matrix_of(dL_drows, "dL_drows", like, absolute ? kPackedGradWidthAbsolute : kPackedGradWidth);
}

/// The three colours in the splats.
ChannelTensors own_colors(const Tensor& background) {
  ChannelTensors channels;
  channels.by_gaussian = false;
  channels.count = channels.color_channels = 3;
  channels.background = background;
  return channels;
}

Tensor checked_background(const Tensor& background) {
  TORCH_CHECK_VALUE(background.dim() == 1 && background.size(0) == 3, "background must have shape (3,)");
  check_floating(background, "background");
  return background.contiguous();
}

struct SavedRows {
  static constexpr size_t kStateFirst = ListTensors::kMembers, kKeptFirst = kStateFirst + BlendState::kMembers;
  static constexpr size_t kMembers = kKeptFirst + KeptRows::kMembers;
  ListTensors lists;
  BlendState state;
  RowTensors rows;  ///< `kept` alone.

  explicit SavedRows(const std::vector<Tensor>& list) {
    TORCH_CHECK_VALUE(list.size() == kMembers, "saved must be what blend_rows saved with keep=True, got ", list.size(),
                      " tensors");
    lists = from_list<ListTensors>(list, 0);
    state = from_list<BlendState>(list, kStateFirst);
    rows.kept = from_list<KeptRows>(list, kKeptFirst);
  }
};

}  // namespace

Results count_rows(BatchArguments arguments) {
  ProjectArguments a = batch_of(arguments);
  const Pass pass(a, a.means3D);
  refuse_rays(pass, kRanks);
  const int64_t cameras = check_cameras(a);
  const at::TensorOptions ints = a.means3D.options().dtype(at::kInt);
  Tensor ends;
  for (int64_t c = 0; c < cameras; ++c) {
    Inputs in = inputs_of(a, c);
    check(in);
    check_values(in, false);
    if (c == 0) ends = at::empty({cameras, in.count()}, ints);
    ProjectedTensors counted;
    counted.flags = ends[c];
    make_backend(in.means3D)->project_rows(in, pass, {}, counted);
    counted.flags.cumsum_(0);
  }
  return {cameras ? ends : at::zeros({0, a.count()}, ints)};
}

Results pack_rows(PackArguments a) {
  const Pass pass(a, a.means3D);
  refuse_rays(pass, kRanks);
  ProjectArguments batch = batch_of(a);
  const int64_t cameras = check_cameras(batch);
  TORCH_CHECK_VALUE(a.shs || a.colors_precomp, "shs or colors_precomp must be given, got neither");
  check_packed_rows(a.rows, a.means3D);
  const int64_t rows = a.rows.size(0);
  check_ints(a.radii, "radii", at::kInt, {rows}, a.means3D);
  check_ints(a.ids, "ids", at::kInt, {rows}, a.means3D);
  check_ints(a.ends, "ends", at::kInt, {cameras, a.count()}, a.means3D);
  check_ints(a.firsts, "firsts", at::kLong, {cameras}, a.means3D);
  std::vector<Inputs> views;
  for (int64_t c = 0; c < cameras; ++c) check(views.emplace_back(inputs_of(batch, c)));
  for (int64_t c = 0; c < cameras; ++c) {
    const Inputs& in = views[c];
    make_backend(in.means3D)->pack_rows(in, pass, {a.rows, a.radii, a.ids, a.ends[c], a.firsts[c], a.first_id});
  }
  note_written(a.rows);
  note_written(a.radii);
  note_written(a.ids);
  return {};
}

Results pack_rows_vjp(PackVjpArguments a) {
  ProjectArguments batch = batch_of(a);
  const int64_t cameras = check_cameras(batch), rows = a.ids.numel(), count = a.count();
  check_packed_gradient(a.dL_drows, a.means3D);
  check_ints(a.ids, "ids", at::kInt, {a.dL_drows.size(0)}, a.means3D);
  check_ranges(a, cameras, rows);
  TORCH_CHECK_VALUE(may_be_rows_of(a.ids, count), "ids must be what pack_rows_ wrote");
  ProjectedGrads dL_drows;
  dL_drows.packed = a.dL_drows;
  const std::unique_ptr<Backend> backend = make_backend(a.means3D);
  return {gradients_of(*backend, batch, a.needs, [&](int64_t c, const Inputs& in, const Grads& grads) {
    dL_drows.rows = row_of_gaussians(a.ids.slice(0, a.firsts[c], a.firsts[c] + a.counts[c]), count, a.firsts[c]);
    return backend->project_rows_vjp(in, dL_drows, grads);
  })};
}

Results blend_rows(BlendRowsArguments a) {
  Pass pass(a, a.rows);
  refuse_rays(pass, kRanks);
  pass.keep = a.keep;
  check_floating(a.rows, "rows");
  check_packed_rows(a.rows, a.background);
  check_image_size(a.image_height, a.image_width);
  const ChannelTensors channels = own_colors(checked_background(a.background));
  const std::unique_ptr<Backend> backend = make_backend(a.rows);
  RowTensors rows;
  rows.packed = a.rows;
  if (a.keep) {
    rows.kept.covs = at::empty({a.rows.size(0), KeptRows::kCovWidth}, a.rows.options());
    rows.kept.opacities = at::empty({a.rows.size(0)}, a.rows.options());
  }
  const ListTensors lists = backend->bin(backend->shape_rows(rows, pass), pass);
  ImageSwitches wanted = {};
  wanted[kAlpha] = true;
  const ImageTensors image = make_images(*backend, channels, wanted, pass.grid);
  BlendState state = make_state(pass, a.rows);
  backend->blend(lists, pass, channels, image, state);
  std::vector<Tensor> saved;
  if (a.keep) {
    append_to(saved, lists);
    append_to(saved, state);
    append_to(saved, rows.kept);
  }
  return {image.color, image.others[kAlpha], saved};
}

Results blend_rows_vjp(BlendRowsVjpArguments a) {
  const Pass pass(a, a.background);
  const SavedRows saved(a.saved);
  const Tensor like = a.background;
  check_image_size(a.image_height, a.image_width);
  check_saved(saved.lists, saved.state, like, pass);
  const int64_t n = saved.lists.splats.size(0);
  check_packed_gradient(a.dL_drows, like);
  const KeptRows& kept = saved.rows.kept;
  check_matrix_of(kept.covs, "saved", like, KeptRows::kCovWidth);
  check_matrix_of(kept.opacities.unsqueeze(-1), "saved", like, 1);
  TORCH_CHECK_VALUE(a.dL_drows.size(0) == n && kept.covs.size(0) == n && kept.opacities.numel() == n,
                    "dL_drows must have a row for each of ", n, " splats");
  const std::vector<OptionalTensor> given = {a.dL_dimage, a.dL_dalpha};
  ImageTensors gradient;
  gradient.color = gradient_of(given, 0, "dL_dimage", like, {3, a.image_height, a.image_width});
  gradient.others[kAlpha] = gradient_of(given, 1, "dL_dalpha", like, {a.image_height, a.image_width});
  const ChannelTensors channels = own_colors(checked_background(a.background));
  Tensor background;
  if (a.needs_background) background = background_grad(gradient.color, channels.background, saved.state, pass.grid);
  const std::unique_ptr<Backend> backend = make_backend(like);
  const bool absolute = a.dL_drows.size(1) == kPackedGradWidthAbsolute;
  const PairSums sums = backend->blend_vjp(saved.lists, saved.state, pass, channels, gradient,
                                           absolute ? MeanSums::kAbsolute : MeanSums::kNone);
  RowTensors dL_drows;
  dL_drows.packed = a.dL_drows;
  backend->row_grads(saved.rows, saved.lists, pass, sums, dL_drows);
  note_written(a.dL_drows);
  return {or_empty(background, like)};
}

}  // namespace ar::ops
