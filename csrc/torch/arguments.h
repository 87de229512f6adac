// The arguments of the ops, a struct per op. `each` lists them in the order of the schema, for boxing.h.
#pragma once

#include <string>
#include <string_view>
#include <vector>

#include "torch/images.h"

namespace ar::ops {

/// Named as in 3DGS.
template <class Optional> struct SceneTensors {
  Tensor means3D;
  Optional means2D;
  Tensor opacities;
  Optional shs, colors_precomp, scales, rotations, cov3D_precomp;
  Tensor viewmatrix, projmatrix, campos;
  Optional lens;  ///< Of a full camera.

  template <class Visit> void each_tensor(Visit&& visit) {
    visit("means3D", means3D);
    visit("means2D", means2D);
    visit("opacities", opacities);
    visit("shs", shs);
    visit("colors_precomp", colors_precomp);
    visit("scales", scales);
    visit("rotations", rotations);
    visit("cov3D_precomp", cov3D_precomp);
    visit("viewmatrix", viewmatrix);
    visit("projmatrix", projmatrix);
    visit("campos", campos);
    visit("lens", lens);
  }
};
inline constexpr size_t kGaussianTensors = 8, kCameraTensors = 4, kSceneTensors = kGaussianTensors + kCameraTensors;

template <class Tangent> struct CameraNumbers {
  int64_t image_height = 0, image_width = 0;
  Tangent tanfovx = {}, tanfovy = {};
  double scale_modifier = 1;
  int64_t sh_degree = 0;

  template <class Visit> void each_number(Visit&& visit) {
    visit("image_height", image_height);
    visit("image_width", image_width);
    visit("tanfovx", tanfovx);
    visit("tanfovy", tanfovy);
    visit("scale_modifier", scale_modifier);
    visit("sh_degree", sh_degree);
  }
};

/// Tangent: double, or a vector for several cameras, whose tensors have one more dimension.
template <class Tangent> struct SceneArguments : SceneTensors<OptionalTensor>, CameraNumbers<Tangent> {
  int64_t count() const { return means3D.size(0); }

  template <class Visit> void each(Visit&& visit) {
    each_tensor(visit);
    this->each_number(visit);
  }
};
using Inputs = SceneArguments<double>;

/// Undefined where not wanted.
struct Grads : SceneTensors<Tensor> {
  MeanSums mean_sums = MeanSums::kNone;  ///< In means2D.
  bool with_camera = false;
  bool add = false;  ///< Only for Gaussians.
};

struct FootprintArguments {
  std::string footprint;
  double option = 0;

  template <class Visit> void each(Visit&& visit) {
    visit("footprint", footprint);
    visit("option", option);
  }
};

struct RasterizeArguments : Inputs, FootprintArguments {
  Tensor bg;  ///< (C,).
  ImageSwitches images = {};
  SummarySwitches summary = {};
  bool keep = false, debug = false;
  std::string means2d_z = "zero";  ///< Column 2 of the gradient of means2D: "zero", "sum_abs", "sum_norm".
  OptionalTensor features;         ///< (P, K), blended on zero after three colours.

  template <class Visit> void each(Visit&& visit) {
    Inputs::each(visit);
    visit("bg", bg);
    FootprintArguments::each(visit);
    for (size_t k = 0; k < kImageCount; ++k) visit(kImageSwitches[k], images[k]);
    for (size_t k = 0; k < kSummaryCount; ++k) visit(kSummarySwitches[k], summary[k]);
    visit("keep=False", keep);
    visit("debug=False", debug);
    visit("means2d_z=\"zero\"", means2d_z);
    visit("features=None", features);
  }
};

/// Poses act on column vectors. See core/camera/prepare.h.
struct PrepareCamerasArguments {
  Tensor views, intrinsics;     ///< (C, 4, 4), (C, 3, 3).
  OptionalTensor coefficients;  ///< (C, kDistortion), if the model is a lens.
  int64_t width = 0, height = 0;
  std::string model;
  double near = 0, far = 0;
  bool off_center = true;

