// Schemas of the ops, and the Python module that loads them.
#include <pybind11/pybind11.h>
#include <torch/library.h>

#include "cpu/tasks.h"

// A splat, pair and tile order that only rasterize and its vjp share travel as tensors of their own:
// `splats` (V, K) rows of Splat<F, T>, `ids` (V,) the Gaussian of each, `pairs` (N,) splats by tile and
// depth, `tile_offsets` (tiles + 1,), and for the backward pass `splat_offsets` (V + 1,) and
// `positions` (N,), the places in pairs of each splat, `transmittance` and `last` (samples, H, W).
// Without `keep` those that only the backward pass reads are empty.
TORCH_LIBRARY(analytic_rasterizer, m) {
  m.def(
      "rasterize(Tensor means3D, Tensor? means2D, Tensor opacities, Tensor? shs, Tensor? colors_precomp, Tensor? "
      "scales, "
      "Tensor? rotations, Tensor? cov3D_precomp, Tensor bg, Tensor viewmatrix, Tensor projmatrix, Tensor campos, "
      "int image_height, int image_width, float tanfovx, float tanfovy, float scale_modifier, int sh_degree, str "
      "footprint, "
      "float variance, bool keep) -> (Tensor color, Tensor radii, Tensor splats, Tensor ids, Tensor pairs, Tensor "
      "tile_offsets, "
      "Tensor splat_offsets, Tensor positions, Tensor transmittance, Tensor last)");
  m.def(
      "rasterize_vjp(Tensor dL_dcolor, Tensor means3D, Tensor? means2D, Tensor opacities, Tensor? shs, Tensor? "
      "colors_precomp, "
      "Tensor? scales, Tensor? rotations, Tensor? cov3D_precomp, Tensor bg, Tensor viewmatrix, Tensor projmatrix, "
      "Tensor campos, int image_height, int image_width, float tanfovx, float tanfovy, float scale_modifier, int "
      "sh_degree, "
      "str footprint, float variance, Tensor splats, Tensor ids, Tensor pairs, Tensor tile_offsets, Tensor "
      "splat_offsets, "
      "Tensor positions, Tensor transmittance, Tensor last, bool[8] needs) -> (Tensor means3D, Tensor means2D, Tensor "
      "opacities, "
      "Tensor shs, Tensor colors_precomp, Tensor scales, Tensor rotations, Tensor cov3D_precomp)");
  m.def(
      "rasterize_stages(Tensor means3D, Tensor opacities, Tensor? shs, Tensor? colors_precomp, Tensor? scales, Tensor? "
      "rotations, "
      "Tensor? cov3D_precomp, Tensor bg, Tensor viewmatrix, Tensor projmatrix, Tensor campos, int image_height, "
      "int image_width, float tanfovx, float tanfovy, float scale_modifier, int sh_degree, str footprint, float "
      "variance) -> "
      "(Tensor color, Tensor radii, Tensor ids, Tensor depths, Tensor means2d, Tensor pairs, Tensor tile_offsets, "
      "Tensor seconds)");
  m.def("footprint_weight(Tensor offset, Tensor cov2d, str footprint, float variance) -> Tensor");
  m.def(
      "footprint_weight_vjp(Tensor dL_dweight, Tensor offset, Tensor cov2d, str footprint, float variance) -> "
      "(Tensor offset, Tensor cov2d)");
}

PYBIND11_MODULE(_C, m) {
  m.doc() = "Loads the ops of analytic_rasterizer into torch.ops.analytic_rasterizer.";
  m.def("instruction_set", &ar::cpu::instruction_set, "Instruction set that the CPU path runs on.");
}
