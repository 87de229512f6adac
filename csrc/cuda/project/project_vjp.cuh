// Kernels of the backward pass beside and after blend_vjp. project_vjp takes sums of pairs, or gradients of public
// rows, to gradients of Gaussians and, for each warp, of the camera. zero_culled_grads writes zeros for 32 adjacent
// Gaussians none of which has pairs. row_grads writes gradients of public rows, sum_channels of channels.
#pragma once

#include "cuda/launch.cuh"
#include "cuda/occupancy.h"
#include "cuda/params.h"
#include "cuda/project/shared.cuh"

namespace ar::cuda {

/// Gaussians of a warp. If none has pairs, zero_culled_grads writes their gradients.
inline constexpr int kGradRows = 32;
static_assert(ProjectPolicy::kThreads % kGradRows == 0 && ProjectPolicy::kZeroThreads % kGradRows == 0);
static_assert(warps_of(kGradRows) == 1 && warps_of(kGradRows + 1) == 2);

__device__ inline uint32_t lanes_with_pairs(int pairs) { return __ballot_sync(kAllLanes, pairs > 0); }
__device__ inline int rows_of_group(int64_t first, int64_t n) { return int(min(int64_t(kGradRows), n - first)); }

struct SplatSums {
  float value[kPairGradWidth];

  /// Adds up to kRows rows [count, kPairGradWidth].
  template <int kRows> __device__ void add(const float* rows, int count) {
    constexpr int kQuads = kPairGradWidth / 4;
    const float4* quads = reinterpret_cast<const float4*>(rows);
    float4 v[kRows][kQuads];
    AR_UNROLL for (int r = 0; r < kRows; ++r) {
      AR_UNROLL for (int q = 0; q < kQuads; ++q) v[r][q] = r < count ? quads[r * kQuads + q] : float4{0, 0, 0, 0};
    }
    AR_UNROLL for (int r = 0; r < kRows; ++r) {
      AR_UNROLL for (int q = 0; q < kQuads; ++q) {
        value[4 * q] += v[r][q].x, value[4 * q + 1] += v[r][q].y;
        value[4 * q + 2] += v[r][q].z, value[4 * q + 3] += v[r][q].w;
      }
    }
  }
  __device__ PairGrad<float> grad() const { return {{{value[0], value[1]}, {value[2], value[3], value[4]}}, value[5]}; }
  __device__ Vec2<float> mean_sums() const { return {value[kPairMeans], value[kPairMeans + 1]}; }
  __device__ Vec3<float> color() const {
    return {value[kPairChannels], value[kPairChannels + 1], value[kPairChannels + 2]};
  }
};

/// Of splat i of each lane, in a fixed order.
__device__ inline SplatSums sum_pairs(const PairSumsView& pairs, int64_t i, PairRange range) {
  SplatSums sums = {};
  const auto row = [&](int64_t k) { return pairs.pair_grads + k * kPairGradWidth; };
  if (pairs.by_splat()) {
    if (range.count > 0) sums.add<1>(row(i), 1);
    return sums;
  }
  if (range.count <= ProjectPolicy::kManyPairs) {
    for (int q = 0; q < range.count; q += ProjectPolicy::kRowsAtOnce)
      sums.add<ProjectPolicy::kRowsAtOnce>(row(range.first + q), range.count - q);
  }
  for (uint32_t many = __brev(__ballot_sync(kAllLanes, range.count > ProjectPolicy::kManyPairs)); many != 0;) {
    const int source = take_first(many);
    const int first = __shfl_sync(kAllLanes, range.first, source), count = __shfl_sync(kAllLanes, range.count, source);
    SplatSums part = {};
    for (int q = lane_id(); q < count; q += 32) part.add<1>(row(first + q), 1);
    AR_UNROLL for (int v = 0; v < kPairGradWidth; ++v) {
      const float total = warp_sum(part.value[v]);
      if (lane_id() == source) sums.value[v] = total;
    }
  }
  return sums;
}

__device__ inline void zero_rows(float* to, int count) {
  if (count % 4 == 0 && reinterpret_cast<uintptr_t>(to) % 16 == 0) {
    for (int e = lane_id(); e < count / 4; e += 32) store_streaming(reinterpret_cast<float4*>(to) + e, {0, 0, 0, 0});
  } else {
    for (int e = lane_id(); e < count; e += 32) to[e] = 0;
  }
}
__device__ inline void zero_grads_of_warp(const Gaussians<float>& g, const GaussianGrads<float>& out, int64_t first,
                                          int n) {
  if (out.means) zero_rows(&out.means[first].x, 3 * n);
  if (out.scales) zero_rows(&out.scales[first].x, 3 * n);
  if (out.rotations) zero_rows(&out.rotations[first].x, 4 * n);
  if (out.cov3ds) zero_rows(&out.cov3ds[first].xx, 6 * n);
  if (out.opacities) zero_rows(out.opacities + first, n);
  if (out.colors) zero_rows(&out.colors[first].x, 3 * n);
  if (out.means2d) zero_rows(out.means2d + first * out.means2d_stride, out.means2d_stride * n);
  if (out.shs) zero_rows(&out.shs[first * g.sh_stride].x, 3 * g.sh_stride * n);
}

/// A view that begins with index `first`.
template <class Row> __device__ const Row* view_from(const float* rows, int64_t first) {
  return reinterpret_cast<const Row*>(reinterpret_cast<uintptr_t>(rows) - uintptr_t(first) * sizeof(Row));
}

/// In shared memory, without colours.
struct GaussianRows {
  float means[kGradRows * 3], shapes[kGradRows * 7], opacities[kGradRows];

