// The weights of a footprint for many covariances and offsets, and the adjoint: a thread per element.
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

}  // namespace

template <typename T> void weight(int footprint, const WeightParams<T>& p, cudaStream_t stream) {
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    if (p.n > 0) launch(weight_kernel<decltype(f), T>, {blocks_of(p.n, kThreads), kThreads}, stream, p);
  });
}
template void weight(int, const WeightParams<float>&, cudaStream_t);
template void weight(int, const WeightParams<double>&, cudaStream_t);

template <typename T> void weight_vjp(int footprint, const WeightParams<T>& p, cudaStream_t stream) {
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    if (p.n > 0) launch(weight_vjp_kernel<decltype(f), T>, {blocks_of(p.n, kThreads), kThreads}, stream, p);
  });
}
template void weight_vjp(int, const WeightParams<float>&, cudaStream_t);
template void weight_vjp(int, const WeightParams<double>&, cudaStream_t);

}  // namespace ar::cuda
