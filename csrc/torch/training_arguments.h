// The arguments of training.cpp's and picture.cpp's ops, a struct per op as in arguments.h.
#pragma once

#include "torch/arguments.h"

namespace ar::ops {

struct SsimArguments {
  Tensor image;   ///< (..., H, W).
  Tensor target;  ///< The same, or uint8. Has no gradient.
  bool keep = false;

  template <class Visit> void each(Visit&& visit) {
    visit("image", image);
    visit("target", target);
    visit("keep=False", keep);
  }
};

/// l1_weight * (mean |image - target|) + ssim_weight * (mean similarity) + constant.
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

struct ActivateArguments {
  Tensor log_scales, quats, logit_opacities;
  double opacity_weight = 0, scale_weight = 0;  ///< Of the penalty.
  bool has_penalty() const { return opacity_weight != 0 || scale_weight != 0; }

  template <class Visit> void each(Visit&& visit) {
    visit("log_scales", log_scales);
    visit("quats", quats);
    visit("logit_opacities", logit_opacities);
    visit("opacity_weight=0.0", opacity_weight);
    visit("scale_weight=0.0", scale_weight);
  }
};

/// See core/activations.h.
struct FilterArguments {
  Tensor scales;
  Tensor opacities;  ///< (P,) or (P, 1).
  Tensor filter_3d;  ///< (P,).

  template <class Visit> void each(Visit&& visit) {
    visit("scales", scales);
    visit("opacities", opacities);
    visit("filter_3d", filter_3d);
  }
};

/// See core/color_correction.h.
struct CorrectArguments {
  Tensor image;                ///< (3, H, W).
  OptionalTensor matrix;       ///< (3, 4).
  OptionalTensor vignetting;   ///< (2,).
  std::vector<double> center;  ///< With it: x and y of the principal point, px.

  template <class Visit> void each(Visit&& visit) {
    visit("image", image);
    visit("matrix", matrix);
    visit("vignetting=None", vignetting);
    visit("center=[]", center);
  }
};

/// How a rendering becomes a loss.
struct LossArguments {
  Tensor target, dL_dloss;     ///< As of `l1_ssim`.
  OptionalTensor exposure;     ///< (3, 4): see core/color_correction.h.
  OptionalTensor vignetting;   ///< (2,): as well.
  std::vector<double> center;  ///< With it: x and y of the target's principal point, px.
  OptionalTensor mask;         ///< (H, W) of the share of each pixel that counts: a factor of both images.
  double ssim_weight = 0;
  int64_t supersampling = 1;  ///< The target has so many times fewer rows and columns, of means over the rendering.

  template <class Visit> void each(Visit&& visit) {
    visit("target", target);
    visit("dL_dloss", dL_dloss);
    visit("exposure", exposure);
    visit("vignetting", vignetting);
    visit("center", center);
    visit("mask", mask);
    visit("ssim_weight", ssim_weight);
    visit("supersampling", supersampling);
  }
};

struct PictureArguments : LossArguments, CameraNumbers<double>, FootprintArguments {
  Tensor means, log_scales, quats, logit_opacities, shs;
  int64_t mean_columns = 0;  ///< Of the gradient of means2D: 3, 4, or 0 for none.
  Tensor bg, viewmatrix, projmatrix, campos;
  OptionalTensor lens;
  OptionalTensor filter_3d;                     ///< (N,), that of `apply_3d_filter`.
  double opacity_weight = 0, scale_weight = 0;  ///< Of the mean opacity and scale, before the filter, in the loss.
  double turn = 0;                              ///< px of a turn in an equirectangular picture. Others have no seam: 0.
  // Added to the loss: depth_weight * sum(depth_shares * h), where h is the absolute difference of inverse depths less
  // half of depth_margin, and continued by a parabola within depth_margin.
  OptionalTensor depth_target;  ///< (H, W) of the target, 1 / world units.
  OptionalTensor depth_shares;  ///< (H, W), with it: how much each pixel counts.
  double depth_weight = 0, depth_margin = 1;

  template <class Visit> void each(Visit&& visit) {
    visit("means", means);
    visit("log_scales", log_scales);
    visit("quats", quats);
    visit("logit_opacities", logit_opacities);
    visit("shs", shs);
    visit("mean_columns", mean_columns);
    LossArguments::each(visit);
    visit("bg", bg);
    visit("viewmatrix", viewmatrix);
    visit("projmatrix", projmatrix);
    visit("campos", campos);
    visit("lens", lens);
    each_number(visit);
    FootprintArguments::each(visit);
    visit("filter_3d=None", filter_3d);
    visit("opacity_weight=0.0", opacity_weight);
    visit("scale_weight=0.0", scale_weight);
    visit("turn=0.0", turn);
    visit("depth_target=None", depth_target);
    visit("depth_shares=None", depth_shares);
    visit("depth_weight=0.0", depth_weight);
    visit("depth_margin=1.0", depth_margin);
  }
};

/// Of the rows of all ranks, those of one camera.
struct RowsPictureArguments : LossArguments, ImageArguments {
  Tensor rows, bg;        ///< As of BlendRowsArguments.
  bool absolute = false;  ///< Gradients of rows have sums of absolute values.

  template <class Visit> void each(Visit&& visit) {
    visit("rows", rows);
    LossArguments::each(visit);
    visit("bg", bg);
    ImageArguments::each(visit);
    visit("absolute=False", absolute);
  }
};

/// See core/density.h.
struct ObserveArguments {
  WrittenTensor<'a'> gradient_sums;
  WrittenTensor<'b'> views;
  Tensor gradients;  ///< (P, 3) or (P, 4), of means2D.
  Tensor radii;
  int64_t first_column = 0;  ///< Two columns of `gradients` are read.

  template <class Visit> void each(Visit&& visit) {
    visit("gradient_sums", gradient_sums);
    visit("views", views);
    visit("gradients", gradients);
    visit("radii", radii);
    visit("first_column", first_column);
  }
};

/// See core/density.h.
struct NoiseArguments {
  WrittenTensor<'a'> means;  ///< Any strides.
  Tensor log_scales, quats, logit_opacities;
  Tensor normals;  ///< (N, 3).
  double strength = 0;

  template <class Visit> void each(Visit&& visit) {
    visit("means", means);
    visit("log_scales", log_scales);
    visit("quats", quats);
    visit("logit_opacities", logit_opacities);
    visit("normals", normals);
    visit("strength", strength);
  }
};

/// A step on several tensors (core/adam.h).
struct AdamArguments {
  WrittenTensors<'a'> params;  ///< Any strides, as all others.
  std::vector<Tensor> grads;
  WrittenTensors<'b'> exp_avgs;
  WrittenTensors<'c'> exp_avg_sqs;
  std::vector<double> rates;
  std::vector<int64_t> steps;  ///< 1 for the first.
  double beta1 = 0, beta2 = 0, eps = 0;
  OptionalTensor rows;  ///< (P,) bool or uint8.
  bool bias_correction = true;
  /// The first heads[i] numbers of a row have the rate head_rates[i].
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

}  // namespace ar::ops
