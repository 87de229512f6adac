// The ops picture_gradients and rows_picture_gradients: loss of a training's picture, and gradients of the parameters
// or, with several ranks, of rows. They call the ops that autograd would, without its cost to the host.
#include <ATen/ops/avg_pool2d.h>
#include <ATen/ops/avg_pool2d_backward.h>
#include <ATen/ops/cat.h>
#include <ATen/ops/constant_pad_nd.h>
#include <ATen/ops/full.h>
#include <ATen/ops/zeros.h>

#include <algorithm>
#include <iterator>

#include "torch/checks.h"
#include "torch/ops.h"

namespace ar::ops {
namespace {

std::vector<Tensor> gradients_of(const Results& of_vjp) { return of_vjp[0].toTensorVector(); }

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
  scene.images[kInverseDepth] = a.depth_target.has_value();
  scene.keep = true;
  return scene;
}

/// Of the op `rasterize` for the parameters' scene.
struct SceneGrads {
  Tensor means3D, means2D, opacities, shs, scales, rotations;
};

struct Rasterized {
  RasterizeArguments scene;
  Results results;
  Tensor image, radii, inverse_depth;

  explicit Rasterized(const RasterizeArguments& a) : scene(a), results(rasterize(a)) {
    image = results[0].toTensor();
    radii = results[2].toTensor();
    if (a.images[kInverseDepth]) inverse_depth = results[1].toTensorVector()[0];
  }
  SceneGrads vjp(const Tensor& dL_dimage, const Tensor& dL_dinverse_depth) const {
    std::vector<bool> needs(kSceneTensors + 2, false);       // The last two: bg, features.
    for (const size_t k : {0, 2, 3, 5, 6}) needs[k] = true;  // means3D, opacities, shs, scales, rotations.
    needs[1] = scene.means2D.has_value();
    std::vector<OptionalTensor> dL_doutputs = {dL_dimage};
    if (inverse_depth.defined()) dL_doutputs.push_back(dL_dinverse_depth);
    const std::vector<Tensor> g =
        gradients_of(rasterize_vjp({dL_doutputs, scene, results.back().toTensorVector(), needs}));
    return {g[0], g[1], g[2], g[3], g[5], g[6]};
  }
};

/// The same of an equirectangular picture. The host waits for the number of repeated splats.
struct Sphere {
  RasterizeArguments scene;
  ProjectArguments camera;
  SeamArguments seam;
  BlendArguments rows;
  Results projected, repeated, blended;
  Tensor image, radii, inverse_depth;

  Sphere(const RasterizeArguments& a, double turn) : scene(a) {
    static_cast<SceneTensors<OptionalTensor>&>(camera) = a;
    camera.means2D = std::nullopt;
    static_cast<FootprintArguments&>(camera) = a;
    camera.image_height = seam.image_height = rows.image_height = a.image_height;
    camera.image_width = seam.image_width = rows.image_width = a.image_width;
    camera.tanfovx = {a.tanfovx};
    camera.tanfovy = {a.tanfovy};
    camera.scale_modifier = a.scale_modifier;
    camera.sh_degree = a.sh_degree;
    camera.keep = seam.keep = rows.keep = true;
    projected = project(camera);
    const Tensor means2d = projected[0].toTensor(), ids = projected[6].toTensor();
    radii = at::zeros({a.means3D.size(0)}, ids.options()).index_copy_(0, ids.to(at::kLong), projected[5].toTensor());

    static_cast<FootprintArguments&>(seam) = a;
    Tensor* const given[] = {&seam.means2d, &seam.cov2d,        &seam.opacities,  &seam.depths,     &seam.colors,
                             &seam.radii,   &seam.gaussian_ids, &seam.camera_ids, &seam.row_splits, &seam.dets};
    for (size_t k = 0; k < std::size(given); ++k) *given[k] = projected[k].toTensor();
    seam.turns = at::full({1}, turn, means2d.options());
    const bool deep = a.images[kInverseDepth];
    if (deep) seam.beside = seam.depths.reciprocal().unsqueeze(1);
    repeated = repeat_at_seam(seam);

    static_cast<FootprintArguments&>(rows) = a;
    rows.means2d = repeated[0].toTensor();
    rows.cov2d = repeated[1].toTensor();
    rows.opacities = repeated[2].toTensor();
    rows.features = deep ? at::cat({repeated[4].toTensor(), repeated[5].toTensor()}, 1) : repeated[4].toTensor();
    rows.background = (deep ? at::constant_pad_nd(a.bg, {0, 1}) : a.bg).unsqueeze(0);
    rows.dets = repeated[9].toTensor();
    rows.row_splits = repeated[10].toTensor();
    if (columns() == 4) rows.means2d_abs = at::empty(rows.means2d.sizes(), means2d.options());
    BinArguments listed;
    static_cast<ImageArguments&>(listed) = rows;
    listed.means2d = rows.means2d;
    listed.cov2d = rows.cov2d;
    listed.dets = rows.dets;
    listed.opacities = rows.opacities;
    listed.depths = repeated[3].toTensor();
    listed.row_splits = rows.row_splits;
    rows.lists = bin(listed)[0].toTensorVector();
    blended = blend(rows);
    image = blended[0].toTensor()[0];
    if (!deep) return;
    inverse_depth = image[3];
    image = image.narrow(0, 0, 3);
  }
  int64_t columns() const { return scene.means2D ? scene.means2D->size(1) : 0; }

