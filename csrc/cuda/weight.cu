// The weights of one footprint for many covariances and offsets, and the adjoint, for torch/backend_cuda.cpp: a thread
// per element.
#include "core/weight.h"

#include "core/footprint/registry.h"
#include "cuda/launch.cuh"
#include "cuda/params.h"

namespace ar::cuda {
namespace {

constexpr int kThreads = 128;

// F: the footprint. T: float or double. All arrays: [n].
template <class F, typename T> __global__ void weight_kernel(const WeightParams<T> params) {
  wait_for_earlier_kernels();
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < params.n) params.weights[i] = ar::weight<F>(params.covs[i], params.offsets[i], params.options);
}

template <class F, typename T> __global__ void weight_vjp_kernel(const WeightParams<T> params) {
  wait_for_earlier_kernels();
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= params.n) return;
  const WeightGrad<T> g = ar::weight_vjp<F>(params.covs[i], params.offsets[i], params.options, params.dL_dweights[i]);
  params.dL_doffsets[i] = g.offset;
  params.dL_dcovs[i] = g.cov;
}

template <typename T> void launch_weight(int footprint, const WeightParams<T>& p, cudaStream_t stream) {
  if (p.n == 0) return;
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    launch(weight_kernel<decltype(f), T>, {blocks_of(p.n, kThreads), kThreads}, stream, p);
  });
}
template <typename T> void launch_weight_vjp(int footprint, const WeightParams<T>& p, cudaStream_t stream) {
  if (p.n == 0) return;
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    launch(weight_vjp_kernel<decltype(f), T>, {blocks_of(p.n, kThreads), kThreads}, stream, p);
  });
}

}  // namespace

void weight(int footprint, const WeightParams<float>& p, cudaStream_t stream) { launch_weight(footprint, p, stream); }
void weight(int footprint, const WeightParams<double>& p, cudaStream_t stream) { launch_weight(footprint, p, stream); }
void weight_vjp(int footprint, const WeightParams<float>& p, cudaStream_t stream) {
  launch_weight_vjp(footprint, p, stream);
}
void weight_vjp(int footprint, const WeightParams<double>& p, cudaStream_t stream) {
  launch_weight_vjp(footprint, p, stream);
}

}  // namespace ar::cuda
