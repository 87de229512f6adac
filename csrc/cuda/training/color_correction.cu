// The correction of a picture's colours and its adjoint. `correct_vjp` writes sums of blocks for the gradient of the
// matrix, `sum_blocks` adds these up in a fixed order.
#include "core/color_correction.h"

#include "cuda/launch.cuh"
#include "cuda/training/training.h"
#include "cuda/warp.cuh"

namespace ar::cuda {
namespace {

constexpr int kThreads = 256, kPixels = 8;

template <class Body> __device__ void for_each_pixel(int64_t pixels, const Body& body) {
  AR_UNROLL for (int k = 0; k < kPixels; ++k) {
    const int64_t i = (int64_t(blockIdx.x) * kPixels + k) * kThreads + threadIdx.x;
    if (i < pixels) body(i);
  }
}

// T: float or double, in this file.
template <typename T> __global__ void __launch_bounds__(kThreads) correct_kernel(const CorrectParams<T> p) {
  wait_for_earlier_kernels();
  const Correction<T> correction = read_correction(p.matrix);
  for_each_pixel(p.pixels, [&](int64_t i) { correct_color(p, correction, i); });
}

/// block_sums: [blocks, kCorrection]; null: not wanted.
template <typename T>
__global__ void __launch_bounds__(kThreads) correct_vjp_kernel(const CorrectVjpParams<T> p, T* block_sums) {
  wait_for_earlier_kernels();
  constexpr int kWarps = kThreads / 32;
  __shared__ T of_warps[kWarps][kCorrection];
  const Correction<T> correction = read_correction(p.matrix);
  T sums[kCorrection] = {};
  for_each_pixel(p.pixels, [&](int64_t i) { correct_color_vjp(p, correction, i, sums); });
  if (!block_sums) return;
  AR_UNROLL for (int k = 0; k < kCorrection; ++k) {
    const T sum = warp_sum(sums[k]);
    if (lane_id() == 0) of_warps[threadIdx.x / 32][k] = sum;
  }
  __syncthreads();
  if (threadIdx.x >= kCorrection) return;
  T sum = T(0);
  for (int w = 0; w < kWarps; ++w) sum += of_warps[w][threadIdx.x];
  block_sums[int64_t(blockIdx.x) * kCorrection + threadIdx.x] = sum;
}

/// One block, with a warp for each number.
template <typename T> __global__ void sum_blocks_kernel(const T* block_sums, int64_t blocks, T* dL_dmatrix) {
  wait_for_earlier_kernels();
  const int k = threadIdx.x / 32;
  double sum = 0;
  for (int64_t i = lane_id(); i < blocks; i += 32) sum += double(block_sums[i * kCorrection + k]);
  sum = warp_sum(sum);
  if (lane_id() == 0) dL_dmatrix[k] = T(sum);
}

}  // namespace

int64_t correct_blocks(int64_t pixels) { return blocks_of(pixels, kThreads * kPixels); }

template <typename T> void correct_colors(const CorrectParams<T>& p, cudaStream_t stream) {
  launch(correct_kernel<T>, {unsigned(correct_blocks(p.pixels)), kThreads}, stream, p);
}
template <typename T> void correct_colors_vjp(const CorrectVjpParams<T>& p, T* block_sums, cudaStream_t stream) {
  const int64_t blocks = correct_blocks(p.pixels);
  launch(correct_vjp_kernel<T>, {unsigned(blocks), kThreads}, stream, p, p.dL_dmatrix ? block_sums : nullptr);
  if (p.dL_dmatrix) launch(sum_blocks_kernel<T>, {1, 32 * kCorrection}, stream, block_sums, blocks, p.dL_dmatrix);
}

template void correct_colors(const CorrectParams<float>&, cudaStream_t);
template void correct_colors(const CorrectParams<double>&, cudaStream_t);
template void correct_colors_vjp(const CorrectVjpParams<float>&, float*, cudaStream_t);
template void correct_colors_vjp(const CorrectVjpParams<double>&, double*, cudaStream_t);

}  // namespace ar::cuda