  template <class Visit> void each(Visit&& visit) {
    visit("views", views);
    visit("intrinsics", intrinsics);
    visit("coefficients", coefficients);
    visit("width", width);
    visit("height", height);
    visit("model", model);
    visit("near", near);
    visit("far", far);
    visit("off_center=True", off_center);
  }
};

struct PrepareLensArguments {
  Tensor viewmatrix, projmatrix;
  OptionalTensor tanfovx, tanfovy, aperture, focus, shift, turn, screen, distortion;
  std::vector<double> numbers;  ///< (kLensWidth,), but for `reach` and `fold`, angles or 0.
  int64_t height = 0;           ///< Of the picture, px.
  bool centered = false;        ///< `center` is the middle of the picture by the matrices.

  template <class Visit> void each_part(Visit&& visit) {
    visit("tanfovx", tanfovx);
    visit("tanfovy", tanfovy);
    visit("aperture", aperture);
    visit("focus", focus);
    visit("shift", shift);
    visit("turn", turn);
    visit("screen", screen);
    visit("distortion", distortion);
  }
  template <class Visit> void each(Visit&& visit) {
    visit("viewmatrix", viewmatrix);
    visit("projmatrix", projmatrix);
    each_part(visit);
    visit("numbers", numbers);
    visit("height", height);
    visit("centered=False", centered);
  }
};

/// Tensors of C cameras: (C, 4, 4), (C, 4, 4), (C, 3), (C, kLensWidth). means2D is a result.
struct BatchArguments : SceneArguments<std::vector<double>>, FootprintArguments {
  template <class Visit> void each(Visit&& visit) {
    SceneArguments::each([&](std::string_view name, auto& value) {
      if (name != "means2D") visit(name, value);
    });
    FootprintArguments::each(visit);
  }
};

/// Gaussians may be in B batches, (B, P, ...), of C / B cameras each; harmonics and values (P, ...) or (C, P, ...) too.
struct ProjectArguments : BatchArguments {
  OptionalTensor values;                        ///< (P, K), features after the colours.
  std::vector<int64_t> table;                   ///< Sizes (..., C, P) of a table with all rows, or none.
  bool measured = false;                        ///< Rows and radii as in gsplat.
  std::string order = "model", shown = "none";  ///< Kinds of depth: of the rows, and as their last feature.
  double center = 0;
  // Of a RowMeasure:
  double variance = 0;
  bool compensated = false;
  double near = 0, far = 0, radius_clip = 0;
  bool keep = false;

  bool is_table() const { return !table.empty(); }
  int64_t batches() const { return means3D.dim() == 3 ? means3D.size(0) : 1; }
  int64_t cameras() const { return viewmatrix.size(0); }  ///< After check_cameras().
  template <class Visit> void each(Visit&& visit) {
    BatchArguments::each(visit);
    visit("values=None", values);
    visit("table=[]", table);
    visit("measured=False", measured);
    visit("order=\"model\"", order);
    visit("shown=\"none\"", shown);
    visit("center=0.0", center);
    visit("variance=0.0", variance);
    visit("compensated=False", compensated);
    visit("near=0.0", near);
    visit("far=0.0", far);
    visit("radius_clip=0.0", radius_clip);
    visit("keep=False", keep);
  }
};

/// Of camera c: counts[c] packed rows, from firsts[c] on.
struct PackedRanges {
  std::vector<int64_t> firsts, counts;

  template <class Visit> void each(Visit&& visit) {
    visit("firsts", firsts);
    visit("counts", counts);
  }
};

struct ImageArguments : FootprintArguments {
  int64_t image_height = 0, image_width = 0;

  template <class Visit> void each(Visit&& visit) {
    visit("image_height", image_height);
    visit("image_width", image_width);
    FootprintArguments::each(visit);
  }
};

struct BinArguments : ImageArguments {
  Tensor means2d, cov2d, dets, opacities, depths;
  Tensor row_splits;  ///< (C + 1,) int64 on the CPU: first row of each camera.
  bool keep = true;
  OptionalTensor slopes;  ///< (N, 2) of `project`, in the order along rays.

