// All loops of the CPU path for one instruction set: kernels_*.cpp include this.
#pragma once

#include "core/footprint/registry.h"
#include "cpu/bin.h"
#include "cpu/blend.h"
#include "cpu/inspect.h"
#include "cpu/project.h"
#include "cpu/weight.h"

namespace ar::AR_ISA {

template <class F, typename T> constexpr auto choose_stage() -> decltype(cpu::Stages<T>::choose) {
  if constexpr (std::is_same_v<F, Adaptive>) {
    return choose<F, T>;
  } else {
    return nullptr;
  }
}

template <class F, template <typename> class Cam, typename T>
inline constexpr cpu::CameraStages<T> kCameraStages = {count_candidates<Cam, T>, project<F, Cam, T>,
                                                       project_vjp<F, Cam, T>};

template <class F, typename T>
inline constexpr cpu::Stages<T> kStages = {
    F::kSamples,
    kCameraStages<F, Camera, T>,
    kCameraStages<F, FullCamera, T>,
    count_pairs<F, T>,
    scatter_pairs<F, T>,
    choose_stage<F, T>(),
    blend<F, T>,
    blend_vjp<F, T>,
    weight<F, T>,
    weight_vjp<F, T>,
    inspect<F, T>,
};

template <typename T> const cpu::Stages<T>* stages(std::string_view footprint) {
  const cpu::Stages<T>* found = nullptr;
  visit_footprint(footprint, Footprints{}, [&](auto f) { found = &kStages<decltype(f), T>; });
  return found;
}

}  // namespace ar::AR_ISA
