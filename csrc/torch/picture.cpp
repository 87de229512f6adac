// The op picture_gradients: activations, 3D filter, rendering and loss of a training's picture, and the gradients of
// the parameters. It calls the ops that autograd would call, in the same order, and saves the host the cost of
// autograd.
#include <ATen/ops/avg_pool2d.h>
#include <ATen/ops/avg_pool2d_backward.h>

#include <algorithm>

#include "torch/checks.h"
#include "torch/ops.h"

namespace ar::ops {
namespace {

RasterizeArguments scene_of(const PictureArguments& a, const Results& activated) {
  RasterizeArguments scene;
  scene.means3D = a.means;
  if (a.mean_columns > 0) scene.means2D = at::empty({a.means.size(0), a.mean_columns}, a.means.options());
  scene.scales = activated[0].toTensor();
  scene.rotations = activated[1].toTensor();
  scene.opacities = activated[2].toTensor();
  scene.shs = a.shs;
  scene.viewmatrix = a.viewmatrix;
  scene.projmatrix = a.projmatrix;
  scene.campos = a.campos;
  scene.lens = a.lens;
  static_cast<CameraNumbers<double>&>(scene) = a;
  static_cast<FootprintArguments&>(scene) = a;
  scene.bg = a.bg;
  scene.keep = true;
  return scene;
}

/// With a mask as `counted` in losses.py.
L1SsimArguments comparison_of(const PictureArguments& a, const Tensor& image) {
  L1SsimArguments comparison;
  comparison.image = image;
  comparison.target = a.target;
  if (a.mask) {
    const bool levels = a.target.scalar_type() == at::kByte;
    comparison.image = comparison.image.mul(*a.mask);
    comparison.target = (levels ? a.target.to(image.scalar_type()).div(255) : a.target).mul(*a.mask);
  }
  comparison.keep = true;
  comparison.l1_weight = 1 - a.ssim_weight;
  comparison.ssim_weight = -a.ssim_weight;
  comparison.constant = a.ssim_weight;
  return comparison;
}

/// Activations, with the regularizers as their penalty.
ActivateArguments parameters_of(const PictureArguments& a) {
  const double count = double(std::max<int64_t>(a.means.size(0), 1));
  return {a.log_scales, a.quats, a.logit_opacities, a.opacity_weight / count, a.scale_weight / (3 * count)};
}

Tensor averaged(const Tensor& image, int64_t times) {
  return times > 1 ? at::avg_pool2d(image, {times, times}, {times, times}) : image;
}

Tensor averaged_vjp(const Tensor& dL_daveraged, const Tensor& image, int64_t times) {
  if (times == 1) return dL_daveraged;
  return at::avg_pool2d_backward(dL_daveraged, image, {times, times}, {times, times}, {0, 0}, /*ceil_mode=*/false,
                                 /*count_include_pad=*/true, /*divisor_override=*/std::nullopt);
}

std::vector<Tensor> gradients_of(const Results& of_vjp) { return of_vjp[0].toTensorVector(); }

}  // namespace

Results picture_gradients(PictureArguments a) {
  check(a);
  const ActivateArguments parameters = parameters_of(a);
  const Results activated = activate(parameters);
  RasterizeArguments scene = scene_of(a, activated);
  const FilterArguments unfiltered = {*scene.scales, scene.opacities, a.filter_3d.value_or(Tensor())};
  if (a.filter_3d) {
    const Results filtered = apply_3d_filter(unfiltered);
    scene.scales = filtered[0].toTensor();
    scene.opacities = filtered[1].toTensor();
  }
  const Results rendered = rasterize(scene);
  const Tensor large = rendered[0].toTensor(), image = averaged(large, a.supersampling);
  const Tensor shown = a.exposure ? correct_colors({image, *a.exposure})[0].toTensor() : image;
  const L1SsimArguments comparison = comparison_of(a, shown);
  const Results compared = l1_ssim(comparison);
  Tensor loss = compared[0].toTensor();
  if (parameters.has_penalty()) loss = loss.add(activated[3].toTensor());

  Tensor dL_dimage =
      gradients_of(l1_ssim_vjp({{a.dL_dloss}, comparison, compared[1].toTensorVector(), {true, false}}))[0];
  if (a.mask) dL_dimage = dL_dimage.mul(*a.mask);
  Tensor dL_dexposure;
  if (a.exposure) {
    const std::vector<Tensor> of_correction =
        gradients_of(correct_colors_vjp({{dL_dimage}, {image, *a.exposure}, {}, {true, true}}));
    dL_dimage = of_correction[0];
    dL_dexposure = of_correction[1];
  }
  dL_dimage = averaged_vjp(dL_dimage, large, a.supersampling);
  std::vector<bool> needs(kSceneTensors + 2, false);       // The last two: bg, features.
  for (const size_t k : {0, 2, 3, 5, 6}) needs[k] = true;  // means3D, opacities, shs, scales, rotations.
  needs[1] = a.mean_columns > 0;
  const std::vector<Tensor> of_scene =
      gradients_of(rasterize_vjp({{dL_dimage}, scene, rendered.back().toTensorVector(), needs}));
  Tensor dL_dscales = of_scene[5], dL_dopacities = of_scene[2];
  if (a.filter_3d) {
    const std::vector<Tensor> of_filter =
        gradients_of(apply_3d_filter_vjp({{dL_dscales, dL_dopacities}, unfiltered, {}, {true, true, false}}));
    dL_dscales = of_filter[0];
    dL_dopacities = of_filter[1];
  }
  const std::vector<Tensor> of_parameters = gradients_of(
      activate_vjp({{dL_dscales, of_scene[6], dL_dopacities, a.dL_dloss}, parameters, {}, {true, true, true}}));
  std::vector<Tensor> gradients = {of_scene[0], of_parameters[0], of_parameters[1], of_parameters[2], of_scene[3]};
  if (needs[1]) gradients.push_back(of_scene[1]);
  if (a.exposure) gradients.push_back(dL_dexposure);
  return {loss, shown, rendered[2], gradients};
}

}  // namespace ar::ops
