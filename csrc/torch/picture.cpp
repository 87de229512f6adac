// The op picture_gradients: activations, rendering and loss of a training's picture, and the gradients of the
// parameters. It calls the ops that autograd would call, in the same order and with the same bits, and saves the host
// the cost of autograd.
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

}  // namespace

Results picture_gradients(PictureArguments a) {
  check(a);
  const ActivateArguments parameters = {a.log_scales, a.quats, a.logit_opacities};
  const RasterizeArguments scene = scene_of(a, activate(parameters));
  const Results rendered = rasterize(scene);
  L1SsimArguments comparison;
  const Tensor image = rendered[0].toTensor();
  const Tensor shown = a.exposure ? correct_colors({image, *a.exposure})[0].toTensor() : image;
  comparison.image = shown;
  comparison.target = a.target;
  if (a.mask) {  // as `counted` in losses.py
    const bool levels = a.target.scalar_type() == at::kByte;
    comparison.image = comparison.image.mul(*a.mask);
    comparison.target = (levels ? a.target.to(image.scalar_type()).div(255) : a.target).mul(*a.mask);
  }
  comparison.keep = true;
  comparison.l1_weight = 1 - a.ssim_weight;
  comparison.ssim_weight = -a.ssim_weight;
  comparison.constant = a.ssim_weight;
  const Results compared = l1_ssim(comparison);

  Tensor dL_dimage =
      l1_ssim_vjp({{a.dL_dloss}, comparison, compared[1].toTensorVector(), {true, false}})[0].toTensorVector()[0];
  if (a.mask) dL_dimage = dL_dimage.mul(*a.mask);
  Tensor dL_dexposure;
  if (a.exposure) {
    const std::vector<Tensor> of_correction =
        correct_colors_vjp({{dL_dimage}, {image, *a.exposure}, {}, {true, true}})[0].toTensorVector();
    dL_dimage = of_correction[0];
    dL_dexposure = of_correction[1];
  }
  std::vector<bool> needs(kSceneTensors + 2, false);       // The last two: bg, features.
  for (const size_t k : {0, 2, 3, 5, 6}) needs[k] = true;  // means3D, opacities, shs, scales, rotations.
  needs[1] = a.mean_columns > 0;
  const std::vector<Tensor> of_scene =
      rasterize_vjp({{dL_dimage}, scene, rendered.back().toTensorVector(), needs})[0].toTensorVector();
  const std::vector<Tensor> of_parameters =
      activate_vjp({{of_scene[5], of_scene[6], of_scene[2]}, parameters, {}, {true, true, true}})[0].toTensorVector();
  std::vector<Tensor> gradients = {of_scene[0], of_parameters[0], of_parameters[1], of_parameters[2], of_scene[3]};
  if (needs[1]) gradients.push_back(of_scene[1]);
  if (a.exposure) gradients.push_back(dL_dexposure);
  return {compared[0], shown, rendered[2], gradients};
}

}  // namespace ar::ops
