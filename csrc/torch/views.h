// Tensors as the views that the stages take. The same on every device.
#pragma once

#include <array>
#include <tuple>

#include "core/camera.h"
#include "torch/checks.h"

namespace ar::ops {

template <class Element, typename T> const Element* rows_of(const OptionalTensor& t) {
  return t ? reinterpret_cast<const Element*>(t->const_data_ptr<T>()) : nullptr;
}

template <typename T> CameraView<T> camera_of(const Inputs& in) {
  return {in.viewmatrix.const_data_ptr<T>(),
          in.projmatrix.const_data_ptr<T>(),
          in.campos.const_data_ptr<T>(),
          int(in.image_width),
          int(in.image_height),
          T(in.tanfovx),
          T(in.tanfovy),
          in.lens ? in.lens->const_data_ptr<T>() : nullptr};
}

template <typename T> Gaussians<T> gaussians_of(const Inputs& in) {
  return {in.count(),
          reinterpret_cast<const Vec3<T>*>(in.means3D.const_data_ptr<T>()),
          rows_of<Vec3<T>, T>(in.scales),
          rows_of<Vec4<T>, T>(in.rotations),
          rows_of<Sym3<T>, T>(in.cov3D_precomp),
          in.opacities.const_data_ptr<T>(),
          rows_of<Vec3<T>, T>(in.shs),
          rows_of<Vec3<T>, T>(in.colors_precomp),
          in.shs ? int(in.shs->size(1)) : 0,
          int(in.sh_degree),
          T(in.scale_modifier)};
}

inline TileGrid grid_of(const Inputs& in) { return {int(in.image_width), int(in.image_height)}; }

/// A footprint has one number; each reads it under its own name.
inline FootprintOptions footprint_options(double option) { return {option, option}; }

/// Arguments of footprint_weight, contiguous, without results.
template <class Task, typename T> Task weight_task(const Tensor& offset, const Tensor& cov2d, double option) {
  Task task{};
  task.n = offset.numel() / 2;
  task.options = footprint_options(option);
  task.offsets = reinterpret_cast<const Vec2<T>*>(offset.const_data_ptr<T>());
  task.covs = reinterpret_cast<const Sym2<T>*>(cov2d.const_data_ptr<T>());
  return task;
}

/// What rasterize returns: color, radii, what its vjp needs, and alpha, if asked for (schemas in ops.cpp).
using RasterizeOutput = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor,
                                   Tensor, Tensor, Tensor, Tensor, std::vector<Tensor>>;
/// An image of other colours, and what takes the place of the same outputs of rasterize in its vjp: checkpoints,
/// chunks, counts.
using ChannelsOutput = std::tuple<Tensor, Tensor, Tensor, Tensor>;
/// Of inspect: median and dominant Gaussian of every pixel; pixels, largest weight and sum of weights of every
/// Gaussian.
using InspectOutput = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor>;
using StagesOutput = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;
/// Gradients of means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp; and of viewmatrix,
/// projmatrix, campos and lens, or of none of these four.
using Grads = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, std::vector<Tensor>>;
inline constexpr size_t kNeeds = 12;
using Needs = std::array<bool, kNeeds>;

/// Room for the gradients that are wanted; an empty tensor stands for one that is not.
inline Grads make_grads(const Inputs& in, const Needs& needs) {
  const auto make = [&](const OptionalTensor& like, bool needed) {
    return needed && like ? at::empty_like(*like, at::MemoryFormat::Contiguous) : at::empty({0}, in.means3D.options());
  };
  return {make(in.means3D, needs[0]),   make(in.means2D, needs[1]),        make(in.opacities, needs[2]),
          make(in.shs, needs[3]),       make(in.colors_precomp, needs[4]), make(in.scales, needs[5]),
          make(in.rotations, needs[6]), make(in.cov3D_precomp, needs[7]),  {}};
}

/// Room for `parts` sums of the camera's gradient, zero; undefined where nobody wants it.
inline Tensor make_camera_grads(const Inputs& in, const Needs& needs, int64_t parts) {
  const bool needed = needs[8] || needs[9] || needs[10] || needs[11];
  return in.lens && needed ? at::zeros({parts, kCameraGradWidth}, in.means3D.options()) : Tensor();
}
template <typename T> const T* const_data_or_null(const Tensor& t) {
  return t.defined() ? t.const_data_ptr<T>() : nullptr;
}
template <typename T> T* data_or_null(const Tensor& t) { return t.defined() ? t.data_ptr<T>() : nullptr; }

/// Adds up the parts of make_camera_grads, in double and always in the same order, and writes what is wanted to `out`.
inline void set_camera_grads(const Inputs& in, const Needs& needs, const Tensor& parts, Grads& out) {
  if (!parts.defined()) return;
  const Tensor sum = parts.sum(0, false, at::kDouble).to(parts.scalar_type());
  const Tensor none = at::empty({0}, sum.options());
  const auto rows = [&](int64_t first, int64_t count) { return sum.narrow(0, first, 4 * count).view({count, 4}); };
  const auto matrix = [&](Tensor first, Tensor last) {  // with a row of zeros between
    return at::cat({first, at::zeros({4 - first.size(0) - last.size(0), 4}, sum.options()), last}).t().contiguous();
  };
  std::get<8>(out) = {needs[8] ? matrix(rows(0, 3), rows(12, 0)) : none.clone(),
                      needs[9] ? matrix(rows(12, 2), rows(20, 1)) : none.clone(),
                      needs[10] ? sum.narrow(0, 24, 3).clone() : none.clone(),
                      needs[11] ? sum.narrow(0, 27, kLensWidth).clone() : none.clone()};
}

template <typename T> GaussianGrads<T> grads_of(const Inputs& in, const Grads& grads) {
  const auto pointer = [](const Tensor& t) { return t.numel() ? t.data_ptr<T>() : nullptr; };
  GaussianGrads<T> out{};
  out.means = reinterpret_cast<Vec3<T>*>(pointer(std::get<0>(grads)));
  out.means2d = pointer(std::get<1>(grads));
  out.means2d_stride = in.means2D ? int(in.means2D->size(1)) : 0;
  out.opacities = pointer(std::get<2>(grads));
  out.shs = reinterpret_cast<Vec3<T>*>(pointer(std::get<3>(grads)));
  out.colors = reinterpret_cast<Vec3<T>*>(pointer(std::get<4>(grads)));
  out.scales = reinterpret_cast<Vec3<T>*>(pointer(std::get<5>(grads)));
  out.rotations = reinterpret_cast<Vec4<T>*>(pointer(std::get<6>(grads)));
  out.cov3ds = reinterpret_cast<Sym3<T>*>(pointer(std::get<7>(grads)));
  return out;
}

}  // namespace ar::ops
