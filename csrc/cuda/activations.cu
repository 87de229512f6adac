// Activations of parameters, their adjoint, and what density control observes, for torch/training_cuda.cpp. Three
// kernels with a thread per Gaussian; core/activations.h and core/density.h say what they read and write.
#include "core/activations.h"
#include "core/density.h"

#include "cuda/launch.cuh"
#include "cuda/training.h"
#include "cuda/tuning.h"

namespace ar::cuda {
namespace {

constexpr int kThreads = kActivateThreads;

// T: float or double. Arrays have a row for each of p.n Gaussians.
template <typename T> __global__ void activate_kernel(const ActivateParams<T> p) {
  wait_for_earlier_kernels();
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < p.n) ar::activate(p, i);
}

template <typename T> __global__ void activate_vjp_kernel(const ActivateVjpParams<T> p) {
  wait_for_earlier_kernels();
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < p.n) ar::activate_vjp(p, i);
}

template <typename T> __global__ void observe_kernel(const ObserveParams<T> p) {
  wait_for_earlier_kernels();
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < p.n) ar::observe(p, i);
}

}  // namespace

template <typename T> void activate(const ActivateParams<T>& p, cudaStream_t stream) {
  if (p.n > 0) launch(activate_kernel<T>, {blocks_of(p.n, kThreads), kThreads}, stream, p);
}
template <typename T> void activate_vjp(const ActivateVjpParams<T>& p, cudaStream_t stream) {
  if (p.n > 0) launch(activate_vjp_kernel<T>, {blocks_of(p.n, kThreads), kThreads}, stream, p);
}
template <typename T> void observe(const ObserveParams<T>& p, cudaStream_t stream) {
  if (p.n > 0) launch(observe_kernel<T>, {blocks_of(p.n, kThreads), kThreads}, stream, p);
}

template void activate(const ActivateParams<float>&, cudaStream_t);
template void activate(const ActivateParams<double>&, cudaStream_t);
template void activate_vjp(const ActivateVjpParams<float>&, cudaStream_t);
template void activate_vjp(const ActivateVjpParams<double>&, cudaStream_t);
template void observe(const ObserveParams<float>&, cudaStream_t);
template void observe(const ObserveParams<double>&, cudaStream_t);

}  // namespace ar::cuda
