// Kernels of project and project_vjp: a thread per Gaussian.
#pragma once

#include "core/project.h"
#include "cuda/tasks.h"
#include "cuda/warp.cuh"

namespace ar::cuda {

inline constexpr int kProjectThreads = 128;

/// Rows of spherical harmonics, up to kDegree, of a warp's Gaussians. Rows go between here and memory with
/// neighbouring lanes at neighbouring addresses; 49 or 76 floats a row keep the lanes on different banks, or nearly.
template <int kDegree> struct ShRows {
  static constexpr int kCount = sh_count(kDegree), kStride = 3 * kCount + 1;
  float value[32][kStride];

  /// Moves the first 4 kQuads numbers of all 32 rows of 4 `quads` in memory, all at once.
  template <int kQuads> __device__ void load_quads(const float4* base, int quads, uint32_t lanes) {
    const int lane = lane_id();
#pragma unroll
    for (int e = 0; e < kQuads; ++e) {
      const int k = e * 32 + lane, row = k / kQuads, q = k % kQuads;
      if (!(lanes >> row & 1)) continue;
      const float4 v = base[row * quads + q];
      float* to = value[row] + 4 * q;
      to[0] = v.x, to[1] = v.y, to[2] = v.z, to[3] = v.w;
    }
    __syncwarp();
  }

  /// Loads `count` coefficients of the rows of the lanes in `lanes`; base is lane 0's row.
  __device__ void load(const Vec3<float>* base, int stride, int count, uint32_t lanes) {
    if (3 * stride % 4 == 0 && reinterpret_cast<uintptr_t>(base) % 16 == 0) {
      const auto* quads = reinterpret_cast<const float4*>(base);
      if (count == 16) return load_quads<12>(quads, 3 * stride / 4, lanes);
      if (count == 9) return load_quads<7>(quads, 3 * stride / 4, lanes);
      if (count == 4) return load_quads<3>(quads, 3 * stride / 4, lanes);
    }
    for (; lanes != 0; lanes &= lanes - 1) {
      const int row = __ffs(lanes) - 1;
      const float* from = &base[int64_t(row) * stride].x;
      for (int e = lane_id(); e < 3 * count; e += 32) value[row][e] = from[e];
    }
    __syncwarp();
  }
  /// Stores rows [0, rows) of `stride` coefficients.
  __device__ void store(Vec3<float>* base, int stride, int rows) const {
    __syncwarp();
    if (stride == 16 && reinterpret_cast<uintptr_t>(base) % 16 == 0) {
      auto* to = reinterpret_cast<float4*>(base);
#pragma unroll
      for (int e = 0; e < 12; ++e) {
        const int k = e * 32 + lane_id(), row = k / 12;
        const float* from = value[row] + 4 * (k % 12);
        if (row < rows) to[k] = {from[0], from[1], from[2], from[3]};
      }
      return;
    }
    const int width = 3 * stride;
    float* to = &base->x;
    for (int row = 0; row < rows; ++row) {
      for (int e = lane_id(); e < width; e += 32) to[row * width + e] = value[row][e];
    }
  }
  __device__ Vec3<float>* row() { return reinterpret_cast<Vec3<float>*>(value[lane_id()]); }
};

template <class F, class Cam>
__global__ void __launch_bounds__(kProjectThreads) project_kernel(const ProjectTask task) {
  __shared__ ShRows<Cam::kShDegree> sh_rows[kProjectThreads / 32];
  const Gaussians<float>& g = task.gaussians;
  const int64_t i = int64_t(blockIdx.x) * kProjectThreads + threadIdx.x;
  const Cam camera = load_camera_as<Cam>(task.camera);
  Splat<F, float> splat = {};
  float depth = 0;
  int radius = 0;
  const float blur = float(max(task.options.variance, kPixelVariance));
  if (i < g.n && may_be_visible(camera, g, i, blur)) radius = project_shape(camera, g, i, task.options, splat, depth);
  ShRows<Cam::kShDegree>& rows = sh_rows[threadIdx.x / 32];
  const uint32_t lit = __ballot_sync(kAllLanes, splat.level > 0);
  if (g.shs && lit) rows.load(g.shs + (i - lane_id()) * g.sh_stride, g.sh_stride, sh_count(g.sh_degree), lit);
  int count = 0;
  if (splat.level > 0) {
    if (splat_color(camera, g, i, rows.row(), splat.color)) {
      for_each_tile_row(support_of(splat), camera.grid,
                        [&](int, Range columns) { count += columns.last - columns.first + 1; });
    } else {
      radius = 0;
      splat.level = 0;
    }
  }
  if (i >= g.n) return;
  auto* splats = reinterpret_cast<Splat<F, float>*>(task.splats);
  if (radius > 0) splats[i] = splat;
  task.keys[i] = count > 0 ? __float_as_uint(depth) : kCulledKey;
  task.ranges[i] = {0, count};
  task.radii[i] = radius;
}

template <class F> void project(const ProjectTask& task, cudaStream_t stream) {
  if (task.gaussians.n == 0) return;
  const auto kernel = task.camera.lens ? project_kernel<F, FullCamera<float>> : project_kernel<F, Camera<float>>;
  kernel<<<blocks_of(task.gaussians.n, kProjectThreads), kProjectThreads, 0, stream>>>(task);
}

/// Gradients summed for one splat.
struct SplatSums {
  float value[kPairGradWidth];

