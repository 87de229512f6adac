// Kernels of projection. `project` writes splats of Gaussians, radii, rows of channels, and what bin reads (keys,
// counts, tiles). `project_rows` writes public rows (mean, covariance, opacity, depth, colour), to keep or send to
// another rank. `shape_rows` turns public rows into splats.
#pragma once

#include "cuda/launch.cuh"
#include "cuda/params.h"
#include "cuda/project/shared.cuh"

namespace ar::cuda {

__device__ inline uint32_t depth_key(float depth) {
  return __float_as_uint(depth + 0.0f) + kDepthKeyOffset;  // + 0: -0 becomes 0
}

/// The tiles of a support, for each of which bin writes a pair.
__device__ inline SplatTiles splat_tiles_of(const Support<float>& support, TileGrid grid) {
  const TileBox box = find_tiles(support, grid);
  return {box.mask, box.row * grid.columns() + box.column, box.count};
}

/// What bin reads. Params: ProjectParams or ShapeRowsParams.
template <class Params>
__device__ void write_tiles(const Params& params, int64_t i, const SplatTiles& tiles, float depth) {
  const bool any = tiles.count > 0;
  params.keys[i] = any ? depth_key(depth) : kCulledKey;
  params.ranges[i] = {0, tiles.count};
  if (any) params.tiles[i] = tiles;
}

/// What count_depths adds to. By the first block alone.
template <class Params> __device__ void clear_counts(const Params& params) {
  if (blockIdx.x > 0) return;
  for (int k = threadIdx.x; k < kDepthHistogramWords; k += ProjectPolicy::kThreads) params.depth_histograms[k] = 0;
  if (threadIdx.x == 0) *params.counts = {};
}

/// Those of `lanes` whose row has a number that is not finite or too large. A warp reads a row together.
__device__ inline uint32_t rows_not_finite(const Channels<float>& channels, int64_t first, uint32_t lanes) {
  uint32_t found = 0;
  for (uint32_t left = __brev(lanes); left != 0;) {
    const int lane = take_first(left);
    const float* row = channels.row(int32_t(first + lane));
    bool bad = false;
    for (int c = lane_id(); c < channels.count; c += 32) bad |= !within(row[c], kMaxColor);
    if (__any_sync(kAllLanes, bad)) found |= 1u << lane;
  }
  return found;
}

// Cam: Camera<float> or FullCamera<float>. A thread has a Gaussian; in `project` it may have several.
template <class Cam>
__global__ void __launch_bounds__(ProjectPolicy::kThreads) project_kernel(const ProjectParams params) {
  wait_for_earlier_kernels();
  __shared__ ShRows<Cam::kShDegree> sh_rows[ProjectPolicy::kThreads / 32];
  __shared__ SharedCamera<Cam> shared_camera;
  const Cam& camera = shared_camera.load(params.camera);
  clear_counts(params);
  const Gaussians<float>& g = params.gaussians;
  ShRows<Cam::kShDegree>& rows = sh_rows[threadIdx.x / 32];
  for (int64_t block = blockIdx.x; block * ProjectPolicy::kThreads < g.n; block += gridDim.x) {
    const int64_t i = block * ProjectPolicy::kThreads + threadIdx.x;
    SplatRow<float> splat = {};
    Support<float> support = {};
    float depth = 0;
    int radius = 0;
    ProjectedMean<float> mean;
    if (i < g.n && may_be_visible(camera, g, i, params.bounds, mean))
      radius = project_shape(camera, g, i, mean, params.footprint, splat, depth, &support);
    const uint32_t lit = __ballot_sync(kAllLanes, splat.level > 0);
    __syncwarp();  // all lanes have read the rows of earlier Gaussians
    if (g.shs && lit) rows.begin_load(g.shs + (i - lane_id()) * g.sh_stride, g.sh_stride, sh_count(g.sh_degree), lit);
    uint32_t not_finite = 0;
    if (params.given.data) not_finite = rows_not_finite(params.given, i - lane_id(), lit);
    // During the copies.
    SplatTiles tiles = {};
    if (splat.level > 0) tiles = splat_tiles_of(support, params.grid);
    wait_for_copies();
    if (splat.level > 0) {
      if (splat_color(camera, g, i, rows.row(), splat.color) && !(not_finite >> lane_id() & 1)) {
        if (params.channels.data) write_channels(params.channels, i, splat.color, depth);
      } else {
        radius = 0;
        splat.level = 0;
        tiles = {};
      }
    }
    if (i >= g.n) continue;
    if (radius > 0) reinterpret_cast<SplatRow<float>*>(params.splats)[i] = splat;
    write_tiles(params, i, tiles, depth);
    params.radii[i] = radius;
  }
}

/// Writes rows, packed rows or flags.
template <class Cam>
__global__ void __launch_bounds__(ProjectPolicy::kThreads) project_rows_kernel(const ProjectRowsParams params) {
  wait_for_earlier_kernels();
  __shared__ ShRows<Cam::kShDegree> sh_rows[ProjectPolicy::kThreads / 32];
  __shared__ SharedCamera<Cam> shared_camera;
  const Cam& camera = shared_camera.load(params.camera);
  const Gaussians<float>& g = params.gaussians;
  const RowOutputs<float>& to = params.rows;
  const int64_t i = int64_t(blockIdx.x) * ProjectPolicy::kThreads + threadIdx.x;
  ProjectedGaussian<float> projected = {};
  SplatRow<float> splat = {};
  int radius = 0;
  ProjectedMean<float> mean = {};
  if (i < g.n && may_be_visible(camera, g, i, params.bounds, mean) && project_gaussian(camera, g, i, mean, projected))
    radius = shape_splat(projected, params.footprint, camera.grid, splat);
  const bool projects = radius > 0;
  if (to.colored || params.packed.rows) {
    ShRows<Cam::kShDegree>& rows = sh_rows[threadIdx.x / 32];
    const uint32_t seen = __ballot_sync(kAllLanes, projects);
    if (g.shs && seen) rows.begin_load(g.shs + (i - lane_id()) * g.sh_stride, g.sh_stride, sh_count(g.sh_degree), seen);
    wait_for_copies();
    if (projects && !splat_color(camera, g, i, rows.row(), splat.color)) {
      if (splat.level > 0) radius = 0;
      splat.color = {0, 0, 0};
    }
  }
  if (i >= g.n) return;
  if (params.packed.rows) {
    if (projects) write_packed(params.packed, i, projected, splat.color, radius);
    return;
  }
  write_row_or_flag(camera, params.rules, to, params.flags, i, mean.view, projected, splat.color, radius);
}

__global__ void __launch_bounds__(ProjectPolicy::kThreads) shape_rows_kernel(const ShapeRowsParams params) {
  wait_for_earlier_kernels();
  clear_counts(params);
  const int64_t i = int64_t(blockIdx.x) * ProjectPolicy::kThreads + threadIdx.x;
  if (i >= params.n) return;
  ProjectedGaussian<float> projected;
  SplatRow<float> splat = {};
  bool valid;
  if (params.packed) {
    const PackedRow<float> row = params.packed[i];
    valid = read_row(row, projected);
    splat.color = row.color;
  } else {
    valid = read_row(params.rows, i, projected);
    if (params.rows.colors) splat.color = params.rows.colors[i];
  }
  if (params.kept_covs) {
    const Cov2d<float>& cov = projected.cov;
    reinterpret_cast<float4*>(params.kept_covs)[i] = {cov.xx, cov.xy, cov.yy, cov.det};
    params.kept_opacities[i] = projected.opacity;
  }
  if (valid && shape_splat(projected, params.footprint, params.grid, splat) == 0) splat.level = 0;
  const Vec3<float>& color = splat.color;
  if (!params.any_color && !(within(color.x, kMaxColor) && within(color.y, kMaxColor) && within(color.z, kMaxColor)))
    splat.level = 0;
  SplatTiles tiles = {};
  if (splat.level > 0) tiles = splat_tiles_of(support_of(splat, params.footprint.index), params.grid);
  reinterpret_cast<SplatRow<float>*>(params.splats)[i] = splat;
  write_tiles(params, i, tiles, projected.depth);
}

}  // namespace ar::cuda
