// The backward pass of the CPU, called as forward.cpp is.
//
//   blend_vjp      gradients of images to a row for each pair                 blend_vjp.h, blend_rays_vjp.h
//   sum_channels   rows of pairs to gradients of channels                     sum_channels.h
//   project_vjp    rows of pairs, or gradients of public rows, to gradients   project.h, rows.h
//                  of Gaussians and cameras
//   row_grads      rows of pairs to gradients of public rows                  rows.h
#include "cpu/stages.h"

namespace ar::cpu {

template <typename T> void blend_vjp(int footprint, const BlendVjpParams<T>& p) {
  const Stages<T>& stages = stages_of<T>(footprint);
  p.order.window ? stages.blend_rays_vjp(p) : stages.blend_vjp(p);
}
template <typename T> void sum_channels(const SumChannelsParams<T>& p) { stages_of<T>().sum_channels(p); }

template <typename T> void project_vjp(const ProjectVjpParams<T>& p) { stages_of<T>().of(p.camera).project_vjp(p); }
template <typename T> void project_rows_vjp(const ProjectRowsVjpParams<T>& p) {
  stages_of<T>().of(p.camera).project_rows_vjp(p);
}
template <typename T> void sum_camera_grads(const CameraGradSums<T>& sums) {
  for (int k = 0; k < kCameraNumbers; ++k) {
    const CameraNumber<T> number = camera_number(sums, k);
    if (!number.to) continue;
    double sum = 0;
    for (int64_t i = 0; number.column >= 0 && i < sums.n; ++i) {
      sum += double(sums.parts[i * kCameraGradWidth + number.column]);
    }
    *number.to = T(sum);
  }
}

template <typename T> void row_grads(const RowGradsParams<T>& p) { stages_of<T>().row_grads(p); }

template <typename T> void weight_vjp(int footprint, const WeightParams<T>& p) {
  stages_of<T>(footprint).weight_vjp(p);
}

#define AR_INSTANTIATE(T)                                         \
  template void blend_vjp(int, const BlendVjpParams<T>&);         \
  template void sum_channels(const SumChannelsParams<T>&);        \
  template void project_vjp(const ProjectVjpParams<T>&);          \
  template void project_rows_vjp(const ProjectRowsVjpParams<T>&); \
  template void sum_camera_grads(const CameraGradSums<T>&);       \
  template void row_grads(const RowGradsParams<T>&);              \
  template void weight_vjp(int, const WeightParams<T>&);
AR_INSTANTIATE(float)
AR_INSTANTIATE(double)

}  // namespace ar::cpu
