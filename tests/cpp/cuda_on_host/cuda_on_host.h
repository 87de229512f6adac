// Runs kernels of csrc/cuda on the host: a block after the other, its threads as contexts that take turns wherever they
// wait for each other. Slow, and without anything of the memory model, but in every CI. Include before any kernel.
//
// Known: threadIdx, blockIdx, gridDim, __syncthreads, __syncthreads_or, __syncwarp, and the votes, shuffles and bit
// functions below, of which all lanes of a warp must take part.
#pragma once

#include <cuda_runtime_api.h>
#include <setjmp.h>
#include <ucontext.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <functional>
#include <vector>

#undef __global__
#undef __device__
#undef __shared__
#undef __launch_bounds__
#define __global__ inline  // several tests include the same kernels
#define __device__
#define __shared__ thread_local  // of the one thread that all contexts run on
#define __launch_bounds__(...)

// Functions that a device has in the global namespace.
using std::max;
using std::min;

namespace cuda_on_host {

inline constexpr int kMaxThreads = 1024;

struct Context {
  ucontext_t start;
  jmp_buf registers;
  bool started = false, done = false;
};

inline jmp_buf scheduler;
inline std::vector<Context> contexts;
inline std::vector<std::vector<char>> stacks;  // of the contexts; they stay for those of the next blocks

/// Where threads exchange a value each: all must have come before any goes on. What the last exchange gave stays until
/// the one after the next, which no thread can complete before all have read it.
struct Meeting {
  uint64_t given[kMaxThreads], taken[2][kMaxThreads];
  int arrived = 0, number = 0;

  const uint64_t* exchange(int place, int size, uint64_t value);
};
inline Meeting of_warps[kMaxThreads / 32], of_block;

}  // namespace cuda_on_host

struct HostDim {
  unsigned x, y, z;
};
inline HostDim threadIdx, blockIdx, gridDim;

namespace cuda_on_host {

// Jumps from stack to stack: swapcontext would ask the system at each of them. (_FORTIFY_SOURCE takes such a jump for a
// mistake.)
[[gnu::noinline]] inline void resume(Context& thread) {
  if (_setjmp(scheduler)) return;
  if (thread.started) _longjmp(thread.registers, 1);
  thread.started = true;
  setcontext(&thread.start);
}
inline void let_others_run() {
  const unsigned me = threadIdx.x;
  if (!_setjmp(contexts[me].registers)) _longjmp(scheduler, 1);
  threadIdx.x = me;
}

inline const uint64_t* Meeting::exchange(int place, int size, uint64_t value) {
  given[place] = value;
  const int mine = number;
  if (++arrived == size) {
    std::memcpy(taken[mine & 1], given, size * sizeof(uint64_t));
    arrived = 0;
    ++number;
  }
  while (number == mine) let_others_run();
  return taken[mine & 1];
}

inline const uint64_t* exchange_in_warp(uint64_t value) {
  return of_warps[threadIdx.x / 32].exchange(int(threadIdx.x % 32), 32, value);
}
inline const uint64_t* exchange_in_block(uint64_t value) {
  return of_block.exchange(int(threadIdx.x), int(contexts.size()), value);
}
template <class T> T from_lane(T value, int lane) {
  static_assert(sizeof(T) <= sizeof(uint64_t));
  uint64_t bits = 0;
  std::memcpy(&bits, &value, sizeof value);
  std::memcpy(&value, exchange_in_warp(bits) + lane, sizeof value);
  return value;
}

inline std::function<void()> kernel;
inline void run_thread() {
  const unsigned me = threadIdx.x;
  kernel();
  contexts[me].done = true;
  _longjmp(scheduler, 1);
}

/// Calls body() for every thread of every block. In every other block, and every other launch the other ones, threads
/// take their turns from the last to the first: a kernel that forgets to wait does not always get away with it.
inline void launch(int blocks, int threads, std::function<void()> body) {
  constexpr size_t kStack = 1 << 17;
  static int launches = 0;
  ++launches;
  kernel = std::move(body);
  gridDim.x = unsigned(blocks);
  for (int block = 0; block < blocks; ++block) {
    blockIdx.x = unsigned(block);
    contexts = std::vector<Context>(threads);
    for (Meeting& meeting : of_warps) meeting.arrived = meeting.number = 0;
    of_block.arrived = of_block.number = 0;
    while (stacks.size() < contexts.size()) stacks.emplace_back(kStack);
    for (int t = 0; t < threads; ++t) {
      ucontext_t& start = contexts[t].start;
      getcontext(&start);
      start.uc_stack.ss_sp = stacks[t].data();
      start.uc_stack.ss_size = kStack;
      start.uc_link = nullptr;
      makecontext(&start, run_thread, 0);
    }
    for (int left = threads; left > 0;) {
      for (int i = 0; i < threads; ++i) {
        const int t = (block + launches) % 2 ? i : threads - 1 - i;
        if (contexts[t].done) continue;
        threadIdx.x = unsigned(t);
        resume(contexts[t]);
        left -= contexts[t].done;
      }
    }
  }
}

}  // namespace cuda_on_host

