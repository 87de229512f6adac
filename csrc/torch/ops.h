// The ops, each written once for every device: the pass in rasterize.cpp, its stages in stages.cpp. Registered with
// torch in ops.cpp, made differentiable in autograd.cpp.
#pragma once

#include <vector>

#include "torch/arguments.h"

namespace ar::ops {

/// What an op returns, in the order of its schema. `saved` is for its adjoint.
struct Rasterized {
  Tensor color;                ///< (C, H, W)
  std::vector<Tensor> images;  ///< of alpha, depth, inverse_depth those that are asked for, (H, W)
  Tensor radii;
  std::vector<Tensor> saved;
};
struct Projected {
  Tensor means2d, cov2d, opacities, depths, colors;    ///< (N, ...) rows, camera after camera
  Tensor radii, gaussian_ids, camera_ids, row_splits;  ///< integers; row_splits on the CPU
  std::vector<Tensor> saved;                           ///< dets (N,)
};
struct Blended {
  Tensor image, alpha;  ///< (C, K, H, W) and (C, H, W)
  std::vector<Tensor> saved;
};

/// With `seconds` the times before, of project, bin and blend are appended to it, and without `keep` the lists are
/// saved.
Rasterized rasterize(RasterizeArguments a, std::vector<double>* seconds = nullptr);
std::vector<Tensor> rasterize_vjp(VjpArguments<RasterizeArguments> a);

Projected project(ProjectArguments a);
std::vector<Tensor> project_vjp(VjpArguments<ProjectArguments> a);

std::vector<Tensor> bin(BinArguments a);

Blended blend(BlendArguments a);
std::vector<Tensor> blend_vjp(VjpArguments<BlendArguments> a);

std::vector<Tensor> inspect(InspectArguments a);

Tensor footprint_weight(WeightArguments a);
std::vector<Tensor> footprint_weight_vjp(VjpArguments<WeightArguments> a);

}  // namespace ar::ops
