// The autograd node of all differentiable ops. In C++: one from Python takes longer than the launches of a small scene.
// That of `name` calls `name_vjp` with VjpArguments. Differentiable outputs come first: up to the first of integers, or
// to the last list, `saved`. Adjoints have no derivative.
#include <torch/csrc/autograd/autograd_not_implemented_fallback.h>
#include <torch/csrc/autograd/custom_function.h>
#include <torch/library.h>

#include <atomic>

#include "torch/ops.h"

namespace ar::ops {
namespace {

using torch::autograd::AutogradContext;
using torch::autograd::variable_list;
using torch::jit::Stack;

/// As indices of arguments.
struct DifferentiableOp {
  c10::OperatorHandle forward, vjp;
  std::vector<size_t> tensors;
  std::vector<size_t> lists;  ///< Of tensors, without gradient.
  size_t arguments, outputs;
  std::optional<size_t> keep;  ///< Makes the op save what its adjoint needs.

  explicit DifferentiableOp(const c10::OperatorHandle& op)
      : forward(op),
        vjp(c10::Dispatcher::singleton().findSchemaOrThrow((op.schema().name() + "_vjp").c_str(), "")),
        arguments(op.schema().arguments().size()),
        outputs(op.schema().returns().size()) {
    for (size_t i = 0; i < arguments; ++i) {
      const c10::Argument& argument = op.schema().arguments()[i];
      const auto& type = *argument.type();
      if (type.isSubtypeOf(*c10::TensorType::get()) ||
          type.isSubtypeOf(*c10::OptionalType::create(c10::TensorType::get())))
        tensors.push_back(i);
      if (type.isSubtypeOf(*c10::ListType::ofTensors())) lists.push_back(i);
      if (argument.name() == "keep") keep = i;
    }
  }
  bool saves() const { return forward.schema().returns()[outputs - 1].type()->kind() == c10::TypeKind::ListType; }
};

bool is_given(const IValue& value) { return value.isTensor() && value.toTensor().defined(); }

struct Node : torch::autograd::Function<Node> {
  /// After the op has run. Returns the tensors of all results; result k has sizes[k].
  static variable_list forward(AutogradContext* ctx, at::TensorList tensors, const DifferentiableOp* op,
                               const Stack* arguments, const Stack* results, std::vector<int64_t>* sizes) {
    Stack others = *arguments;  // Without tensors, which autograd saves.
    std::vector<bool> given;
    for (const size_t i : op->tensors) {
      given.push_back(is_given(others[i]));
      others[i] = IValue();
    }
    variable_list listed;  // Autograd frees them when the adjoint has run.
    for (const size_t i : op->lists) {
      const std::vector<Tensor> list = others[i].toTensorVector();
      listed.insert(listed.end(), list.begin(), list.end());
      others[i] = int64_t(list.size());
    }
    variable_list out;
    size_t differentiable = 0;
    bool counting = true;
    for (size_t k = 0; k < op->outputs; ++k) {
      const IValue& value = (*results)[k];
      const bool last = k + 1 == op->outputs && op->saves();
      const std::vector<Tensor> list =
          value.isTensor() ? std::vector<Tensor>{value.toTensor()} : value.toTensorVector();
      counting = counting && !last && (list.empty() || list[0].is_floating_point());
      if (counting) differentiable += list.size();
      sizes->push_back(int64_t(list.size()));
      out.insert(out.end(), list.begin(), list.end());
    }
    ctx->set_materialize_grads(false);  // No zeros for saved tensors.
    ctx->mark_non_differentiable({out.begin() + differentiable, out.end()});
    variable_list saved(tensors.begin(), tensors.end());
    if (op->saves()) saved.insert(saved.end(), out.end() - sizes->back(), out.end());
    const int64_t own = int64_t(saved.size());
    saved.insert(saved.end(), listed.begin(), listed.end());
    ctx->save_for_backward(std::move(saved));
    ctx->saved_data["own"] = own;
    ctx->saved_data["op"] = int64_t(reinterpret_cast<intptr_t>(op));  // Never freed.
    ctx->saved_data["arguments"] = c10::ivalue::Tuple::create(std::move(others));
    ctx->saved_data["given"] = given;
    ctx->saved_data["differentiable"] = int64_t(differentiable);
    return out;
  }

