// Rows of spherical harmonics between memory and the threads of a warp.
#pragma once

#include "core/sh.h"
#include "cuda/warp.cuh"

namespace ar::cuda {

/// Rows of spherical harmonics, up to kDegree, of a warp's Gaussians. Rows go between here and memory with
/// neighbouring lanes at neighbouring addresses; 49 or 76 floats a row keep the lanes on different banks, or nearly.
template <int kDegree> struct ShRows {
  static constexpr int kCount = sh_count(kDegree), kStride = 3 * kCount + 1;
  float value[32][kStride];

  /// Begins to load `count` coefficients of the rows of the lanes in `lanes`; base is lane 0's row. They are here after
  /// wait_for_copies().
  __device__ void begin_load(const Vec3<float>* base, int stride, int count, uint32_t lanes) {
    if (stride == kPacked && count == kPacked) return begin_load_packed(&base->x, lanes);
    const float* from = &base->x + lane_id();
    float* to = value[0] + lane_id();
    const int here = 3 * count - lane_id();
#pragma unroll 8
    for (int row = 0; row < 32; ++row, from += 3 * stride, to += kStride) {
      if (!(lanes >> row & 1)) continue;
#pragma unroll
      for (int e = 0; e < 3 * kCount; e += 32) {
        if (e < here) copy_async(to + e, from + e);
      }
    }
  }
  /// Stores rows [0, rows) of `stride` coefficients, or adds them to those that are there.
  template <bool kAdd> __device__ void store(Vec3<float>* base, int stride, int rows) const {
    __syncwarp();
    if (stride == 16 && reinterpret_cast<uintptr_t>(base) % 16 == 0) {
      auto* to = reinterpret_cast<float4*>(base);
#pragma unroll
      for (int e = 0; e < 12; ++e) {
        const int k = e * 32 + lane_id(), row = k / 12;
        const float* from = value[row] + 4 * (k % 12);
        if (row >= rows) continue;
        float4 stored = {from[0], from[1], from[2], from[3]};
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
      for (int e = lane_id(); e < width; e += 32)
        to[row * width + e] = kAdd ? to[row * width + e] + value[row][e] : value[row][e];
    }
  }
  __device__ Vec3<float>* row() { return reinterpret_cast<Vec3<float>*>(value[lane_id()]); }

 private:
  /// Coefficients of degree 3 without gaps, as most scenes have them: all lanes copy, two rows with three copies, at
  /// offsets that are known when this is compiled.
  static constexpr int kPacked = sh_count(3);
  __device__ void begin_load_packed(const float* base, uint32_t lanes) {
    constexpr int kWidth = 3 * kPacked;
    static_assert(kWidth == 48);
    const float* from = base + lane_id();
    const bool second = lane_id() >= 16;  // of the two rows, in the second copy
    const CopyTarget to(value[0] + lane_id()), middle(value[0] + lane_id() + 32 + (second ? kStride - kWidth : 0));
    const uint32_t middle_lanes = lanes >> second;
#pragma unroll
    for (int row = 0; row < 32; row += 2) {
      const float* rows = from + row * kWidth;
      if (lanes & 1u << row) to.copy(row * kStride, rows);
      if (middle_lanes & 1u << row) middle.copy(row * kStride, rows + 32);
      if (lanes & 2u << row) to.copy((row + 1) * kStride + 16, rows + 64);
    }
  }
};

}  // namespace ar::cuda
