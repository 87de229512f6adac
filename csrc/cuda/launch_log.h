// For tests: what launch() calls while torch/for_tests_cuda.cpp records kernels.
#pragma once

#include <atomic>

namespace ar::cuda {

/// Null where nobody records. `kernel`: the host's address of a kernel.
inline std::atomic<void (*)(const void* kernel)> launch_observer = nullptr;

}  // namespace ar::cuda
