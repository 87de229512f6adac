// checks.h for the ops of training.cpp and picture.cpp. Ops that write to their arguments refuse tensors that share
// memory.
#include <ATen/MemoryOverlap.h>

#include <cmath>
#include <vector>

#include "torch/check_tensors.h"
#include "torch/checks.h"

namespace ar::ops {
namespace {

/// (size, stride in bytes) of the dimensions with more than one number.
std::vector<std::pair<int64_t, int64_t>> extents_of(const Tensor& t) {
  std::vector<std::pair<int64_t, int64_t>> extents;
  for (int64_t d = 0; d < t.dim(); ++d) {
    if (t.size(d) > 1) extents.emplace_back(t.size(d), t.stride(d) * t.element_size());
  }
  return extents;
}

/// As in an expanded tensor. Not if each stride exceeds what lies within smaller ones.
bool may_overlap_itself(const Tensor& t) {
  auto extents = extents_of(t);
  std::sort(extents.begin(), extents.end(), [](const auto& x, const auto& y) { return x.second < y.second; });
  int64_t last = 0;  // Byte of the last number within the smaller strides.
  for (const auto& [size, stride] : extents) {
    if (stride <= last) return true;
    last += (size - 1) * stride;
  }
  return false;
}

/// Bytes from the start of the first number to the end of the last.
int64_t span_of(const Tensor& t) {
  int64_t last = 0;
  for (const auto& [size, stride] : extents_of(t)) last += (size - 1) * stride;
  return last + t.element_size();
}

/// Whether two tensors alternate in memory, as columns of a matrix: modulo a stride, their addresses are disjoint
/// intervals.
bool are_interleaved(const Tensor& a, const Tensor& b) {
  const auto extents_a = extents_of(a), extents_b = extents_of(b);
  const int64_t distance = static_cast<const char*>(b.const_data_ptr()) - static_cast<const char*>(a.const_data_ptr());
  const auto apart = [&](int64_t divisor) {
    const auto width = [&](const auto& extents, int64_t size_of_one) {
      for (const auto& [size, stride] : extents) size_of_one += stride % divisor ? (size - 1) * stride : 0;
      return size_of_one;
    };
    const int64_t between = (distance % divisor + divisor) % divisor;
    return width(extents_a, a.element_size()) <= between && between + width(extents_b, b.element_size()) <= divisor;
  };
  const auto by_stride = [&](const auto& extent) { return apart(extent.second); };
  return std::any_of(extents_a.begin(), extents_a.end(), by_stride) ||
         std::any_of(extents_b.begin(), extents_b.end(), by_stride);
}

/// With written memory in two tensors the result would depend on the order.
void check_overlaps(const AdamArguments& a) {
  struct Range {
    const char *begin, *end;
    bool written;
    const Tensor* tensor;
  };
  std::vector<Range> ranges;
  ranges.reserve(4 * a.params.size());
  const auto add = [&](const std::vector<Tensor>& tensors, bool written) {
    for (const Tensor& t : tensors) {
      const char* begin = static_cast<const char*>(t.const_data_ptr());
      const int64_t bytes = t.is_contiguous() ? int64_t(t.nbytes()) : span_of(t);
      if (t.numel() > 0) ranges.push_back({begin, begin + bytes, written, &t});
    }
  };
  add(a.params, true);
  add(a.exp_avgs, true);
  add(a.exp_avg_sqs, true);
  add(a.grads, false);
  std::sort(ranges.begin(), ranges.end(), [](const Range& x, const Range& y) { return x.begin < y.begin; });
  bool apart = true;
  const char *end = nullptr, *written_end = nullptr;  // Of earlier ranges.
  for (const Range& range : ranges) {
    apart = apart && range.begin >= (range.written ? end : written_end);
    end = std::max(end, range.end);
    if (range.written) written_end = std::max(written_end, range.end);
  }
  if (apart) return;
  for (auto x = ranges.begin(); x != ranges.end(); ++x) {
    for (auto y = x + 1; y != ranges.end() && y->begin < x->end; ++y) {
      TORCH_CHECK_VALUE(!(x->written || y->written) || are_interleaved(*x->tensor, *y->tensor),
                        "params, exp_avgs and exp_avg_sqs must not share memory with each other or with grads");
    }
  }
}

void check_target_type(const Tensor& target, const Like& like) {
  const Tensor& other = like.tensor;
  TORCH_CHECK_TYPE(target.scalar_type() == other.scalar_type() || target.scalar_type() == at::kByte,
                   "target must have the dtype of ", like.name, ", ", other.scalar_type(), ", or uint8, got ",
                   target.scalar_type(), way_out_of(target.scalar_type()));
  TORCH_CHECK_VALUE(target.device() == other.device(), "target must be on the device of ", like.name, ", ",
                    other.device(), ", got ", target.device());
}

void check_weights(double opacity_weight, double scale_weight) {
  TORCH_CHECK_VALUE(std::isfinite(opacity_weight) && std::isfinite(scale_weight),
                    "opacity_weight and scale_weight must be finite, got ", opacity_weight, " and ", scale_weight);
}

/// Raises unless a tensor has a number for each pixel of the target (3, H, W).
void check_pixels(const Tensor& t, const char* name, const Like& like, const Tensor& target) {
  like.check_type(t, name);
  const std::vector<int64_t> pixels = {target.size(1), target.size(2)};
  check_shape(t.sizes() == at::IntArrayRef(pixels), t, name, text_of(pixels));
}

/// `like`: of the rendering, which has this size.
void check_correction(const OptionalTensor& matrix, const char* name, const OptionalTensor& vignetting,
                      const std::vector<double>& center, const Like& like) {
  if (matrix) {
    like.check_type(*matrix, name);
    check_shape(matrix->sizes() == at::IntArrayRef({3, 4}), *matrix, name, "(3, 4)");
  }
  const size_t numbers = vignetting ? 2 : 0;
  TORCH_CHECK_VALUE(center.size() == numbers, "center must have two numbers with vignetting, and none without, got ",
                    center.size());
  if (!vignetting) return;
  like.check_type(*vignetting, "vignetting");
  check_shape(vignetting->sizes() == at::IntArrayRef({2}), *vignetting, "vignetting", "(2,)");
  TORCH_CHECK_VALUE(std::isfinite(center[0]) && std::isfinite(center[1]), "center must be finite, got ", center[0],
                    " and ", center[1]);
}

void check_loss(const LossArguments& a, const Like& like, int64_t height, int64_t width) {
  TORCH_CHECK_VALUE(a.ssim_weight >= 0 && a.ssim_weight <= 1, "ssim_weight must be in [0, 1], got ", a.ssim_weight);
  like.check_type(a.dL_dloss, "dL_dloss");
  check_shape(a.dL_dloss.dim() == 0, a.dL_dloss, "dL_dloss", "()");
  check_target_type(a.target, like);
  const int64_t times = a.supersampling;
  TORCH_CHECK_VALUE(times >= 1 && height % times == 0 && width % times == 0,
                    "supersampling must be at least 1 and divide image_height and image_width, ", height, " and ",
                    width, ", got ", times);
  const std::vector<int64_t> image = {3, height / times, width / times};
  check_shape(a.target.sizes() == at::IntArrayRef(image), a.target, "target", text_of(image));
  check_correction(a.exposure, "exposure", a.vignetting, a.center, like);
  if (a.mask) check_pixels(*a.mask, "mask", like, a.target);
}

}  // namespace

void check(SsimArguments& a) {
  const Tensor &image = a.image, &target = a.target;
  check_floating(image, "image");
  check_target_type(target, {image, "image"});
  check_shape(image.dim() == 3 || image.dim() == 4, image, "image", "(C, H, W) or (B, C, H, W)");
  check_shape(target.sizes() == image.sizes(), target, "target", "that of image, ", shape_of(image));
  // The mean over nothing is NaN.
  TORCH_CHECK_VALUE(image.numel() > 0, "image must have at least one pixel, got shape ", shape_of(image));
  constexpr int64_t kMax = int64_t(1) << 30;
  const int64_t planes = image.numel() / (image.size(-1) * image.size(-2));
  TORCH_CHECK_VALUE(image.size(-1) <= kMax && image.size(-2) <= kMax && planes <= kMax, "image must have at most ",
                    kMax, " rows, columns and channels of the whole batch, got shape ", shape_of(image));
  a.image = a.image.contiguous();
  a.target = a.target.contiguous();
}

void check(ActivateArguments& a) {
  check_floating(a.log_scales, "log_scales");
  check_shape(a.log_scales.dim() == 2 && a.log_scales.size(1) == 3, a.log_scales, "log_scales", "(N, 3)");
  a.log_scales = a.log_scales.contiguous();
  const Like like{a.log_scales, "log_scales"};
  like.check_rows_of(a.quats, "quats", {4}, "(N, 4)");
  like.check_rows_of(a.logit_opacities, "logit_opacities", {1}, "(N, 1)");
  check_weights(a.opacity_weight, a.scale_weight);
}

void check(FilterArguments& a) {
  check_floating(a.scales, "scales");
  check_shape(a.scales.dim() == 2 && a.scales.size(1) == 3, a.scales, "scales", "(P, 3)");
  a.scales = a.scales.contiguous();
  const Like like{a.scales, "scales"};
  const bool flat = a.opacities.dim() == 1;
  if (flat) like.check_rows_of(a.opacities, "opacities", {}, "(P,)");
  if (!flat) like.check_rows_of(a.opacities, "opacities", {1}, "(P, 1) or (P,)");
  like.check_rows_of(a.filter_3d, "filter_3d", {}, "(P,)");
}

void check(ObserveArguments& a) {
  const Tensor& sums = a.gradient_sums;
  check_floating(sums, "gradient_sums");
  check_shape(sums.dim() == 1 && sums.is_contiguous(), sums, "gradient_sums", "(P,), contiguous");
  const Like like{sums, "gradient_sums"};
  const auto check_counts = [&](const Tensor& t, const char* name) {
    TORCH_CHECK_TYPE(t.scalar_type() == at::kInt, name, " must have dtype int32, got ", t.scalar_type());
    TORCH_CHECK_VALUE(t.device() == sums.device(), name, " must be on the device of gradient_sums, ", sums.device(),
                      ", got ", t.device());
    check_shape(t.sizes() == sums.sizes(), t, name, "(P,) with P = ", sums.numel());
  };
  check_counts(a.views, "views");
  TORCH_CHECK_VALUE(a.views.is_contiguous(), "views must be contiguous, got strides ", a.views.strides());
  check_counts(a.radii, "radii");
  a.radii = a.radii.contiguous();
  const int64_t columns = a.gradients.dim() == 2 && a.gradients.size(1) == 4 ? 4 : 3;
  like.check_rows_of(a.gradients, "gradients", {columns}, "(P, 3) or (P, 4)");
  TORCH_CHECK_VALUE(a.first_column >= 0 && a.first_column <= columns - 2, "first_column must be 0 to ", columns - 2,
                    ", got ", a.first_column);
  const auto apart = [](const Tensor& x, const Tensor& y) {
    return at::get_overlap_status(x, y) == at::MemOverlapStatus::No;
  };
  TORCH_CHECK_VALUE(apart(sums, a.views) && apart(sums, a.gradients) && apart(sums, a.radii) &&
                        apart(a.views, a.gradients) && apart(a.views, a.radii),
                    "gradient_sums and views must not share memory with each other or with gradients and radii");
}

void check(NoiseArguments& a) {
  check_floating(a.means, "means");
  check_shape(a.means.dim() == 2 && a.means.size(1) == 3, a.means, "means", "(N, 3)");
  const Like like{a.means, "means"};
  like.check_rows_of(a.log_scales, "log_scales", {3}, "(N, 3)");
  like.check_rows_of(a.quats, "quats", {4}, "(N, 4)");
  like.check_rows_of(a.logit_opacities, "logit_opacities", {1}, "(N, 1)");
  like.check_rows_of(a.normals, "normals", {3}, "(N, 3)");
  TORCH_CHECK_VALUE(std::isfinite(a.strength) && a.strength >= 0, "strength must be finite and not negative, got ",
                    a.strength);
  bool apart = !may_overlap_itself(a.means);
  for (const Tensor& t : {a.log_scales, a.quats, a.logit_opacities, a.normals})
    apart = apart && at::get_overlap_status(a.means, t) != at::MemOverlapStatus::Full &&
            at::get_overlap_status(a.means, t) != at::MemOverlapStatus::Partial;
  TORCH_CHECK_VALUE(apart, "means must not share memory with the others, or within itself");
}

void check(CorrectArguments& a) {
  check_floating(a.image, "image");
  check_shape(a.image.dim() == 3 && a.image.size(0) == 3, a.image, "image", "(3, H, W)");
  TORCH_CHECK_VALUE(a.image.numel() > 0, "image must have at least one pixel, got shape ", shape_of(a.image));
  check_image_size(a.image.size(1), a.image.size(2));
  a.image = a.image.contiguous();
  const Like like{a.image, "image"};
  check_correction(a.matrix, "matrix", a.vignetting, a.center, like);
  if (a.matrix) a.matrix = a.matrix->contiguous();
  if (a.vignetting) a.vignetting = a.vignetting->contiguous();
}

void check(PictureArguments& a) {
  TORCH_CHECK_VALUE(a.mean_columns == 0 || a.mean_columns == 3 || a.mean_columns == 4,
                    "mean_columns must be 0, 3 or 4, got ", a.mean_columns);
  check_floating(a.means, "means");
  check_shape(a.means.dim() == 2 && a.means.size(1) == 3, a.means, "means", "(N, 3)");
  a.means = a.means.contiguous();
  const Like like{a.means, "means"};
  like.check_rows_of(a.log_scales, "log_scales", {3}, "(N, 3)");
  check_loss(a, like, a.image_height, a.image_width);
  like.check_rows_of(a.filter_3d, "filter_3d", {}, "(N,)");
  check_weights(a.opacity_weight, a.scale_weight);
  TORCH_CHECK_VALUE(std::isfinite(a.turn) && a.turn >= 0, "turn must be finite and not negative, got ", a.turn);
  const bool deep = a.depth_target.has_value();
  TORCH_CHECK_VALUE(deep == a.depth_shares.has_value(), "depth_target and depth_shares must be given together");
  TORCH_CHECK_VALUE(std::isfinite(a.depth_weight) && a.depth_weight >= 0,
                    "depth_weight must be finite and not negative, got ", a.depth_weight);
  TORCH_CHECK_VALUE(std::isfinite(a.depth_margin) && a.depth_margin > 0,
                    "depth_margin must be finite and positive, got ", a.depth_margin);
  if (deep) check_pixels(*a.depth_target, "depth_target", like, a.target);
  if (deep) check_pixels(*a.depth_shares, "depth_shares", like, a.target);
}

void check(RowsPictureArguments& a) {
  check_floating(a.rows, "rows");
  check_loss(a, {a.rows, "rows"}, a.image_height, a.image_width);
}

void check(AdamArguments& a) {
  const size_t count = a.params.size();
  const auto check_count = [&](size_t members, const char* name) {
    TORCH_CHECK_VALUE(members == count, name, " must have as many members as params, ", count, ", got ", members);
  };
  check_count(a.grads.size(), "grads");
  check_count(a.exp_avgs.size(), "exp_avgs");
  check_count(a.exp_avg_sqs.size(), "exp_avg_sqs");
  check_count(a.rates.size(), "rates");
  check_count(a.steps.size(), "steps");
  const bool with_heads = !a.heads.empty() || !a.head_rates.empty();
  if (with_heads) {
    check_count(a.heads.size(), "heads");
    check_count(a.head_rates.size(), "head_rates");
  }
  TORCH_CHECK_VALUE(a.beta1 >= 0 && a.beta1 < 1, "beta1 must be in [0, 1), got ", a.beta1);
  TORCH_CHECK_VALUE(a.beta2 >= 0 && a.beta2 < 1, "beta2 must be in [0, 1), got ", a.beta2);
  TORCH_CHECK_VALUE(std::isfinite(a.eps) && a.eps >= 0, "eps must be finite and not negative, got ", a.eps);

  const auto check_tensor = [&](const Tensor& t, const char* list, size_t i) {
    const Tensor &first = a.params[0], &param = a.params[i];
    TORCH_CHECK_TYPE(t.scalar_type() == first.scalar_type(), list, "[", i, "] must have the dtype of params[0], ",
                     first.scalar_type(), ", got ", t.scalar_type());
    TORCH_CHECK_VALUE(t.device() == first.device(), list, "[", i, "] must be on the device of params[0], ",
                      first.device(), ", got ", t.device());
    TORCH_CHECK_VALUE(t.sizes() == param.sizes(), list, "[", i, "] must have the shape of params[", i, "], ",
                      shape_of(param), ", got ", shape_of(t));
  };
  const auto check_written = [&](const Tensor& t, const char* list, size_t i) {
    check_tensor(t, list, i);
    TORCH_CHECK_VALUE(t.is_contiguous() || !may_overlap_itself(t), list, "[", i,
                      "] must have memory of its own for every number, which an expanded tensor has not (clone() has), "
                      "got shape ",
                      shape_of(t), " with strides ", text_of(t.strides()));
  };
  const auto check_rate = [&](double rate, const char* list, size_t i) {
    TORCH_CHECK_VALUE(std::isfinite(float(rate)) && rate >= 0, list, "[", i, "] must be finite and not negative, got ",
                      rate);
  };
  for (size_t i = 0; i < count; ++i) {
    check_rate(a.rates[i], "rates", i);
    TORCH_CHECK_VALUE(a.steps[i] >= 1, "steps[", i, "] must be at least 1, got ", a.steps[i]);
    check_floating(a.params[i], "params");
    check_written(a.params[i], "params", i);
    check_tensor(a.grads[i], "grads", i);
    check_written(a.exp_avgs[i], "exp_avgs", i);
    check_written(a.exp_avg_sqs[i], "exp_avg_sqs", i);
    if (with_heads && a.heads[i] != 0) {
      check_rate(a.head_rates[i], "head_rates", i);
      const Tensor& param = a.params[i];
      const int64_t most = param.dim() >= 1 && param.size(0) > 0 ? param.numel() / param.size(0) : a.heads[i];
      TORCH_CHECK_VALUE(a.heads[i] > 0 && a.heads[i] <= most && param.dim() >= 1, "heads[", i,
                        "] must be 0 to the size of a row of params[", i, "], got ", a.heads[i], " and shape ",
                        shape_of(param));
    }
    if (!a.rows) continue;
    TORCH_CHECK_VALUE(a.params[i].dim() >= 1 && a.params[i].size(0) == a.rows->numel(), "params[", i,
                      "] must have a row for each of rows, ", a.rows->numel(), ", got shape ", shape_of(a.params[i]));
  }
  if (a.rows) {
    TORCH_CHECK_TYPE(a.rows->scalar_type() == at::kBool || a.rows->scalar_type() == at::kByte,
                     "rows must have dtype bool or uint8, got ", a.rows->scalar_type());
    check_shape(a.rows->dim() == 1, *a.rows, "rows", "(P,)");
    TORCH_CHECK_VALUE(count == 0 || a.rows->device() == a.params[0].device(),
                      "rows must be on the device of params, got ", a.rows->device());
    a.rows = a.rows->contiguous();
  }
  for (Tensor& grad : a.grads) grad = grad.contiguous();
  check_overlaps(a);
}

}  // namespace ar::ops
