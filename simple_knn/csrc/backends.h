// What a device does for distCUDA2. No torch here: memory comes from the caller.
//
// points: n rows of 3 floats. out: n floats. 0 < n <= kMaxPoints. scratch: as many bytes as scratch_bytes(n) says,
// aligned to 16 (cpu) or 256 (cuda).
#pragma once

#include <cstdint>

struct CUstream_st;

namespace simple_knn {

namespace cpu {
int64_t scratch_bytes(int64_t n);
void mean_distances(const float* points, int64_t n, void* scratch, float* out, int threads);
}  // namespace cpu

/// On the current device, which holds all pointers. Nothing waits for the device. std::runtime_error where CUDA fails.
namespace cuda {
int64_t scratch_bytes(int64_t n);
void mean_distances(const float* points, int64_t n, void* scratch, float* out, CUstream_st* stream);
}  // namespace cuda

}  // namespace simple_knn
