// core/activations.h and core/density.h, a thread per Gaussian. `sum_penalty` adds up what blocks of `activate` have of
// the penalty.
#include "core/activations.h"
#include "core/density.h"

#include "cuda/launch.cuh"
#include "cuda/training/training.h"
#include "cuda/warp.cuh"

namespace ar::cuda {
namespace {

constexpr int kThreads = 256, kWarps = kThreads / 32;

// Arrays have a row for each of p.n Gaussians.
/// block_sums: [blocks]; null: no penalty is wanted.
template <typename T> __global__ void activate_kernel(const ActivateParams<T> p, T* block_sums) {
  wait_for_earlier_kernels();
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  T sum[] = {i < p.n ? ar::activate(p, i) : T(0)};
  if (!block_sums) return;
  sum_block<kWarps>(sum);
  if (threadIdx.x == 0) block_sums[blockIdx.x] = sum[0];
}

/// One block.
template <typename T> __global__ void sum_penalty_kernel(const T* block_sums, int64_t blocks, T* penalty) {
  wait_for_earlier_kernels();
  double sum[] = {0};
  for (int64_t i = threadIdx.x; i < blocks; i += kThreads) sum[0] += double(block_sums[i]);
  sum_block<kWarps>(sum);
  if (threadIdx.x == 0) *penalty = T(sum[0]);
}

/// kBody: of core/, for Gaussian i.
template <class Params, void (*kBody)(const Params&, int64_t)> __global__ void each_gaussian_kernel(const Params p) {
  wait_for_earlier_kernels();
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < p.n) kBody(p, i);
}
template <auto kBody, class Params> void launch_over_gaussians(const Params& p, cudaStream_t stream) {
  if (p.n > 0) launch(each_gaussian_kernel<Params, kBody>, {blocks_of(p.n, kThreads), kThreads}, stream, p);
}

}  // namespace

int64_t activate_blocks(int64_t n) { return blocks_of(n, kThreads); }

template <typename T> void activate(const ActivateParams<T>& p, T* block_sums, cudaStream_t stream) {
  const int64_t blocks = activate_blocks(p.n);
  if (blocks > 0) launch(activate_kernel<T>, {unsigned(blocks), kThreads}, stream, p, p.penalty ? block_sums : nullptr);
  if (p.penalty) launch(sum_penalty_kernel<T>, {1, kThreads}, stream, block_sums, blocks, p.penalty);
}
template <typename T> void activate_vjp(const ActivateVjpParams<T>& p, cudaStream_t stream) {
  launch_over_gaussians<ar::activate_vjp<T>>(p, stream);
}
template <typename T> void apply_filter(const FilterParams<T>& p, cudaStream_t stream) {
  launch_over_gaussians<ar::apply_filter<T>>(p, stream);
}
template <typename T> void apply_filter_vjp(const FilterVjpParams<T>& p, cudaStream_t stream) {
  launch_over_gaussians<ar::apply_filter_vjp<T>>(p, stream);
}
template <typename T> void observe(const ObserveParams<T>& p, cudaStream_t stream) {
  launch_over_gaussians<ar::observe<T>>(p, stream);
}
template <typename T> void add_noise(const NoiseParams<T>& p, cudaStream_t stream) {
  launch_over_gaussians<ar::add_noise<T>>(p, stream);
}

template void activate(const ActivateParams<float>&, float*, cudaStream_t);
template void activate(const ActivateParams<double>&, double*, cudaStream_t);
template void activate_vjp(const ActivateVjpParams<float>&, cudaStream_t);
template void activate_vjp(const ActivateVjpParams<double>&, cudaStream_t);
template void apply_filter(const FilterParams<float>&, cudaStream_t);
template void apply_filter(const FilterParams<double>&, cudaStream_t);
template void apply_filter_vjp(const FilterVjpParams<float>&, cudaStream_t);
template void apply_filter_vjp(const FilterVjpParams<double>&, cudaStream_t);
template void observe(const ObserveParams<float>&, cudaStream_t);
template void observe(const ObserveParams<double>&, cudaStream_t);
template void add_noise(const NoiseParams<float>&, cudaStream_t);
template void add_noise(const NoiseParams<double>&, cudaStream_t);

}  // namespace ar::cuda
