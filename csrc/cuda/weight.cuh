// The kernels of footprint_weight and its adjoint, which read covariances and offsets, and write the weights of one
// footprint, or gradients. A thread per element; weight.cu launches them.
#pragma once

#include "core/weight.h"
#include "cuda/launch.cuh"
#include "cuda/params.h"
#include "cuda/tuning.h"
#include "cuda/warp.cuh"

namespace ar::cuda {

// F: the footprint. T: float or double. All arrays: [n].
template <class F, typename T> __global__ void weight_kernel(const WeightParams<T> params) {
  wait_for_earlier_kernels();
  const int64_t i = int64_t(blockIdx.x) * kWeightThreads + threadIdx.x;
  if (i < params.n) params.weights[i] = ar::weight<F>(params.covs[i], params.offsets[i], params.options);
}

template <class F, typename T> __global__ void weight_vjp_kernel(const WeightParams<T> params) {
  wait_for_earlier_kernels();
  const int64_t i = int64_t(blockIdx.x) * kWeightThreads + threadIdx.x;
  if (i >= params.n) return;
  const WeightGrad<T> g = ar::weight_vjp<F>(params.covs[i], params.offsets[i], params.options, params.dL_dweights[i]);
  params.dL_doffsets[i] = g.offset;
  params.dL_dcovs[i] = g.cov;
}

}  // namespace ar::cuda