  template <class Visit> void each(Visit&& visit) {
    visit("means2d", means2d);
    visit("cov2d", cov2d);
    visit("dets", dets);
    visit("opacities", opacities);
    visit("depths", depths);
    visit("row_splits", row_splits);
    ImageArguments::each(visit);
    visit("keep=True", keep);
    visit("slopes=None", slopes);
  }
};

struct BlendArguments : ImageArguments {
  Tensor means2d, cov2d, opacities, features, background;
  OptionalTensor means2d_abs;  ///< Its gradient: sums over pixels of |dL/dmeans2d|.
  Tensor dets, row_splits;
  std::vector<Tensor> lists;  ///< Of `bin`.
  bool keep = false;

  template <class Visit> void each(Visit&& visit) {
    visit("means2d", means2d);
    visit("cov2d", cov2d);
    visit("opacities", opacities);
    visit("features", features);
    visit("background", background);
    visit("means2d_abs", means2d_abs);
    visit("dets", dets);
    visit("row_splits", row_splits);
    visit("lists", lists);
    ImageArguments::each(visit);
    visit("keep=False", keep);
  }
};

/// `bin` and `blend` in one; rows may be a table, (..., 2) and (...,).
struct CompositeArguments : ImageArguments {
  Tensor means2d, cov2d, opacities, features;
  OptionalTensor background;   ///< (..., K), of the first channels, zero behind others.
  OptionalTensor means2d_abs;  ///< As in BlendArguments.
  Tensor dets, depths, row_splits;
  double center = 0;      ///< Of pixels, in means2d.
  bool expected = false;  ///< The last channel is divided by alpha.
  bool keep = false;
  OptionalTensor slopes;            ///< As in BinArguments.
  int64_t background_channels = 0;  ///< Of `background` as given; check() fills it up.

  template <class Visit> void each(Visit&& visit) {
    visit("means2d", means2d);
    visit("cov2d", cov2d);
    visit("opacities", opacities);
    visit("features", features);
    visit("background", background);
    visit("means2d_abs", means2d_abs);
    visit("dets", dets);
    visit("depths", depths);
    visit("row_splits", row_splits);
    ImageArguments::each(visit);
    visit("center=0.0", center);
    visit("expected=False", expected);
    visit("keep=False", keep);
    visit("slopes=None", slopes);
  }
};

/// Rows, repeated in pictures with a seam.
struct SeamArguments : ImageArguments {
  Tensor means2d, cov2d, opacities, depths, colors;  ///< Colours (N, 3), or (0, 3).
  Tensor turns;                                      ///< (C,) px of a turn of each camera, infinite without a seam.
  OptionalTensor beside;                             ///< (N, K), repeated too.
  Tensor radii, gaussian_ids, camera_ids, dets, row_splits;
  bool keep = false;

  static constexpr size_t kTensors = 12;
  template <class Visit> void each(Visit&& visit) {
    visit("means2d", means2d);
    visit("cov2d", cov2d);
    visit("opacities", opacities);
    visit("depths", depths);
    visit("colors", colors);
    visit("turns", turns);
    visit("beside", beside);
    visit("radii", radii);
    visit("gaussian_ids", gaussian_ids);
    visit("camera_ids", camera_ids);
    visit("dets", dets);
    visit("row_splits", row_splits);
    ImageArguments::each(visit);
    visit("keep=False", keep);
  }
};

struct InspectArguments : ImageArguments {
  std::vector<Tensor> lists;  ///< Of `bin`, of one camera.
  Tensor depths;              ///< (N,) of the rows.
  SummarySwitches summary = {};
  int64_t count() const { return depths.size(0); }

