#include "torch/checks.h"

#include <sstream>

#include "core/camera.h"
#include "core/sh.h"

namespace ar::ops {
namespace {

/// -1 stands for P, any number of Gaussians.
void check_shape(const Tensor& t, const char* name, int64_t count, std::initializer_list<int64_t> rest,
                 const char* expected) {
  const bool ok = t.dim() == int64_t(1 + rest.size()) && t.size(0) == count &&
                  std::equal(rest.begin(), rest.end(), t.sizes().begin() + 1);
  TORCH_CHECK_VALUE(ok, name, " must have shape ", expected, count >= 0 ? " with P = " + std::to_string(count) : "",
                    ", got ", shape_of(t));
}

void check_matrix(Tensor& t, const char* name) {
  const bool ok = (t.dim() == 2 || (t.dim() == 3 && t.size(0) == 1)) && t.size(-1) == 4 && t.size(-2) == 4;
  TORCH_CHECK_VALUE(ok, name, " must have shape (4, 4) or (1, 4, 4), got ", shape_of(t));
  t = t.reshape({4, 4}).contiguous();
}

void check_vector(Tensor& t, const char* name) {
  TORCH_CHECK_VALUE(t.numel() == 3 && (t.dim() == 1 || (t.dim() == 2 && t.size(0) == 1)), name,
                    " must have shape (3,) or (1, 3), got ", shape_of(t));
  t = t.reshape({3}).contiguous();
}

void check_positive(double value, const char* name) {
  // As a float, too: what is zero or infinite there makes the projection so.
  TORCH_CHECK_VALUE(std::isfinite(float(value)) && float(value) > 0, name, " must be positive and finite, got ", value);
}

void check_finite(const Tensor& t, const char* name) {
  const Tensor finite = at::isfinite(t);
  if (finite.all().item<bool>()) return;
  const int64_t first = finite.logical_not().reshape(-1).nonzero()[0].item<int64_t>(), columns = t.size(-1);
  TORCH_CHECK_VALUE(false, name, " must be finite, got ", t.reshape(-1)[first].item<double>(), " at (",
                    t.dim() == 1 ? "" : std::to_string(first / columns) + ", ", first % columns,
                    t.dim() == 1 ? ",)" : ")");
}

}  // namespace

std::string shape_of(const Tensor& t) {
  std::ostringstream out;
  out << "(";
  for (int64_t d = 0; d < t.dim(); ++d) out << (d ? ", " : "") << t.size(d);
  out << (t.dim() == 1 ? ",)" : ")");
  return out.str();
}

void check_floating(const Tensor& t, const char* name) {
  TORCH_CHECK_TYPE(t.scalar_type() == at::kFloat || t.scalar_type() == at::kDouble, name,
                   " must have dtype float32 or float64, got ", t.scalar_type());
}

void check_like(const Tensor& t, const char* name, const Tensor& like, const char* like_name) {
  TORCH_CHECK_TYPE(t.scalar_type() == like.scalar_type(), name, " must have the dtype of ", like_name, ", ",
                   like.scalar_type(), ", got ", t.scalar_type());
  TORCH_CHECK_VALUE(t.device() == like.device(), name, " must be on the device of ", like_name, ", ", like.device(),
                    ", got ", t.device());
}

void check_weight_arguments(const Tensor& offset, const Tensor& cov2d, double option) {
  check_floating(offset, "offset");
  TORCH_CHECK_VALUE(offset.dim() >= 1 && offset.size(-1) == 2, "offset must have shape (..., 2), got ",
                    shape_of(offset));
  check_like(cov2d, "cov2d", offset, "offset");
  TORCH_CHECK_VALUE(cov2d.dim() == offset.dim() && cov2d.size(-1) == 3 &&
                        cov2d.sizes().slice(0, cov2d.dim() - 1) == offset.sizes().slice(0, offset.dim() - 1),
                    "cov2d must have shape (..., 3) with the leading sizes of offset ", shape_of(offset), ", got ",
                    shape_of(cov2d));
  TORCH_CHECK_VALUE(std::isfinite(option) && option >= 0, "option must be finite and not negative, got ", option);
}

void check_lists(const Tensor& splats, const std::vector<Tensor>& lists) {
  check_floating(splats, "splats");
  TORCH_CHECK_VALUE(splats.dim() == 2 && splats.size(1) == kSplatWidth && splats.is_contiguous(),
                    "splats must be an output of rasterize with keep=True, got shape ", shape_of(splats));
  for (const Tensor& t : lists) {
    TORCH_CHECK_VALUE(t.device() == splats.device() && t.is_contiguous(),
                      "ids ... tile_samples must be contiguous, on the device of splats, ", splats.device(),
                      ", got a tensor of shape ", shape_of(t), " on ", t.device());
  }
}

void check_channels(const Tensor& colors, const Tensor& bg, const Tensor& splats) {
  check_like(colors, "colors", splats, "splats");
  TORCH_CHECK_VALUE(colors.dim() == 2 && colors.size(1) == 3, "colors must have shape (P, 3), got ", shape_of(colors));
  check_like(bg, "bg", splats, "splats");
  TORCH_CHECK_VALUE(bg.dim() == 1 && bg.size(0) == 3, "bg must have shape (3,), got ", shape_of(bg));
}

void check_image_size(int64_t height, int64_t width) {
  // float32 counts pixels exactly up to 2^24; 2^20 leaves four bits for where in the pixel.
  constexpr int64_t kMax = int64_t(1) << 20;
  TORCH_CHECK_VALUE(height >= 1 && height <= kMax, "image_height must be in [1, ", kMax, "], got ", height);
  TORCH_CHECK_VALUE(width >= 1 && width <= kMax, "image_width must be in [1, ", kMax, "], got ", width);
}

void Inputs::check() {
  TORCH_CHECK_VALUE(means3D.dim() == 2 && means3D.size(1) == 3, "means3D must have shape (P, 3), got ",
                    shape_of(means3D));
  check_floating(means3D, "means3D");
  const int64_t p = count();
  TORCH_CHECK_VALUE(p < (int64_t(1) << 31), "means3D must have fewer than 2^31 rows, got ", p);

  const auto check_per_gaussian = [&](Tensor& t, const char* name, std::initializer_list<int64_t> rest,
                                      const char* expected) {
    check_like(t, name, means3D, "means3D");
    check_shape(t, name, p, rest, expected);
    t = t.contiguous();
  };
  means3D = means3D.contiguous();
  if (opacities.dim() == 1) {
    check_per_gaussian(opacities, "opacities", {}, "(P, 1) or (P,)");
  } else {
    check_per_gaussian(opacities, "opacities", {1}, "(P, 1) or (P,)");
  }
  if (means2D) {
    if (means2D->dim() == 2 && means2D->size(1) == 4) {
      check_per_gaussian(*means2D, "means2D", {4}, "(P, 3) or (P, 4)");
    } else {
      check_per_gaussian(*means2D, "means2D", {3}, "(P, 3) or (P, 4)");
    }
  }
  TORCH_CHECK_VALUE(shs.has_value() != colors_precomp.has_value(),
                    "exactly one of shs and colors_precomp must be given, got ", shs ? "both" : "neither");
  const int degrees = lens ? FullCamera<float>::kShDegree : Camera<float>::kShDegree;
  TORCH_CHECK_VALUE(sh_degree >= 0 && sh_degree <= degrees, "sh_degree must be 0 to ", degrees, ", got ", sh_degree);
  if (shs) {
    const int64_t needed = sh_count(int(sh_degree));
    TORCH_CHECK_VALUE(shs->dim() == 3 && shs->size(0) == p && shs->size(1) >= needed && shs->size(2) == 3,
                      "shs must have shape (P, M, 3) with P = ", p, " and M >= ", needed, " for sh_degree ", sh_degree,
                      ", got ", shape_of(*shs));
    check_like(*shs, "shs", means3D, "means3D");
    shs = shs->contiguous();
  } else {
    check_per_gaussian(*colors_precomp, "colors_precomp", {3}, "(P, 3)");
  }
  TORCH_CHECK_VALUE(scales.has_value() == rotations.has_value(),
                    "scales and rotations must be given together, got only ", scales ? "scales" : "rotations");
  TORCH_CHECK_VALUE(scales.has_value() != cov3D_precomp.has_value(),
                    "exactly one of scales with rotations and cov3D_precomp must be given, got ",
                    scales ? "both" : "neither");
  if (scales) {
    check_per_gaussian(*scales, "scales", {3}, "(P, 3)");
    check_per_gaussian(*rotations, "rotations", {4}, "(P, 4)");
  } else {
    check_per_gaussian(*cov3D_precomp, "cov3D_precomp", {6}, "(P, 6)");
  }

  check_like(background, "bg", means3D, "means3D");
  check_like(viewmatrix, "viewmatrix", means3D, "means3D");
  check_like(projmatrix, "projmatrix", means3D, "means3D");
  check_like(campos, "campos", means3D, "means3D");
  check_vector(background, "bg");
  check_matrix(viewmatrix, "viewmatrix");
  check_matrix(projmatrix, "projmatrix");
  check_vector(campos, "campos");
  if (lens) {
    check_like(*lens, "lens", means3D, "means3D");
    TORCH_CHECK_VALUE(lens->dim() == 1 && lens->size(0) == kLensWidth, "lens must have shape (", kLensWidth, ",), got ",
                      shape_of(*lens));
    lens = lens->contiguous();
  }
  check_image_size(image_height, image_width);
  check_positive(tanfovx, "tanfovx");
  check_positive(tanfovy, "tanfovy");
  check_positive(scale_modifier, "scale_modifier");
  TORCH_CHECK_VALUE(std::isfinite(option) && option >= 0, "option must be finite and not negative, got ", option);
}

void check_weight_gradient(const Tensor& dL_dweight, const Tensor& offset) {
  check_like(dL_dweight, "dL_dweight", offset, "offset");
  TORCH_CHECK_VALUE(dL_dweight.sizes() == offset.sizes().slice(0, offset.dim() - 1),
                    "dL_dweight must have the leading sizes of offset ", shape_of(offset), ", got ",
                    shape_of(dL_dweight));
}

void Inputs::check_gradient(const Tensor& dL_dcolor, const OptionalTensor& dL_dalpha) const {
  check_like(dL_dcolor, "dL_dcolor", means3D, "means3D");
  TORCH_CHECK_VALUE(dL_dcolor.sizes() == at::IntArrayRef({3, image_height, image_width}),
                    "dL_dcolor must have shape (3, ", image_height, ", ", image_width, "), got ", shape_of(dL_dcolor));
  if (!dL_dalpha) return;
  check_like(*dL_dalpha, "dL_dalpha", means3D, "means3D");
  TORCH_CHECK_VALUE(dL_dalpha->sizes() == at::IntArrayRef({image_height, image_width}), "dL_dalpha must have shape (",
                    image_height, ", ", image_width, "), got ", shape_of(*dL_dalpha));
}

void Inputs::check_camera() const {
  check_finite(background, "bg");
  check_finite(viewmatrix, "viewmatrix");
  check_finite(projmatrix, "projmatrix");
  check_finite(campos, "campos");
  // Up to far, which may be infinite.
  if (lens) check_finite(lens->narrow(0, 0, offsetof(Lens<float>, far) / sizeof(float)), "lens");
}

}  // namespace ar::ops
