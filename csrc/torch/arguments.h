// The arguments of the ops, each named once, in the order of its schema: `each` of a struct lists them for the schema
// and for reading them off the dispatcher's stack (boxing.h), and for the names in snapshots.
#pragma once

#include <string>
#include <string_view>
#include <vector>

#include "torch/images.h"

namespace ar::ops {

/// A tensor, or what takes its place, for every tensor of a scene and a camera as 3DGS names them.
template <class Optional> struct SceneTensors {
  Tensor means3D;
  Optional means2D;
  Tensor opacities;
  Optional shs, colors_precomp, scales, rotations, cov3D_precomp;
  Tensor viewmatrix, projmatrix, campos;
  Optional lens;  ///< of a full camera

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
/// The first of them are of the Gaussians, the others of the camera.
inline constexpr size_t kGaussianTensors = 8, kCameraTensors = 4, kSceneTensors = kGaussianTensors + kCameraTensors;

/// How a camera renders, besides its tensors.
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

/// A scene and a camera, whose tangents are a double each; or several cameras, with a std::vector<double> and tensors
/// that have a dimension more. check() (checks.h) brings the tensors into the form the kernels read.
template <class Tangent> struct SceneArguments : SceneTensors<OptionalTensor>, CameraNumbers<Tangent> {
  int64_t count() const { return means3D.size(0); }

  template <class Visit> void each(Visit&& visit) {
    each_tensor(visit);
    this->each_number(visit);
  }
};
using Inputs = SceneArguments<double>;

/// Gradients with respect to the tensors of Inputs; undefined where nobody wants one.
struct Grads : SceneTensors<Tensor> {
  MeanSums mean_sums = MeanSums::kNone;  ///< that means2D holds
  bool with_camera = false;              ///< one of the camera's tensors wants a gradient
  bool add = false;                      ///< those of the Gaussians are added to what is there
};

/// A footprint by its key, and the number of its option.
struct FootprintArguments {
  std::string footprint;
  double option = 0;

  template <class Visit> void each(Visit&& visit) {
    visit("footprint", footprint);
    visit("option", option);
  }
};

/// Arguments of `rasterize`.
struct RasterizeArguments : Inputs, FootprintArguments {
  Tensor bg;  ///< (C,) of C colour channels
  ImageSwitches images = {};
  bool keep = false, debug = false;
  std::string means2d_z = "zero";  ///< third column of the gradient with respect to means2D: "sum_abs", "sum_norm"
  OptionalTensor features;         ///< (P, K) further channels beside three colours, blended on zero

  template <class Visit> void each(Visit&& visit) {
    Inputs::each(visit);
    visit("bg", bg);
    FootprintArguments::each(visit);
    for (size_t k = 0; k < kImageCount; ++k) visit(kImageSwitches[k], images[k]);
    visit("keep=False", keep);
    visit("debug=False", debug);
    visit("means2d_z=\"zero\"", means2d_z);
    visit("features=None", features);
  }
};

/// Arguments of `project`: of one or several cameras, in C numbers each of the tangents and in tensors of shape
/// (C, 4, 4), (C, 4, 4), (C, 3), (C, kLensWidth). It has no means2D, which is an output.
struct ProjectArguments : SceneArguments<std::vector<double>>, FootprintArguments {
  template <class Visit> void each(Visit&& visit) {
    SceneArguments::each([&](std::string_view name, auto& value) {
      if (name != "means2D") visit(name, value);
    });
    FootprintArguments::each(visit);
  }
};

/// Which rows of packed rows belong to C cameras: `counts[c]` from `firsts[c]` on.
struct PackedPlaces {
  std::vector<int64_t> firsts, counts;

  template <class Visit> void each(Visit&& visit) {
    visit("firsts", firsts);
    visit("counts", counts);
  }
};

/// What the arguments of `bin`, `blend` and `inspect` have in common.
struct ImageArguments : FootprintArguments {
  int64_t image_height = 0, image_width = 0;

  template <class Visit> void each(Visit&& visit) {
    visit("image_height", image_height);
    visit("image_width", image_width);
    FootprintArguments::each(visit);
  }
};

/// Arguments of `bin`: the rows that `project` made for C cameras, camera after camera.
struct BinArguments : ImageArguments {
  Tensor means2d, cov2d, dets, opacities, depths;
  Tensor row_splits;  ///< (C + 1,) int64 on the CPU, first row of each camera
  bool keep = true;

  template <class Visit> void each(Visit&& visit) {
    visit("means2d", means2d);
    visit("cov2d", cov2d);
    visit("dets", dets);
    visit("opacities", opacities);
    visit("depths", depths);
    visit("row_splits", row_splits);
    ImageArguments::each(visit);
    visit("keep=True", keep);
  }
};

/// Arguments of `blend`.
struct BlendArguments : ImageArguments {
  Tensor means2d, cov2d, opacities, features, background;
  OptionalTensor means2d_abs;  ///< its values are ignored; its gradient is the sum over pixels of |dL/dmeans2d|
  Tensor dets, row_splits;
  std::vector<Tensor> lists;  ///< of `bin`
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

/// Arguments of `inspect`: what every pixel shows of the Gaussians that `lists` of rasterize hold, and how much of each
/// Gaussian is seen.
struct InspectArguments : ImageArguments {
  std::vector<Tensor> saved;
  Tensor depths;  ///< (P,) of all Gaussians. Only P is read, which as a number would be fixed for a compiled program
  int64_t count() const { return depths.size(0); }

  template <class Visit> void each(Visit&& visit) {
    visit("saved", saved);
    visit("depths", depths);
    ImageArguments::each(visit);
  }
};

/// Arguments of `footprint_weight`.
struct WeightArguments : FootprintArguments {
  Tensor offset, cov2d;

  template <class Visit> void each(Visit&& visit) {
    visit("offset", offset);
    visit("cov2d", cov2d);
    FootprintArguments::each(visit);
  }
};

/// Arguments of `ssim_map`: the similarity of every pixel of `image` and `target` (core/ssim.h).
struct SsimArguments {
  Tensor image;   ///< (..., H, W)
  Tensor target;  ///< the same, of the image's dtype or uint8; has no gradient
  bool keep = false;

  template <class Visit> void each(Visit&& visit) {
    visit("image", image);
    visit("target", target);
    visit("keep=False", keep);
  }
};

/// Arguments of `l1_ssim`: l1_weight * (mean of |image - target|) + ssim_weight * (mean similarity) + constant.
struct L1SsimArguments : SsimArguments {
  double l1_weight = 0, ssim_weight = 0, constant = 0;

  template <class Visit> void each(Visit&& visit) {
    visit("image", image);
    visit("target", target);
    visit("l1_weight", l1_weight);
    visit("ssim_weight", ssim_weight);
    visit("constant", constant);
    visit("keep=False", keep);
  }
};

/// Arguments of `activate`: parameters of Gaussians as a training optimises them (core/activations.h).
struct ActivateArguments {
  Tensor log_scales, quats, logit_opacities;

  template <class Visit> void each(Visit&& visit) {
    visit("log_scales", log_scales);
    visit("quats", quats);
    visit("logit_opacities", logit_opacities);
  }
};

/// Arguments of `picture_gradients`: a scene by the parameters that a training optimises, a plain or a full camera, and
/// what the picture should be.
struct PictureArguments : CameraNumbers<double>, FootprintArguments {
  Tensor means, log_scales, quats, logit_opacities, shs;
  int64_t mean_columns = 0;  ///< of the gradient with respect to means2D, 3 or 4; 0: none is wanted
  Tensor target, dL_dloss;   ///< as of `l1_ssim`; ()
  double ssim_weight = 0;
  Tensor bg, viewmatrix, projmatrix, campos;
  OptionalTensor lens;

  template <class Visit> void each(Visit&& visit) {
    visit("means", means);
    visit("log_scales", log_scales);
    visit("quats", quats);
    visit("logit_opacities", logit_opacities);
    visit("shs", shs);
    visit("mean_columns", mean_columns);
    visit("target", target);
    visit("dL_dloss", dL_dloss);
    visit("ssim_weight", ssim_weight);
    visit("bg", bg);
    visit("viewmatrix", viewmatrix);
    visit("projmatrix", projmatrix);
    visit("campos", campos);
    visit("lens", lens);
    each_number(visit);
    FootprintArguments::each(visit);
  }
};

/// Tensors that an op writes to, marked in its schema by a letter that no other argument has.
template <char kLetter> struct WrittenTensors : std::vector<Tensor> {};

/// A tensor that an op writes to, likewise.
template <char kLetter> struct WrittenTensor : Tensor {};

/// So that autograd notices where a backward pass still needs the values of before. Inference tensors have no version.
inline void note_written(const Tensor& t) {
  if (!t.is_inference()) t.unsafeGetTensorImpl()->bump_version();
}

/// Arguments of `observe_`: a picture's gradients and radii, and the sums that they are added to (core/density.h).
struct ObserveArguments {
  WrittenTensor<'a'> gradient_sums;  ///< (P,)
  WrittenTensor<'b'> views;          ///< (P,) int32
  Tensor gradients;                  ///< (P, 3) or (P, 4), with respect to means2D
  Tensor radii;                      ///< (P,) int32
  int64_t first_column = 0;          ///< of the two columns of `gradients` that are looked at

  template <class Visit> void each(Visit&& visit) {
    visit("gradient_sums", gradient_sums);
    visit("views", views);
    visit("gradients", gradients);
    visit("radii", radii);
    visit("first_column", first_column);
  }
};

/// Arguments of `adam_`: a step on several tensors (core/adam.h). The lists have a member for each of them.
struct AdamArguments {
  WrittenTensors<'a'> params;  ///< of any strides, as all others
  std::vector<Tensor> grads;
  WrittenTensors<'b'> exp_avgs;
  WrittenTensors<'c'> exp_avg_sqs;
  std::vector<double> rates;
  std::vector<int64_t> steps;  ///< 1 for the first
  double beta1 = 0, beta2 = 0, eps = 0;
  OptionalTensor rows;  ///< (P,) bool or uint8
  bool bias_correction = true;
  /// The first numbers of every row, along the first dimension, that have a learning rate of their own, and that rate;
  /// 0: none. Empty lists: none at all.
  std::vector<int64_t> heads;
  std::vector<double> head_rates;

  template <class Visit> void each(Visit&& visit) {
    visit("params", params);
    visit("grads", grads);
    visit("exp_avgs", exp_avgs);
    visit("exp_avg_sqs", exp_avg_sqs);
    visit("rates", rates);
    visit("steps", steps);
    visit("beta1", beta1);
    visit("beta2", beta2);
    visit("eps", eps);
    visit("rows=None", rows);
    visit("bias_correction=True", bias_correction);
    visit("heads=[]", heads);
    visit("head_rates=[]", head_rates);
  }
};

/// Arguments of `pack_rows_`: what `project` takes, which Gaussians have rows, and where. What does not fit the room is
/// left out.
struct PackArguments : ProjectArguments {
  WrittenTensor<'a'> rows;   ///< (room, kPackedWidth)
  WrittenTensor<'b'> radii;  ///< (room,) int32
  WrittenTensor<'c'> ids;    ///< (room,) int32
  Tensor ends;               ///< (C, P) int32, of `count_rows`
  Tensor firsts;             ///< (C,) int64 on the device, place of each camera's first row
  int64_t first_id = 0;      ///< what ids in `rows` begin with

  template <class Visit> void each(Visit&& visit) {
    visit("rows", rows);
    visit("radii", radii);
    visit("ids", ids);
    ProjectArguments::each(visit);
    visit("ends", ends);
    visit("firsts", firsts);
    visit("first_id", first_id);
  }
};

/// Arguments of `pack_rows_vjp`.
struct PackVjpArguments : ProjectArguments, PackedPlaces {
  Tensor dL_drows;          ///< (n, kPackedGradWidth or more)
  Tensor ids;               ///< (n,) int32, of `pack_rows_`
  std::vector<bool> needs;  ///< of ProjectArguments' tensors

  template <class Visit> void each(Visit&& visit) {
    visit("dL_drows", dL_drows);
    ProjectArguments::each(visit);
    visit("ids", ids);
    PackedPlaces::each(visit);
    visit("needs", needs);
  }
};

/// Arguments of `blend_rows`: packed rows of one camera, in the order of their Gaussians, and what `bin` and `blend`
/// take besides.
struct BlendRowsArguments : ImageArguments {
  Tensor rows, background;  ///< (n, kPackedWidth), (3,)
  bool keep = false;

  template <class Visit> void each(Visit&& visit) {
    visit("rows", rows);
    visit("background", background);
    ImageArguments::each(visit);
    visit("keep=False", keep);
  }
};

/// Arguments of `blend_rows_vjp_`.
struct BlendRowsVjpArguments : ImageArguments {
  /// (n, kPackedGradWidth), or (n, kPackedGradWidthAbsolute) where sums of absolute gradients are wanted. It may lie in
  /// the memory of the splats in `saved`, which are then no more.
  WrittenTensor<'a'> dL_drows;
  OptionalTensor dL_dimage, dL_dalpha;  ///< (3, H, W), (H, W)
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

/// The name in a declaration `name` or `name=default`.
inline std::string_view name_of(std::string_view declaration) { return declaration.substr(0, declaration.find('=')); }

/// Arguments of the adjoint of an op: the gradient with respect to its differentiable outputs, its own arguments, what
/// it saved, and which of its tensor arguments want a gradient.
template <class Arguments> struct VjpArguments {
  std::vector<OptionalTensor> dL_doutputs;
  Arguments of_op;
  std::vector<Tensor> saved;
  std::vector<bool> needs;

  template <class Visit> void each(Visit&& visit) {
    visit("dL_doutputs", dL_doutputs);
    // Nothing without a default may follow something that has one.
    of_op.each([&](std::string_view declaration, auto& value) { visit(name_of(declaration), value); });
    visit("saved", saved);
    visit("needs", needs);
  }
};

}  // namespace ar::ops
