// Launches the kernels of weight.cuh for torch/backend_cuda.cpp.
#include "core/footprint/registry.h"
#include "cuda/launch.cuh"
#include "cuda/weight.cuh"

namespace ar::cuda {
namespace {

template <typename T> void launch_weight(int footprint, const WeightParams<T>& p, cudaStream_t stream) {
  if (p.n == 0) return;
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    launch(weight_kernel<decltype(f), T>, {blocks_of(p.n, kWeightThreads), kWeightThreads}, stream, p);
  });
}
template <typename T> void launch_weight_vjp(int footprint, const WeightParams<T>& p, cudaStream_t stream) {
  if (p.n == 0) return;
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    launch(weight_vjp_kernel<decltype(f), T>, {blocks_of(p.n, kWeightThreads), kWeightThreads}, stream, p);
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
