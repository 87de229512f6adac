// Under torch.autocast the ops compute in float32: this kernel, then called first, casts arguments of 16 bits as torch
// does: gradients have the dtype of the arguments.
#include <torch/library.h>

#include "torch/boxing.h"

namespace ar::ops {
namespace {

using torch::jit::Stack;

template <c10::DispatchKey kAutocast> void in_float32(const c10::OperatorHandle& op, Stack* stack) {
  const c10::impl::ExcludeDispatchKeyGuard without_autocast(kAutocast);
  const bool on_cuda = kAutocast == c10::DispatchKey::AutocastCUDA;
  const size_t first = stack->size() - op.schema().arguments().size();
  for (size_t i = first; i < stack->size(); ++i) {
    IValue& value = (*stack)[i];
    if (!value.isTensor() || !value.toTensor().defined()) continue;
    const Tensor& t = value.toTensor();
    const bool is_half = t.scalar_type() == at::kHalf || t.scalar_type() == at::kBFloat16;
    if (is_half && t.is_cuda() == on_cuda) value = t.to(at::kFloat);
  }
  op.callBoxed(stack);
}

/// The ops that write to no argument. Adjoints get arguments that have been cast.
template <c10::DispatchKey kAutocast> void register_casts(torch::Library& m) {
  for (const char* name : {"prepare_cameras", "prepare_lens", "rasterize", "rasterize_timed", "project",
                           "repeat_at_seam", "composite", "count_rows", "bin", "blend", "inspect", "footprint_weight",
                           "ssim_map", "l1_ssim", "activate", "apply_3d_filter", "correct_colors"})
    m.impl(name, torch::CppFunction::makeFromBoxedFunction<&in_float32<kAutocast>>());
}

TORCH_LIBRARY_IMPL(analytic_rasterizer, AutocastCPU, m) { register_casts<c10::DispatchKey::AutocastCPU>(m); }
TORCH_LIBRARY_IMPL(analytic_rasterizer, AutocastCUDA, m) { register_casts<c10::DispatchKey::AutocastCUDA>(m); }

}  // namespace
}  // namespace ar::ops
