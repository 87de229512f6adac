// Tensors as the views that the stages take. The same on every device.
#pragma once

#include "core/camera.h"
#include "torch/backend.h"

namespace ar::ops {

template <typename T> const T* const_data_or_null(const Tensor& t) {
  return t.defined() && t.numel() ? t.const_data_ptr<T>() : nullptr;
}
template <typename T> T* data_or_null(const Tensor& t) { return t.defined() && t.numel() ? t.data_ptr<T>() : nullptr; }
template <class Element, typename T> const Element* rows_of(const OptionalTensor& t) {
  return t ? reinterpret_cast<const Element*>(t->const_data_ptr<T>()) : nullptr;
}

template <typename T> CameraView<T> camera_of(const Inputs& in) {
  CameraView<T> c;
  c.view = in.viewmatrix.const_data_ptr<T>();
  c.proj = in.projmatrix.const_data_ptr<T>();
  c.position = in.campos.const_data_ptr<T>();
  c.width = int(in.image_width);
  c.height = int(in.image_height);
  c.tan_half_fov_x = T(in.tanfovx);
  c.tan_half_fov_y = T(in.tanfovy);
  c.lens = in.lens ? in.lens->const_data_ptr<T>() : nullptr;
  return c;
}

template <typename T> Gaussians<T> gaussians_of(const Inputs& in) {
  Gaussians<T> g = {};
  g.n = in.count();
  g.means = reinterpret_cast<const Vec3<T>*>(in.means3D.const_data_ptr<T>());
  g.scales = rows_of<Vec3<T>, T>(in.scales);
  g.rotations = rows_of<Vec4<T>, T>(in.rotations);
  g.cov3ds = rows_of<Sym3<T>, T>(in.cov3D_precomp);
  g.opacities = in.opacities.const_data_ptr<T>();
  g.shs = rows_of<Vec3<T>, T>(in.shs);
  if (in.colors_precomp && in.colors_precomp->size(1) == 3) g.colors = rows_of<Vec3<T>, T>(in.colors_precomp);
  g.sh_stride = in.shs ? int(in.shs->size(1)) : 0;
  g.sh_degree = int(in.sh_degree);
  g.scale_modifier = T(in.scale_modifier);
  return g;
}

inline TileGrid grid_of(const Inputs& in) { return {int(in.image_width), int(in.image_height)}; }

/// The rows that `project` fills.
template <typename T> ChannelRows<T> channel_rows(const ChannelTensors& channels, ChannelColumns columns) {
  const bool fills = columns.color >= 0 || columns.depth >= 0 || columns.inverse_depth >= 0;
  return {fills ? channels.rows.data_ptr<T>() : nullptr, channels.count, columns.color, columns.depth,
          columns.inverse_depth};
}

template <typename T> Planes<T> planes_of(const ImageTensors& image) {
  Planes<T> planes = {};
  planes.first = const_cast<T*>(const_data_or_null<std::remove_const_t<T>>(image.color));
  planes.split = int(image.color_channels);
  for (size_t k = 0; k < image.extra.size(); ++k)
    planes.extra[k] = const_cast<T*>(const_data_or_null<std::remove_const_t<T>>(image.extra[k]));
  return planes;
}

template <typename T> GaussianGrads<T> grads_of(const Inputs& in, const Grads& grads) {
  GaussianGrads<T> out = {};
  out.means = reinterpret_cast<Vec3<T>*>(data_or_null<T>(grads.means3D));
  out.scales = reinterpret_cast<Vec3<T>*>(data_or_null<T>(grads.scales));
  out.rotations = reinterpret_cast<Vec4<T>*>(data_or_null<T>(grads.rotations));
  out.cov3ds = reinterpret_cast<Sym3<T>*>(data_or_null<T>(grads.cov3D_precomp));
  out.opacities = data_or_null<T>(grads.opacities);
  out.shs = reinterpret_cast<Vec3<T>*>(data_or_null<T>(grads.shs));
  if (in.colors_precomp && in.colors_precomp->size(1) == 3)
    out.colors = reinterpret_cast<Vec3<T>*>(data_or_null<T>(grads.colors_precomp));
  out.means2d = data_or_null<T>(grads.means2D);
  out.means2d_stride = in.means2D ? int(in.means2D->size(1)) : 0;
  out.mean_sums = grads.mean_sums;
  return out;
}

/// Arguments of footprint_weight, contiguous, without results.
template <class Params, typename T>
Params weight_params(const Tensor& offset, const Tensor& cov2d, const FootprintSpec& footprint) {
  Params p = {};
  p.n = offset.numel() / 2;
  p.options = footprint.choice.options;
  p.offsets = reinterpret_cast<const Vec2<T>*>(offset.const_data_ptr<T>());
  p.covs = reinterpret_cast<const Sym2<T>*>(cov2d.const_data_ptr<T>());
  return p;
}

}  // namespace ar::ops
