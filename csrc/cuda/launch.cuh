// How kernels are launched and begin, and what the host asks a device.
//
// A kernel may begin before earlier kernels of its stream have ended (programmatic dependent launch): every thread
// first calls wait_for_earlier_kernels(). Except in a kernel B that runs beside the kernel A before it: A calls
// let_next_kernel_begin(), B begin_beside_earlier_kernels(). B reads what was written before a kernel that waits first
// and then lets the next begin.
#pragma once

#include <cuda_runtime.h>

#include <algorithm>
#include <atomic>
#include <utility>

#include "cuda/launch_log.h"

namespace ar::cuda {

inline constexpr int kMaxDevices = 64;

__device__ inline void wait_for_earlier_kernels() {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
  asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
}

/// When all blocks have called this or ended.
__device__ inline void let_next_kernel_begin() {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
  asm volatile("griddepcontrol.launch_dependents;" ::: "memory");
#endif
}

/// For kernel B. True for the last block, which only ends after kernel A, because the next kernel waits for B alone.
__device__ inline bool begin_beside_earlier_kernels(bool beside) {
  const bool is_last = blockIdx.x == gridDim.x - 1;
  if (!beside || is_last) wait_for_earlier_kernels();
  return is_last;
}

/// Whether kernels may begin early on the current device, in graphs too. Code from older PTX does not wait; `kernel`
/// stands for all.
inline bool may_begin_early(const void* kernel) {
  constexpr int kGraphsMayHoldIt = 12030;  // CUDA of the driver
  enum : signed char { kNotAsked, kNo, kYes };
  static std::atomic<signed char> answers[kMaxDevices];
  int device = 0;
  if (cudaGetDevice(&device) != cudaSuccess || device >= kMaxDevices) return false;
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

struct LaunchShape {
  dim3 blocks;
  unsigned threads;
  size_t shared_bytes = 0;  ///< of dynamic_shared()
  /// Recorded when all blocks have begun, or earlier: no result may depend on it.
  cudaEvent_t begun = nullptr;
};

/// Of the current device, which is asked once; 0 on errors.
template <cudaDeviceAttr kAttribute> int device_attribute() {
  static std::atomic<int> answers[kMaxDevices];  // 0: not asked
  int device = 0, answer = 0;
  if (cudaGetDevice(&device) != cudaSuccess) return 0;
  const bool remembers = device < kMaxDevices;
  if (remembers) answer = answers[device];
  if (answer == 0 && cudaDeviceGetAttribute(&answer, kAttribute, device) == cudaSuccess && remembers)
    answers[device] = answer;
  return answer;
}

inline unsigned multiprocessors() { return unsigned(std::max(device_attribute<cudaDevAttrMultiProcessorCount>(), 1)); }

inline size_t max_shared_bytes() { return size_t(device_attribute<cudaDevAttrMaxSharedMemoryPerBlockOptin>()); }

/// For each of so many blocks on a multiprocessor.
inline size_t shared_bytes_of_blocks(int blocks) {
  const int all = device_attribute<cudaDevAttrMaxSharedMemoryPerMultiprocessor>();
  const int reserved = device_attribute<cudaDevAttrReservedSharedMemoryPerBlock>();  // of each block
  const size_t own = std::max(all / blocks - reserved, 0);
  return std::min(own, max_shared_bytes());
}

/// False if the toolkit is older than that.
inline bool set_begun_event([[maybe_unused]] cudaLaunchAttribute& attribute, [[maybe_unused]] cudaEvent_t event) {
#if CUDART_VERSION >= 12030
  attribute.id = cudaLaunchAttributeLaunchCompletionEvent;
  attribute.val.launchCompletionEvent.event = event;
  return true;
#else
  return false;
#endif
}

/// cudaGetLastError() tells of errors.
template <class... Params, class... Arguments>
void launch(void (*kernel)(Params...), const LaunchShape& shape, cudaStream_t stream, Arguments&&... arguments) {
  if (const auto observe = launch_observer.load(std::memory_order_relaxed))
    observe(reinterpret_cast<const void*>(kernel));
  constexpr size_t kUnasked = 48 * 1024;  // bytes that every kernel may have
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