  template <class Visit> void each(Visit&& visit) {
    visit("lists", lists);
    visit("depths", depths);
    ImageArguments::each(visit);
    for (size_t k = 0; k < kSummaryCount; ++k) visit(kSummarySwitches[k], summary[k]);
  }
};

struct WeightArguments : FootprintArguments {
  Tensor offset, cov2d;

  template <class Visit> void each(Visit&& visit) {
    visit("offset", offset);
    visit("cov2d", cov2d);
    FootprintArguments::each(visit);
  }
};

/// Written by an op; the schema marks each by its letter.
template <char kLetter> struct WrittenTensors : std::vector<Tensor> {};
template <char kLetter> struct WrittenTensor : Tensor {};

/// Then autograd refuses a backward pass that needs old values. Inference tensors have no version.
inline void note_written(const Tensor& t) {
  if (!t.is_inference()) t.unsafeGetTensorImpl()->bump_version();
}

/// Rows from `room` on are not written.
struct PackArguments : BatchArguments {
  WrittenTensor<'a'> rows;   ///< (room, kPackedWidth).
  WrittenTensor<'b'> radii;  ///< (room,) int32.
  WrittenTensor<'c'> ids;    ///< (room,) int32.
  Tensor ends;               ///< (C, P) int32, of `count_rows`.
  Tensor firsts;             ///< (C,) int64: each camera's first row.
  int64_t first_id = 0;      ///< PackedRow::id of Gaussian 0.

  template <class Visit> void each(Visit&& visit) {
    visit("rows", rows);
    visit("radii", radii);
    visit("ids", ids);
    BatchArguments::each(visit);
    visit("ends", ends);
    visit("firsts", firsts);
    visit("first_id", first_id);
  }
};

struct PackVjpArguments : BatchArguments, PackedRanges {
  Tensor dL_drows;          ///< (n, kPackedGradWidth or more).
  Tensor ids;               ///< (n,) int32, of `pack_rows_`.
  std::vector<bool> needs;  ///< Of BatchArguments.

  template <class Visit> void each(Visit&& visit) {
    visit("dL_drows", dL_drows);
    BatchArguments::each(visit);
    visit("ids", ids);
    PackedRanges::each(visit);
    visit("needs", needs);
  }
};

/// Rows of one camera, Gaussians ascending.
struct BlendRowsArguments : ImageArguments {
  Tensor rows, background;  ///< (n, kPackedWidth), (3,).
  bool keep = false;

  template <class Visit> void each(Visit&& visit) {
    visit("rows", rows);
    visit("background", background);
    ImageArguments::each(visit);
    visit("keep=False", keep);
  }
};

struct BlendRowsVjpArguments : ImageArguments {
  /// (n, kPackedGradWidth or kPackedGradWidthAbsolute). May lie in the memory of splats in `saved`.
  WrittenTensor<'a'> dL_drows;
  OptionalTensor dL_dimage, dL_dalpha;  ///< (3, H, W), (H, W).
  Tensor background;
  std::vector<Tensor> saved;
  bool needs_background = false;

  template <class Visit> void each(Visit&& visit) {
    visit("dL_drows", dL_drows);
    visit("dL_dimage", dL_dimage);
    visit("dL_dalpha", dL_dalpha);
    visit("background", background);
    ImageArguments::each(visit);
    visit("saved", saved);
    visit("needs_background", needs_background);
  }
};

/// Of a declaration `name=default`.
inline std::string_view name_of(std::string_view declaration) { return declaration.substr(0, declaration.find('=')); }

/// `needs`: which tensors of `of_op` want a gradient.
template <class Arguments> struct VjpArguments {
  std::vector<OptionalTensor> dL_doutputs;
  Arguments of_op;
  std::vector<Tensor> saved;
  std::vector<bool> needs;

  template <class Visit> void each(Visit&& visit) {
    visit("dL_doutputs", dL_doutputs);
    // No defaults, since arguments without one follow.
    of_op.each([&](std::string_view declaration, auto& value) { visit(name_of(declaration), value); });
    visit("saved", saved);
    visit("needs", needs);
  }
};

}  // namespace ar::ops
