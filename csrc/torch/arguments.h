// The arguments of the ops, each named and typed once: `each` of a struct lists them for the schema, for reading them off
// the dispatcher's stack, for passing them on, and for the names in snapshots.
#pragma once

#include <ATen/ATen.h>
#include <ATen/core/ivalue.h>
#include <ATen/core/stack.h>

#include <cstddef>
#include <optional>
#include <string>
#include <vector>

namespace ar::ops {

using at::Tensor;
using OptionalTensor = std::optional<Tensor>;
using c10::IValue;

/// A scene and a camera as 3DGS names them. check() (checks.h) brings the tensors into the form the kernels read.
struct Inputs {
  Tensor means3D;
  OptionalTensor means2D;
  Tensor opacities;
  OptionalTensor shs, colors_precomp, scales, rotations, cov3D_precomp;
  Tensor viewmatrix, projmatrix, campos;
  OptionalTensor lens;  ///< of a full camera
  int64_t image_height = 0, image_width = 0;
  double tanfovx = 0, tanfovy = 0, scale_modifier = 1;
  int64_t sh_degree = 0;

  int64_t count() const { return means3D.size(0); }

  /// The tensors in the order of GaussianGrads, then the camera's: those that may have a gradient.
  static constexpr size_t kTensors = 12, kGaussianTensors = 8;

  template <class Visit> void each(Visit&& visit) {
    visit("Tensor means3D", means3D);
    visit("Tensor? means2D", means2D);
    visit("Tensor opacities", opacities);
    visit("Tensor? shs", shs);
    visit("Tensor? colors_precomp", colors_precomp);
    visit("Tensor? scales", scales);
    visit("Tensor? rotations", rotations);
    visit("Tensor? cov3D_precomp", cov3D_precomp);
    visit("Tensor viewmatrix", viewmatrix);
    visit("Tensor projmatrix", projmatrix);
    visit("Tensor campos", campos);
    visit("Tensor? lens", lens);
    visit("int image_height", image_height);
    visit("int image_width", image_width);
    visit("float tanfovx", tanfovx);
    visit("float tanfovy", tanfovy);
    visit("float scale_modifier", scale_modifier);
    visit("int sh_degree", sh_degree);
  }
};

/// Gradients with respect to the tensors of Inputs, in their order; undefined where nobody wants one.
struct Grads {
  Tensor means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp;
  Tensor viewmatrix, projmatrix, campos, lens;

  template <class Visit> void each(Visit&& visit) {
    for (Tensor* t : {&means3D, &means2D, &opacities, &shs, &colors_precomp, &scales, &rotations, &cov3D_precomp,
                      &viewmatrix, &projmatrix, &campos, &lens})
      visit(*t);
  }
};

}  // namespace ar::ops
