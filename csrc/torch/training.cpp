// Ops of a training step: loss, activations, 3D filter, colour correction, density control (observe_, add_noise_) and
// optimiser, with adjoints.
#include "torch/training.h"

#include "torch/checks.h"
#include "torch/ops.h"

namespace ar::ops {
namespace {

SsimTensors make_ssim(SsimArguments& a, bool keep) {
  check(a);
  SsimTensors t;
  t.image = a.image;
  t.target = a.target;
  if (keep) {
    std::vector<int64_t> sizes = {kSsimPartials};
    sizes.insert(sizes.end(), a.image.sizes().begin(), a.image.sizes().end());
    t.partials = at::empty(sizes, a.image.options());
  }
  return t;
}

std::vector<Tensor> saved_of(const SsimTensors& t) {
  return t.partials.defined() ? std::vector<Tensor>{t.partials} : std::vector<Tensor>{};
}

SsimTensors make_ssim_vjp(SsimArguments& a, const std::vector<Tensor>& saved, const std::vector<bool>& needs) {
  SsimTensors t = make_ssim(a, false);
  check_needs(needs, 2);
  TORCH_CHECK_VALUE(!needs[1], "target has no gradient, but one is wanted");
  const bool fits = saved.size() == 1 && saved[0].numel() == kSsimPartials * a.image.numel() &&
                    saved[0].scalar_type() == a.image.scalar_type() && saved[0].device() == a.image.device();
  TORCH_CHECK_VALUE(fits, "saved must be what the op saved for the same images");
  t.partials = saved[0].contiguous();
  t.dL_dimage = at::empty(a.image.sizes(), a.image.options());
  return t;
}

/// For a gradient of `like`; empty if not wanted.
Tensor room_for(bool wanted, const Tensor& like) {
  return at::empty(wanted ? like.sizes() : at::IntArrayRef({0}), like.options());
}

CorrectTensors correction_of(const CorrectArguments& a) {
  return {a.image, a.matrix.value_or(Tensor()), a.vignetting.value_or(Tensor()), a.center};
}

Results run_ssim_vjp(const SsimTensors& t) {
  training_kernels(t.image).ssim_vjp(t);
  return {std::vector<Tensor>{t.dL_dimage, at::empty({0}, t.image.options())}};
}

}  // namespace

Results ssim_map(SsimArguments a) {
  SsimTensors t = make_ssim(a, a.keep);
  t.map = at::empty(a.image.sizes(), a.image.options());
  training_kernels(t.image).ssim(t);
  return {t.map, saved_of(t)};
}

Results ssim_map_vjp(VjpArguments<SsimArguments> arguments) {
  SsimTensors t = make_ssim_vjp(arguments.of_op, arguments.saved, arguments.needs);
  t.dL_dmap = only_gradient_of(arguments.dL_doutputs, "map", t.image, t.image.sizes());
  return run_ssim_vjp(t);
}

Results l1_ssim(L1SsimArguments a) {
  SsimTensors t = make_ssim(a, a.keep);
  t.weights = {a.l1_weight, a.ssim_weight, a.constant};
  t.loss = at::empty({}, a.image.options());
  training_kernels(t.image).ssim(t);
  return {t.loss, saved_of(t)};
}

Results l1_ssim_vjp(VjpArguments<L1SsimArguments> arguments) {
  const L1SsimArguments& a = arguments.of_op;
  SsimTensors t = make_ssim_vjp(arguments.of_op, arguments.saved, arguments.needs);
  t.weights = {a.l1_weight, a.ssim_weight, a.constant};
  t.dL_dloss = only_gradient_of(arguments.dL_doutputs, "loss", t.image, {});
  return run_ssim_vjp(t);
}

Results activate(ActivateArguments a) {
  check(a);
  ActivateTensors t = {a.log_scales, a.quats, a.logit_opacities, {a.opacity_weight, a.scale_weight}};
  t.scales = at::empty(a.log_scales.sizes(), a.log_scales.options());
  t.rotations = at::empty(a.quats.sizes(), a.quats.options());
  t.opacities = at::empty(a.logit_opacities.sizes(), a.logit_opacities.options());
  t.penalty = a.has_penalty() ? at::empty({}, a.log_scales.options()) : at::empty({0}, a.log_scales.options());
  training_kernels(a.log_scales).activate(t);
  return {t.scales, t.rotations, t.opacities, t.penalty};
}

Results activate_vjp(VjpArguments<ActivateArguments> arguments) {
  ActivateArguments& a = arguments.of_op;
  check(a);
  check_needs(arguments.needs, 3);
  const auto gradient = [&](size_t output, const char* name, const Tensor& of) {
    return gradient_of(arguments.dL_doutputs, output, name, a.log_scales, of.sizes());
  };
  ActivateTensors t = {a.log_scales, a.quats, a.logit_opacities, {a.opacity_weight, a.scale_weight}};
  t.dL_dscales = gradient(0, "dL_dscales", a.log_scales);
  t.dL_drotations = gradient(1, "dL_drotations", a.quats);
  t.dL_dopacities = gradient(2, "dL_dopacities", a.logit_opacities);
  if (a.has_penalty()) t.dL_dpenalty = gradient_of(arguments.dL_doutputs, 3, "dL_dpenalty", a.log_scales, {});
  t.dL_dlog_scales = room_for(arguments.needs[0], a.log_scales);
  t.dL_dquats = room_for(arguments.needs[1], a.quats);
  t.dL_dlogit_opacities = room_for(arguments.needs[2], a.logit_opacities);
  training_kernels(a.log_scales).activate_vjp(t);
  return {std::vector<Tensor>{t.dL_dlog_scales, t.dL_dquats, t.dL_dlogit_opacities}};
}

Results apply_3d_filter(FilterArguments a) {
  check(a);
  FilterTensors t = {a.scales, a.opacities, a.filter_3d};
  t.filtered_scales = at::empty(a.scales.sizes(), a.scales.options());
  t.filtered_opacities = at::empty(a.opacities.sizes(), a.opacities.options());
  training_kernels(a.scales).apply_filter(t);
  return {t.filtered_scales, t.filtered_opacities};
}

Results apply_3d_filter_vjp(VjpArguments<FilterArguments> arguments) {
  FilterArguments& a = arguments.of_op;
  check(a);
  check_needs(arguments.needs, 3);
  const auto gradient = [&](size_t output, const char* name, const Tensor& of) {
    return gradient_of(arguments.dL_doutputs, output, name, a.scales, of.sizes());
  };
  FilterTensors t = {a.scales, a.opacities, a.filter_3d};
  t.dL_dfiltered_scales = gradient(0, "dL_dfiltered_scales", a.scales);
  t.dL_dfiltered_opacities = gradient(1, "dL_dfiltered_opacities", a.opacities);
  t.dL_dscales = room_for(arguments.needs[0], a.scales);
  t.dL_dopacities = room_for(arguments.needs[1], a.opacities);
  t.dL_dfilter_3d = room_for(arguments.needs[2], a.filter_3d);
  training_kernels(a.scales).apply_filter_vjp(t);
  return {std::vector<Tensor>{t.dL_dscales, t.dL_dopacities, t.dL_dfilter_3d}};
}

Results correct_colors(CorrectArguments a) {
  check(a);
  CorrectTensors t = correction_of(a);
  t.corrected = at::empty(a.image.sizes(), a.image.options());
  training_kernels(a.image).correct_colors(t);
  return {t.corrected};
}

Results correct_colors_vjp(VjpArguments<CorrectArguments> arguments) {
  CorrectArguments& a = arguments.of_op;
  check(a);
  check_needs(arguments.needs, 3);
  CorrectTensors t = correction_of(a);
  t.dL_dcorrected = only_gradient_of(arguments.dL_doutputs, "corrected", a.image, a.image.sizes());
  t.dL_dimage = room_for(arguments.needs[0], a.image);
  t.dL_dmatrix = room_for(arguments.needs[1] && a.matrix, a.matrix.value_or(a.image));
  t.dL_dvignetting = room_for(arguments.needs[2] && a.vignetting, a.vignetting.value_or(a.image));
  training_kernels(a.image).correct_colors_vjp(t);
  return {std::vector<Tensor>{t.dL_dimage, t.dL_dmatrix, t.dL_dvignetting}};
}

Results observe(ObserveArguments a) {
  check(a);
  training_kernels(a.gradient_sums).observe(a);
  note_written(a.gradient_sums);
  note_written(a.views);
  return {};
}

Results add_noise(NoiseArguments a) {
  check(a);
  const Tensor means = a.means;
  note_written(means);
  static_cast<Tensor&>(a.means) = means.contiguous();
  training_kernels(means).add_noise(a);
  if (!means.is_contiguous()) means.copy_(a.means);
  return {};
}

Results adam(AdamArguments a) {
  check(a);
  if (a.params.empty()) return {};
  const std::initializer_list<std::vector<Tensor>*> written = {&a.params, &a.exp_avgs, &a.exp_avg_sqs};
  // Kernels take contiguous tensors: others are copied, and back.
  std::vector<std::pair<Tensor, Tensor>> copied;
  for (std::vector<Tensor>* list : written) {
    for (Tensor& t : *list) {
      note_written(t);
      if (!t.is_contiguous()) t = copied.emplace_back(t, t.contiguous()).second;
    }
  }
  training_kernels(a.params[0]).adam(a);
  for (const auto& [strided, copy] : copied) strided.copy_(copy);
  return {};
}

}  // namespace ar::ops
