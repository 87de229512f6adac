// Arguments of ops with several cameras, or batches of Gaussians.
#include <string>
#include <type_traits>

#include "core/lens.h"
#include "torch/check_tensors.h"
#include "torch/checks.h"

namespace ar::ops {
namespace {

/// A tensor of all batches has `dims` + 1 dimensions; of `by_camera` too.
void check_batches(const ProjectArguments& a, const OptionalTensor& t, const char* name, int64_t dims, bool by_camera) {
  if (!t || (t->dim() == dims && a.batches() == 1) || t->dim() < dims) return;
  const bool ok = t->dim() == dims + 1 && (t->size(0) == a.batches() || (by_camera && t->size(0) == a.cameras()));
  TORCH_CHECK_VALUE(ok, name, " must have a part for each of ", a.batches(), " batches",
                    by_camera ? " or for each camera" : "", ", got shape ", shape_of(*t));
}

}  // namespace

ProjectArguments batch_of(const BatchArguments& a) {
  ProjectArguments out;
  static_cast<BatchArguments&>(out) = a;
  return out;
}

int64_t check_cameras(ProjectArguments& a) {
  check_shape((a.means3D.dim() == 2 || a.means3D.dim() == 3) && a.means3D.size(-1) == 3, a.means3D, "means3D",
              "(P, 3)");
  for (Tensor* matrix : {&a.viewmatrix, &a.projmatrix}) {
    if (matrix->dim() == 2) *matrix = matrix->unsqueeze(0);
  }
  if (a.campos.dim() == 1) a.campos = a.campos.unsqueeze(0);
  if (a.lens && a.lens->dim() == 1) a.lens = a.lens->unsqueeze(0);
  const bool ok = a.viewmatrix.dim() == 3 && a.viewmatrix.size(1) == 4 && a.viewmatrix.size(2) == 4;
  check_shape(ok, a.viewmatrix, "viewmatrix", "(C, 4, 4)");
  const int64_t cameras = a.cameras(), batches = a.batches();
  check_rows(a.projmatrix, "projmatrix", cameras, {4, 4}, "(C, 4, 4)");
  check_rows(a.campos, "campos", cameras, {3}, "(C, 3)");
  if (a.lens) check_rows(*a.lens, "lens", cameras, {kLensWidth}, ("(C, " + std::to_string(kLensWidth) + ")").c_str());
  TORCH_CHECK_VALUE(int64_t(a.tanfovx.size()) == cameras && int64_t(a.tanfovy.size()) == cameras,
                    "tanfovx and tanfovy must have a number for each of ", cameras, " cameras, got ", a.tanfovx.size(),
                    " and ", a.tanfovy.size());
  TORCH_CHECK_VALUE(!(a.shs && a.colors_precomp), "at most one of shs and colors_precomp must be given, got both");
  TORCH_CHECK_VALUE(!a.colors_precomp || (a.colors_precomp->dim() == 2 && a.colors_precomp->size(1) == 3),
                    "colors_precomp must have shape (P, 3), got ", a.colors_precomp ? shape_of(*a.colors_precomp) : "");
  TORCH_CHECK_VALUE(batches > 0 && cameras % batches == 0, "viewmatrix must have as many cameras for each of ", batches,
                    " batches, got ", cameras);
  check_batches(a, a.shs, "shs", 3, true);
  check_batches(a, a.scales, "scales", 2, false);
  check_batches(a, a.rotations, "rotations", 2, false);
  check_batches(a, a.cov3D_precomp, "cov3D_precomp", 2, false);
  if (batches > 1) check_batches(a, a.opacities, "opacities", 1, false);
  TORCH_CHECK_VALUE(!a.is_table() || a.measured, "measured must be True for a table, got False");
  TORCH_CHECK_VALUE(!a.is_table() || c10::multiply_integers(a.table) == cameras * a.means3D.size(-2),
                    "table must be the sizes of ", cameras * a.means3D.size(-2), " rows, got ", text_of(a.table));
  if (!a.values) return cameras;
  check_batches(a, a.values, "values", 2, true);
  const Like like{a.means3D, "means3D"};
  like.check_type(*a.values, "values");
  const int64_t p = a.means3D.size(-2), colors = a.shs || a.colors_precomp ? 3 : 0;
  const bool fits = a.values->dim() >= 2 && a.values->size(-2) == p && a.values->size(-1) >= 1 &&
                    a.values->size(-1) + colors + (a.shown != "none") <= kMaxChannels;
  check_shape(fits, *a.values, "values", "(P, K) with P = ", p, " and at most ", kMaxChannels, " features in all");
  return cameras;
}

Tensor part_of(const ProjectArguments& a, int64_t c, const Tensor& t, int64_t dims) {
  if (!t.defined() || t.dim() == dims) return t;
  return t.select(0, t.size(0) == a.cameras() ? c : c / (a.cameras() / a.batches()));
}

template <class T> void take_parts(const ProjectArguments& a, int64_t c, SceneTensors<T>& of) {
  const auto take = [&](T& t, int64_t dims) {
    if constexpr (std::is_same_v<T, Tensor>) {
      t = part_of(a, c, t, dims);
    } else if (t) {
      t = part_of(a, c, *t, dims);
    }
  };
  of.means3D = part_of(a, c, of.means3D, 2);
  if (a.means3D.dim() == 3) of.opacities = part_of(a, c, of.opacities, 1);
  take(of.shs, 3);
  take(of.scales, 2);
  take(of.rotations, 2);
  take(of.cov3D_precomp, 2);
}
template void take_parts(const ProjectArguments&, int64_t, SceneTensors<Tensor>&);
template void take_parts(const ProjectArguments&, int64_t, SceneTensors<OptionalTensor>&);

Inputs inputs_of(const ProjectArguments& a, int64_t c) {
  Inputs in;
  static_cast<SceneTensors<OptionalTensor>&>(in) = a;
  take_parts(a, c, in);
  in.viewmatrix = a.viewmatrix[c];
  in.projmatrix = a.projmatrix[c];
  in.campos = a.campos[c];
  if (a.lens) in.lens = (*a.lens)[c];
  in.image_height = a.image_height;
  in.image_width = a.image_width;
  in.tanfovx = a.tanfovx[c];
  in.tanfovy = a.tanfovy[c];
  in.scale_modifier = a.scale_modifier;
  in.sh_degree = a.sh_degree;
  return in;
}

}  // namespace ar::ops
