// Tensors as parameters of stages (core/stages.h), as far as all devices share them.
#pragma once

#include "core/camera.h"
#include "core/project.h"
#include "torch/backend.h"

namespace ar::ops {

template <typename T> CameraView<T> camera_of(const Inputs& in) {
  CameraView<T> c;
  c.view = const_pointer<T>(in.viewmatrix);
  c.proj = const_pointer<T>(in.projmatrix);
  c.position = const_pointer<T>(in.campos);
  c.width = int(in.image_width);
  c.height = int(in.image_height);
  c.tan_half_fov_x = T(in.tanfovx);
  c.tan_half_fov_y = T(in.tanfovy);
  c.lens = const_pointer<T>(in.lens);
  return c;
}

/// Whether colors_precomp are colours of splats, and not channels.
inline bool has_colors(const Inputs& in) { return in.colors_precomp && in.colors_precomp->size(1) == 3; }

template <typename T> Gaussians<T> gaussians_of(const Inputs& in) {
  Gaussians<T> g = {};
  g.n = in.count();
  g.means = const_pointer<Vec3<T>>(in.means3D);
  g.scales = const_pointer<Vec3<T>>(in.scales);
  g.rotations = const_pointer<Vec4<T>>(in.rotations);
  g.cov3ds = const_pointer<Sym3<T>>(in.cov3D_precomp);
  g.opacities = const_pointer<T>(in.opacities);
  g.shs = const_pointer<Vec3<T>>(in.shs);
  if (has_colors(in)) g.colors = const_pointer<Vec3<T>>(in.colors_precomp);
  g.sh_stride = in.shs ? int(in.shs->size(1)) : 0;
  g.sh_degree = int(in.sh_degree);
  g.scale_modifier = T(in.scale_modifier);
  return g;
}

template <typename T> GaussianGrads<T> grads_of(const Inputs& in, const Grads& grads) {
  GaussianGrads<T> out = {};
  out.means = pointer<Vec3<T>>(grads.means3D);
  out.scales = pointer<Vec3<T>>(grads.scales);
  out.rotations = pointer<Vec4<T>>(grads.rotations);
  out.cov3ds = pointer<Sym3<T>>(grads.cov3D_precomp);
  out.opacities = pointer<T>(grads.opacities);
  out.shs = pointer<Vec3<T>>(grads.shs);
  out.colors = pointer<Vec3<T>>(grads.colors_precomp);
  out.means2d = pointer<T>(grads.means2D);
  out.means2d_stride = in.means2D ? int(in.means2D->size(1)) : 0;
  out.mean_sums = grads.mean_sums;
  return out;
}

template <typename T> CameraGradSums<T> camera_sums_of(const Tensor& parts, const Grads& grads) {
  return {const_pointer<T>(parts),  parts.size(0),         pointer<T>(grads.viewmatrix), pointer<T>(grads.projmatrix),
          pointer<T>(grads.campos), pointer<T>(grads.lens)};
}

template <typename T> ProjectedRows<T> projected_rows_of(const RowTensors& rows) {
  ProjectedRows<T> out;
  out.means2d = const_cast<Vec2<T>*>(const_pointer<Vec2<T>>(rows.means2d));
  out.cov2d = const_cast<Sym2<T>*>(const_pointer<Sym2<T>>(rows.cov2d));
  out.dets = const_cast<T*>(const_pointer<T>(rows.dets));
  out.opacities = const_cast<T*>(const_pointer<T>(rows.opacities));
  out.depths = const_cast<T*>(const_pointer<T>(rows.depths));
  out.colors = const_cast<Vec3<T>*>(const_pointer<Vec3<T>>(rows.colors));
  out.center = T(rows.center);
  return out;
}

template <typename T> RowOutputs<T> row_outputs_of(const ProjectedTensors& rows) {
  RowOutputs<T> out;
  out.means2d = pointer<Vec2<T>>(rows.means2d);
  out.cov2d = pointer<Sym2<T>>(rows.cov2d);
  out.dets = pointer<T>(rows.dets);
  out.opacities = pointer<T>(rows.opacities);
  out.depths = pointer<T>(rows.depths);
  out.center = T(rows.center);
  out.features = pointer<T>(rows.features);
  out.stride = rows.features.defined() ? rows.features.size(1) : 0;
  out.colored = rows.colored;
  out.shows_depth = rows.shows_depth;
  out.radii = pointer<int32_t>(rows.radii);
  out.conics = pointer<Vec3<T>>(rows.conics);
  out.shown_opacities = pointer<T>(rows.shown_opacities);
  out.gaussian_ids = pointer<int32_t>(rows.gaussian_ids);
  out.camera_ids = pointer<int32_t>(rows.camera_ids);
  out.slopes = pointer<Vec2<T>>(rows.slopes);
  out.camera = int32_t(rows.camera);
  out.places.ends = const_pointer<int32_t>(rows.ends);
  out.places.first = rows.first;
  out.places.last = rows.last;
  return out;
}

template <typename T> RowRules<T> row_rules_of(const RowRules<double>& rules) {
  return {rules.order,       rules.shown,          rules.measured, T(rules.variance),
          rules.compensated, T(rules.radius_clip), T(rules.near),  T(rules.far)};
}

template <typename T> ProjectedRowGrads<T> projected_row_grads_of(const ProjectedGrads& dL_drows) {
  ProjectedRowGrads<T> out;
  out.places = {const_pointer<int32_t>(dL_drows.rows), const_pointer<int32_t>(dL_drows.ends),
                const_pointer<int32_t>(dL_drows.radii), dL_drows.first, dL_drows.last};
  if (const T* packed = const_pointer<T>(dL_drows.packed)) {
    const int64_t stride = dL_drows.packed.size(1) * int64_t(sizeof(T));
    out.means2d = {reinterpret_cast<const Vec2<T>*>(packed + kPackedMean), stride};
    out.cov2d = {reinterpret_cast<const Sym2<T>*>(packed + kPackedCov), stride};
    out.opacities = {packed + kPackedOpacity, stride};
    out.colors = {reinterpret_cast<const Vec3<T>*>(packed + kPackedColor), stride};
    return out;
  }
  out.means2d = const_pointer<Vec2<T>>(dL_drows.means2d);
  out.cov2d = const_pointer<Sym2<T>>(dL_drows.cov2d);
  out.opacities = const_pointer<T>(dL_drows.opacities);
  out.depths = const_pointer<T>(dL_drows.depths);
  out.order = dL_drows.order;
  out.shown = dL_drows.shown;
  if (const T* features = const_pointer<T>(dL_drows.features)) {
    const int64_t width = dL_drows.features.size(1), stride = width * int64_t(sizeof(T));
    if (dL_drows.colored) out.colors = {reinterpret_cast<const Vec3<T>*>(features), stride};
    if (dL_drows.shows_depth) out.shown_depths = {features + width - 1, stride};
  }
  return out;
}

template <typename T> PackedRows<T> packed_rows_of(const PackedTensors& packed) {
  PackedRows<T> out;
  out.rows = reinterpret_cast<PackedRow<T>*>(pointer<T>(packed.rows));
  out.room = packed.rows.size(0);
  out.first = const_pointer<int64_t>(packed.first);
  out.ends = const_pointer<int32_t>(packed.ends);
  out.radii = pointer<int32_t>(packed.radii);
  out.ids = pointer<int32_t>(packed.ids);
  out.first_id = packed.first_id;
  return out;
}

template <typename T, class Params> void set_projection(Params& p, const Inputs& in, const Pass& pass) {
  p.camera = camera_of<T>(in);
  p.gaussians = gaussians_of<T>(in);
  p.footprint = pass.footprint.choice;
  p.bounds = cull_bounds<T>(pass.footprint.choice);
}
template <typename T> void set_channels(ProjectParams<T>& p, const ChannelTensors& channels) {
  p.channels = channel_rows<T>(channels.rows, channels);
  if (!channels.given.defined()) return;
  p.given.data = const_pointer<T>(channels.given);
  p.given.stride = channels.given.size(1);
  p.given.count = int(p.given.stride);
}

template <typename T, class Params> void set_projection_vjp(Params& p, const Inputs& in, const Grads& grads) {
  p.camera = camera_of<T>(in);
  p.gaussians = gaussians_of<T>(in);
  p.grads = grads_of<T>(in, grads);
}

inline int64_t row_count(const RowTensors& rows) {
  return rows.packed.defined() ? rows.packed.size(0) : rows.means2d.size(0);
}

template <typename T>
void set_shape_rows(ShapeRowsParams<T>& p, const RowTensors& rows, const Pass& pass, const Tensor& splats) {
  p.n = row_count(rows);
  p.rows = projected_rows_of<T>(rows);
  p.any_color = rows.any_color;
  p.footprint = pass.footprint.choice;
  p.grid = pass.grid;
  p.splats = pointer<T>(splats);
  p.packed = reinterpret_cast<const PackedRow<T>*>(const_pointer<T>(rows.packed));
  p.kept_covs = pointer<T>(rows.kept.covs);
  p.kept_opacities = pointer<T>(rows.kept.opacities);
}

template <typename T>
void set_row_grads(RowGradsParams<T>& p, const RowTensors& rows, const Pass& pass, const RowTensors& dL_drows) {
  p.n = row_count(dL_drows);
  p.rows = projected_rows_of<T>(rows);
  p.footprint = pass.footprint.choice;
  p.kept_covs = const_pointer<T>(rows.kept.covs);
  p.kept_opacities = const_pointer<T>(rows.kept.opacities);
  p.packed = pointer<T>(dL_drows.packed);
  p.packed_width = dL_drows.packed.defined() ? int(dL_drows.packed.size(1)) : 0;
  p.dL_dmeans2d = pointer<Vec2<T>>(dL_drows.means2d);
  p.dL_dcov2d = pointer<Sym2<T>>(dL_drows.cov2d);
  p.dL_dopacities = pointer<T>(dL_drows.opacities);
  p.absolute = pointer<Vec2<T>>(dL_drows.absolute);
  p.dL_dcolors = pointer<Vec3<T>>(dL_drows.colors);
}

/// For `blend` and its adjoint, where `image` is a gradient.
template <typename T, class Params>
void set_blend(Params& p, const ListTensors& lists, const Pass& pass, const ChannelTensors& channels,
               const ImageTensors& image, const BlendState& state) {
  p.grid = pass.grid;
  p.splats = const_pointer<T>(lists.splats);
  p.background = const_pointer<T>(channels.background);
  p.transmittance = pointer<T>(state.transmittance);
  p.last = pointer<int32_t>(state.last);
  set_images(p, image, channels);
}

template <typename T>
void set_inspect(InspectParams<T>& p, const ListTensors& lists, const Pass& pass, const Tensor& depths,
                 const SummaryTensors& summary) {
  p.splats = const_pointer<T>(lists.splats);
  p.grid = pass.grid;
  p.depths = const_pointer<T>(depths);
  p.median = pointer<T>(summary.median);
  p.dominant = pointer<int32_t>(summary.dominant);
  p.touched = pointer<int32_t>(summary.touched);
  p.largest = reinterpret_cast<int32_t*>(pointer<float>(summary.largest));
  p.units = pointer<int64_t>(summary.total);
  p.in_front = pointer<int32_t>(summary.in_front);
  p.dominated = pointer<int32_t>(summary.dominated);
}

template <typename T> void set_weight(WeightParams<T>& p, const WeightTensors& t, const FootprintSpec& footprint) {
  p.n = t.offset.numel() / 2;
  p.options = footprint.choice.options;
  p.offsets = const_pointer<Vec2<T>>(t.offset);
  p.covs = const_pointer<Sym2<T>>(t.cov2d);
  p.weights = pointer<T>(t.weight);
  p.dL_dweights = const_pointer<T>(t.dL_dweight);
  p.dL_doffsets = pointer<Vec2<T>>(t.dL_doffset);
  p.dL_dcovs = pointer<Sym2<T>>(t.dL_dcov2d);
}

}  // namespace ar::ops
