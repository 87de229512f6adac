// Gradients of Gaussians, cameras and background: allocates them, adds up cameras, and lists tensors as ops return
// them. `needs`: the wanted SceneTensors.
#pragma once

#include <functional>
#include <vector>

#include "torch/backend.h"

namespace ar::ops {

/// A camera without a lens has no gradient.
void check_camera_needs(const std::vector<bool>& needs, const OptionalTensor& lens);

Grads make_grads(const Inputs& in, const std::vector<bool>& needs);

/// `parts`: what Backend::project_vjp returned.
void set_camera_grads(Backend& backend, const Tensor& parts, const std::vector<bool>& needs, Grads& grads);

/// Ops return empty tensors for undefined ones.
inline Tensor or_empty(const Tensor& t, const Tensor& like) { return t.defined() ? t : at::empty({0}, like.options()); }
std::vector<Tensor> list_of(Grads grads, const Tensor& like);

/// Summed over cameras for Gaussians, stacked for cameras. `a`: after check_cameras(). `adjoint`:
/// Backend::project_rows_vjp of one camera.
std::vector<Tensor> gradients_of(Backend& backend, const ProjectArguments& a, std::vector<bool> needs,
                                 const std::function<Tensor(int64_t c, const Inputs&, const Grads&)>& adjoint);

/// Whether `ids` are in [0, count). Always true on CUDA, where the host would wait.
bool may_be_rows_of(const Tensor& ids, int64_t count);

/// (count,) int32: first + k for Gaussian ids[k], else -1. Ids may be out of range.
Tensor row_of_gaussians(const Tensor& ids, int64_t count, int64_t first);

/// By the background of the first channels.
Tensor background_grad(const Tensor& dL_dimage, const Tensor& background, const BlendState& state, TileGrid grid);

}  // namespace ar::ops
