// The stages that every instruction set has: blending, in packs, and projection and bin, which gain from fused
// multiply-add and rounding instructions.
#pragma once

#include "core/footprint/registry.h"
#include "cpu/bin.h"
#include "cpu/blend_rays_vjp.h"
#include "cpu/project.h"

namespace ar::AR_ISA {

/// kReferences: also of reference footprints, whose speed does not matter.
template <typename T, bool kReferences> void set_blend_stages(int footprint, cpu::Stages<T>& stages) {
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    using F = decltype(f);
    if constexpr (kReferences || !F::kReference) {
      stages.blend = blend<PixelsOf<F>, T>;
      stages.blend_vjp = blend_vjp<PixelsOf<F>, T>;
      if constexpr (F::kAlongRays) {
        stages.blend_rays = blend_rays<PixelsOf<F>, T>;
        stages.blend_rays_vjp = blend_rays_vjp<PixelsOf<F>, T>;
      }
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
