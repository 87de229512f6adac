// Loops of footprint_weight and its adjoint: the weight of one splat in one pixel, elementwise.
#pragma once

#include <algorithm>

#include "core/params.h"
#include "cpu/isa.h"
#include "cpu/parallel.h"
#include "cpu/tasks.h"

namespace ar::AR_ISA {

template <typename T> AR_HD Cov2d<T> with_det(Sym2<T> c) {
  return {c.xx, c.xy, c.yy, difference_of_products(c.xx, c.yy, c.xy, c.xy)};
}

/// The weight of several samples is their mean.
template <class F, typename T> void weight(const cpu::WeightTask<T>& task) {
  cpu::parallel_for(cpu::chunks_of(task.n), task.threads, [&](int64_t chunk) {
    for (int64_t i = chunk * cpu::kChunk; i < std::min(task.n, (chunk + 1) * cpu::kChunk); ++i) {
      const auto terms = F::terms(F::prepare(with_det(task.covs[i]), task.options), T(1));
      T total = T(0);
      for (int s = 0; s < F::kSamples; ++s) total += F::alpha(terms, task.offsets[i], s);
      task.weights[i] = total / T(F::kSamples);
    }
  });
}

template <class F, typename T> void weight_vjp(const cpu::WeightTask<T>& task) {
  cpu::parallel_for(cpu::chunks_of(task.n), task.threads, [&](int64_t chunk) {
    for (int64_t i = chunk * cpu::kChunk; i < std::min(task.n, (chunk + 1) * cpu::kChunk); ++i) {
      const Cov2d<T> cov = with_det(task.covs[i]);
      const auto shape = F::prepare(cov, task.options);
      const auto terms = F::terms(shape, T(1));
      const T g = task.dL_dweights[i] / T(F::kSamples);
      ShapeGrad<T> sums = {};
      T weighted = T(0);
      for (int s = 0; s < F::kSamples; ++s) {
        const T w = F::alpha(terms, task.offsets[i], s);
        const ShapeGrad<T> one = F::alpha_vjp(terms, task.offsets[i], s, w, g);
        sums.offset = sums.offset + one.offset;
        sums.shape = {sums.shape.xx + one.shape.xx, sums.shape.xy + one.shape.xy, sums.shape.yy + one.shape.yy};
        weighted += g * w;
      }
      const SplatGrad<T> grad = F::prepare_vjp(cov, shape, sums, weighted);
      const T l = grad.dL_dlog_det == T(0) ? T(0) : grad.dL_dlog_det / cov.det;  // Sigma^-1 = adj(Sigma) / det
      task.dL_doffsets[i] = {-grad.dL_dmean.x, -grad.dL_dmean.y};
      task.dL_dcovs[i] = {grad.dL_dcov.xx + l * cov.yy, T(2) * (grad.dL_dcov.xy - l * cov.xy),
                          grad.dL_dcov.yy + l * cov.xx};
    }
  });
}

}  // namespace ar::AR_ISA
