// TrainingKernels (training.h) for CUDA tensors, float32 or float64. Never waits for the device.
#include <ATen/ops/empty.h>

#include "cuda/training/training.h"
#include "torch/cuda_stream.h"
#include "torch/training.h"

namespace ar::ops {
namespace {

template <typename T, class Params> int64_t count_blocks(const Params& p) {
  const int64_t blocks = cuda::ssim_blocks<T>(p.planes, p.height, p.width), most = (int64_t(1) << 31) - 1;
  TORCH_CHECK_VALUE(blocks <= most, "image must have at most ", most, " blocks of pixels, got ", blocks);
  return blocks;
}

class CudaTrainingKernels final : public TrainingKernels {
 public:
  void ssim(const SsimTensors& t) const override {
    visit_scalars(t, [&](auto scalar, auto target) {
      using T = decltype(scalar);
      const auto p = ssim_params<T, decltype(target)>(t);
      const Tensor block_sums = at::empty({count_blocks<T>(p), p.loss ? 2 : 0}, t.image.options());
      on_stream(t.image, [&](cudaStream_t stream) { cuda::ssim(p, pointer<T>(block_sums), stream); });
    });
  }
  void ssim_vjp(const SsimTensors& t) const override {
    visit_scalars(t, [&](auto scalar, auto target) {
      using T = decltype(scalar);
      const auto p = ssim_vjp_params<T, decltype(target)>(t);
      count_blocks<T>(p);
      on_stream(t.image, [&](cudaStream_t stream) { cuda::ssim_vjp(p, stream); });
    });
  }
  void activate(const ActivateTensors& t) const override {
    visit_scalar(t.log_scales, [&](auto scalar) {
      using T = decltype(scalar);
      const auto p = activate_params<T>(t);
      const int64_t blocks = p.penalty ? cuda::activate_blocks(p.n) : 0;
      const Tensor block_sums = blocks ? at::empty({blocks}, t.log_scales.options()) : Tensor();
      on_stream(t.log_scales, [&](cudaStream_t stream) { cuda::activate(p, pointer<T>(block_sums), stream); });
    });
  }
  void activate_vjp(const ActivateTensors& t) const override {
    visit_scalar(t.log_scales, [&](auto scalar) {
      const auto p = activate_vjp_params<decltype(scalar)>(t);
      on_stream(t.log_scales, [&](cudaStream_t stream) { cuda::activate_vjp(p, stream); });
    });
  }
  void apply_filter(const FilterTensors& t) const override {
    visit_scalar(t.scales, [&](auto scalar) {
      const auto p = filter_params<decltype(scalar)>(t);
      on_stream(t.scales, [&](cudaStream_t stream) { cuda::apply_filter(p, stream); });
    });
  }
  void apply_filter_vjp(const FilterTensors& t) const override {
    visit_scalar(t.scales, [&](auto scalar) {
      const auto p = filter_vjp_params<decltype(scalar)>(t);
      on_stream(t.scales, [&](cudaStream_t stream) { cuda::apply_filter_vjp(p, stream); });
    });
  }
  void correct_colors(const CorrectTensors& t) const override {
    visit_scalar(t.image, [&](auto scalar) {
      const auto p = correct_params<decltype(scalar)>(t);
      on_stream(t.image, [&](cudaStream_t stream) { cuda::correct_colors(p, stream); });
    });
  }
  void correct_colors_vjp(const CorrectTensors& t) const override {
    visit_scalar(t.image, [&](auto scalar) {
      using T = decltype(scalar);
      const auto p = correct_vjp_params<T>(t);
      const int64_t blocks = p.sums() ? cuda::correct_blocks(p.pixels) : 0;
      const Tensor block_sums = at::empty({blocks, kCorrection + kVignetting}, t.image.options());
      on_stream(t.image, [&](cudaStream_t stream) { cuda::correct_colors_vjp(p, pointer<T>(block_sums), stream); });
    });
  }
  void observe(const ObserveArguments& a) const override {
    visit_scalar(a.gradient_sums, [&](auto scalar) {
      const auto p = observe_params<decltype(scalar)>(a);
      on_stream(a.gradient_sums, [&](cudaStream_t stream) { cuda::observe(p, stream); });
    });
  }
  void add_noise(const NoiseArguments& a) const override {
    visit_scalar(a.means, [&](auto scalar) {
      const auto p = noise_params<decltype(scalar)>(a);
      on_stream(a.means, [&](cudaStream_t stream) { cuda::add_noise(p, stream); });
    });
  }
  void adam(const AdamArguments& a) const override {
    visit_scalar(a.params[0], [&](auto scalar) {
      for_adam_tensors<decltype(scalar)>(
          a, [&](const auto& p) { on_stream(a.params[0], [&](cudaStream_t stream) { cuda::adam(p, stream); }); });
    });
  }
};

}  // namespace

const TrainingKernels& cuda_training_kernels() {
  static const CudaTrainingKernels kernels;
  return kernels;
}

}  // namespace ar::ops