  static variable_list backward(AutogradContext* ctx, variable_list dL_doutputs) {
    const DifferentiableOp* op = reinterpret_cast<const DifferentiableOp*>(intptr_t(ctx->saved_data["op"].toInt()));
    const auto given = ctx->saved_data["given"].toBoolList();
    const size_t differentiable = size_t(ctx->saved_data["differentiable"].toInt());
    const variable_list saved = ctx->get_saved_variables();
    std::vector<size_t> given_at;  // In op->tensors.
    for (size_t k = 0; k < given.size(); ++k) {
      if (given[k]) given_at.push_back(k);
    }
    variable_list grads(given_at.size() + 4);  // Four arguments of forward() have no gradient.
    bool any = false;
    c10::List<OptionalTensor> gradients;
    for (size_t k = 0; k < differentiable; ++k) {
      gradients.push_back(dL_doutputs[k].defined() ? OptionalTensor(dL_doutputs[k]) : std::nullopt);
      any = any || dL_doutputs[k].defined();
    }
    if (!any) return grads;
    Stack stack = {gradients};
    const auto arguments = ctx->saved_data["arguments"].toTuple();
    for (const IValue& value : arguments->elements()) stack.push_back(value);
    std::vector<bool> needs(given.size(), false);
    for (size_t k = 0; k < given_at.size(); ++k) {
      stack[1 + op->tensors[given_at[k]]] = saved[k];
      needs[given_at[k]] = ctx->needs_input_grad(k);
    }
    auto end = saved.begin() + ctx->saved_data["own"].toInt();
    stack.push_back(c10::List<Tensor>(std::vector<Tensor>(saved.begin() + int64_t(given_at.size()), end)));
    for (const size_t i : op->lists) {
      const auto first = end;
      end += stack[1 + i].toInt();
      stack[1 + i] = c10::List<Tensor>(std::vector<Tensor>(first, end));
    }
    stack.push_back(needs);
    op->vjp.callBoxed(stack);
    const std::vector<Tensor> out = stack[0].toTensorVector();
    for (size_t k = 0; k < given_at.size(); ++k) {
      if (!needs[given_at[k]]) continue;
      const Tensor& grad = out[given_at[k]];
      // A matrix may be (1, 4, 4).
      grads[k] = grad.dim() == saved[k].dim() ? grad : grad.view_as(saved[k]);
    }
    return grads;
  }
};

bool wants_gradient(const DifferentiableOp& op, const Stack& stack, size_t first) {
  if (!at::GradMode::is_enabled()) return false;
  for (const size_t i : op.tensors) {
    const IValue& value = stack[first + i];
    if (is_given(value) && value.toTensor().requires_grad()) return true;
  }
  return false;
}

std::atomic<bool> any_required = false;

/// torch.func allows no C++ nodes.
void refuse_transforms(const DifferentiableOp& op) {
  TORCH_CHECK_NOT_IMPLEMENTED(
      !c10::impl::tls_is_dispatch_key_included(c10::DispatchKey::FuncTorchDynamicLayerBackMode),
      op.forward.schema().name(),
      " has no derivative in torch.func (grad, vjp, jacrev); it has one in torch.autograd (backward, grad)");
}

/// Forward mode would drop tangents silently.
void refuse_tangents(const DifferentiableOp& op, const Stack& stack, size_t first) {
  for (const size_t i : op.tensors) {
    const IValue& value = stack[first + i];
    TORCH_CHECK_NOT_IMPLEMENTED(!is_given(value) || !value.toTensor()._fw_grad(/*level=*/0).defined(),
                                op.forward.schema().name(), " has no derivative in forward mode, which a tangent of ",
                                op.forward.schema().arguments()[i].name(), " asks for; it has one in reverse mode");
  }
}

void differentiate(const c10::OperatorHandle& handle, Stack* stack) {
  // Never freed. A schema keeps its address.
  static auto* ops = new std::unordered_map<const c10::FunctionSchema*, std::unique_ptr<DifferentiableOp>>;
  static auto* mutex = new std::mutex;
  const DifferentiableOp* op = nullptr;
  {
    const std::lock_guard lock(*mutex);
    std::unique_ptr<DifferentiableOp>& entry = (*ops)[&handle.schema()];
    if (!entry) entry = std::make_unique<DifferentiableOp>(handle);
    op = entry.get();
  }
  const size_t first = stack->size() - op->arguments;
  refuse_tangents(*op, *stack, first);
  if (!wants_gradient(*op, *stack, first)) {
    const at::AutoDispatchBelowADInplaceOrView guard;
    op->forward.callBoxed(*stack);
    return;
  }
  refuse_transforms(*op);
  any_required.store(true, std::memory_order_relaxed);
  if (op->keep) (*stack)[first + *op->keep] = true;
  Stack arguments(stack->begin() + int64_t(first), stack->end());
  torch::jit::drop(*stack, op->arguments);
  variable_list tensors;
  for (const size_t i : op->tensors) {
    if (is_given(arguments[i])) tensors.push_back(arguments[i].toTensor());
  }
  // Before the node is made, so that the device has work meanwhile.
  Stack results = arguments;
  {
    const at::AutoDispatchBelowADInplaceOrView guard;
    op->forward.callBoxed(results);
  }
  std::vector<int64_t> sizes;
  const variable_list out = Node::apply(at::TensorList(tensors), op, &arguments, &results, &sizes);
  auto next = out.begin();
  for (size_t k = 0; k < op->outputs; ++k) {
    const bool is_list = handle.schema().returns()[k].type()->kind() == c10::TypeKind::ListType;
    if (is_list) {
      stack->push_back(c10::List<Tensor>(std::vector<Tensor>(next, next + sizes[k])));
    } else {
      stack->push_back(*next);
    }
    next += sizes[k];
  }
}

TORCH_LIBRARY_IMPL(analytic_rasterizer, Autograd, m) {
  for (const char* name :
       {"prepare_cameras", "prepare_lens", "rasterize", "project", "repeat_at_seam", "composite", "blend",
        "footprint_weight", "ssim_map", "l1_ssim", "activate", "apply_3d_filter", "correct_colors"})
    m.impl(name, torch::CppFunction::makeFromBoxedFunction<&differentiate>());
  for (const char* name : {"prepare_cameras_vjp",  "prepare_lens_vjp",
                           "rasterize_vjp",        "project_vjp",
                           "composite_vjp",        "blend_vjp",
                           "footprint_weight_vjp", "ssim_map_vjp",
                           "l1_ssim_vjp",          "activate_vjp",
                           "apply_3d_filter_vjp",  "correct_colors_vjp",
                           "picture_gradients",    "rows_picture_gradients",
                           "repeat_at_seam_vjp",   "observe_",
                           "add_noise_",           "adam_",
                           "count_rows",           "pack_rows_",
                           "pack_rows_vjp",        "blend_rows",
                           "blend_rows_vjp_"})
    m.impl(name, torch::autograd::autogradNotImplementedFallback());
}

}  // namespace

bool gradient_was_required() { return any_required.load(std::memory_order_relaxed); }

}  // namespace ar::ops
