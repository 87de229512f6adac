// The list of camera models. A new model is a header and an entry here.
#pragma once

#include <type_traits>

#include "core/camera/equirectangular.h"
#include "core/camera/fisheye.h"
#include "core/camera/fov.h"
#include "core/camera/orthographic.h"
#include "core/camera/perspective.h"
#include "core/camera/pinhole.h"

namespace ar {

template <class... M> struct CameraModelList {};

/// Lens::model is an index in this list.
using CameraModels = CameraModelList<Pinhole, Orthographic, Perspective, Fisheye, RadTanFisheye, Fov, Equirectangular>;

template <class... M> constexpr int count_of_models(CameraModelList<M...>) { return sizeof...(M); }
inline constexpr int kCameraModels = count_of_models(CameraModels());

template <class Model, class... M> constexpr int index_of_model(CameraModelList<M...>) {
  int index = 0;
  ((std::is_same_v<Model, M> ? true : (++index, false)) || ...);
  return index;
}
template <class Model> inline constexpr int kCameraModel = index_of_model<Model>(CameraModels());

/// Visits the model with this index, or the last model if there is none.
template <int kIndex = 0, typename T, class Visit, class M, class... Later>
AR_HD auto visit_model_at(T model, CameraModelList<M, Later...>, Visit&& visit) {
  if constexpr (sizeof...(Later) > 0) {
    if (model != T(kIndex)) return visit_model_at<kIndex + 1>(model, CameraModelList<Later...>(), visit);
  }
  return visit(M());
}

template <typename T, class Visit> AR_HD auto visit_model(const Camera<T>&, Visit&& visit) { return visit(Pinhole()); }
template <typename T, class Visit> AR_HD auto visit_model(const FullCamera<T>& camera, Visit&& visit) {
  return visit_model_at(camera.lens.model, CameraModels(), visit);
}

}  // namespace ar