  __device__ void add(const float* row) {
    const float4* quads = reinterpret_cast<const float4*>(row);
#pragma unroll
    for (int q = 0; q < kPairGradWidth / 4; ++q) {
      const float4 v = quads[q];
      value[4 * q] += v.x, value[4 * q + 1] += v.y, value[4 * q + 2] += v.z, value[4 * q + 3] += v.w;
    }
  }
  __device__ PairGrad<float> grad() const {
    return {{{value[0], value[1]}, {value[2], value[3], value[4]}}, value[5], {value[6], value[7], value[8]}};
  }
};

/// A splat with more pairs than this is summed by its whole warp.
inline constexpr int kManyPairs = 64;

/// Sums the pairs of each lane's splat, always in the same order.
__device__ inline SplatSums sum_pairs(const ProjectVjpTask& task, PairRange range) {
  SplatSums sums = {};
  const auto add_pair = [&](SplatSums& to, int q) { to.add(task.pair_grads + int64_t(q) * kPairGradWidth); };
  if (range.count <= kManyPairs) {
    for (int q = range.first; q < range.first + range.count; ++q) add_pair(sums, q);
  }
  for (uint32_t many = __ballot_sync(kAllLanes, range.count > kManyPairs); many != 0; many &= many - 1) {
    const int source = __ffs(many) - 1;
    const int first = __shfl_sync(kAllLanes, range.first, source), count = __shfl_sync(kAllLanes, range.count, source);
    SplatSums part = {};
    for (int q = lane_id(); q < count; q += 32) add_pair(part, first + q);
#pragma unroll
    for (int v = 0; v < kPairGradWidth; ++v) {
      const float total = warp_sum(part.value[v]);
      if (lane_id() == source) sums.value[v] = total;
    }
  }
  return sums;
}

/// Zeros, with neighbouring lanes at neighbouring addresses.
__device__ inline void zero_rows(float* to, int count) {
  for (int e = lane_id(); e < count; e += 32) to[e] = 0;
}

/// Sums of the lanes' gradients, one lane after the other for each number.
__device__ inline void store_warp_sums(const CameraGrad<float>& grad, float* to) {
  const float* values = &grad.view_x.x;
#pragma unroll
  for (int k = 0; k < kCameraGradWidth; ++k) {
    const float total = warp_sum(values[k]);
    if (lane_id() == 0) to[k] = total;
  }
}

template <class F, class Cam>
__global__ void __launch_bounds__(kProjectThreads, Cam::kFull ? 1 : 5) project_vjp_kernel(const ProjectVjpTask task) {
  __shared__ ShRows<Cam::kShDegree> sh_rows[kProjectThreads / 32];
  const Gaussians<float>& g = task.gaussians;
  const int64_t i = int64_t(blockIdx.x) * kProjectThreads + threadIdx.x;
  const int64_t first = i - lane_id();  // of the warp
  if (first >= g.n) return;
  const PairRange range = i < g.n ? task.ranges[i] : PairRange{0, 0};
  const uint32_t lit = __ballot_sync(kAllLanes, range.count > 0);
  const int n = int(min(int64_t(32), g.n - first));
  const GaussianGrads<float>& out = task.grads;
  if (lit == 0) {
    if (out.means) zero_rows(&out.means[first].x, 3 * n);
    if (out.scales) zero_rows(&out.scales[first].x, 3 * n);
    if (out.rotations) zero_rows(&out.rotations[first].x, 4 * n);
    if (out.cov3ds) zero_rows(&out.cov3ds[first].xx, 6 * n);
    if (out.opacities) zero_rows(out.opacities + first, n);
    if (out.colors) zero_rows(&out.colors[first].x, 3 * n);
    if (out.means2d) zero_rows(out.means2d + first * out.means2d_stride, out.means2d_stride * n);
    if (out.shs) zero_rows(&out.shs[first * g.sh_stride].x, 3 * g.sh_stride * n);
    if (Cam::kFull && task.camera_grads) zero_rows(task.camera_grads + first / 32 * kCameraGradWidth, kCameraGradWidth);
    return;
  }
  ShRows<Cam::kShDegree>& rows = sh_rows[threadIdx.x / 32];
  if (g.shs) rows.load(g.shs + first * g.sh_stride, g.sh_stride, sh_count(g.sh_degree), lit);
  SplatSums sums = {};
  if (task.counts->pairs <= task.capacity) {
    sums = sum_pairs(task, range);
  } else if (range.count > 0) {
    sums.add(task.pair_grads + i * kPairGradWidth);
  }
  const Cam camera = load_camera_as<Cam>(task.camera);
  // Longer rows than the largest degree's hold coefficients without influence.
  const bool staged = out.shs && g.sh_stride <= rows.kCount;
  Vec3<float>* dL_dsh = staged ? rows.row() : out.shs ? out.shs + i * g.sh_stride : nullptr;
  CameraGrad<float> camera_grad = {};
  if (range.count > 0) {
    ar::project_vjp<F>(camera, g, i, task.options, sums.grad(), rows.row(), dL_dsh, out,
                       Cam::kFull && task.camera_grads ? &camera_grad : nullptr);
    if (out.means2d && out.means2d_stride == 4) {
      out.means2d[i * 4 + 2] = 0.5f * camera.size.x * sums.value[9];
      out.means2d[i * 4 + 3] = 0.5f * camera.size.y * sums.value[10];
    }
  } else if (i < g.n) {
    zero_grads(g, i, out, dL_dsh);
  }
  if (staged) rows.store(out.shs + first * g.sh_stride, g.sh_stride, n);
  if constexpr (Cam::kFull) {
    if (task.camera_grads) store_warp_sums(camera_grad, task.camera_grads + first / 32 * kCameraGradWidth);
  }
}

template <class F> void project_vjp(const ProjectVjpTask& task, cudaStream_t stream) {
  if (task.gaussians.n == 0) return;
  const auto kernel =
      task.camera.lens ? project_vjp_kernel<F, FullCamera<float>> : project_vjp_kernel<F, Camera<float>>;
  kernel<<<blocks_of(task.gaussians.n, kProjectThreads), kProjectThreads, 0, stream>>>(task);
}

}  // namespace ar::cuda
