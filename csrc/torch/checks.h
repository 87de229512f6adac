// What the ops accept. Checked once, before anything is touched, for every backend alike. Messages
// say which argument, what was expected and what came: `means3D must have shape (P, 3), got (5, 2)`.
#pragma once

#include <ATen/ATen.h>
#include <torch/library.h>

#include <cmath>
#include <optional>
#include <string>
#include <vector>

namespace ar::ops {

using at::Tensor;
using OptionalTensor = std::optional<Tensor>;

/// Arguments of rasterize, as given; check() brings the tensors into the form the kernels read.
struct Inputs {
  Tensor means3D, opacities;
  OptionalTensor means2D, shs, colors_precomp, scales, rotations, cov3D_precomp;
  Tensor background, viewmatrix, projmatrix, campos;
  OptionalTensor lens;  ///< of a full camera
  int64_t image_height, image_width;
  double tanfovx, tanfovy, scale_modifier;
  int64_t sh_degree;
  std::string footprint;
  double option;

  int64_t count() const { return means3D.size(0); }

  /// Raises TypeError for a wrong dtype and ValueError for anything else. Afterwards every tensor is
  /// contiguous, and the matrices are 4x4.
  void check();

  /// dL_dcolor and dL_dalpha are gradients of images of these arguments.
  void check_gradient(const Tensor& dL_dcolor, const OptionalTensor& dL_dalpha) const;

  /// Background, matrices and camera centre are finite. On a device this waits for it.
  void check_camera() const;
};

std::string shape_of(const Tensor& t);

/// dtype float32 or float64.
void check_floating(const Tensor& t, const char* name);

/// Same dtype and device as `like`, which is called `like_name` in the message.
void check_like(const Tensor& t, const char* name, const Tensor& like, const char* like_name);

/// What `find` gave for a footprint; raises ValueError if that is nothing.
template <class Stages> const Stages& found(const Stages* stages, const std::string& footprint) {
  TORCH_CHECK_VALUE(stages != nullptr, "footprint must be one of those in csrc/core/footprint/registry.h, got '",
                    footprint, "'");
  return *stages;
}

/// Arguments of footprint_weight.
void check_weight_arguments(const Tensor& offset, const Tensor& cov2d, double option);
void check_weight_gradient(const Tensor& dL_dweight, const Tensor& offset);

/// `splats` and the other `lists` look like outputs of rasterize with keep=True.
void check_lists(const Tensor& splats, const std::vector<Tensor>& lists);

/// Arguments of rasterize_channels.
void check_channels(const Tensor& colors, const Tensor& bg, const Tensor& splats);

/// Sizes that tensors and tiles can be indexed with.
void check_image_size(int64_t height, int64_t width);

}  // namespace ar::ops
