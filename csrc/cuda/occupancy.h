// Launch bounds of kernels: how many blocks a multiprocessor of the compiled architecture can hold.
#pragma once

#include <initializer_list>

namespace ar::cuda {

/// Threads that a multiprocessor can hold, by __CUDA_ARCH__.
constexpr int resident_threads(int architecture) {
  for (int known : {800, 900, 1000, 1030}) {
    if (architecture == known) return 2048;
  }
  for (int known : {860, 870, 880, 890, 1100, 1200, 1210}) {
    if (architecture == known) return 1536;
  }
  return 1024;  // 750; the least, for unknown devices
}
#if defined(__CUDA_ARCH__)
inline constexpr int kArchitecture = __CUDA_ARCH__;
#else
inline constexpr int kArchitecture = 900;  // the host needs none
#endif
/// The second launch bound: `wanted` resident blocks, or what fits.
constexpr int blocks_per_sm(int wanted, int threads, int architecture = kArchitecture) {
  const int fit = resident_threads(architecture) / threads;
  return fit < 1 ? 1 : fit < wanted ? fit : wanted;
}

}  // namespace ar::cuda