  SceneGrads vjp(const Tensor& dL_dimage, const Tensor& dL_dinverse_depth) const {
    const bool absolute = columns() == 4, deep = inverse_depth.defined();
    const Tensor dL_dchannels = deep ? at::cat({dL_dimage, dL_dinverse_depth.unsqueeze(0)}) : dL_dimage;
    const std::vector<Tensor> of_rows =
        gradients_of(blend_vjp({{dL_dchannels.unsqueeze(0)},
                                rows,
                                blended.back().toTensorVector(),
                                {true, true, true, true, false, absolute, false, false}}));
    const std::vector<Tensor> saved = repeated.back().toTensorVector();
    std::vector<bool> needs(SeamArguments::kTensors, false);
    for (const size_t k : {0, 1, 2, 4}) needs[k] = true;  // means2d, cov2d, opacities, colors.
    needs[6] = deep;                                      // beside.
    std::vector<OptionalTensor> dL_drepeated = {of_rows[0], of_rows[1], of_rows[2], std::nullopt, of_rows[3]};
    if (deep) {
      dL_drepeated[4] = of_rows[3].narrow(1, 0, 3).contiguous();
      dL_drepeated.push_back(of_rows[3].narrow(1, 3, 1).contiguous());
    }
    const std::vector<Tensor> of_splats = gradients_of(repeat_at_seam_vjp({dL_drepeated, seam, saved, needs}));
    OptionalTensor dL_ddepths;
    if (deep) dL_ddepths = of_splats[6].mul(seam.beside->square()).neg().squeeze(1);
    needs.assign(kSceneTensors, false);                      // Of these all but means2D, and values.
    for (const size_t k : {0, 1, 2, 4, 5}) needs[k] = true;  // means3D, opacities, shs, scales, rotations.
    const std::vector<Tensor> g =
        gradients_of(project_vjp({{of_splats[0], of_splats[1], of_splats[2], dL_ddepths, of_splats[4]},
                                  camera,
                                  projected.back().toTensorVector(),
                                  needs}));
    SceneGrads grads = {g[0], {}, g[1].view_as(scene.opacities), g[2], g[4], g[5]};
    if (columns() == 0) return grads;
    // By normalized device coordinates.
    std::vector<Tensor> parts = {of_splats[0]};
    if (absolute) parts.push_back(summed_copies(of_rows[5], saved[0]));
    grads.means2D = at::zeros(scene.means2D->sizes(), image.options());
    const Tensor ids = seam.gaussian_ids.to(at::kLong);
    for (size_t k = 0; k < parts.size(); ++k) {
      grads.means2D.select(1, 2 * k).index_copy_(0, ids, parts[k].select(1, 0).mul(scene.image_width / 2.0));
      grads.means2D.select(1, 2 * k + 1).index_copy_(0, ids, parts[k].select(1, 1).mul(scene.image_height / 2.0));
    }
    return grads;
  }
};

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

/// With a mask as `counted` in losses.py.
L1SsimArguments comparison_of(const LossArguments& a, const Tensor& image) {
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

struct Loss {
  Tensor value, shown;  ///< (), and the image as compared with the target, but for the mask.
  Tensor dL_drendered, dL_dexposure, dL_dvignetting;

  Loss(const LossArguments& a, const Tensor& rendered) {
    const Tensor image = averaged(rendered, a.supersampling);
    const bool corrects = a.exposure || a.vignetting;
    const CorrectArguments correction = {image, a.exposure, a.vignetting, a.center};
    shown = corrects ? correct_colors(correction)[0].toTensor() : image;
    const L1SsimArguments comparison = comparison_of(a, shown);
    const Results compared = l1_ssim(comparison);
    value = compared[0].toTensor();
    Tensor dL_dimage =
        gradients_of(l1_ssim_vjp({{a.dL_dloss}, comparison, compared[1].toTensorVector(), {true, false}}))[0];
    if (a.mask) dL_dimage = dL_dimage.mul(*a.mask);
    if (corrects) {
      const std::vector<Tensor> of_correction =
          gradients_of(correct_colors_vjp({{dL_dimage}, correction, {}, {true, true, true}}));
      dL_dimage = of_correction[0];
      dL_dexposure = of_correction[1];
      dL_dvignetting = of_correction[2];
    }
    dL_drendered = averaged_vjp(dL_dimage, rendered, a.supersampling);
  }
};

/// The loss of depths, Huber's, and its gradient. Undefined: none.
struct DepthLoss {
  Tensor value, dL_drendered;

  DepthLoss(const PictureArguments& a, const Tensor& rendered) {
    if (!a.depth_target) return;
    const Tensor planes = rendered.unsqueeze(0), difference = averaged(planes, a.supersampling)[0].sub(*a.depth_target);
    const Tensor slope = difference.div(a.depth_margin).clamp(-1, 1), weights = a.depth_shares->mul(a.depth_weight);
    // In rows first, as in background_grad.
    value = difference.sub(slope.mul(a.depth_margin / 2)).mul(slope).mul(weights).sum(1).sum();
    const Tensor dL_daveraged = slope.mul(weights).mul(a.dL_dloss);
    dL_drendered = averaged_vjp(dL_daveraged.unsqueeze(0), planes, a.supersampling)[0];
  }
};

template <class Rendering> Results gradients_through(const PictureArguments& a, const Rendering& render) {
  const ActivateArguments parameters = parameters_of(a);
  const Results activated = activate(parameters);
  RasterizeArguments scene = scene_of(a, activated);
  const FilterArguments unfiltered = {*scene.scales, scene.opacities, a.filter_3d.value_or(Tensor())};
  if (a.filter_3d) {
    const Results filtered = apply_3d_filter(unfiltered);
    scene.scales = filtered[0].toTensor();
    scene.opacities = filtered[1].toTensor();
  }
  const auto rendering = render(scene);
  Loss loss(a, rendering.image);
  const DepthLoss depth(a, rendering.inverse_depth);
  if (parameters.has_penalty()) loss.value = loss.value.add(activated[3].toTensor());
  if (depth.value.defined()) loss.value = loss.value.add(depth.value);
  SceneGrads grads = rendering.vjp(loss.dL_drendered, depth.dL_drendered);
  if (a.filter_3d) {
    const std::vector<Tensor> of_filter =
        gradients_of(apply_3d_filter_vjp({{grads.scales, grads.opacities}, unfiltered, {}, {true, true, false}}));
    grads.scales = of_filter[0];
    grads.opacities = of_filter[1];
  }
  const std::vector<Tensor> of_parameters = gradients_of(
      activate_vjp({{grads.scales, grads.rotations, grads.opacities, a.dL_dloss}, parameters, {}, {true, true, true}}));
  std::vector<Tensor> gradients = {grads.means3D, of_parameters[0], of_parameters[1], of_parameters[2], grads.shs};
  if (a.mean_columns > 0) gradients.push_back(grads.means2D);
  if (a.exposure) gradients.push_back(loss.dL_dexposure);
  if (a.vignetting) gradients.push_back(loss.dL_dvignetting);
  return {loss.value, loss.shown, rendering.radii, gradients};
}

}  // namespace

Results picture_gradients(PictureArguments a) {
  check(a);
  if (a.turn > 0) return gradients_through(a, [&](const RasterizeArguments& scene) { return Sphere(scene, a.turn); });
  return gradients_through(a, [](const RasterizeArguments& scene) { return Rasterized(scene); });
}

Results rows_picture_gradients(RowsPictureArguments a) {
  check(a);
  BlendRowsArguments blended;
  static_cast<ImageArguments&>(blended) = a;
  blended.rows = a.rows;
  blended.background = a.bg;
  blended.keep = true;
  const Results rendered = blend_rows(blended);
  const Loss loss(a, rendered[0].toTensor());
  BlendRowsVjpArguments back;
  static_cast<ImageArguments&>(back) = a;
  back.dL_dimage = loss.dL_drendered;
  back.background = a.bg;
  back.saved = rendered[2].toTensorVector();
  const int64_t width = a.absolute ? kPackedGradWidthAbsolute : kPackedGradWidth, n = a.rows.size(0);
  // In the place of splats, which are as wide at least.
  static_cast<Tensor&>(back.dL_drows) = back.saved[0].view({-1}).narrow(0, 0, n * width).view({n, width});
  blend_rows_vjp(back);
  return {loss.value, loss.shown, back.dL_drows};
}

}  // namespace ar::ops
