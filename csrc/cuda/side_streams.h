// Streams beside the caller's, for kernels that need not wait for each other.
#pragma once

#include <cuda_runtime.h>

#include <map>

namespace ar::cuda {

/// Work on `stream(k)` between construction and join() runs side by side, after all that was on the caller's
/// stream before; what follows there waits for it. Each thread has streams of its own.
class SideStreams {
 public:
  static constexpr int kCount = 3;

  explicit SideStreams(cudaStream_t caller) : own_(of_this_thread()), caller_(caller) {
    cudaEventRecord(own_.fork, caller);
    for (cudaStream_t side : own_.streams) cudaStreamWaitEvent(side, own_.fork, 0);
  }
  /// The caller's for k = 0, then the others in turn.
  cudaStream_t stream(int k) const { return k == 0 ? caller_ : own_.streams[(k - 1) % kCount]; }

  void join() {
    for (int k = 0; k < kCount; ++k) {
      cudaEventRecord(own_.joins[k], own_.streams[k]);
      cudaStreamWaitEvent(caller_, own_.joins[k], 0);
    }
  }

 private:
  struct Own {
    cudaStream_t streams[kCount];
    cudaEvent_t fork, joins[kCount];

    Own() {
      cudaEventCreateWithFlags(&fork, cudaEventDisableTiming);
      for (int k = 0; k < kCount; ++k) {
        cudaStreamCreateWithFlags(&streams[k], cudaStreamNonBlocking);
        cudaEventCreateWithFlags(&joins[k], cudaEventDisableTiming);
      }
    }
    Own(const Own&) = delete;
    ~Own() {
      cudaEventDestroy(fork);
      for (int k = 0; k < kCount; ++k) {
        cudaStreamDestroy(streams[k]);
        cudaEventDestroy(joins[k]);
      }
    }
  };
  static Own& of_this_thread() {
    static thread_local std::map<int, Own> of_device;
    int device = 0;
    cudaGetDevice(&device);
    return of_device[device];
  }

  Own& own_;
  cudaStream_t caller_;
};

}  // namespace ar::cuda