  /// Begins to load Gaussian first + k for lane k. Returns views, to read after wait_for_copies().
  __device__ Gaussians<float> begin_load(const Gaussians<float>& g, int64_t first, uint32_t lanes) {
    Gaussians<float> out = g;
    copy_rows_async<3>(means, &g.means[first].x, lanes);
    copy_rows_async<1>(opacities, g.opacities + first, lanes);
    out.means = view_from<Vec3<float>>(means, first);
    out.opacities = view_from<float>(opacities, first);
    if (g.cov3ds) {
      copy_rows_async<6>(shapes, &g.cov3ds[first].xx, lanes);
      out.cov3ds = view_from<Sym3<float>>(shapes, first);
    } else {
      float* rotations = shapes + kGradRows * 3;
      copy_rows_async<3>(shapes, &g.scales[first].x, lanes);
      copy_rows_async<4>(rotations, &g.rotations[first].x, lanes);
      out.scales = view_from<Vec3<float>>(shapes, first);
      out.rotations = view_from<Vec4<float>>(rotations, first);
    }
    return out;
  }
};

/// A source of project_vjp: sums of pairs.
struct FromPairs {
  using Params = ProjectVjpParams;
  static constexpr bool kZeroed = true;  ///< by zero_culled_grads
  const ProjectVjpParams& params;

  __device__ PairRange range(int64_t i) const { return params.sums.ranges[i]; }
  __device__ SplatSums sum(int64_t i, PairRange range) const { return sum_pairs(params.sums, i, range); }
  /// Calls use(function from splat to gradient, ShownGrad, sums).
  template <class Cam, class Use>
  __device__ void visit(const Cam& camera, const Gaussians<float>& g, int64_t i, const SplatSums& sums,
                        Use&& use) const {
    ShownGrad<float> shown = {{0, 0, 0}, 0};
    const float depth = depth_of(camera, g.means[i]);
    if (params.dL_dchannels.data) {
      add_channels_vjp(params.dL_dchannels, i, depth, shown);
    } else {
      shown.color = sums.color();
    }
    if (params.channels_in_pairs) {
      const ChannelRows<const float>& columns = params.dL_dchannels;
      const float fourth = sums.value[kPairFourthChannel];
      const ChannelRows<const float> row = {&fourth, 1, -1, columns.depth >= 0 ? 0 : -1,
                                            columns.inverse_depth >= 0 ? 0 : -1};
      add_channels_vjp(row, 0, depth, shown);
    }
    use([&](const Cov2d<float>& cov, float) { return projected_grad(params.footprint, cov, sums.grad()); }, shown,
        sums.mean_sums());
  }
};

/// A source: gradients of public rows.
struct FromRows {
  using Params = ProjectRowsVjpParams;
  static constexpr bool kZeroed = false;
  const ProjectRowsVjpParams& params;

