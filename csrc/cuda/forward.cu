// Kernels of the forward pass, for every footprint.
#include "core/footprint/registry.h"
#include "cuda/bin.cuh"
#include "cuda/blend.cuh"
#include "cuda/choose.cuh"
#include "cuda/inspect.cuh"
#include "cuda/project.cuh"
#include "cuda/weight.cuh"

namespace ar::cuda {

template <class F> constexpr auto choose_stage() -> decltype(ForwardStages::choose) {
  if constexpr (std::is_same_v<F, Adaptive>) {
    return choose<F>;
  } else {
    return nullptr;
  }
}

template <class F>
inline constexpr ForwardStages kForward = {F::kSamples, project<F>,       emit_pairs<F>,     choose_stage<F>(),
                                           blend<F>,    weight<F, float>, weight<F, double>, inspect<F>};

const ForwardStages* find_forward(std::string_view footprint) {
  const ForwardStages* found = nullptr;
  visit_footprint(footprint, Footprints{}, [&](auto f) { found = &kForward<decltype(f)>; });
  return found;
}

}  // namespace ar::cuda
