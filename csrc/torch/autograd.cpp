// Gradients of the ops, for every device. In C++: registered from Python they took longer than the
// launches of a small scene.
#include <torch/csrc/autograd/autograd_not_implemented_fallback.h>
#include <torch/csrc/autograd/custom_function.h>
#include <torch/library.h>

#include "torch/views.h"

namespace ar::ops {
namespace {

using torch::autograd::AutogradContext;
using torch::autograd::variable_list;

/// The arguments of rasterize that are no tensors, on their way to the backward pass.
struct Settings {
  int64_t image_height, image_width;
  double tanfovx, tanfovy, scale_modifier;
  int64_t sh_degree;
  std::string footprint;
  double option;
  bool debug;

  void save(AutogradContext* ctx) const {
    ctx->saved_data["ints"] = std::vector<int64_t>{image_height, image_width, sh_degree};
    ctx->saved_data["doubles"] = std::vector<double>{tanfovx, tanfovy, scale_modifier, option};
    ctx->saved_data["footprint"] = footprint;
    ctx->saved_data["debug"] = debug;
  }
  static Settings load(AutogradContext* ctx) {
    const auto ints = ctx->saved_data["ints"].toIntVector();
    const auto doubles = ctx->saved_data["doubles"].toDoubleVector();
    return {ints[0],
            ints[1],
            doubles[0],
            doubles[1],
            doubles[2],
            ints[2],
            ctx->saved_data["footprint"].toStringRef(),
            doubles[3],
            ctx->saved_data["debug"].toBool()};
  }
};

using RasterizeSignature = RasterizeOutput(const Tensor&, const OptionalTensor&, const Tensor&, const OptionalTensor&,
                                           const OptionalTensor&, const OptionalTensor&, const OptionalTensor&,
                                           const OptionalTensor&, const Tensor&, const Tensor&, const Tensor&,
                                           const Tensor&, const OptionalTensor&, int64_t, int64_t, double, double,
                                           double, int64_t, std::string, double, bool, bool, bool);
using RasterizeVjpSignature = Grads(const Tensor&, const OptionalTensor&, const Tensor&, const OptionalTensor&,
                                    const Tensor&, const OptionalTensor&, const OptionalTensor&, const OptionalTensor&,
                                    const OptionalTensor&, const OptionalTensor&, const Tensor&, const Tensor&,
                                    const Tensor&, const Tensor&, const OptionalTensor&, int64_t, int64_t, double,
                                    double, double, int64_t, std::string, double, const Tensor&, const Tensor&,
                                    const Tensor&, const Tensor&, const Tensor&, const Tensor&, const Tensor&,
                                    const Tensor&, const Tensor&, const Tensor&, const Tensor&, const Tensor&, Needs,
                                    bool);
using WeightSignature = Tensor(const Tensor&, const Tensor&, std::string, double);
using WeightVjpSignature = std::tuple<Tensor, Tensor>(const Tensor&, const Tensor&, const Tensor&, std::string, double);

template <class Signature> c10::TypedOperatorHandle<Signature> find_op(const char* name) {
  return c10::Dispatcher::singleton().findSchemaOrThrow(name, "").typed<Signature>();
}

void append(variable_list& list, const Tensor& tensor) { list.push_back(tensor); }
void append(variable_list& list, const std::vector<Tensor>& tensors) {
  list.insert(list.end(), tensors.begin(), tensors.end());
}
template <class Tuple> variable_list list_of(const Tuple& tuple) {
  variable_list list;
  std::apply([&](const auto&... t) { (append(list, t), ...); }, tuple);
  return list;
}

constexpr size_t kGaussianInputs = 8, kBackground = 8, kLens = 12, kInputs = 13,
                 kAlpha = std::tuple_size_v<RasterizeOutput> - 1;

/// The derivative of a derivative must fail, not be zero: rasterize_vjp has none, and says so.
struct Rasterize : torch::autograd::Function<Rasterize> {
  static variable_list forward(AutogradContext* ctx, const Tensor& means3D, const OptionalTensor& means2D,
                               const Tensor& opacities, const OptionalTensor& shs, const OptionalTensor& colors_precomp,
                               const OptionalTensor& scales, const OptionalTensor& rotations,
                               const OptionalTensor& cov3D_precomp, const Tensor& bg, const Tensor& viewmatrix,
                               const Tensor& projmatrix, const Tensor& campos, const OptionalTensor& lens,
                               const Settings& s, bool keep, bool alpha) {
    static const auto op = find_op<RasterizeSignature>("analytic_rasterizer::rasterize");
    const at::AutoDispatchBelowADInplaceOrView guard;
    const variable_list out =
        list_of(op.call(means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp, bg,
                        viewmatrix, projmatrix, campos, lens, s.image_height, s.image_width, s.tanfovx, s.tanfovy,
                        s.scale_modifier, s.sh_degree, s.footprint, s.option, keep, alpha, s.debug));
    ctx->set_materialize_grads(false);  // no zeros the size of everything saved
    ctx->mark_non_differentiable({out.begin() + 1, out.begin() + kAlpha});
    ctx->saved_data["keep"] = keep;
    if (keep) {
      const auto given = [](const OptionalTensor& t) { return t ? *t : Tensor(); };
      variable_list saved = {means3D,
                             given(means2D),
                             opacities,
                             given(shs),
                             given(colors_precomp),
                             given(scales),
                             given(rotations),
                             given(cov3D_precomp),
                             bg,
                             viewmatrix,
                             projmatrix,
                             campos,
                             given(lens)};
      saved.insert(saved.end(), out.begin() + 2, out.begin() + kAlpha);
      ctx->save_for_backward(std::move(saved));
      s.save(ctx);
    }
    return out;
  }

