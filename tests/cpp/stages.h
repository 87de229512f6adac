// Runs the stages of the CPU path one after the other, project -> bin -> blend and back, without torch.
#pragma once

#include <cstdint>
#include <utility>
#include <vector>

#include "cpu/tasks.h"

namespace ar::test {

/// What the stages write. Gradients lie in one array: means, scales, rotations, opacities, colours, means2d; then
/// cov3ds and coefficients, where these are given.
template <typename T> struct Rendered {
  std::vector<T> image, grads;
  std::vector<int32_t> radii;
  int64_t pairs = 0;
  std::vector<T> camera_grad;  ///< of a full camera: the numbers of CameraGrad
};

template <typename T> struct GradArrays {
  std::vector<T> all;
  GaussianGrads<T> views = {};
  explicit GradArrays(int64_t n, int64_t cov3ds = 0, int64_t shs = 0) : all(18 * n + 6 * cov3ds + 3 * shs, T(-7)) {
    T* p = all.data();
    views.means = reinterpret_cast<Vec3<T>*>(p);
    views.scales = reinterpret_cast<Vec3<T>*>(p + 3 * n);
    views.rotations = reinterpret_cast<Vec4<T>*>(p + 6 * n);
    views.opacities = p + 10 * n;
    views.colors = reinterpret_cast<Vec3<T>*>(p + 11 * n);
    views.means2d = p + 14 * n;
    views.means2d_stride = 4;
    if (cov3ds) views.cov3ds = reinterpret_cast<Sym3<T>*>(p + 18 * n);
    if (shs) views.shs = reinterpret_cast<Vec3<T>*>(p + 18 * n + 6 * cov3ds);
  }
};

template <typename T>
Rendered<T> run_stages(const cpu::Stages<T>& stages, CameraView<T> camera, Gaussians<T> gaussians, const T* background,
                       const T* dL_dimage, FootprintOptions options, int threads) {
  const TileGrid grid = {camera.width, camera.height};
  const int64_t plane = int64_t(grid.width) * grid.height;
  Rendered<T> out;
  out.radii.resize(gaussians.n);
  std::vector<uint8_t> candidates(gaussians.n);
  std::vector<int64_t> chunk_offsets(cpu::chunks_of(gaussians.n) + 1);
  cpu::ProjectTask<T> project = {camera, gaussians, options, threads,         candidates.data(), chunk_offsets.data(),
                                 {},     {},        {},      out.radii.data()};
  stages.of(camera).count_candidates(project);
  int64_t n = 0;
  for (int64_t& offset : chunk_offsets) n += std::exchange(offset, n);
  std::vector<T> splats(n * kSplatWidth), depths(n);
  std::vector<int32_t> ids(n);
  project.splats = splats.data();
  project.depths = depths.data();
  project.ids = ids.data();
  stages.of(camera).project(project);

  std::vector<int64_t> tile_offsets(grid.tiles() + 1), splat_offsets(n + 1);
  cpu::BinTask<T> bin = {};
  bin.splats = splats.data();
  bin.depths = depths.data();
  bin.n = n;
  bin.grid = grid;
  bin.threads = threads;
  bin.tile_offsets = tile_offsets.data();
  bin.splat_offsets = splat_offsets.data();
  stages.count_pairs(bin);
  out.pairs = tile_offsets.back();
  std::vector<int32_t> pairs(out.pairs);
  std::vector<int64_t> positions(out.pairs);
  bin.pairs = pairs.data();
  bin.positions = positions.data();
  stages.scatter_pairs(bin);

  out.image.resize(3 * plane);
  std::vector<T> transmittance(stages.samples * plane);
  std::vector<int32_t> last(stages.samples * plane);
  // Without a tolerance, as many as there may be.
  std::vector<int32_t> samples(grid.tiles(), stages.samples);
  if (stages.choose && options.tolerance > 0) {
    stages.choose({splats.data(), pairs.data(), bin.tile_offsets, grid, threads, background, options, samples.data()});
  }
  const int32_t* tile_samples = stages.choose ? samples.data() : nullptr;
  stages.blend({splats.data(), pairs.data(), tile_offsets.data(), grid, threads, tile_samples, background,
                out.image.data(), transmittance.data(), last.data(), nullptr});

  std::vector<PairGrad<T>> pair_grads(out.pairs);
  std::vector<Vec2<T>> pair_abs(out.pairs);
  GradArrays<T> grads(gaussians.n, gaussians.cov3ds ? gaussians.n : 0,
                      gaussians.shs ? gaussians.n * gaussians.sh_stride : 0);
  stages.blend_vjp({splats.data(), pairs.data(), tile_offsets.data(), grid, threads, tile_samples, background,
                    transmittance.data(), last.data(), dL_dimage, nullptr, pair_grads.data(), pair_abs.data()});
  std::vector<CameraGrad<T>> camera_grads(camera.lens ? cpu::chunks_of(gaussians.n) : 0, CameraGrad<T>{});
  stages.of(camera).project_vjp({camera, gaussians, options, threads, ids.data(), n, splat_offsets.data(),
                                 positions.data(), pair_grads.data(), pair_abs.data(), grads.views,
                                 camera.lens ? camera_grads.data() : nullptr});
  out.camera_grad.resize(camera.lens ? kCameraGradWidth : 0);
  for (const CameraGrad<T>& chunk : camera_grads) {
    for (int k = 0; k < kCameraGradWidth; ++k) out.camera_grad[k] += reinterpret_cast<const T*>(&chunk)[k];
  }
  out.grads = std::move(grads.all);
  return out;
}

}  // namespace ar::test
