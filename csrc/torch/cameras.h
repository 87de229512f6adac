// Cameras on CUDA, for cameras.cpp; cameras_cuda.cpp implements it.
#pragma once

#include "core/camera/prepare.h"
#include "torch/pointers.h"

namespace ar::ops {

/// On the device of `like`. Never waits for it.
template <class Source> void prepare_on_cuda(const Source& source, const Tensor& like);
template <typename T>
void prepare_vjp_on_cuda(const CameraSource<T>& source, const CameraSourceGrads<T>& grads, const Tensor& like);
void middle_vjp_on_cuda(const Tensor& view, const Tensor& proj, const Tensor& dL_dlens, const Tensor& dL_dview,
                        const Tensor& dL_dproj);

}  // namespace ar::ops
