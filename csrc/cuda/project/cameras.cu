// Cameras and lenses from what users give, and adjoints (core/camera/prepare.h), so that a frame neither copies from
// the host nor waits for it. A block per direction and camera searches the limits of a lens.
#include "cuda/project/cameras.h"

#include "cuda/launch.cuh"

namespace ar::cuda {
namespace {

constexpr int kThreads = 128, kWriters = 32;

/// The least k in [0, kLimitAngles] for which bad(k), or kLimitAngles + 1. All threads get it.
template <class Bad> __device__ int first_of_block(const Bad& bad) {
  __shared__ int first;
  __syncthreads();
  if (threadIdx.x == 0) first = kLimitAngles + 1;
  __syncthreads();
  for (int k = threadIdx.x; k <= kLimitAngles; k += kThreads) {
    if (bad(k)) atomicMin(&first, k);
  }
  __syncthreads();
  return first;
}

/// Grid: (directions, cameras), also below.
template <class Source> __global__ void __launch_bounds__(kThreads) fold_kernel(const Source source, double* folds) {
  wait_for_earlier_kernels();
  const int direction = int(blockIdx.x), c = int(blockIdx.y);
  const Lens<double> lens = source.lens(c);
  const FullCamera<double> camera = bare_camera(lens);
  const double fold = fold_in_direction(limit_kind(lens), [&](double first, double last) {
    return first_of_block([&](int k) { return !is_map_at(camera, limit_angle(first, last, k), direction); });
  });
  if (threadIdx.x == 0) folds[c * kLimitDirections + direction] = fold;
}

template <class Source> __device__ double fold_of(const Source& source, const double* folds, int c) {
  if (source.limits.fold > 0 || !folds) return source.limits.fold;
  double fold = folds[c * kLimitDirections];
  for (int k = 1; k < kLimitDirections; ++k) fold = min(fold, folds[c * kLimitDirections + k]);
  return fold;
}

template <class Source>
__global__ void __launch_bounds__(kThreads) reach_kernel(const Source source, const double* folds, int32_t* seen) {
  wait_for_earlier_kernels();
  __shared__ int last;
  const int direction = int(blockIdx.x), c = int(blockIdx.y);
  if (threadIdx.x == 0) last = -1;
  __syncthreads();
  const Lens<double> lens = source.lens(c);
  const FullCamera<double> camera = bare_camera(lens);
  const double corner = corner_distance(lens), fold = fold_of(source, folds, c);
  for (int k = threadIdx.x; k <= kLimitAngles; k += kThreads) {
    if (distance_seen(camera, limit_angle(0, fold, k), direction) <= corner) atomicMax(&last, k);
  }
  __syncthreads();
  if (threadIdx.x == 0) seen[c * kLimitDirections + direction] = last;
}

/// A thread per camera.
template <class Source>
__global__ void __launch_bounds__(kWriters)
    write_cameras_kernel(const Source source, const double* folds, const int32_t* seen) {
  wait_for_earlier_kernels();
  const int c = int(blockIdx.x) * kWriters + int(threadIdx.x);
  if (c >= source.count) return;
  int last = -1;
  for (int k = 0; seen && k < kLimitDirections; ++k) last = max(last, int(seen[c * kLimitDirections + k]));
  write_lens(source, c, fold_of(source, folds, c), last);
  source.write_matrices(c);
}

template <typename T>
__global__ void __launch_bounds__(kWriters)
    cameras_vjp_kernel(const CameraSource<T> source, const CameraSourceGrads<T> grads) {
  wait_for_earlier_kernels();
  const int c = int(blockIdx.x) * kWriters + int(threadIdx.x);
  if (c < source.count) camera_source_vjp(source, grads, c);
}

template <typename T>
__global__ void __launch_bounds__(kWriters)
    middle_vjp_kernel(const T* view, const T* proj, const T* dL_dlens, T* dL_dview, T* dL_dproj) {
  wait_for_earlier_kernels();
  if (threadIdx.x == 0) write_middle_vjp(view, proj, dL_dlens, dL_dview, dL_dproj);
}

unsigned blocks_of_cameras(int count) { return unsigned((count + kWriters - 1) / kWriters); }

}  // namespace

template <class Source> void prepare(const Source& source, const LimitScratch& scratch, cudaStream_t stream) {
  const dim3 grid(kLimitDirections, unsigned(source.count));
  const bool folds = finds_fold(source), reaches = finds_reach(source);
  if (folds) launch(fold_kernel<Source>, {grid, kThreads}, stream, source, scratch.folds);
  const double* found = folds ? scratch.folds : nullptr;
  if (reaches) launch(reach_kernel<Source>, {grid, kThreads}, stream, source, found, scratch.seen);
  launch(write_cameras_kernel<Source>, {blocks_of_cameras(source.count), kWriters}, stream, source, found,
         static_cast<const int32_t*>(reaches ? scratch.seen : nullptr));
}
template void prepare(const CameraSource<float>&, const LimitScratch&, cudaStream_t);
template void prepare(const CameraSource<double>&, const LimitScratch&, cudaStream_t);
template void prepare(const LensSource<float>&, const LimitScratch&, cudaStream_t);
template void prepare(const LensSource<double>&, const LimitScratch&, cudaStream_t);

template <typename T>
void prepare_vjp(const CameraSource<T>& source, const CameraSourceGrads<T>& grads, cudaStream_t stream) {
  launch(cameras_vjp_kernel<T>, {blocks_of_cameras(source.count), kWriters}, stream, source, grads);
}
template void prepare_vjp(const CameraSource<float>&, const CameraSourceGrads<float>&, cudaStream_t);
template void prepare_vjp(const CameraSource<double>&, const CameraSourceGrads<double>&, cudaStream_t);

template <typename T>
void middle_vjp(const T* view, const T* proj, const T* dL_dlens, T* dL_dview, T* dL_dproj, cudaStream_t stream) {
  launch(middle_vjp_kernel<T>, {1, kWriters}, stream, view, proj, dL_dlens, dL_dview, dL_dproj);
}
template void middle_vjp(const float*, const float*, const float*, float*, float*, cudaStream_t);
template void middle_vjp(const double*, const double*, const double*, double*, double*, cudaStream_t);

}  // namespace ar::cuda
