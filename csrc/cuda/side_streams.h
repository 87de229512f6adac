// Streams beside the caller's, for kernels that need not wait for each other.
#pragma once

#include <cuda_runtime_api.h>

#include <map>

namespace ar::cuda {

/// Work on `stream(k)` runs side by side while this lives, after all that was on the caller's stream before; what
/// follows there waits for it. Each thread has streams of its own. Those of another kCount are others, so that a fork
/// of one does not wait for what runs on the other's.
template <int kCount> class SideStreams {
 public:
  explicit SideStreams(cudaStream_t caller) : own_(of_this_thread()), caller_(caller) {
    cudaEventRecord(own_.fork, caller);
    for (cudaStream_t side : own_.streams) cudaStreamWaitEvent(side, own_.fork, 0);
  }
  SideStreams(const SideStreams&) = delete;
  /// What follows on the caller's stream waits for what the others have been given.
  ~SideStreams() {
    for (int k = 0; k < kCount; ++k) {
      cudaEventRecord(own_.events[k], own_.streams[k]);
      cudaStreamWaitEvent(caller_, own_.events[k], 0);
    }
  }
  /// An event for a kernel on one of the others to record when its blocks have begun (`LaunchShape::begun`).
  cudaEvent_t begun() const { return own_.begun; }
  /// What the caller's stream is given from now on waits for that event: its kernels are placed on the device behind
  /// the blocks of that one, which would else wait until theirs leave room. No result depends on it.
  void wait_until_begun() const { cudaStreamWaitEvent(caller_, own_.begun, 0); }
  /// The caller's for k = 0, then the others in turn.
  cudaStream_t stream(int k) const { return k == 0 ? caller_ : own_.streams[(k - 1) % kCount]; }

 private:
  struct Own {
    cudaStream_t streams[kCount];
    cudaEvent_t fork, begun, events[kCount];

    Own() {
      // Allowed while a graph is captured too: nothing here is part of it.
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
