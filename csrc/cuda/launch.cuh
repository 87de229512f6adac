// How the host launches kernels.
#pragma once

#include <cuda_runtime.h>

#include <utility>

namespace ar::cuda {

inline unsigned blocks_of(int64_t n, int threads) { return unsigned((n + threads - 1) / threads); }

/// Blocks, the threads of each, and bytes of dynamic_shared().
struct LaunchShape {
  dim3 blocks;
  unsigned threads;
  size_t shared_bytes = 0;
};

/// Bytes of shared memory that a block may have on the current device.
inline size_t max_shared_bytes() {
  int device = 0, bytes = 0;
  cudaGetDevice(&device);
  cudaDeviceGetAttribute(&bytes, cudaDevAttrMaxSharedMemoryPerBlockOptin, device);
  return size_t(bytes);
}

/// Launches `kernel`. An error is left for cudaGetLastError.
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
  cudaLaunchKernelEx(&config, kernel, std::forward<Arguments>(arguments)...);
}

}  // namespace ar::cuda
