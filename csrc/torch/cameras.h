// Names of camera models; and cameras on CUDA, for cameras.cpp, which cameras_cuda.cpp implements.
#pragma once

#include <array>

#include "core/camera/prepare.h"
#include "torch/pointers.h"

namespace ar::ops {

template <class... M> constexpr std::array<const char*, sizeof...(M)> names_of_models(CameraModelList<M...>) {
  return {M::kName...};
}
/// By the number of the model.
inline constexpr auto kCameraModelNames = names_of_models(CameraModels());

/// On the device of `like`. Never waits for it.
template <class Source> void prepare_on_cuda(const Source& source, const Tensor& like);
template <typename T>
void prepare_vjp_on_cuda(const CameraSource<T>& source, const CameraSourceGrads<T>& grads, const Tensor& like);
void middle_vjp_on_cuda(const Tensor& view, const Tensor& proj, const Tensor& dL_dlens, const Tensor& dL_dview,
                        const Tensor& dL_dproj);

}  // namespace ar::ops
