// Loops of footprint_weight and its adjoint.
#pragma once

#include <algorithm>

#include "core/weight.h"
#include "cpu/isa.h"
#include "cpu/parallel.h"
#include "cpu/tasks.h"

namespace ar::AR_ISA {

template <class F, typename T> void weight(const cpu::WeightTask<T>& task) {
  cpu::parallel_for(cpu::chunks_of(task.n), task.threads, [&](int64_t chunk) {
    for (int64_t i = chunk * cpu::kChunk; i < std::min(task.n, (chunk + 1) * cpu::kChunk); ++i)
      task.weights[i] = ar::weight<F>(task.covs[i], task.offsets[i], task.options);
  });
}

template <class F, typename T> void weight_vjp(const cpu::WeightTask<T>& task) {
  cpu::parallel_for(cpu::chunks_of(task.n), task.threads, [&](int64_t chunk) {
    for (int64_t i = chunk * cpu::kChunk; i < std::min(task.n, (chunk + 1) * cpu::kChunk); ++i) {
      const WeightGrad<T> g = ar::weight_vjp<F>(task.covs[i], task.offsets[i], task.options, task.dL_dweights[i]);
      task.dL_doffsets[i] = g.offset;
      task.dL_dcovs[i] = g.cov;
    }
  });
}

}  // namespace ar::AR_ISA
