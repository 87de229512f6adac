// All stages, also those that are not worth compiling for several instruction sets: kernels_baseline.cpp and
// kernels_double.cpp include this.
#pragma once

#include "cpu/inspect.h"
#include "cpu/kernels.h"
#include "cpu/rows.h"
#include "cpu/sum_channels.h"
#include "cpu/weight.h"

namespace ar::AR_ISA {

template <template <typename> class Cam, typename T> void set_row_stages(cpu::CameraStages<T>& stages) {
  stages.project_rows = project_rows<Cam, T>;
  stages.project_rows_vjp = project_rows_vjp<Cam, T>;
}

template <typename T> cpu::Stages<T> all_stages(int footprint) {
  cpu::Stages<T> stages = {};
  set_blend_stages<T, true>(footprint, stages);
  set_projection_and_bin(stages);
  set_row_stages<Camera>(stages.plain);
  set_row_stages<FullCamera>(stages.full);
  stages.shape_rows = shape_rows<T>;
  stages.row_grads = row_grads<T>;
  stages.sum_channels = sum_channels<T>;
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    using F = decltype(f);
    stages.samples = F::kSamples;
    stages.moves = F::kMoves;
    stages.inspect = inspect<PixelsOf<F>, T>;
    stages.weight = weight<F, T>;
    stages.weight_vjp = weight_vjp<F, T>;
  });
  return stages;
}

}  // namespace ar::AR_ISA
