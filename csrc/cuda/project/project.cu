// Launches the kernels of project.cuh and project_vjp.cuh for torch/backend_cuda.cpp, where they read a camera for its
// type; params.h declares what they read and write.
#include <algorithm>
#include <mutex>
#include <set>

#include "cuda/launch.cuh"
#include "cuda/project/project_vjp.cuh"

namespace ar::cuda {
namespace {

/// A thread for each of n rows, in at most `most_blocks` blocks.
template <class Params>
void launch_rows(void (*kernel)(Params), const Params& p, int64_t n, cudaStream_t stream, unsigned most_blocks = ~0u) {
  if (n > 0) launch(kernel, {std::min(blocks_of(n, kProjectThreads), most_blocks), kProjectThreads}, stream, p);
}

template <class Params>
void launch_rows(void (*plain)(Params), void (*full)(Params), const Params& p, cudaStream_t stream,
                 unsigned most_blocks = ~0u) {
  launch_rows(p.camera.lens ? full : plain, p, p.gaussians.n, stream, most_blocks);
}

/// All kernels on a multiprocessor share one division of its memory into cache and shared memory: blend_vjp, with much
/// shared memory, cannot begin beside a kernel with much cache. Once per device, as every call takes memory.
void let_blend_vjp_begin_beside_zero_culled_grads() {
  static std::mutex mutex;
  static std::set<int> devices;
  int device = 0;
  cudaGetDevice(&device);
  const std::lock_guard lock(mutex);
  if (!devices.insert(device).second) return;
  cudaFuncSetAttribute(zero_culled_grads_kernel, cudaFuncAttributePreferredSharedMemoryCarveout,
                       cudaSharedmemCarveoutMaxShared);
}

using Plain = Camera<float>;
using Full = FullCamera<float>;

}  // namespace

void project(const ProjectParams& p, cudaStream_t stream) {
  launch_rows(project_kernel<Plain>, project_kernel<Full>, p, stream, multiprocessors() * kProjectBlocksPerSm);
}
void project_rows(const ProjectRowsParams& p, cudaStream_t stream) {
  launch_rows(project_rows_kernel<Plain>, project_rows_kernel<Full>, p, stream);
}
void project_vjp(const ProjectVjpParams& p, cudaStream_t stream) {
  launch_rows(project_vjp_kernel<Plain>, project_vjp_kernel<Full>, p, stream);
}
void zero_culled_grads(const ZeroGradsParams& p, cudaStream_t stream, cudaEvent_t begun) {
  let_blend_vjp_begin_beside_zero_culled_grads();
  launch(zero_culled_grads_kernel, {multiprocessors() * kZeroBlocksPerSm, kZeroThreads, 0, begun}, stream, p);
}
void project_rows_vjp(const ProjectRowsVjpParams& p, cudaStream_t stream) {
  if (!p.add) return launch_rows(project_vjp_kernel<Plain, FromRows>, project_vjp_kernel<Full, FromRows>, p, stream);
  launch_rows(project_vjp_kernel<Plain, FromRows, StagedGrads>, project_vjp_kernel<Full, FromRows, StagedGrads>, p,
              stream);
}

void sum_camera_grads(const CameraGradSums<float>& p, cudaStream_t stream) {
  launch(sum_camera_grads_kernel, {kCameraNumbers, kSumThreads}, stream, p);
}
void shape_rows(const ShapeRowsParams& p, cudaStream_t stream) { launch_rows(shape_rows_kernel, p, p.n, stream); }
void row_grads(const RowGradsParams& p, cudaStream_t stream) { launch_rows(row_grads_kernel, p, p.n, stream); }

void sum_channels(const SumChannelsParams& p, cudaStream_t stream) {
  const int64_t n = p.sums.n;
  if (!p.channel_sums) return launch_rows(sum_few_channels_kernel, p, n, stream);
  const auto kernel = p.width == kSmallGroup ? sum_channels_kernel<kSmallGroup> : sum_channels_kernel<kChannelGroup>;
  if (n > 0) launch(kernel, {blocks_of(n, kSumThreads / kSumLanes), kSumThreads}, stream, p);
}

}  // namespace ar::cuda