  static variable_list backward(AutogradContext* ctx, variable_list dL_doutputs) {
    TORCH_CHECK(ctx->saved_data["keep"].toBool(),
                "rasterize was called with keep=False and cannot be differentiated; gradients of a camera take "
                "Effects(camera_gradients=True)");
    variable_list grads(kInputs + 3);  // settings, keep and alpha have none
    const Tensor dL_dalpha = dL_doutputs.size() > kAlpha ? dL_doutputs[kAlpha] : Tensor();
    if (!dL_doutputs[0].defined() && !dL_dalpha.defined()) return grads;
    static const auto op = find_op<RasterizeVjpSignature>("analytic_rasterizer::rasterize_vjp");
    const variable_list t = ctx->get_saved_variables();
    const Settings s = Settings::load(ctx);
    const Tensor dL_dcolor =
        dL_doutputs[0].defined() ? dL_doutputs[0] : at::zeros({3, s.image_height, s.image_width}, t[0].options());
    const auto given = [](const Tensor& t) { return t.defined() ? OptionalTensor(t) : std::nullopt; };
    Needs needs;
    size_t edge = 0;                   // counts the tensors that were given
    std::array<size_t, kNeeds> input;  // of every gradient
    for (size_t i = 0, k = 0; i < kInputs; ++i) {
      const bool needed = t[i].defined() && ctx->needs_input_grad(edge++);
      if (i == kBackground) continue;
      input[k] = i;
      needs[k++] = needed && (i < kGaussianInputs || t[kLens].defined());
    }
    const auto saved = t.begin() + kInputs;
    const variable_list out = list_of(op.call(
        dL_dcolor, given(dL_dalpha), t[0], given(t[1]), t[2], given(t[3]), given(t[4]), given(t[5]), given(t[6]),
        given(t[7]), t[8], t[9], t[10], t[11], given(t[kLens]), s.image_height, s.image_width, s.tanfovx, s.tanfovy,
        s.scale_modifier, s.sh_degree, s.footprint, s.option, saved[0], saved[1], saved[2], saved[3], saved[4],
        saved[5], saved[6], saved[7], saved[8], saved[9], saved[10], saved[11], needs, s.debug));
    for (size_t k = 0; k < kNeeds; ++k) {
      if (!needs[k]) continue;
      // A matrix may have come as (1, 4, 4).
      grads[input[k]] = input[k] < kGaussianInputs ? out[k] : out[k].view_as(t[input[k]]);
    }
    return grads;
  }
};
static_assert(kAlpha == 14, "backward passes all that forward saves");

RasterizeOutput rasterize_autograd(const Tensor& means3D, const OptionalTensor& means2D, const Tensor& opacities,
                                   const OptionalTensor& shs, const OptionalTensor& colors_precomp,
                                   const OptionalTensor& scales, const OptionalTensor& rotations,
                                   const OptionalTensor& cov3D_precomp, const Tensor& bg, const Tensor& viewmatrix,
                                   const Tensor& projmatrix, const Tensor& campos, const OptionalTensor& lens,
                                   int64_t image_height, int64_t image_width, double tanfovx, double tanfovy,
                                   double scale_modifier, int64_t sh_degree, std::string footprint, double option,
                                   bool keep, bool alpha, bool debug) {
  const Settings settings = {image_height, image_width, tanfovx, tanfovy, scale_modifier,
                             sh_degree,    footprint,   option,  debug};
  const variable_list out =
      Rasterize::apply(means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp, bg,
                       viewmatrix, projmatrix, campos, lens, settings, keep, alpha);
  return {out[0],  out[1],  out[2],  out[3],  out[4],
          out[5],  out[6],  out[7],  out[8],  out[9],
          out[10], out[11], out[12], out[13], {out.begin() + kAlpha, out.end()}};
}

struct Weight : torch::autograd::Function<Weight> {
  static Tensor forward(AutogradContext* ctx, const Tensor& offset, const Tensor& cov2d, const std::string& footprint,
                        double option) {
    static const auto op = find_op<WeightSignature>("analytic_rasterizer::footprint_weight");
    const at::AutoDispatchBelowADInplaceOrView guard;
    ctx->save_for_backward({offset, cov2d});
    ctx->saved_data["footprint"] = footprint;
    ctx->saved_data["option"] = option;
    return op.call(offset, cov2d, footprint, option);
  }
  static variable_list backward(AutogradContext* ctx, variable_list dL_dweight) {
    static const auto op = find_op<WeightVjpSignature>("analytic_rasterizer::footprint_weight_vjp");
    const variable_list t = ctx->get_saved_variables();
    const auto [dL_doffset, dL_dcov] = op.call(dL_dweight[0], t[0], t[1], ctx->saved_data["footprint"].toStringRef(),
                                               ctx->saved_data["option"].toDouble());
    return {dL_doffset, dL_dcov, Tensor(), Tensor()};
  }
};

Tensor footprint_weight_autograd(const Tensor& offset, const Tensor& cov2d, std::string footprint, double option) {
  return Weight::apply(offset, cov2d, footprint, option);
}

TORCH_LIBRARY_IMPL(analytic_rasterizer, Autograd, m) {
  m.impl("rasterize", rasterize_autograd);
  m.impl("footprint_weight", footprint_weight_autograd);
  m.impl("rasterize_vjp", torch::autograd::autogradNotImplementedFallback());
  m.impl("rasterize_channels", torch::autograd::autogradNotImplementedFallback());
  m.impl("footprint_weight_vjp", torch::autograd::autogradNotImplementedFallback());
}

}  // namespace
}  // namespace ar::ops
