// The backward pass of CUDA: the adjoints of forward.cu, called in the same way. `blend_vjp` is in still/, moment/,
// channels/ and rays/, the rest in project/project_vjp.cuh.
#include <algorithm>
#include <mutex>
#include <set>

#include "cuda/dispatch.h"
#include "cuda/project/project_vjp.cuh"

namespace ar::cuda {
namespace {

/// Kernels on a multiprocessor share one division of its memory: blend_vjp, with much shared memory, cannot begin
/// beside a kernel with much cache. Once per device: every call takes memory.
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

constexpr int kClearBlock = 256;

/// Before each group of channels. Zeros *chunks_taken and, with patches, the rows that tiles add to: pair_grads for the
/// first group, channel_sums [n, width] for all.
__global__ void clear_sums_kernel(const BlendVjpParams params, int first, int width) {
  wait_for_earlier_kernels();
  if (blockIdx.x == 0 && threadIdx.x == 0) *params.chunks_taken = 0;
  if (!params.lists.counts->in_patches(params.lists.capacity)) return;
  const auto clear = [&](float* to, int numbers_of_row) {
    const int64_t n = params.lists.n * numbers_of_row;
    for (int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x; i < n; i += int64_t(gridDim.x) * blockDim.x)
      to[i] = 0;
  };
  if (first == 0) clear(params.pair_grads, kPairGradWidth);
  if (params.channel_sums) clear(params.channel_sums, width);
}

using Policy = ProjectPolicy;
using Plain = Camera<float>;
using Full = FullCamera<float>;

}  // namespace

void zero_culled_grads(const ZeroGradsParams& p, cudaStream_t stream, cudaEvent_t begun) {
  let_blend_vjp_begin_beside_zero_culled_grads();
  launch(zero_culled_grads_kernel, {multiprocessors() * Policy::kZeroBlocksPerSm, Policy::kZeroThreads, 0, begun},
         stream, p);
}

void blend_vjp(int footprint, const BlendVjpParams& p, int first, cudaStream_t stream) {
  const int width = channel_group(footprint, p.channels.count - first);
  launch(clear_sums_kernel, {kBlocksPerSm * multiprocessors(), kClearBlock}, stream, p, first, width);
  const Family family = family_at(footprint, p.channels.count, p.order.window > 0);
  if (family == Family::kStill) blend_vjp_still(footprint, p, stream);
  if (family == Family::kMoment) blend_vjp_moment(footprint, p, first, stream);
  if (family == Family::kChannels) blend_vjp_channels(footprint, p, first, stream);
  if (family == Family::kRays) blend_vjp_rays(footprint, p, stream);
}

void sum_channels(const SumChannelsParams& p, cudaStream_t stream) {
  const int64_t n = p.sums.n;
  if (!p.channel_sums) return launch_rows(sum_few_channels_kernel, p, n, stream);
  const auto kernel = p.width == kSmallGroup ? sum_channels_kernel<kSmallGroup> : sum_channels_kernel<kChannelGroup>;
  if (n > 0) launch(kernel, {blocks_of(n, Policy::kSumThreads / Policy::kSumLanes), Policy::kSumThreads}, stream, p);
}

void project_vjp(const ProjectVjpParams& p, cudaStream_t stream) {
  launch_rows(project_vjp_kernel<Plain>, project_vjp_kernel<Full>, p, stream);
}

void project_rows_vjp(const ProjectRowsVjpParams& p, cudaStream_t stream) {
  if (!p.add) return launch_rows(project_vjp_kernel<Plain, FromRows>, project_vjp_kernel<Full, FromRows>, p, stream);
  launch_rows(project_vjp_kernel<Plain, FromRows, StagedGrads>, project_vjp_kernel<Full, FromRows, StagedGrads>, p,
              stream);
}

void sum_camera_grads(const CameraGradSums<float>& p, cudaStream_t stream) {
  launch(sum_camera_grads_kernel, {kCameraNumbers, Policy::kSumThreads}, stream, p);
}

void row_grads(const RowGradsParams& p, cudaStream_t stream) { launch_rows(row_grads_kernel, p, p.n, stream); }

}  // namespace ar::cuda
