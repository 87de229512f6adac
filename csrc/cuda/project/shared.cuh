// For kernels of projection: the camera and harmonics in shared memory, and launches.
#pragma once

#include <algorithm>

#include "core/camera.h"
#include "core/sh.h"
#include "cuda/launch.cuh"
#include "cuda/project/policy.h"
#include "cuda/warp.cuh"

namespace ar::cuda {

/// A camera that takes no registers. As bytes, because shared variables may not have initialisers.
template <class Cam> struct SharedCamera {
  alignas(16) char memory[sizeof(Cam)];

  /// All threads of a block must call it.
  __device__ const Cam& load(const CameraView<float>& view) {
    Cam& camera = *reinterpret_cast<Cam*>(memory);
    if (threadIdx.x == 0) camera = load_camera_as<Cam>(view);
    __syncthreads();
    return camera;
  }
};

/// Coefficients up to kDegree, a row per lane. Rows have an odd number of quads, 13 or 19, so that lanes access
/// different banks.
template <int kDegree> struct ShRows {
  static constexpr int kCount = sh_count(kDegree), kStride = ((3 * kCount + 3) / 4 | 1) * 4;
  alignas(16) float value[32][kStride];

  /// `count` coefficients for each of `lanes`, to read after wait_for_copies(). `base`: [32, stride] of the warp.
  __device__ void begin_load(const Vec3<float>* base, int stride, int count, uint32_t lanes) {
    if (stride == kPacked && count == kPacked && in_quads(base)) return begin_load_packed(base, lanes);
    const float* from = &base->x + lane_id();
    float* to = value[0] + lane_id();
    const int here = 3 * count - lane_id();
#pragma unroll 8
    for (int row = 0; row < 32; ++row, from += 3 * stride, to += kStride) {
      if (!(lanes >> row & 1)) continue;
      AR_UNROLL for (int e = 0; e < 3 * kCount; e += 32) {
        if (e < here) copy_async(to + e, from + e);
      }
    }
  }
  /// Writes `rows` rows to `base` [rows, stride]; kAdd: adds them. Coefficients that are not here count as zero.
  template <bool kAdd> __device__ void store(Vec3<float>* base, int stride, int rows) const {
    __syncwarp();
    if (stride == kPacked && in_quads(base)) {
      auto* to = reinterpret_cast<float4*>(base);
      AR_UNROLL for (int e = 0; e < kQuads; ++e) {
        const int k = e * 32 + lane_id(), row = k / kQuads;
        if (row >= rows) continue;
        float4 stored = *quad(row, k % kQuads);
        if (kAdd) {
          const float4 old = to[k];
          stored = {old.x + stored.x, old.y + stored.y, old.z + stored.z, old.w + stored.w};
        }
        to[k] = stored;
      }
      return;
    }
    const int width = 3 * stride;
    float* to = &base->x;
    for (int row = 0; row < rows; ++row) {
      for (int e = lane_id(); e < width; e += 32) {
        const float stored = e < 3 * kCount ? value[row][e] : 0.0f;
        to[row * width + e] = kAdd ? to[row * width + e] + stored : stored;
      }
    }
  }
  __device__ Vec3<float>* row() { return reinterpret_cast<Vec3<float>*>(value[lane_id()]); }

 private:
  /// Of degree 3 without gaps, as in most scenes.
  static constexpr int kPacked = sh_count(3), kQuads = 3 * kPacked / 4, kSteps = 3, kRowsOfStep = kSteps * 32 / kQuads;
  static_assert(kRowsOfStep * kQuads == kSteps * 32);

  __device__ static bool in_quads(const Vec3<float>* base) {
    return reinterpret_cast<uintptr_t>(base) % sizeof(float4) == 0;
  }
  __device__ float4* quad(int row, int k) { return reinterpret_cast<float4*>(value[row]) + k; }
  __device__ const float4* quad(int row, int k) const { return reinterpret_cast<const float4*>(value[row]) + k; }

  /// With offsets that the compiler knows.
  __device__ void begin_load_packed(const Vec3<float>* base, uint32_t lanes) {
    const auto* from = reinterpret_cast<const float4*>(base) + lane_id();
    AR_UNROLL for (int step = 0; step < kSteps; ++step) {
      const int k = 32 * step + lane_id();
      float4* to = quad(k / kQuads, k % kQuads);
      const uint32_t mine = lanes >> k / kQuads;
      AR_UNROLL for (int row = 0; row < 32; row += kRowsOfStep) {
        if (mine >> row & 1) copy_async(to + row * kStride / 4, from + 32 * step + row * kQuads);
      }
    }
  }
};

/// A thread for each of n rows.
template <class Params>
void launch_rows(void (*kernel)(Params), const Params& p, int64_t n, cudaStream_t stream, unsigned most_blocks = ~0u) {
  if (n > 0)
    launch(kernel, {std::min(blocks_of(n, ProjectPolicy::kThreads), most_blocks), ProjectPolicy::kThreads}, stream, p);
}
/// By the kind of camera.
template <class Params>
void launch_rows(void (*plain)(Params), void (*full)(Params), const Params& p, cudaStream_t stream,
                 unsigned most_blocks = ~0u) {
  launch_rows(p.camera.lens ? full : plain, p, p.gaussians.n, stream, most_blocks);
}

}  // namespace ar::cuda
