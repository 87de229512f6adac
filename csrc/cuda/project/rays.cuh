// Kernels for the order along rays (core/order.h): ray_depths after `project`, row_slopes after `project_rows`. Apart,
// so that both stay as quick.
#pragma once

#include "core/order.h"
#include "cuda/project/project.cuh"

namespace ar::cuda {

template <class Cam>
__global__ void __launch_bounds__(ProjectPolicy::kThreads) ray_depths_kernel(const RayDepthsParams params) {
  wait_for_earlier_kernels();
  __shared__ SharedCamera<Cam> shared_camera;
  const Cam& camera = shared_camera.load(params.camera);
  const int64_t i = int64_t(blockIdx.x) * ProjectPolicy::kThreads + threadIdx.x;
  if (i >= params.gaussians.n || params.ranges[i].count == 0) return;
  const Vec3<float> view = project_mean(camera, params.gaussians.means[i]).view;
  params.depths[i] = {depth_at(camera, view), ray_slope(camera, params.gaussians, i, view, DepthKind::kOfModel)};
}

/// Where there is no row the slope is zero already.
template <class Cam>
__global__ void __launch_bounds__(ProjectPolicy::kThreads) row_slopes_kernel(const ProjectRowsParams params) {
  wait_for_earlier_kernels();
  __shared__ SharedCamera<Cam> shared_camera;
  const Cam& camera = shared_camera.load(params.camera);
  const int64_t i = int64_t(blockIdx.x) * ProjectPolicy::kThreads + threadIdx.x;
  const RowOutputs<float>& to = params.rows;
  const int64_t row = i < params.gaussians.n ? to.places.of(i) : -1;
  if (row < 0 || to.radii[to.conics ? 2 * row : row] <= 0) return;
  const Vec3<float> view = project_mean(camera, params.gaussians.means[i]).view;
  to.slopes[row] = ray_slope(camera, params.gaussians, i, view, params.rules.order);
}

}  // namespace ar::cuda
