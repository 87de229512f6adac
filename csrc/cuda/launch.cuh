// How the host launches kernels, and how kernels begin.
//
// A kernel may be put on the device while the one before it on the stream ends (programmatic stream serialization),
// which saves 1 to 2 us for each. So that it touches nothing before then, every kernel but one begins by
// wait_for_earlier_kernels(): all of its threads, since the next kernel waits for this one alone.
//
// The exception is a kernel that works beside the one before it, B beside A. A calls let_next_kernel_begin(), so that B
// is put on the device when all blocks of A are, and B does not wait. What B reads has to be complete by then. So of
// the kernels in front of B, one waits before it lets the next begin: all before that one have ended when any after it
// begins. And B ends after A, for the kernel behind B waits for B alone (begin_beside_earlier_kernels).
#pragma once

#include <cuda_runtime.h>

#include <algorithm>
#include <atomic>
#include <utility>

namespace ar::cuda {

/// Waits until the kernels before this one on its stream have ended and their results can be read.
__device__ inline void wait_for_earlier_kernels() {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
  asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
}

/// Lets the next kernel on the stream begin beside this one, as soon as all blocks of this one have come here or ended.
/// At wait_for_earlier_kernels() it waits until this one has ended all the same.
__device__ inline void let_next_kernel_begin() {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
  asm volatile("griddepcontrol.launch_dependents;" ::: "memory");
#endif
}

/// In the place of wait_for_earlier_kernels(): with `beside` this kernel runs while the one before it does, and those
/// that have let that one begin. It must not need their results. As the next kernel waits for this one alone, its last
/// block has nothing to do but to end after the kernel before: returns whether this is that block.
__device__ inline bool begin_beside_earlier_kernels(bool beside) {
  const bool is_last = blockIdx.x == gridDim.x - 1;
  if (!beside || is_last) wait_for_earlier_kernels();
  return is_last;
}

/// Whether kernels may be put on the current device before those ahead of them have ended. The device has to be able
/// to, its driver also while a graph is captured, and the code has to wait: what is compiled at load time from code for
/// older devices does not. All kernels are compiled for the same devices, so that `kernel` stands for all.
inline bool may_begin_early(const void* kernel) {
  constexpr int kDevices = 64, kGraphsMayHoldIt = 12030;  // version of the driver's CUDA
  enum : signed char { kNotAsked, kNo, kYes };
  static std::atomic<signed char> answers[kDevices];
  int device = 0;
  if (cudaGetDevice(&device) != cudaSuccess || device >= kDevices) return false;
  if (answers[device] == kNotAsked) {
    cudaFuncAttributes code;
    int driver = 0;
    const bool known = cudaFuncGetAttributes(&code, kernel) == cudaSuccess;
    const bool yes = known && code.ptxVersion >= 90 && cudaDriverGetVersion(&driver) == cudaSuccess;
    answers[device] = yes && driver >= kGraphsMayHoldIt ? kYes : kNo;
  }
  return answers[device] == kYes;
}

inline unsigned blocks_of(int64_t n, int threads) { return unsigned((n + threads - 1) / threads); }

/// Blocks, the threads of each, and bytes of dynamic_shared().
struct LaunchShape {
  dim3 blocks;
  unsigned threads;
  size_t shared_bytes = 0;
  /// If not null: recorded when all blocks have begun, as far as the driver can tell, or where kernels may not begin
  /// early, when what is ahead of them on the stream has ended. Only order on the device may depend on it, no result.
  cudaEvent_t begun = nullptr;
};

/// Multiprocessors of the current device.
inline unsigned multiprocessors() {
  int device = 0, count = 1;
  cudaGetDevice(&device);
  cudaDeviceGetAttribute(&count, cudaDevAttrMultiProcessorCount, device);
  return unsigned(count);
}

/// Bytes of shared memory that a block may have on the current device.
inline size_t max_shared_bytes() {
  int device = 0, bytes = 0;
  cudaGetDevice(&device);
  cudaDeviceGetAttribute(&bytes, cudaDevAttrMaxSharedMemoryPerBlockOptin, device);
  return size_t(bytes);
}

/// Bytes of shared memory that each of so many blocks may have that are on a multiprocessor of the current device at
/// once.
inline size_t shared_bytes_of_blocks(int blocks) {
  int device = 0, all = 0, reserved = 0;
  cudaGetDevice(&device);
  cudaDeviceGetAttribute(&all, cudaDevAttrMaxSharedMemoryPerMultiprocessor, device);
  cudaDeviceGetAttribute(&reserved, cudaDevAttrReservedSharedMemoryPerBlock, device);  // by the system, of each block
  const size_t own = std::max(all / blocks - reserved, 0);
  return std::min(own, max_shared_bytes());
}

/// Makes an attribute by which a launch records an event when all of its blocks have begun. False where the toolkit is
/// older than that. (CUDA promises no more than to try; the driver has to be as new, which may_begin_early() asks.)
inline bool set_begun_event([[maybe_unused]] cudaLaunchAttribute& attribute, [[maybe_unused]] cudaEvent_t event) {
#if CUDART_VERSION >= 12030
  attribute.id = cudaLaunchAttributeLaunchCompletionEvent;
  attribute.val.launchCompletionEvent.event = event;
  return true;
#else
  return false;
#endif
}

/// Launches `kernel`. An error is left for cudaGetLastError.
template <class... Params, class... Arguments>
void launch(void (*kernel)(Params...), const LaunchShape& shape, cudaStream_t stream, Arguments&&... arguments) {
  constexpr size_t kUnasked = 48 * 1024;  // bytes of shared memory that every kernel may have
  if (shape.shared_bytes > kUnasked)
    cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, int(shape.shared_bytes));
  const bool early = may_begin_early(reinterpret_cast<const void*>(kernel));
  cudaLaunchAttribute attributes[2] = {};
  attributes[0].id = cudaLaunchAttributeProgrammaticStreamSerialization;
  attributes[0].val.programmaticStreamSerializationAllowed = early;
  const bool records = shape.begun && early && set_begun_event(attributes[1], shape.begun);
  if (shape.begun && !records) cudaEventRecord(shape.begun, stream);
  cudaLaunchConfig_t config = {};
  config.gridDim = shape.blocks;
  config.blockDim = shape.threads;
  config.dynamicSmemBytes = shape.shared_bytes;
  config.stream = stream;
  config.attrs = attributes;
  config.numAttrs = records ? 2 : 1;
  cudaLaunchKernelEx(&config, kernel, std::forward<Arguments>(arguments)...);
}

}  // namespace ar::cuda
