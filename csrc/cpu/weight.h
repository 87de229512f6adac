// Loops of footprint_weight and its adjoint.
#pragma once

#include <algorithm>

#include "core/weight.h"
#include "cpu/isa.h"
#include "cpu/parallel.h"
#include "cpu/stages.h"

namespace ar::AR_ISA {

template <class F, typename T> void weight(const cpu::WeightParams<T>& p) {
  cpu::parallel_for(cpu::chunks_of(p.n), p.threads, [&](int64_t chunk) {
    for (int64_t i = chunk * cpu::kChunk; i < std::min(p.n, (chunk + 1) * cpu::kChunk); ++i)
      p.weights[i] = ar::weight<F>(p.covs[i], p.offsets[i], p.options);
  });
}

template <class F, typename T> void weight_vjp(const cpu::WeightParams<T>& p) {
  cpu::parallel_for(cpu::chunks_of(p.n), p.threads, [&](int64_t chunk) {
    for (int64_t i = chunk * cpu::kChunk; i < std::min(p.n, (chunk + 1) * cpu::kChunk); ++i) {
      const WeightGrad<T> g = ar::weight_vjp<F>(p.covs[i], p.offsets[i], p.options, p.dL_dweights[i]);
      p.dL_doffsets[i] = g.offset;
      p.dL_dcovs[i] = g.cov;
    }
  });
}

}  // namespace ar::AR_ISA
