// scene_grads.h, implemented.
#include "torch/scene_grads.h"

#include <ATen/ops/aminmax.h>
#include <ATen/ops/arange.h>
#include <ATen/ops/empty_like.h>
#include <ATen/ops/full.h>
#include <ATen/ops/stack.h>
#include <ATen/ops/zeros_like.h>

#include <algorithm>

#include "core/camera.h"
#include "torch/checks.h"

namespace ar::ops {
namespace {

bool needs_camera(const std::vector<bool>& needs) {
  const auto first = needs.begin() + kGaussianTensors, last = first + kCameraTensors;
  return std::find(first, last, true) != last;
}

}  // namespace

void check_camera_needs(const std::vector<bool>& needs, const OptionalTensor& lens) {
  TORCH_CHECK_VALUE(lens || !needs_camera(needs),
                    "lens must be given where viewmatrix, projmatrix or campos requires a gradient, got None");
}

Grads make_grads(const Inputs& in, const std::vector<bool>& needs) {
  Grads grads;
  const auto make = [&](Tensor& grad, const OptionalTensor& like, bool needed) {
    if (needed && like) grad = at::empty_like(*like, at::MemoryFormat::Contiguous);
  };
  make(grads.means3D, in.means3D, needs[0]);
  make(grads.means2D, in.means2D, needs[1]);
  make(grads.opacities, in.opacities, needs[2]);
  make(grads.shs, in.shs, needs[3]);
  // Other colours are the caller's channels, whose gradient comes from blend_vjp.
  if (in.colors_precomp && in.colors_precomp->size(1) == 3) make(grads.colors_precomp, in.colors_precomp, needs[4]);
  make(grads.scales, in.scales, needs[5]);
  make(grads.rotations, in.rotations, needs[6]);
  make(grads.cov3D_precomp, in.cov3D_precomp, needs[7]);
  grads.with_camera = in.lens && needs_camera(needs);
  return grads;
}

void set_camera_grads(Backend& backend, const Tensor& parts, const std::vector<bool>& needs, Grads& grads) {
  const at::TensorOptions options = parts.options();
  if (needs[8]) grads.viewmatrix = at::empty({4, 4}, options);
  if (needs[9]) grads.projmatrix = at::empty({4, 4}, options);
  if (needs[10]) grads.campos = at::empty({3}, options);
  if (needs[11]) grads.lens = at::empty({kLensWidth}, options);
  backend.sum_camera_grads(parts, grads);
}

std::vector<Tensor> list_of(Grads grads, const Tensor& like) {
  std::vector<Tensor> list;
  grads.each_tensor([&](const char*, Tensor& t) { list.push_back(or_empty(t, like)); });
  return list;
}

std::vector<Tensor> gradients_of(Backend& backend, const ProjectArguments& a, std::vector<bool> needs,
                                 const std::function<Tensor(int64_t c, const Inputs&, const Grads&)>& adjoint) {
  check_needs(needs, kSceneTensors - 1);
  needs.insert(needs.begin() + 1, false);  // means2D
  check_camera_needs(needs, a.lens);
  const int64_t cameras = a.cameras(), batches = a.batches();
  Inputs all;
  static_cast<SceneTensors<OptionalTensor>&>(all) = a;
  const Grads sums = make_grads(all, needs);
  // Those of several cameras that have coefficients of their own are added to zeros.
  if (sums.shs.defined() && a.shs->dim() == 4 && cameras > batches && a.shs->size(0) == cameras) sums.shs.zero_();
  std::array<std::vector<Tensor>, kCameraTensors> of_cameras;
  for (int64_t c = 0; c < cameras; ++c) {
    Inputs in = inputs_of(a, c);
    check(in);
    Grads grads = sums;
    take_parts<Tensor>(a, c, grads);
    grads.add = c % (cameras / batches) > 0;
    const Tensor camera = adjoint(c, in, grads);
    if (grads.with_camera) set_camera_grads(backend, camera, needs, grads);
    const std::vector<Tensor> list = list_of(grads, in.means3D);
    for (size_t k = 0; k < kCameraTensors; ++k) of_cameras[k].push_back(list[kGaussianTensors + k]);
  }
  const std::vector<Tensor> of_gaussians = list_of(sums, a.means3D);
  std::vector<Tensor> out;
  all.each_tensor([&](std::string_view, const OptionalTensor& tensor) {
    const size_t k = out.size();
    out.push_back(!needs[k] || !tensor   ? at::empty({0}, a.means3D.options())
                  : cameras == 0         ? at::zeros_like(*tensor)
                  : k < kGaussianTensors ? of_gaussians[k]
                  : cameras == 1         ? of_cameras[k - kGaussianTensors][0].unsqueeze(0)
                                         : at::stack(of_cameras[k - kGaussianTensors]));
  });
  out.erase(out.begin() + 1);  // means2D
  return out;
}

bool may_be_rows_of(const Tensor& ids, int64_t count) {
  if (ids.numel() == 0 || !ids.is_cpu()) return true;
  const auto [least, most] = at::aminmax(ids);
  return least.item<int64_t>() >= 0 && most.item<int64_t>() < count;
}

Tensor row_of_gaussians(const Tensor& ids, int64_t count, int64_t first) {
  const Tensor rows = at::full({count + 1}, -1, ids.options());  // The last is for ids that are out of range.
  rows.index_put_({ids.to(at::kLong).clamp(-1, count)}, at::arange(first, first + ids.numel(), ids.options()));
  return rows.slice(0, 0, count);
}

Tensor background_grad(const Tensor& dL_dimage, const Tensor& background, const BlendState& state, TileGrid grid) {
  if (!dL_dimage.defined()) return at::zeros_like(background);
  const Tensor dL_dcolor = dL_dimage.narrow(0, 0, background.size(0));
  // One axis at a time: torch divides long sums among threads, whose number would change bits.
  const int64_t longer = grid.height > grid.width ? 1 : 2;
  return dL_dcolor.mul(state.transmittance.mean(0)).sum(longer).sum(1);
}

}  // namespace ar::ops
