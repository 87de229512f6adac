// Kernels of the backward pass, for every footprint.
#include "core/footprint/registry.h"
#include "cuda/blend.cuh"
#include "cuda/project.cuh"
#include "cuda/weight.cuh"

namespace ar::cuda {

template <class F>
inline constexpr BackwardStages kBackward = {blend_vjp<F>, project_vjp<F>, weight_vjp<F, float>, weight_vjp<F, double>};

const BackwardStages* find_backward(std::string_view footprint) {
  const BackwardStages* found = nullptr;
  visit_footprint(footprint, Footprints{}, [&](auto f) { found = &kBackward<decltype(f)>; });
  return found;
}

}  // namespace ar::cuda
