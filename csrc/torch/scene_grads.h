// Tensors of the gradients with respect to a scene and its camera, for the ops whose adjoint ends there.
#pragma once

#include <functional>
#include <vector>

#include "torch/backend.h"

namespace ar::ops {

/// `needs`, here and below: which of the tensors of SceneTensors want a gradient. Without a lens those of the camera
/// have none; raises ValueError where one of them wants it.
void check_camera_needs(const std::vector<bool>& needs, const OptionalTensor& lens);

/// Room for the gradients with respect to the Gaussians, and whether those of the camera are wanted.
Grads make_grads(const Inputs& in, const std::vector<bool>& needs);

/// Sets the gradients with respect to the camera that are wanted, from the parts that project_vjp returned.
void set_camera_grads(const Tensor& parts, const std::vector<bool>& needs, Grads& grads);

/// For an op to return: an empty tensor like `like` stands for one that is not wanted.
inline Tensor or_empty(const Tensor& t, const Tensor& like) { return t.defined() ? t : at::empty({0}, like.options()); }
std::vector<Tensor> list_of(Grads grads, const Tensor& like);

/// Gradients with respect to the tensors of `project` but means2D, which is no argument of it and has no place in
/// `needs`: of the Gaussians the sum over all cameras, of the cameras side by side. `adjoint` is that of one camera
/// (Backend::project_rows_vjp). Checks `needs`.
std::vector<Tensor> gradients_of(const ProjectArguments& a, std::vector<bool> needs,
                                 const std::function<Tensor(int64_t c, const Inputs&, const Grads&)>& adjoint);

/// Whether int32 `ids` number rows of `count`; on a device, where the answer would have to be waited for, it is not
/// asked for.
bool may_be_rows_of(const Tensor& ids, int64_t count);

/// (count,) int32: at the place of each id its number, counted from `first`, and -1 at all others. Ids that are no
/// places, which nobody has checked on a device, are left out.
Tensor places_of(const Tensor& ids, int64_t count, int64_t first);

/// Gradient with respect to a background, whose channels are the first of the image's: it shows through what no splat
/// covers. Zero where there is no gradient with respect to the image.
Tensor background_grad(const Tensor& dL_dimage, const Tensor& background, const BlendState& state, TileGrid grid);

}  // namespace ar::ops
