// How the host launches kernels: each while the one before it still runs, so that the gap between two of them, some
// microseconds that a pass of a dozen short kernels has a dozen times, is spent beside it (programmatic dependent
// launch). Kernels that are launched here must begin with begin_kernel(), which waits.
#pragma once

#include <cuda_runtime.h>

#include <cub/util_device.cuh>
#include <utility>

#include "cuda/side_streams.h"
#include "cuda/warp.cuh"

namespace ar::cuda {

inline unsigned blocks_of(int64_t n, int threads) { return unsigned((n + threads - 1) / threads); }

/// Blocks, the threads of each, and bytes of dynamic_shared().
struct LaunchShape {
  dim3 blocks;
  unsigned threads;
  size_t shared_bytes = 0;
};

/// Whether a kernel may be launched while the one before it on the stream runs. That takes code that waits: the code
/// counts, not the device, which may run code for an older one.
inline bool launches_overlap() {
  // Older drivers do not capture such launches in a graph.
  static const bool known_to_driver = [] {
    int version = 0;
    return cudaDriverGetVersion(&version) == cudaSuccess && version >= 12030;
  }();
  int code = 0;
  // Side by side, kernels that wait would take the place of others' that could work.
  return known_to_driver && !SideStreams::in_use() && cub::PtxVersion(code) == cudaSuccess && code >= 900;
}

/// Launches `kernel`, which begins with begin_kernel(). An error is left for cudaGetLastError.
template <class... Params, class... Arguments>
void launch(void (*kernel)(Params...), const LaunchShape& shape, cudaStream_t stream, Arguments&&... arguments) {
  constexpr size_t kUnasked = 48 * 1024;  // bytes of shared memory that every kernel may have
  if (shape.shared_bytes > kUnasked)
    cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, int(shape.shared_bytes));
  cudaLaunchConfig_t config = {};
  config.gridDim = shape.blocks;
  config.blockDim = shape.threads;
  config.dynamicSmemBytes = shape.shared_bytes;
  config.stream = stream;
  cudaLaunchAttribute overlap = {};
  overlap.id = cudaLaunchAttributeProgrammaticStreamSerialization;
  overlap.val.programmaticStreamSerializationAllowed = 1;
  config.attrs = &overlap;
  config.numAttrs = launches_overlap() ? 1 : 0;
  cudaLaunchKernelEx(&config, kernel, std::forward<Arguments>(arguments)...);
}

}  // namespace ar::cuda
