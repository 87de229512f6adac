// The forward pass of the CPU, in the order of Backend (torch/backend.h), with the loops of each stage.
// torch/backend_cpu.cpp allocates, and calls these functions.
//
//   project   Gaussians to splats, or to public rows             project.h, rows.h
//   bin       splats to the list of each tile, sorted by depth   bin.h, sort.cpp
//   blend     lists to images                                    blend.h, blend_rays.h
//   inspect   lists to statistics of pixels and Gaussians        inspect.h
//
// stages_of() is the table of the instruction set that instruction_sets.cpp chose.
#include <utility>

#include "cpu/stages.h"

namespace ar::cpu {

// project

template <typename T> int64_t count_candidates(const ProjectParams<T>& p) {
  stages_of<T>().of(p.camera).count_candidates(p);
  int64_t count = 0;
  for (int64_t chunk = 0; chunk <= chunks_of(p.gaussians.n); ++chunk) {
    count += std::exchange(p.chunk_offsets[chunk], count);
  }
  return count;
}
template <typename T> void project(const ProjectParams<T>& p) { stages_of<T>().of(p.camera).project(p); }
template <typename T> void project_rows(const ProjectRowsParams<T>& p) { stages_of<T>().of(p.camera).project_rows(p); }
template <typename T> void shape_rows(const ShapeRowsParams<T>& p) { stages_of<T>().shape_rows(p); }

// bin

template <typename T> int64_t count_pairs(BinParams<T>& p) {
  stages_of<T>().count_pairs(p);
  return p.tile_offsets[p.grid.tiles()];
}
template <typename T> void scatter_pairs(BinParams<T>& p) { stages_of<T>().scatter_pairs(p); }

// blend

template <typename T> void blend(int footprint, const BlendParams<T>& p) {
  const Stages<T>& stages = stages_of<T>(footprint);
  p.order.window ? stages.blend_rays(p) : stages.blend(p);
}

// inspect

template <typename T> void inspect(int footprint, const InspectParams<T>& p) { stages_of<T>(footprint).inspect(p); }

// weight

template <typename T> void weight(int footprint, const WeightParams<T>& p) { stages_of<T>(footprint).weight(p); }

#define AR_INSTANTIATE(T)                                     \
  template int64_t count_candidates(const ProjectParams<T>&); \
  template void project(const ProjectParams<T>&);             \
  template void project_rows(const ProjectRowsParams<T>&);    \
  template void shape_rows(const ShapeRowsParams<T>&);        \
  template int64_t count_pairs(BinParams<T>&);                \
  template void scatter_pairs(BinParams<T>&);                 \
  template void blend(int, const BlendParams<T>&);            \
  template void inspect(int, const InspectParams<T>&);        \
  template void weight(int, const WeightParams<T>&);
AR_INSTANTIATE(float)
AR_INSTANTIATE(double)

}  // namespace ar::cpu
