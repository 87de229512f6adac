// The arguments of the ops, each named and typed once: `each` of a struct lists them for the schema, for reading them
// off the dispatcher's stack, and for the names in snapshots.
#pragma once

#include <ATen/ATen.h>
#include <ATen/core/ivalue.h>
#include <ATen/core/stack.h>

#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "core/stages.h"

namespace ar::ops {

using at::Tensor;
using OptionalTensor = std::optional<Tensor>;
using c10::IValue;

/// A scene and a camera as 3DGS names them. check() (checks.h) brings the tensors into the form the kernels read.
struct Inputs {
  Tensor means3D;
  OptionalTensor means2D;
  Tensor opacities;
  OptionalTensor shs, colors_precomp, scales, rotations, cov3D_precomp;
  Tensor viewmatrix, projmatrix, campos;
  OptionalTensor lens;  ///< of a full camera
  int64_t image_height = 0, image_width = 0;
  double tanfovx = 0, tanfovy = 0, scale_modifier = 1;
  int64_t sh_degree = 0;

  int64_t count() const { return means3D.size(0); }

  template <class Visit> void each(Visit&& visit) {
    visit("Tensor means3D", means3D);
    visit("Tensor? means2D", means2D);
    visit("Tensor opacities", opacities);
    visit("Tensor? shs", shs);
    visit("Tensor? colors_precomp", colors_precomp);
    visit("Tensor? scales", scales);
    visit("Tensor? rotations", rotations);
    visit("Tensor? cov3D_precomp", cov3D_precomp);
    visit("Tensor viewmatrix", viewmatrix);
    visit("Tensor projmatrix", projmatrix);
    visit("Tensor campos", campos);
    visit("Tensor? lens", lens);
    visit("int image_height", image_height);
    visit("int image_width", image_width);
    visit("float tanfovx", tanfovx);
    visit("float tanfovy", tanfovy);
    visit("float scale_modifier", scale_modifier);
    visit("int sh_degree", sh_degree);
  }
};

/// Gradients with respect to the tensors of Inputs, in their order; undefined where nobody wants one.
struct Grads {
  Tensor means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp;
  Tensor viewmatrix, projmatrix, campos, lens;
  MeanSums mean_sums = MeanSums::kNone;  ///< that means2D holds

  template <class Visit> void each(Visit&& visit) {
    for (Tensor* t : {&means3D, &means2D, &opacities, &shs, &colors_precomp, &scales, &rotations, &cov3D_precomp,
                      &viewmatrix, &projmatrix, &campos, &lens})
      visit(*t);
  }
};

/// Arguments of `rasterize`.
struct RasterizeArguments : Inputs {
  Tensor bg;  ///< (C,) of C colour channels
  std::string footprint;
  double option = 0;
  bool depth = false, inverse_depth = false, alpha = false, keep = false, debug = false;
  std::string means2d_z = "zero";  ///< third column of the gradient with respect to means2D: "sum_abs", "sum_norm"

  template <class Visit> void each(Visit&& visit) {
    Inputs::each(visit);
    visit("Tensor bg", bg);
    visit("str footprint", footprint);
    visit("float option", option);
    visit("bool alpha=False", alpha);
    visit("bool depth=False", depth);
    visit("bool inverse_depth=False", inverse_depth);
    visit("bool keep=False", keep);
    visit("bool debug=False", debug);
    visit("str means2d_z=\"zero\"", means2d_z);
  }
};

/// Arguments of `project`: Inputs for several cameras at once.
struct ProjectArguments {
  Tensor means3D, opacities;
  OptionalTensor shs, colors_precomp, scales, rotations, cov3D_precomp;
  Tensor viewmatrix, projmatrix, campos;  ///< (C, 4, 4), (C, 4, 4), (C, 3)
  OptionalTensor lens;                    ///< (C, kLensWidth)
  int64_t image_height = 0, image_width = 0;
  std::vector<double> tanfovx, tanfovy;  ///< C numbers each
  double scale_modifier = 1;
  int64_t sh_degree = 0;
  std::string footprint;
  double option = 0;

  template <class Visit> void each(Visit&& visit) {
    visit("Tensor means3D", means3D);
    visit("Tensor opacities", opacities);
    visit("Tensor? shs", shs);
    visit("Tensor? colors_precomp", colors_precomp);
    visit("Tensor? scales", scales);
    visit("Tensor? rotations", rotations);
    visit("Tensor? cov3D_precomp", cov3D_precomp);
    visit("Tensor viewmatrix", viewmatrix);
    visit("Tensor projmatrix", projmatrix);
    visit("Tensor campos", campos);
    visit("Tensor? lens", lens);
    visit("int image_height", image_height);
    visit("int image_width", image_width);
    visit("float[] tanfovx", tanfovx);
    visit("float[] tanfovy", tanfovy);
    visit("float scale_modifier", scale_modifier);
    visit("int sh_degree", sh_degree);
    visit("str footprint", footprint);
    visit("float option", option);
  }
};

/// Arguments of `bin`: the rows that `project` made for C cameras, camera after camera.
struct BinArguments {
  Tensor means2d, cov2d, dets, opacities, depths;
  OptionalTensor colors, background;  ///< (N, 3), (3,): what `adaptive` chooses samples by
  Tensor row_splits;                  ///< (C + 1,) int64 on the CPU, first row of each camera
  int64_t image_height = 0, image_width = 0;
  std::string footprint;
  double option = 0;
  bool keep = true;