  __device__ PairRange range(int64_t i) const {
    const auto row = int32_t(params.rows.places.of(i));
    return {row, row >= 0 && has_gradient(params.rows, row) ? 1 : 0};
  }
  __device__ int64_t sum(int64_t, PairRange range) const { return range.first; }  ///< the row
  template <class Cam, class Use>
  __device__ void visit(const Cam&, const Gaussians<float>&, int64_t, int64_t row, Use&& use) const {
    use([&](const Cov2d<float>&, float opacity) { return projected_grad(params.rows, row, opacity); },
        shown_grad(params.rows, row), Vec2<float>{0, 0});
  }
};

/// Adds; coefficients go by way of shared memory.
struct StagedGrads : GaussianGrads<float> {
  AR_HD static constexpr bool adds() { return true; }
  AR_HD static constexpr bool adds_shs() { return false; }
  __device__ StagedGrads(const GaussianGrads<float>& grads) : GaussianGrads<float>(grads) {}
};

/// From: FromPairs or FromRows. Out: GaussianGrads<float>, or StagedGrads with FromRows.
template <class Cam, class From = FromPairs, class Out = GaussianGrads<float>>
__global__ void __launch_bounds__(ProjectPolicy::kThreads,
                                  blocks_per_sm(Cam::kFull ? ProjectPolicy::kFullVjpBlocks : ProjectPolicy::kVjpBlocks,
                                                ProjectPolicy::kThreads))
    project_vjp_kernel(const typename From::Params params) {
  wait_for_earlier_kernels();
  __shared__ ShRows<Cam::kShDegree> sh_rows[ProjectPolicy::kThreads / 32];
  __shared__ GaussianRows gaussian_rows[ProjectPolicy::kThreads / 32];
  __shared__ SharedCamera<Cam> shared_camera;
  const From from{params};
  const Out& out = params.grads;
  const int64_t i = int64_t(blockIdx.x) * ProjectPolicy::kThreads + threadIdx.x;
  const int lane = lane_id(), warp = threadIdx.x / 32;
  const int64_t first = i - lane;
  const PairRange range = i < params.gaussians.n ? from.range(i) : PairRange{0, 0};
  const Cam& camera = shared_camera.load(params.camera);
  if (first >= params.gaussians.n) return;
  const uint32_t lit = lanes_with_pairs(range.count);
  const int n = rows_of_group(first, params.gaussians.n);
  float* camera_grads = params.camera_grads ? params.camera_grads + first / kGradRows * kCameraGradWidth : nullptr;
  if (lit == 0) {
    if (!Out::adds() && !From::kZeroed) zero_grads_of_warp(params.gaussians, out, first, n);
    if (Cam::kFull && camera_grads) zero_rows(camera_grads, kCameraGradWidth);
    return;
  }
  // All loads begin before the first wait.
  Gaussians<float> g = gaussian_rows[warp].begin_load(params.gaussians, first, lit);
  ShRows<Cam::kShDegree>& rows = sh_rows[warp];
  if (g.shs) rows.begin_load(g.shs + first * g.sh_stride, g.sh_stride, sh_count(g.sh_degree), lit);
  const auto sums = from.sum(i, range);
  wait_for_copies();
  Vec3<float>* dL_dsh = out.shs ? rows.row() : nullptr;
  g.sh_stride = min(g.sh_stride, rows.kCount);  // in shared memory
  CameraGrad<float> camera_grad = {};
  if (range.count > 0) {
    from.visit(camera, g, i, sums, [&](const auto& grad_of, const auto& shown, Vec2<float> means) {
      const auto grad_of_splat = [&](const Cov2d<float>& cov, float opacity) {
        forget_loads();
        return grad_of(cov, opacity);
      };
      ar::project_vjp(camera, g, i, grad_of_splat, shown, rows.row(), dL_dsh, out,
                      Cam::kFull && camera_grads ? &camera_grad : nullptr);
      write_mean_sums(out, i, camera.size, means);
    });
  } else if (i < g.n) {
    zero_grads(g, i, out, dL_dsh);
  }
  const int stride = params.gaussians.sh_stride;
  if (out.shs) rows.template store<Out::adds()>(out.shs + first * stride, stride, n);
  if (!Cam::kFull || !camera_grads) return;
  const float* values = &camera_grad.view_x.x;
  AR_UNROLL for (int k = 0; k < kCameraGradWidth; ++k) {
    const float total = warp_sum(values[k]);
    if (lane == 0) camera_grads[k] = total;
  }
}

__global__ void __launch_bounds__(ProjectPolicy::kZeroThreads,
                                  blocks_per_sm(ProjectPolicy::kZeroBlocks, ProjectPolicy::kZeroThreads))
    zero_culled_grads_kernel(const ZeroGradsParams params) {
  wait_for_earlier_kernels();
  const int64_t n = params.gaussians.n, step = int64_t(gridDim.x) * ProjectPolicy::kZeroThreads;
  const auto count_of = [&](int64_t i) { return i < n ? params.ranges[i].count : 0; };
  int64_t first = int64_t(blockIdx.x) * ProjectPolicy::kZeroThreads + threadIdx.x - lane_id();
  int count = count_of(first + lane_id());
  for (; first < n; first += step) {
    const uint32_t lit = lanes_with_pairs(count);
    count = count_of(first + step + lane_id());  // of the next group
    if (lit == 0) zero_grads_of_warp(params.gaussians, params.grads, first, rows_of_group(first, n));
  }
}

__global__ void __launch_bounds__(ProjectPolicy::kSumThreads)
    sum_camera_grads_kernel(const CameraGradSums<float> params) {
  wait_for_earlier_kernels();
  constexpr int kThreads = ProjectPolicy::kSumThreads;
  __shared__ double parts[kThreads];
  const CameraNumber<float> number = camera_number(params, int(blockIdx.x));
  if (!number.to) return;
  double sum = 0;
  for (int64_t i = threadIdx.x; number.column >= 0 && i < params.n; i += kThreads)
    sum += params.parts[i * kCameraGradWidth + number.column];
  parts[threadIdx.x] = sum;
  for (int half = kThreads / 2; half > 0; half /= 2) {
    __syncthreads();
    if (threadIdx.x < half) parts[threadIdx.x] += parts[threadIdx.x + half];
  }
  if (threadIdx.x == 0) *number.to = float(parts[0]);
}

__global__ void __launch_bounds__(ProjectPolicy::kThreads) row_grads_kernel(const RowGradsParams params) {
  wait_for_earlier_kernels();
  __shared__ float packed_rows[ProjectPolicy::kThreads * kPackedGradWidthAbsolute];
  const int64_t i = int64_t(blockIdx.x) * ProjectPolicy::kThreads + threadIdx.x;
  const PairRange range = i < params.n ? params.sums.ranges[i] : PairRange{0, 0};
  const SplatSums sums = sum_pairs(params.sums, i, range);
  Vec2<float> dL_dmean = {0, 0};
  Sym2<float> dL_dcov = {0, 0, 0};
  float dL_dopacity = 0;
  if (range.count > 0) {
    const Cov2d<float> cov = params.cov(i);
    const ProjectedGrad<float> grad = projected_grad(params.footprint, cov, sums.grad());
    dL_dmean = grad.splat.dL_dmean;
    dL_dcov = cov_grad(cov, grad.splat);
    dL_dopacity = grad.weighted / params.opacity(i);
  }
  if (params.packed) {
    const int width = params.packed_width;
    write_packed_grad(packed_rows + threadIdx.x * width, width, dL_dmean, {dL_dcov.xx, 2 * dL_dcov.xy, dL_dcov.yy},
                      dL_dopacity, sums.color(), sums.mean_sums());
    __syncthreads();
    const int64_t first = int64_t(blockIdx.x) * ProjectPolicy::kThreads;
    const int numbers = int(min(int64_t(ProjectPolicy::kThreads), params.n - first)) * width;
    for (int e = threadIdx.x; e < numbers; e += ProjectPolicy::kThreads)
      params.packed[first * width + e] = packed_rows[e];
    return;
  }
  if (i >= params.n) return;
  params.dL_dmeans2d[i] = dL_dmean;
  params.dL_dcov2d[i] = {dL_dcov.xx, 2 * dL_dcov.xy, dL_dcov.yy};
  params.dL_dopacities[i] = dL_dopacity;
  if (params.absolute) params.absolute[i] = sums.mean_sums();
  if (params.dL_dcolors) params.dL_dcolors[i] = sums.color();
}

__global__ void __launch_bounds__(ProjectPolicy::kThreads) sum_few_channels_kernel(const SumChannelsParams params) {
  wait_for_earlier_kernels();
  const int64_t i = int64_t(blockIdx.x) * ProjectPolicy::kThreads + threadIdx.x, n = params.sums.n;
  const PairRange range = i < n ? params.sums.ranges[i] : PairRange{0, 0};
  const SplatSums sums = sum_pairs(params.sums, i, range);
  if (i >= n) return;
  AR_UNROLL for (int c = 0; c < kFewChannels; ++c) {
    const float sum = sums.value[c == 3 ? kPairFourthChannel : kPairChannels + c];
    if (c < params.count) params.dL_dchannels[i * params.stride + params.first + c] = sum;
  }
}

/// channel_sums: [rows, C]. A splat has kLanes lanes, or with many pairs the block; a lane four channels.
template <int C>
__global__ void __launch_bounds__(ProjectPolicy::kSumThreads) sum_channels_kernel(const SumChannelsParams params) {
  wait_for_earlier_kernels();
  constexpr int kThreads = ProjectPolicy::kSumThreads, kLanes = ProjectPolicy::kSumLanes;
  constexpr int kQuads = C / 4, kRows = kLanes / kQuads, kSplats = kThreads / kLanes;
  constexpr int kAhead = ProjectPolicy::kSumRowsAtOnce, kMany = ProjectPolicy::kSumManyLoads * kAhead * kRows;
  static_assert(kRows > 0);
  __shared__ PairRange ranges[kSplats];
  __shared__ float4 parts[kThreads / 32][kQuads];
  const int t = int(threadIdx.x), quad = t % kQuads, lane = t % kLanes;
  const int64_t first_splat = int64_t(blockIdx.x) * kSplats, i = first_splat + t / kLanes, n = params.sums.n;
  PairRange range = i < n ? params.sums.ranges[i] : PairRange{0, 0};
  if (params.sums.by_splat() && range.count > 0) range = {int32_t(i), 1};
  const auto add = [](float4& to, const float4& v) { to.x += v.x, to.y += v.y, to.z += v.z, to.w += v.w; };
  const auto sum_rows = [&](const PairRange& of_splat, int row, int step) {
    const auto* quads = reinterpret_cast<const float4*>(params.channel_sums) + int64_t(of_splat.first) * kQuads + quad;
    float4 sum = {0, 0, 0, 0};
    for (int q = row; q < of_splat.count; q += kAhead * step) {
      float4 x[kAhead];
      AR_UNROLL for (int k = 0; k < kAhead; ++k) {
        const int at = q + k * step;
        x[k] = at < of_splat.count ? quads[int64_t(at) * kQuads] : float4{0, 0, 0, 0};
      }
      AR_UNROLL for (int k = 0; k < kAhead; ++k) add(sum, x[k]);
    }
    return sum;
  };
  const auto sum_lanes = [&](float4& sum, int lanes) {
    for (int offset = kQuads; offset < lanes; offset *= 2) {
      add(sum, {__shfl_xor_sync(kAllLanes, sum.x, offset), __shfl_xor_sync(kAllLanes, sum.y, offset),
                __shfl_xor_sync(kAllLanes, sum.z, offset), __shfl_xor_sync(kAllLanes, sum.w, offset)});
    }
  };
  const auto store = [&](int64_t splat, const float4& sum) {
    float* to = params.dL_dchannels + splat * params.stride + params.first + 4 * quad;
    const int left = params.count - 4 * quad;
    if (left >= 4 && params.stride % 4 == 0) {
      *reinterpret_cast<float4*>(to) = sum;
    } else {
      const float values[4] = {sum.x, sum.y, sum.z, sum.w};
      AR_UNROLL for (int c = 0; c < 4; ++c) {
        if (c < left) to[c] = values[c];
      }
    }
  };
  const bool many = range.count > kMany;
  float4 own = sum_rows(many ? PairRange{0, 0} : range, lane / kQuads, kRows);
  sum_lanes(own, kLanes);
  if (i < n && !many && lane < kQuads) store(i, own);
  if (lane == 0) ranges[t / kLanes] = range;
  if (!__syncthreads_or(many)) return;
  for (int k = 0; k < kSplats; ++k) {
    if (ranges[k].count <= kMany) continue;
    float4 sum = sum_rows(ranges[k], t / kQuads, kThreads / kQuads);
    sum_lanes(sum, 32);
    if (t % 32 < kQuads) parts[t / 32][quad] = sum;
    __syncthreads();
    if (t < kQuads) {
      for (int w = 1; w < kThreads / 32; ++w) add(sum, parts[w][quad]);
      store(first_splat + k, sum);
    }
    __syncthreads();
  }
}

}  // namespace ar::cuda
