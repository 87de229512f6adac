// Kernels of footprint_weight and its adjoint: a thread per element.
#pragma once

#include "core/weight.h"
#include "cuda/tasks.h"
#include "cuda/warp.cuh"

namespace ar::cuda {

inline constexpr int kWeightThreads = 128;

template <class F, typename T> __global__ void weight_kernel(const WeightTask<T> task) {
  const int64_t i = int64_t(blockIdx.x) * kWeightThreads + threadIdx.x;
  if (i < task.n) task.weights[i] = ar::weight<F>(task.covs[i], task.offsets[i], task.options);
}

template <class F, typename T> __global__ void weight_vjp_kernel(const WeightTask<T> task) {
  const int64_t i = int64_t(blockIdx.x) * kWeightThreads + threadIdx.x;
  if (i >= task.n) return;
  const WeightGrad<T> g = ar::weight_vjp<F>(task.covs[i], task.offsets[i], task.options, task.dL_dweights[i]);
  task.dL_doffsets[i] = g.offset;
  task.dL_dcovs[i] = g.cov;
}

template <class F, typename T> void weight(const WeightTask<T>& task, cudaStream_t stream) {
  if (task.n > 0) weight_kernel<F><<<blocks_of(task.n, kWeightThreads), kWeightThreads, 0, stream>>>(task);
}
template <class F, typename T> void weight_vjp(const WeightTask<T>& task, cudaStream_t stream) {
  if (task.n > 0) weight_vjp_kernel<F><<<blocks_of(task.n, kWeightThreads), kWeightThreads, 0, stream>>>(task);
}

}  // namespace ar::cuda
