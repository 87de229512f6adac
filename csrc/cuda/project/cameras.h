// What torch/cameras_cuda.cpp asks of cameras.cu. Nothing waits for the device.
#pragma once

#include <cuda_runtime_api.h>

#include "core/camera/prepare.h"

namespace ar::cuda {

/// Scratch of prepare(), [count, kLimitDirections]: the fold in each direction, and reach_of()'s `seen`.
struct LimitScratch {
  double* folds;
  int32_t* seen;
};

/// Source: CameraSource or LensSource of float or double.
template <class Source> void prepare(const Source& source, const LimitScratch& scratch, cudaStream_t stream);
template <typename T>
void prepare_vjp(const CameraSource<T>& source, const CameraSourceGrads<T>& grads, cudaStream_t stream);
/// Of the middle of the picture: writes gradients of both matrices.
template <typename T>
void middle_vjp(const T* view, const T* proj, const T* dL_dlens, T* dL_dview, T* dL_dproj, cudaStream_t stream);

}  // namespace ar::cuda
