// Fills the table of stages with the functions of one instruction set: kernels_*.cpp include this.
//
// These are the stages that are compiled for every instruction set. Blending works on packs of pixels; projection and
// bin are scalar code, which gains from fused multiply-add and rounding instructions. kernels_all.h has the other
// stages, which are compiled for the baseline only.
#pragma once

#include "core/footprint/registry.h"
#include "cpu/bin.h"
#include "cpu/blend.h"
#include "cpu/blend_vjp.h"
#include "cpu/project.h"

namespace ar::AR_ISA {

/// Blending; of reference footprints, which nobody waits for, only if `kReferences`.
template <typename T, bool kReferences> void set_blend_stages(int footprint, cpu::Stages<T>& stages) {
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    using F = decltype(f);
    if constexpr (kReferences || !F::kReference) {
      stages.blend = blend<PixelsOf<F>, T>;
      stages.blend_vjp = blend_vjp<PixelsOf<F>, T>;
    }
  });
}

template <template <typename> class Cam, typename T> void set_camera_stages(cpu::CameraStages<T>& stages) {
  stages.count_candidates = count_candidates<Cam, T>;
  stages.project = project<Cam, T>;
  stages.project_vjp = project_vjp<Cam, T>;
}

template <typename T> void set_projection_and_bin(cpu::Stages<T>& stages) {
  set_camera_stages<Camera>(stages.plain);
  set_camera_stages<FullCamera>(stages.full);
  stages.count_pairs = count_pairs<T>;
  stages.scatter_pairs = scatter_pairs<T>;
}

}  // namespace ar::AR_ISA
