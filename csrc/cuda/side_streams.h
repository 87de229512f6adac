// A library for the CUDA backend and blend: streams for kernels that run beside those of the caller's stream.
#pragma once

#include <cuda_runtime_api.h>

#include <map>

namespace ar::cuda {

/// Work on stream(k) starts after earlier work of the caller's stream; later work there waits for it. Threads and
/// devices have separate streams, and each kCount, their number, has.
template <int kCount> class SideStreams {
 public:
  explicit SideStreams(cudaStream_t caller) : own_(of_this_thread()), caller_(caller) {
    cudaEventRecord(own_.fork, caller);
    for (cudaStream_t side : own_.streams) cudaStreamWaitEvent(side, own_.fork, 0);
  }
  SideStreams(const SideStreams&) = delete;
  ~SideStreams() {
    for (int k = 0; k < kCount; ++k) {
      cudaEventRecord(own_.events[k], own_.streams[k]);
      cudaStreamWaitEvent(caller_, own_.events[k], 0);
    }
  }
  /// For LaunchShape::begun of a kernel on a side stream.
  cudaEvent_t begun() const { return own_.begun; }
  /// Later kernels of the caller's stream come after the blocks of that kernel, which would wait for room.
  void wait_until_begun() const { cudaStreamWaitEvent(caller_, own_.begun, 0); }
  /// The caller's for k = 0, then the side streams, cyclically.
  cudaStream_t stream(int k) const { return k == 0 ? caller_ : own_.streams[(k - 1) % kCount]; }

 private:
  struct Own {
    cudaStream_t streams[kCount];
    cudaEvent_t fork, begun, events[kCount];

    Own() {
      // While a graph is captured too, as nothing here is part of it.
      cudaStreamCaptureMode mode = cudaStreamCaptureModeRelaxed;
      cudaThreadExchangeStreamCaptureMode(&mode);
      for (cudaEvent_t* event : {&fork, &begun}) cudaEventCreateWithFlags(event, cudaEventDisableTiming);
      for (int k = 0; k < kCount; ++k) {
        cudaStreamCreateWithFlags(&streams[k], cudaStreamNonBlocking);
        cudaEventCreateWithFlags(&events[k], cudaEventDisableTiming);
      }
      cudaThreadExchangeStreamCaptureMode(&mode);
    }
    Own(const Own&) = delete;
    ~Own() {
      for (cudaEvent_t event : {fork, begun}) cudaEventDestroy(event);
      for (int k = 0; k < kCount; ++k) {
        cudaStreamDestroy(streams[k]);
        cudaEventDestroy(events[k]);
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
