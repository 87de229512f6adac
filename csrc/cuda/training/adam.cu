// A step of Adam on several tensors in one kernel; a block has a part of one tensor.
#include "core/adam.h"

#include "cuda/launch.cuh"
#include "cuda/training/training.h"

namespace ar::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kBytes = 16;  ///< of each array that a thread loads at once

/// Numbers that a thread loads at once.
template <typename T> struct alignas(kBytes) Packed {
  static constexpr int kWidth = kBytes / sizeof(T);
  T values[kWidth];
};

template <typename T> constexpr int kBlockNumbers = kThreads * Packed<T>::kWidth;

template <typename T> __device__ Packed<T>& packed(T* first) { return *reinterpret_cast<Packed<T>*>(first); }
template <typename T> __device__ const Packed<T>& packed(const T* first) {
  return *reinterpret_cast<const Packed<T>*>(first);
}

template <typename T> __device__ void update_one(const AdamParams<T>& p, const AdamTensor<T>& t, int64_t i) {
  const int64_t row = p.rows || t.head > 0 ? i / t.row_size : 0;
  if (p.rows && !p.rows[row]) return;
  const T rate = i - row * t.row_size < t.head ? t.rule.head_rate : t.rule.rate;
  ar::adam(t.rule, rate, t.grad[i], t.param[i], t.exp_avg[i], t.exp_avg_sq[i]);
}

/// Numbers [i, i + kWidth).
template <typename T> __device__ void update_packed(const AdamParams<T>& p, const AdamTensor<T>& t, int64_t i) {
  constexpr int kWidth = Packed<T>::kWidth;
  bool chosen[kWidth], any = false;
  T rates[kWidth];
  int64_t row = p.rows || t.head > 0 ? i / t.row_size : 0, column = i - row * t.row_size;
  AR_UNROLL for (int k = 0; k < kWidth; ++k) {
    chosen[k] = !p.rows || p.rows[row];
    any |= chosen[k];
    rates[k] = column < t.head ? t.rule.head_rate : t.rule.rate;
    if (++column == t.row_size) {
      column = 0;
      ++row;
    }
  }
  if (!any) return;
  const Packed<T> grad = packed(t.grad + i);
  Packed<T> param = packed(t.param + i), exp_avg = packed(t.exp_avg + i), exp_avg_sq = packed(t.exp_avg_sq + i);
  AR_UNROLL for (int k = 0; k < kWidth; ++k) {
    if (chosen[k]) ar::adam(t.rule, rates[k], grad.values[k], param.values[k], exp_avg.values[k], exp_avg_sq.values[k]);
  }
  packed(t.param + i) = param;
  packed(t.exp_avg + i) = exp_avg;
  packed(t.exp_avg_sq + i) = exp_avg_sq;
}

/// Arrays have the shapes of AdamTensor. Those that are not aligned to Packed are updated one number at a time.
template <typename T> __global__ void __launch_bounds__(kThreads) adam_kernel(const __grid_constant__ AdamParams<T> p) {
  wait_for_earlier_kernels();
  const AdamPart part = part_of_item(p, blockIdx.x, kBlockNumbers<T>);
  const AdamTensor<T>& t = p.tensors[part.tensor];
  if (!t.aligned) {
    for (int64_t i = part.begin + threadIdx.x; i < part.end; i += kThreads) update_one(p, t, i);
    return;
  }
  int64_t i = part.begin + threadIdx.x * Packed<T>::kWidth;
  if (i + Packed<T>::kWidth <= part.end) {
    update_packed(p, t, i);
  } else {
    for (; i < part.end; ++i) update_one(p, t, i);
  }
}

}  // namespace

template <typename T> void adam(AdamParams<T> p, cudaStream_t stream) {
  const int64_t blocks = divide_work(p, kBlockNumbers<T>);
  launch(adam_kernel<T>, {unsigned(blocks), kThreads}, stream, p);
}

template void adam(AdamParams<float>, cudaStream_t);
template void adam(AdamParams<double>, cudaStream_t);

}  // namespace ar::cuda
