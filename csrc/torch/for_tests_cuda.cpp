// For tests, functions of _C: launched_kernels(), names of kernels launched while recording, and blend_route(), those
// of cuda/dispatch.h.
#include <cuda_runtime_api.h>

#include <mutex>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "cuda/dispatch.h"
#include "cuda/launch_log.h"
#include "torch/backend.h"

namespace ar::ops {
namespace {

std::mutex mutex;
std::set<const void*>& kernels() {
  static auto* recorded = new std::set<const void*>;
  return *recorded;
}
void observe(const void* kernel) {
  const std::lock_guard lock(mutex);
  kernels().insert(kernel);
}

}  // namespace

/// Begins anew, or stops recording.
void record_kernels(bool on) {
  const std::lock_guard lock(mutex);
  kernels().clear();
  cuda::launch_observer = on ? observe : nullptr;
}

/// Mangled names.
std::vector<std::string> launched_kernels() {
  const std::lock_guard lock(mutex);
  std::vector<std::string> names;
  for (const void* kernel : kernels()) {
    const char* name = nullptr;
#if CUDART_VERSION >= 12030
    TORCH_CHECK(cudaFuncGetName(&name, kernel) == cudaSuccess, "a kernel has no name");
#endif
    if (name) names.push_back(name);
  }
  return names;
}

/// Kernels that blend forward and backward, with room for `capacity` pairs.
std::pair<std::vector<std::string>, std::vector<std::string>> blend_route(const std::string& key, int64_t channels,
                                                                          int64_t width, int64_t height,
                                                                          int64_t capacity) {
  const FootprintSpec footprint = find_footprint(key, 0);
  const TileGrid grid = grid_of(footprint, width, height, true);
  const cuda::Route route = cuda::route_of(footprint.choice.index, channels, capacity, grid,
                                           cuda::multiprocessors_of_device(), footprint.along_rays());
  const auto named = [](const auto& names) {
    std::vector<std::string> out;
    for (const char* name : names) {
      if (name) out.emplace_back(name);
    }
    return out;
  };
  return {named(route.forward), named(route.backward)};
}

}  // namespace ar::ops
