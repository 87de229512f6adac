// TrainingKernels (training.h) for CPU tensors, float32 or float64.
#include "cpu/training.h"
#include "torch/backend.h"
#include "torch/training.h"

namespace ar::ops {
namespace {

class CpuTrainingKernels final : public TrainingKernels {
 public:
  void ssim(const SsimTensors& t) const override {
    visit_scalars(t, [&](auto scalar, auto target) {
      cpu::ssim(ssim_params<decltype(scalar), decltype(target)>(t), thread_count());
    });
  }
  void ssim_vjp(const SsimTensors& t) const override {
    visit_scalars(t, [&](auto scalar, auto target) {
      cpu::ssim_vjp(ssim_vjp_params<decltype(scalar), decltype(target)>(t), thread_count());
    });
  }
  void activate(const ActivateTensors& t) const override {
    visit_scalar(t.log_scales,
                 [&](auto scalar) { cpu::activate(activate_params<decltype(scalar)>(t), thread_count()); });
  }
  void activate_vjp(const ActivateTensors& t) const override {
    visit_scalar(t.log_scales,
                 [&](auto scalar) { cpu::activate_vjp(activate_vjp_params<decltype(scalar)>(t), thread_count()); });
  }
  void apply_filter(const FilterTensors& t) const override {
    visit_scalar(t.scales, [&](auto scalar) { cpu::apply_filter(filter_params<decltype(scalar)>(t), thread_count()); });
  }
  void apply_filter_vjp(const FilterTensors& t) const override {
    visit_scalar(t.scales,
                 [&](auto scalar) { cpu::apply_filter_vjp(filter_vjp_params<decltype(scalar)>(t), thread_count()); });
  }
  void correct_colors(const CorrectTensors& t) const override {
    visit_scalar(t.image,
                 [&](auto scalar) { cpu::correct_colors(correct_params<decltype(scalar)>(t), thread_count()); });
  }
  void correct_colors_vjp(const CorrectTensors& t) const override {
    visit_scalar(t.image, [&](auto scalar) {
      cpu::correct_colors_vjp(correct_vjp_params<decltype(scalar)>(t), thread_count());
    });
  }
  void observe(const ObserveArguments& a) const override {
    visit_scalar(a.gradient_sums,
                 [&](auto scalar) { cpu::observe(observe_params<decltype(scalar)>(a), thread_count()); });
  }
  void add_noise(const NoiseArguments& a) const override {
    visit_scalar(a.means, [&](auto scalar) { cpu::add_noise(noise_params<decltype(scalar)>(a), thread_count()); });
  }
  void adam(const AdamArguments& a) const override {
    visit_scalar(a.params[0], [&](auto scalar) {
      for_adam_tensors<decltype(scalar)>(a, [](const auto& p) { cpu::adam(p, thread_count()); });
    });
  }
};

}  // namespace

const TrainingKernels& cpu_training_kernels() {
  static const CpuTrainingKernels kernels;
  return kernels;
}

}  // namespace ar::ops
