// What backend_cuda.cpp keeps beyond a call: SharedGuesses (pair_guess.h) and Laps, a clock.
#pragma once

#include <ATen/ops/empty.h>
#include <c10/cuda/CUDAException.h>

#include <mutex>

#include "torch/backend.h"
#include "torch/pair_guess.h"
#include "torch/pointers.h"

namespace ar::ops {

class SharedGuesses {
 public:
  static SharedGuesses& instance() {
    static auto* guesses = new SharedGuesses;  // Never freed: it outlives the CUDA context.
    return *guesses;
  }
  template <class Use> auto use(Use&& use) {
    const std::lock_guard lock(mutex_);
    return use(guesses_);
  }

 private:
  SharedGuesses()
      : words_(at::empty({cuda::PairGuesses::kSlots}, at::TensorOptions().dtype(at::kLong).pinned_memory(true))),
        guesses_(reinterpret_cast<uint64_t*>(words_.data_ptr<int64_t>())) {}

  std::mutex mutex_;
  Tensor words_;
  cuda::PairGuesses guesses_;
};

inline bool is_capturing(cudaStream_t stream) {
  cudaStreamCaptureStatus status = cudaStreamCaptureStatusNone;
  C10_CUDA_CHECK(cudaStreamIsCapturing(stream, &status));
  return status != cudaStreamCaptureStatusNone;
}

/// From here on, frames of samples that move are counted for a backward pass: a pair takes hundreds of bytes of
/// checkpoints, waiting little time.
inline constexpr int64_t kCountedGaussians = 1 << 23;

inline cuda::Counting counting_of(const Pass& pass, int64_t gaussians, cudaStream_t stream) {
  if (pass.exact) return cuda::Counting::kAlways;
  if (is_capturing(stream)) return cuda::Counting::kNever;
  const bool many = pass.footprint.moves && pass.keep && gaussians >= kCountedGaussians;
  return many ? cuda::Counting::kAlways : cuda::Counting::kIfNeeded;
}

/// Seconds between calls of next().
class Laps {
 public:
  Laps() = default;
  Laps(const Laps&) = delete;
  ~Laps() {
    for (cudaEvent_t event : events_) {
      if (event) cudaEventDestroy(event);
    }
  }
  double next(cudaStream_t stream) {
    cudaEvent_t& now = events_[turn_];
    const cudaEvent_t before = events_[1 - turn_];
    turn_ = 1 - turn_;
    if (!now) C10_CUDA_CHECK(cudaEventCreate(&now));
    C10_CUDA_CHECK(cudaEventRecord(now, stream));
    C10_CUDA_CHECK(cudaEventSynchronize(now));
    float milliseconds = 0;
    if (before) C10_CUDA_CHECK(cudaEventElapsedTime(&milliseconds, before, now));
    return milliseconds * 1e-3;
  }

 private:
  cudaEvent_t events_[2] = {};
  int turn_ = 0;
};

}  // namespace ar::ops
