// The correction of a picture's colours and its adjoint. `sum_blocks` adds up, in a fixed order, what blocks of
// `correct_vjp` have of the matrix's gradient.
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

template <bool kVignetted> constexpr int kSums = kCorrection + (kVignetted ? kVignetting : 0);

template <bool kVignetted, typename T>
__global__ void __launch_bounds__(kThreads) correct_kernel(const CorrectParams<T> p) {
  wait_for_earlier_kernels();
  const Correction<T> correction = read_correction(p.matrix);
  for_each_pixel(p.pixels, [&](int64_t i) { correct_color<kVignetted>(p, correction, i); });
}

/// block_sums: [blocks, kSums]; null: not wanted.
template <bool kVignetted, typename T>
__global__ void __launch_bounds__(kThreads) correct_vjp_kernel(const CorrectVjpParams<T> p, T* block_sums) {
  wait_for_earlier_kernels();
  constexpr int kWarps = kThreads / 32, kCount = kSums<kVignetted>;
  __shared__ T of_warps[kWarps][kCount];
  const Correction<T> correction = read_correction(p.matrix);
  T sums[kCount] = {};
  for_each_pixel(p.pixels, [&](int64_t i) { correct_color_vjp<kVignetted>(p, correction, i, sums); });
  if (!block_sums) return;
  AR_UNROLL for (int k = 0; k < kCount; ++k) {
    const T sum = warp_sum(sums[k]);
    if (lane_id() == 0) of_warps[threadIdx.x / 32][k] = sum;
  }
  __syncthreads();
  if (threadIdx.x >= kCount) return;
  T sum = T(0);
  for (int w = 0; w < kWarps; ++w) sum += of_warps[w][threadIdx.x];
  block_sums[int64_t(blockIdx.x) * kCount + threadIdx.x] = sum;
}

/// One block, with a warp for each number.
template <bool kVignetted, typename T>
__global__ void sum_blocks_kernel(const T* block_sums, int64_t blocks, T* dL_dmatrix, T* dL_dvignetting) {
  wait_for_earlier_kernels();
  const int k = threadIdx.x / 32;
  double sum = 0;
  for (int64_t i = lane_id(); i < blocks; i += 32) sum += double(block_sums[i * kSums<kVignetted> + k]);
  sum = warp_sum(sum);
  if (lane_id() != 0) return;
  if (k < kCorrection) {
    if (dL_dmatrix) dL_dmatrix[k] = T(sum);
  } else if (dL_dvignetting) {
    dL_dvignetting[k - kCorrection] = T(sum);
  }
}

template <bool kVignetted, typename T>
void correct_vjp(const CorrectVjpParams<T>& p, T* block_sums, cudaStream_t stream) {
  const int64_t blocks = correct_blocks(p.pixels);
  launch(correct_vjp_kernel<kVignetted, T>, {unsigned(blocks), kThreads}, stream, p, p.sums() ? block_sums : nullptr);
  if (p.sums())
    launch(sum_blocks_kernel<kVignetted, T>, {1, 32 * kSums<kVignetted>}, stream, block_sums, blocks, p.dL_dmatrix,
           p.dL_dvignetting);
}

}  // namespace

int64_t correct_blocks(int64_t pixels) { return blocks_of(pixels, kThreads * kPixels); }

template <typename T> void correct_colors(const CorrectParams<T>& p, cudaStream_t stream) {
  const LaunchShape shape = {unsigned(correct_blocks(p.pixels)), kThreads};
  if (p.vignetting) return launch(correct_kernel<true, T>, shape, stream, p);
  launch(correct_kernel<false, T>, shape, stream, p);
}
template <typename T> void correct_colors_vjp(const CorrectVjpParams<T>& p, T* block_sums, cudaStream_t stream) {
  if (p.vignetting) return correct_vjp<true>(p, block_sums, stream);
  correct_vjp<false>(p, block_sums, stream);
}

template void correct_colors(const CorrectParams<float>&, cudaStream_t);
template void correct_colors(const CorrectParams<double>&, cudaStream_t);
template void correct_colors_vjp(const CorrectVjpParams<float>&, float*, cudaStream_t);
template void correct_colors_vjp(const CorrectVjpParams<double>&, double*, cudaStream_t);

}  // namespace ar::cuda
