// Loops of footprint_weight and its adjoint: a weight per pair of covariance and offset (core/weight.h).
#pragma once

#include "core/weight.h"
#include "cpu/chunks.h"

namespace ar::AR_ISA {

template <class F, typename T> void weight(const cpu::WeightParams<T>& p) {
  for_each_chunk(p.n, p.threads, [&](int64_t, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) p.weights[i] = ar::weight<F>(p.covs[i], p.offsets[i], p.options);
  });
}

template <class F, typename T> void weight_vjp(const cpu::WeightParams<T>& p) {
  for_each_chunk(p.n, p.threads, [&](int64_t, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const WeightGrad<T> g = ar::weight_vjp<F>(p.covs[i], p.offsets[i], p.options, p.dL_dweights[i]);
      p.dL_doffsets[i] = g.offset;
      p.dL_dcovs[i] = g.cov;
    }
  });
}

}  // namespace ar::AR_ISA
