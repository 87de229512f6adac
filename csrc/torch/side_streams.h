// A second stream, one per thread and device, whose kernels run beside the caller's stream.
#pragma once

#include <cuda_runtime_api.h>

#include <map>

namespace ar::cuda {

/// Work on stream() begins after earlier work of the caller's stream. Work after this object's end waits for it.
class SideStream {
 public:
  explicit SideStream(cudaStream_t caller) : own_(of_this_thread()), caller_(caller) {
    cudaEventRecord(own_.fork, caller);
    cudaStreamWaitEvent(own_.stream, own_.fork, 0);
  }
  SideStream(const SideStream&) = delete;
  ~SideStream() {
    cudaEventRecord(own_.end, own_.stream);
    cudaStreamWaitEvent(caller_, own_.end, 0);
  }
  cudaStream_t stream() const { return own_.stream; }
  /// For LaunchShape::begun of a kernel on stream().
  cudaEvent_t begun() const { return own_.begun; }
  /// Later kernels of the caller's stream wait for that kernel's blocks to begin, else these would wait for room.
  void wait_until_begun() const { cudaStreamWaitEvent(caller_, own_.begun, 0); }

 private:
  struct Own {
    cudaStream_t stream;
    cudaEvent_t fork, begun, end;

    Own() {
      // Also during the capture of a graph: nothing here is part of it.
      cudaStreamCaptureMode mode = cudaStreamCaptureModeRelaxed;
      cudaThreadExchangeStreamCaptureMode(&mode);
      cudaStreamCreateWithFlags(&stream, cudaStreamNonBlocking);
      for (cudaEvent_t* event : {&fork, &begun, &end}) cudaEventCreateWithFlags(event, cudaEventDisableTiming);
      cudaThreadExchangeStreamCaptureMode(&mode);
    }
    Own(const Own&) = delete;
    ~Own() {
      for (cudaEvent_t event : {fork, begun, end}) cudaEventDestroy(event);
      cudaStreamDestroy(stream);
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