  template <class Visit> void each(Visit&& visit) {
    visit("Tensor means2d", means2d);
    visit("Tensor cov2d", cov2d);
    visit("Tensor dets", dets);
    visit("Tensor opacities", opacities);
    visit("Tensor depths", depths);
    visit("Tensor? colors", colors);
    visit("Tensor? background", background);
    visit("Tensor row_splits", row_splits);
    visit("int image_height", image_height);
    visit("int image_width", image_width);
    visit("str footprint", footprint);
    visit("float option", option);
    visit("bool keep=True", keep);
  }
};

/// Arguments of `blend`.
struct BlendArguments {
  Tensor means2d, cov2d, opacities, features, background;
  OptionalTensor means2d_abs;  ///< its values are ignored; its gradient is the sum over pixels of |dL/dmeans2d|
  Tensor dets, row_splits;
  std::vector<Tensor> lists;  ///< of `bin`
  int64_t image_height = 0, image_width = 0;
  std::string footprint;
  double option = 0;
  bool keep = false;

  template <class Visit> void each(Visit&& visit) {
    visit("Tensor means2d", means2d);
    visit("Tensor cov2d", cov2d);
    visit("Tensor opacities", opacities);
    visit("Tensor features", features);
    visit("Tensor background", background);
    visit("Tensor? means2d_abs", means2d_abs);
    visit("Tensor dets", dets);
    visit("Tensor row_splits", row_splits);
    visit("Tensor[] lists", lists);
    visit("int image_height", image_height);
    visit("int image_width", image_width);
    visit("str footprint", footprint);
    visit("float option", option);
    visit("bool keep=False", keep);
  }
};

/// Arguments of `inspect`: what every pixel shows of the Gaussians that `lists` of rasterize hold, and how much of each
/// of the `count` Gaussians is seen.
struct InspectArguments {
  std::vector<Tensor> saved;
  int64_t count = 0, image_height = 0, image_width = 0;
  std::string footprint;
  double option = 0;

  template <class Visit> void each(Visit&& visit) {
    visit("Tensor[] saved", saved);
    visit("int count", count);
    visit("int image_height", image_height);
    visit("int image_width", image_width);
    visit("str footprint", footprint);
    visit("float option", option);
  }
};

/// Arguments of `footprint_weight`.
struct WeightArguments {
  Tensor offset, cov2d;
  std::string footprint;
  double option = 0;

  template <class Visit> void each(Visit&& visit) {
    visit("Tensor offset", offset);
    visit("Tensor cov2d", cov2d);
    visit("str footprint", footprint);
    visit("float option", option);
  }
};

/// Arguments of the adjoint of an op: the gradient with respect to its differentiable outputs, its own arguments, what
/// it saved, and which of its tensor arguments want a gradient.
template <class Arguments> struct VjpArguments {
  std::vector<OptionalTensor> dL_doutputs;
  Arguments of_op;
  std::vector<Tensor> saved;
  std::vector<bool> needs;

  template <class Visit> void each(Visit&& visit) {
    visit("Tensor?[] dL_doutputs", dL_doutputs);
    of_op.each([&](const char* declaration, auto& value) {
      // Nothing may follow a default that has none itself.
      const std::string_view text = declaration;
      visit(std::string(text.substr(0, text.find('='))).c_str(), value);
    });
    visit("Tensor[] saved", saved);
    visit("bool[] needs", needs);
  }
};

/// "Tensor means3D, Tensor? means2D, ...".
template <class Arguments> std::string schema_of() {
  std::string text;
  Arguments arguments;
  arguments.each(
      [&](const char* declaration, auto&) { text += (text.empty() ? "" : ", ") + std::string(declaration); });
  return text;
}

inline void assign(const IValue& from, Tensor& to) { to = from.toTensor(); }
inline void assign(const IValue& from, OptionalTensor& to) {
  to = from.isTensor() && from.toTensor().defined() ? OptionalTensor(from.toTensor()) : std::nullopt;
}
inline void assign(const IValue& from, int64_t& to) { to = from.toInt(); }
inline void assign(const IValue& from, double& to) { to = from.toDouble(); }
inline void assign(const IValue& from, bool& to) { to = from.toBool(); }
inline void assign(const IValue& from, std::string& to) { to = from.toStringRef(); }
inline void assign(const IValue& from, std::vector<Tensor>& to) { to = from.toTensorVector(); }
inline void assign(const IValue& from, std::vector<OptionalTensor>& to) {
  to.clear();
  for (const OptionalTensor& t : from.toOptionalTensorVector()) to.push_back(t && t->defined() ? t : std::nullopt);
}
inline void assign(const IValue& from, std::vector<double>& to) { to = from.toDoubleVector(); }
inline void assign(const IValue& from, std::vector<bool>& to) {
  const auto list = from.toBoolList();
  to.assign(list.begin(), list.end());
}

/// Takes an op's arguments off the dispatcher's stack.
template <class Arguments> Arguments take(torch::jit::Stack& stack) {
  Arguments arguments;
  size_t count = 0;
  arguments.each([&](const char*, auto&) { ++count; });
  const IValue* next = stack.data() + (stack.size() - count);
  arguments.each([&](const char*, auto& value) { assign(*next++, value); });
  torch::jit::drop(stack, count);
  return arguments;
}

}  // namespace ar::ops
