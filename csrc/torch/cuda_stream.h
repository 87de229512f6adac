// Work on the current stream of a tensor's device.
#pragma once

#include <ATen/core/Tensor.h>
#include <c10/cuda/CUDAException.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>

namespace ar::ops {

/// launch(stream) on the device of `like`. Raises the launch's error.
template <class Launch> void on_stream(const at::Tensor& like, const Launch& launch) {
  const c10::cuda::CUDAGuard guard(like.device());
  launch(cudaStream_t(c10::cuda::getCurrentCUDAStream()));
  C10_CUDA_KERNEL_LAUNCH_CHECK();
}

}  // namespace ar::ops
