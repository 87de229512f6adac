// Schemas of the ops, and the Python module that loads them.
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>
#include <torch/library.h>

#include <string>
#include <vector>

#include "core/footprint/registry.h"
#include "cpu/tasks.h"

#if defined(AR_WITH_CUDA)
namespace ar::ops {
void force_pair_capacity(int64_t capacity);
}
#endif

// What only rasterize and its vjp share travels as tensors of its own. On the CPU: `splats` (V, 12) rows of
// Splat<F, T>, `ids` (V,) the Gaussian of each, `pairs` (N,) splats by tile and depth, `tile_offsets`
// (tiles + 1,), and for the backward pass `splat_offsets` (V + 1,) and `positions` (N,), the places in
// pairs of each splat, `transmittance` and `last` (samples, H, W). On CUDA every Gaussian has a row of
// splats, ids are in the order of depth, pairs (room, 2) are splats and slots, `splat_offsets` (P, 2) the
// first slot and the number of them, positions is empty, and there are `checkpoints` (n, samples, 256, 4),
// `chunks` (m, 3) and `counts` (12,), see csrc/cuda/tasks.h. Without `keep` what only the backward pass reads is empty.
// `alpha` holds one image (H, W), 1 - transmittance, if asked for; `camera` of the vjp the gradients of viewmatrix,
// projmatrix, campos and lens, if one is needed. As lists, which are no tensors to make where there is nothing.
// `debug` waits for every stage, so that an error is raised by the stage that caused it.
TORCH_LIBRARY(analytic_rasterizer, m) {
  m.def(
      "rasterize(Tensor means3D, Tensor? means2D, Tensor opacities, Tensor? shs, Tensor? colors_precomp, Tensor? "
      "scales, "
      "Tensor? rotations, Tensor? cov3D_precomp, Tensor bg, Tensor viewmatrix, Tensor projmatrix, Tensor campos, "
      "Tensor? lens, int image_height, int image_width, float tanfovx, float tanfovy, float scale_modifier, int "
      "sh_degree, str "
      "footprint, "
      "float option, bool keep, bool alpha, bool debug) -> (Tensor color, Tensor radii, Tensor splats, "
      "Tensor ids, Tensor pairs, "
      "Tensor "
      "tile_offsets, "
      "Tensor splat_offsets, Tensor positions, Tensor transmittance, Tensor last, Tensor checkpoints, Tensor "
      "chunks, Tensor counts, Tensor tile_samples, Tensor[] alpha)");
  m.def(
      "rasterize_vjp(Tensor dL_dcolor, Tensor? dL_dalpha, Tensor means3D, Tensor? means2D, Tensor opacities, Tensor? "
      "shs, Tensor? "
      "colors_precomp, "
      "Tensor? scales, Tensor? rotations, Tensor? cov3D_precomp, Tensor bg, Tensor viewmatrix, Tensor projmatrix, "
      "Tensor campos, Tensor? lens, int image_height, int image_width, float tanfovx, float tanfovy, float "
      "scale_modifier, int "
      "sh_degree, "
      "str footprint, float option, Tensor splats, Tensor ids, Tensor pairs, Tensor tile_offsets, Tensor "
      "splat_offsets, "
      "Tensor positions, Tensor transmittance, Tensor last, Tensor checkpoints, Tensor chunks, Tensor counts, Tensor "
      "tile_samples, bool[12] "
      "needs, bool "
      "debug) -> (Tensor means3D, Tensor means2D, Tensor "
      "opacities, "
      "Tensor shs, Tensor colors_precomp, Tensor scales, Tensor rotations, Tensor cov3D_precomp, Tensor[] camera)");
  m.def(
      "rasterize_stages(Tensor means3D, Tensor opacities, Tensor? shs, Tensor? colors_precomp, Tensor? scales, Tensor? "
      "rotations, "
      "Tensor? cov3D_precomp, Tensor bg, Tensor viewmatrix, Tensor projmatrix, Tensor campos, Tensor? lens, int "
      "image_height, "
      "int image_width, float tanfovx, float tanfovy, float scale_modifier, int sh_degree, str footprint, float "
      "option) -> "
      "(Tensor color, Tensor radii, Tensor ids, Tensor depths, Tensor means2d, Tensor pairs, Tensor tile_offsets, "
      "Tensor seconds)");
  // Other colours (P, 3) for the same splats: what rasterize with keep=True returned, blended again.
  // `checkpoints`, `chunks` and `counts` are rasterize_vjp's for an image of these colours; its splats are those of
  // rasterize with these colours.
  m.def(
      "rasterize_channels(Tensor colors, Tensor bg, int image_height, int image_width, str footprint, float option, "
      "Tensor splats, Tensor ids, Tensor pairs, Tensor tile_offsets, Tensor counts, Tensor tile_samples, bool keep, "
      "bool debug) -> (Tensor color, Tensor checkpoints, Tensor chunks, Tensor counts)");
  // What every pixel shows of rasterize's splats, and every one of the `count` Gaussians of the pixels. `total` is in
  // units of 2^-32.
  m.def(
      "inspect(Tensor splats, Tensor ids, Tensor pairs, Tensor tile_offsets, Tensor counts, Tensor tile_samples, int "
      "count, int image_height, int image_width, str footprint) -> (Tensor median, Tensor dominant, Tensor touched, "
      "Tensor largest, Tensor total)");
  m.def("footprint_weight(Tensor offset, Tensor cov2d, str footprint, float option) -> Tensor");
  m.def(
      "footprint_weight_vjp(Tensor dL_dweight, Tensor offset, Tensor cov2d, str footprint, float option) -> "
      "(Tensor offset, Tensor cov2d)");
}

PYBIND11_MODULE(_C, m) {
  m.doc() = "Loads the ops of analytic_rasterizer into torch.ops.analytic_rasterizer.";
#if defined(AR_WITH_CUDA)
  m.attr("has_cuda") = true;
  m.def("force_pair_capacity", &ar::ops::force_pair_capacity,
        "For tests: room for so many pairs on CUDA, whatever comes; 0 to guess anew, from the frames that follow.");
#else
  m.attr("has_cuda") = false;
#endif
  m.def(
      "footprints",
      [] {
        std::vector<std::string> names;
        ar::for_each_footprint(ar::Footprints{}, [&](auto f) { names.emplace_back(decltype(f)::kName); });
        return names;
      },
      "Keys of all footprints, in the order of the registry.");
  m.def("instruction_set", &ar::cpu::instruction_set, "Instruction set that the CPU path runs on.");
}