inline void __syncthreads() { cuda_on_host::exchange_in_block(0); }
inline int __syncthreads_or(int x) {
  const uint64_t* all = cuda_on_host::exchange_in_block(x != 0);
  return std::any_of(all, all + cuda_on_host::contexts.size(), [](uint64_t one) { return one != 0; });
}
inline void __syncwarp() { cuda_on_host::exchange_in_warp(0); }
inline uint32_t __ballot_sync(uint32_t, bool x) {
  const uint64_t* all = cuda_on_host::exchange_in_warp(x);
  uint32_t bits = 0;
  for (int lane = 0; lane < 32; ++lane) bits |= uint32_t(all[lane]) << lane;
  return bits;
}
inline uint32_t __match_all_sync(uint32_t, uint32_t x, int* agree) {
  const uint64_t* all = cuda_on_host::exchange_in_warp(x);
  *agree = std::all_of(all, all + 32, [&](uint64_t one) { return one == x; });
  return *agree ? 0xffffffff : 0;
}
inline uint32_t __match_any_sync(uint32_t, int x) {
  const uint64_t* all = cuda_on_host::exchange_in_warp(uint32_t(x));
  uint32_t peers = 0;
  for (int lane = 0; lane < 32; ++lane) peers |= uint32_t(all[lane] == uint32_t(x)) << lane;
  return peers;
}
inline bool __any_sync(uint32_t lanes, bool x) { return __ballot_sync(lanes, x) != 0; }
template <class T> T __shfl_sync(uint32_t, T x, int lane) { return cuda_on_host::from_lane(x, lane); }
template <class T> T __shfl_up_sync(uint32_t, T x, int lanes) {
  const int lane = int(threadIdx.x % 32);
  return cuda_on_host::from_lane(x, lane < lanes ? lane : lane - lanes);
}
template <class T> T __shfl_xor_sync(uint32_t, T x, int lanes) {
  return cuda_on_host::from_lane(x, int(threadIdx.x % 32) ^ lanes);
}

namespace ar::cuda {
/// The shared memory whose size a launch gives, of all kernels: they run one after the other.
alignas(16) inline float4 dynamic_memory[1 << 13];
inline float4* dynamic_shared() { return dynamic_memory; }
}  // namespace ar::cuda

// What launches ask about the devices, which are H200s.
namespace cuda_on_host {
inline int device = 0;  ///< the current one
inline constexpr int kMultiprocessors = 132;
inline std::atomic<int> attributes_asked = 0;
}  // namespace cuda_on_host
extern "C" inline cudaError_t cudaGetDevice(int* device) {
  *device = cuda_on_host::device;
  return cudaSuccess;
}
extern "C" inline cudaError_t cudaDeviceGetAttribute(int* value, cudaDeviceAttr attribute, int) {
  ++cuda_on_host::attributes_asked;
  *value = attribute == cudaDevAttrMaxSharedMemoryPerBlockOptin ? 227 * 1024
           : attribute == cudaDevAttrMultiProcessorCount        ? cuda_on_host::kMultiprocessors
                                                                : 0;
  return cudaSuccess;
}

inline int __ffs(uint32_t x) { return __builtin_ffs(int(x)); }
inline uint32_t __brev(uint32_t x) {
  uint32_t reversed = 0;
  for (int bit = 0; bit < 32; ++bit) reversed |= (x >> bit & 1) << (31 - bit);
  return reversed;
}
inline int __popc(uint32_t x) { return __builtin_popcount(x); }
inline int __clz(uint32_t x) { return x ? __builtin_clz(x) : 32; }
inline float __int_as_float(int x) {
  float y;
  std::memcpy(&y, &x, sizeof y);
  return y;
}
inline uint32_t __float_as_uint(float x) {
  uint32_t bits;
  std::memcpy(&bits, &x, sizeof bits);
  return bits;
}
inline int __float_as_int(float x) {
  int y;
  std::memcpy(&y, &x, sizeof y);
  return y;
}
template <class T, class X> T atomicAdd(T* place, X x) {
  const T before = *place;
  *place += x;
  return before;
}
template <class T> T atomicMax(T* place, T x) {
  const T before = *place;
  *place = std::max(before, x);
  return before;
}
