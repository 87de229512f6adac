// TrainingKernels, which training.cpp asks of a device, and parameters of kernels from tensors, checked and contiguous,
// or undefined: absent or not wanted.
#pragma once

#include <cmath>

#include "core/activations.h"
#include "core/adam.h"
#include "core/color_correction.h"
#include "core/density.h"
#include "core/ssim.h"
#include "torch/training_arguments.h"

namespace ar::ops {

/// Either of map and loss, or either of dL_dmap and dL_dloss.
struct SsimTensors {
  Tensor image;   ///< (..., H, W), as all but loss and partials.
  Tensor target;  ///< May be uint8.
  LossWeights<double> weights = {};
  Tensor map;
  Tensor loss;      ///< ().
  Tensor partials;  ///< (kSsimPartials, ..., H, W).
  Tensor dL_dmap, dL_dloss;
  Tensor dL_dimage;
};

struct ActivateTensors {
  Tensor log_scales, quats, logit_opacities;
  PenaltyWeights<double> weights = {};
  Tensor scales, rotations, opacities;
  Tensor penalty;  ///< (), or empty.
  Tensor dL_dscales, dL_drotations, dL_dopacities, dL_dpenalty;
  Tensor dL_dlog_scales, dL_dquats, dL_dlogit_opacities;
};

struct FilterTensors {
  Tensor scales, opacities, filter_3d;
  Tensor filtered_scales, filtered_opacities;
  Tensor dL_dfiltered_scales, dL_dfiltered_opacities;
  Tensor dL_dscales, dL_dopacities, dL_dfilter_3d;
};

struct CorrectTensors {
  Tensor image, matrix, vignetting;
  std::vector<double> center;  ///< Empty without vignetting.
  Tensor corrected;
  Tensor dL_dcorrected;
  Tensor dL_dimage, dL_dmatrix, dL_dvignetting;
};

/// On the device's current stream.
class TrainingKernels {
 public:
  virtual ~TrainingKernels() = default;
  virtual void ssim(const SsimTensors& t) const = 0;
  virtual void ssim_vjp(const SsimTensors& t) const = 0;
  virtual void activate(const ActivateTensors& t) const = 0;
  virtual void activate_vjp(const ActivateTensors& t) const = 0;
  virtual void apply_filter(const FilterTensors& t) const = 0;
  virtual void apply_filter_vjp(const FilterTensors& t) const = 0;
  virtual void correct_colors(const CorrectTensors& t) const = 0;
  virtual void correct_colors_vjp(const CorrectTensors& t) const = 0;
  virtual void observe(const ObserveArguments& a) const = 0;
  virtual void add_noise(const NoiseArguments& a) const = 0;
  virtual void adam(const AdamArguments& a) const = 0;
};
const TrainingKernels& cpu_training_kernels();
const TrainingKernels& cuda_training_kernels();
inline const TrainingKernels& training_kernels([[maybe_unused]] const Tensor& like) {
#if defined(AR_WITH_CUDA)
  if (like.is_cuda()) return cuda_training_kernels();
#endif
  return cpu_training_kernels();
}

/// visit(T(), Target()) for the dtypes of image and target.
template <class Visit> void visit_scalars(const SsimTensors& t, const Visit& visit) {
  const bool is_double = t.image.scalar_type() == at::kDouble, is_uint8 = t.target.scalar_type() == at::kByte;
  if (is_double && is_uint8) visit(double(), uint8_t());
  if (is_double && !is_uint8) visit(double(), double());
  if (!is_double && is_uint8) visit(float(), uint8_t());
  if (!is_double && !is_uint8) visit(float(), float());
}

template <typename T, typename Target, class Params> void set_images(Params& p, const SsimTensors& t) {
  p.height = int(t.image.size(-2));
  p.width = int(t.image.size(-1));
  p.planes = t.image.numel() / t.image.size(-2) / t.image.size(-1);
  p.image = const_pointer<T>(t.image);
  p.target = const_pointer<Target>(t.target);
  p.weights = {T(t.weights.l1), T(t.weights.ssim), T(t.weights.constant)};
}

template <typename T, typename Target> SsimParams<T, Target> ssim_params(const SsimTensors& t) {
  SsimParams<T, Target> p = {};
  set_images<T, Target>(p, t);
  p.map = pointer<T>(t.map);
  p.loss = pointer<T>(t.loss);
  p.partials = pointer<T>(t.partials);
  return p;
}

template <typename T, typename Target> SsimVjpParams<T, Target> ssim_vjp_params(const SsimTensors& t) {
  SsimVjpParams<T, Target> p = {};
  set_images<T, Target>(p, t);
  p.partials = const_pointer<T>(t.partials);
  p.dL_dmap = const_pointer<T>(t.dL_dmap);
  p.dL_dloss = const_pointer<T>(t.dL_dloss);
  p.dL_dimage = pointer<T>(t.dL_dimage);
  return p;
}

/// visit(T()) for the dtype.
template <class Visit> void visit_scalar(const Tensor& parameters, const Visit& visit) {
  if (parameters.scalar_type() == at::kDouble) return visit(double());
  visit(float());
}

template <typename T, class Params> void set_parameters(Params& p, const ActivateTensors& t) {
  p.n = t.log_scales.size(0);
  p.log_scales = const_pointer<Vec3<T>>(t.log_scales);
  p.quats = const_pointer<Vec4<T>>(t.quats);
  p.logit_opacities = const_pointer<T>(t.logit_opacities);
  p.weights = {T(t.weights.opacity), T(t.weights.scale)};
}

template <typename T> ActivateParams<T> activate_params(const ActivateTensors& t) {
  ActivateParams<T> p = {};
  set_parameters<T>(p, t);
  p.scales = pointer<Vec3<T>>(t.scales);
  p.rotations = pointer<Vec4<T>>(t.rotations);
  p.opacities = pointer<T>(t.opacities);
  p.penalty = pointer<T>(t.penalty);
  return p;
}

template <typename T> ActivateVjpParams<T> activate_vjp_params(const ActivateTensors& t) {
  ActivateVjpParams<T> p = {};
  set_parameters<T>(p, t);
  p.dL_dscales = const_pointer<Vec3<T>>(t.dL_dscales);
  p.dL_drotations = const_pointer<Vec4<T>>(t.dL_drotations);
  p.dL_dopacities = const_pointer<T>(t.dL_dopacities);
  p.dL_dpenalty = const_pointer<T>(t.dL_dpenalty);
  p.dL_dlog_scales = pointer<Vec3<T>>(t.dL_dlog_scales);
  p.dL_dquats = pointer<Vec4<T>>(t.dL_dquats);
  p.dL_dlogit_opacities = pointer<T>(t.dL_dlogit_opacities);
  return p;
}

template <typename T, class Params> void set_filter(Params& p, const FilterTensors& t) {
  p.n = t.scales.size(0);
  p.scales = const_pointer<Vec3<T>>(t.scales);
  p.opacities = const_pointer<T>(t.opacities);
  p.widths = const_pointer<T>(t.filter_3d);
}

template <typename T> FilterParams<T> filter_params(const FilterTensors& t) {
  FilterParams<T> p = {};
  set_filter<T>(p, t);
  p.filtered_scales = pointer<Vec3<T>>(t.filtered_scales);
  p.filtered_opacities = pointer<T>(t.filtered_opacities);
  return p;
}

template <typename T> FilterVjpParams<T> filter_vjp_params(const FilterTensors& t) {
  FilterVjpParams<T> p = {};
  set_filter<T>(p, t);
  p.dL_dfiltered_scales = const_pointer<Vec3<T>>(t.dL_dfiltered_scales);
  p.dL_dfiltered_opacities = const_pointer<T>(t.dL_dfiltered_opacities);
  p.dL_dscales = pointer<Vec3<T>>(t.dL_dscales);
  p.dL_dopacities = pointer<T>(t.dL_dopacities);
  p.dL_dwidths = pointer<T>(t.dL_dfilter_3d);
  return p;
}

template <typename T, class Params> void set_correction(Params& p, const CorrectTensors& t) {
  p.pixels = t.image.numel() / 3;
  p.image = const_pointer<T>(t.image);
  p.matrix = const_pointer<T>(t.matrix);
  p.vignetting = const_pointer<T>(t.vignetting);
  if (p.vignetting) p.radii = radii_of<T>(t.image.size(1), t.image.size(2), t.center[0], t.center[1]);
}

template <typename T> CorrectParams<T> correct_params(const CorrectTensors& t) {
  CorrectParams<T> p = {};
  set_correction<T>(p, t);
  p.corrected = pointer<T>(t.corrected);
  return p;
}

template <typename T> CorrectVjpParams<T> correct_vjp_params(const CorrectTensors& t) {
  CorrectVjpParams<T> p = {};
  set_correction<T>(p, t);
  p.dL_dcorrected = const_pointer<T>(t.dL_dcorrected);
  p.dL_dimage = pointer<T>(t.dL_dimage);
  p.dL_dmatrix = pointer<T>(t.dL_dmatrix);
  p.dL_dvignetting = pointer<T>(t.dL_dvignetting);
  return p;
}

template <typename T> ObserveParams<T> observe_params(const ObserveArguments& a) {
  ObserveParams<T> p = {};
  p.n = a.gradient_sums.numel();
  p.gradients = const_pointer<T>(a.gradients);
  p.stride = int(a.gradients.size(1));
  p.first = int(a.first_column);
  p.radii = const_pointer<int32_t>(a.radii);
  p.gradient_sums = pointer<T>(a.gradient_sums);
  p.views = pointer<int32_t>(a.views);
  return p;
}

template <typename T> NoiseParams<T> noise_params(const NoiseArguments& a) {
  NoiseParams<T> p = {};
  p.n = a.means.size(0);
  p.means = pointer<Vec3<T>>(a.means);
  p.log_scales = const_pointer<Vec3<T>>(a.log_scales);
  p.quats = const_pointer<Vec4<T>>(a.quats);
  p.logit_opacities = const_pointer<T>(a.logit_opacities);
  p.normals = const_pointer<Vec3<T>>(a.normals);
  p.strength = T(a.strength);
  return p;
}

/// For tensor i. Powers in double, since 1 - beta2^step is small at first.
template <typename T> AdamRule<T> adam_rule(const AdamArguments& a, size_t i) {
  AdamRule<T> rule = {};
  rule.beta1 = T(a.beta1);
  rule.one_minus_beta1 = T(1 - a.beta1);
  rule.beta2 = T(a.beta2);
  rule.one_minus_beta2 = T(1 - a.beta2);
  rule.eps = T(a.eps);
  const double step = double(a.steps[i]);
  const double bias = a.bias_correction ? 1 - std::pow(a.beta1, step) : 1;
  rule.rate = T(a.rates[i] / bias);
  if (!a.heads.empty()) rule.head_rate = T(a.head_rates[i] / bias);
  rule.root_scale = T(a.bias_correction ? 1 / std::sqrt(1 - std::pow(a.beta2, step)) : 1);
  return rule;
}

template <typename T> AdamTensor<T> adam_tensor(const AdamArguments& a, size_t i) {
  AdamTensor<T> t = {};
  t.n = a.params[i].numel();
  t.head = a.heads.empty() ? 0 : a.heads[i];
  t.row_size = a.rows || t.head > 0 ? t.n / a.params[i].size(0) : t.n;
  t.rule = adam_rule<T>(a, i);
  t.grad = const_pointer<T>(a.grads[i]);
  t.param = pointer<T>(a.params[i]);
  t.exp_avg = pointer<T>(a.exp_avgs[i]);
  t.exp_avg_sq = pointer<T>(a.exp_avg_sqs[i]);
  t.aligned = true;
  for (const T* first :
       {t.grad, static_cast<const T*>(t.param), static_cast<const T*>(t.exp_avg), static_cast<const T*>(t.exp_avg_sq)})
    t.aligned = t.aligned && reinterpret_cast<uintptr_t>(first) % 16 == 0;
  return t;
}

/// run(AdamParams<T>) for up to kAdamTensors tensors at once. Empty ones are skipped.
template <typename T, class Run> void for_adam_tensors(const AdamArguments& a, const Run& run) {
  AdamParams<T> p = {};
  // bool or uint8, both of one byte.
  p.rows = a.rows ? static_cast<const uint8_t*>(a.rows->const_data_ptr()) : nullptr;
  for (size_t i = 0; i < a.params.size(); ++i) {
    if (a.params[i].numel() == 0) continue;
    p.tensors[p.count++] = adam_tensor<T>(a, i);
    if (p.count < kAdamTensors) continue;
    run(p);
    p.count = 0;
  }
  if (p.count > 0) run(p);
}

}  // namespace ar::ops
