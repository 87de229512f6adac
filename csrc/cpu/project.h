// Loops of project and project_vjp, over chunks of Gaussians; Cam is Camera or FullCamera.
#pragma once

#include <algorithm>

#include "core/project.h"
#include "cpu/isa.h"
#include "cpu/parallel.h"
#include "cpu/tasks.h"

namespace ar::AR_ISA {

/// First pass: which Gaussians may be visible, and how many of each chunk, so that splats can be
/// written densely and in input order.
template <template <typename> class Cam, typename T> void count_candidates(const cpu::ProjectTask<T>& task) {
  const Gaussians<T>& g = task.gaussians;
  const T blur = T(std::max(task.options.variance, kPixelVariance));
  cpu::parallel_for(cpu::chunks_of(g.n), task.threads, [&](int64_t chunk) {
    const auto camera = load_camera_as<Cam<T>>(task.camera);
    const int64_t begin = chunk * cpu::kChunk, end = std::min(g.n, begin + cpu::kChunk);
    int64_t count = 0;
    for (int64_t i = begin; i < end; ++i) {
      const bool candidate = may_be_visible(camera, g, i, blur);
      task.candidates[i] = candidate;
      count += candidate;
    }
    task.chunk_offsets[chunk] = count;
  });
}

template <class F, template <typename> class Cam, typename T> void project(const cpu::ProjectTask<T>& task) {
  const int64_t n = task.gaussians.n;
  auto* splats = reinterpret_cast<Splat<F, T>*>(task.splats);
  cpu::parallel_for(cpu::chunks_of(n), task.threads, [&](int64_t chunk) {
    const auto camera = load_camera_as<Cam<T>>(task.camera);
    const int64_t begin = chunk * cpu::kChunk, end = std::min(n, begin + cpu::kChunk);
    int64_t j = task.chunk_offsets[chunk];
    for (int64_t i = begin; i < end; ++i) {
      task.radii[i] = 0;
      if (!task.candidates[i]) continue;
      Splat<F, T> splat = {};
      T depth = T(0);
      task.radii[i] = ar::project<F>(camera, task.gaussians, i, task.options, splat, depth);
      splats[j] = splat;
      task.depths[j] = depth;
      task.ids[j] = int32_t(i);
      ++j;
    }
  });
}

template <class F, template <typename> class Cam, typename T> void project_vjp(const cpu::ProjectVjpTask<T>& task) {
  const int64_t n = task.gaussians.n;
  cpu::parallel_for(cpu::chunks_of(n), task.threads, [&](int64_t chunk) {
    const auto camera = load_camera_as<Cam<T>>(task.camera);
    const int64_t begin = chunk * cpu::kChunk, end = std::min(n, begin + cpu::kChunk);
    int64_t j = std::lower_bound(task.ids, task.ids + task.n_splats, begin) - task.ids;
    for (int64_t i = begin; i < end; ++i) {
      const bool is_splat = j < task.n_splats && task.ids[j] == i;
      const int64_t first = is_splat ? task.splat_offsets[j] : 0, last = is_splat ? task.splat_offsets[j + 1] : 0;
      j += is_splat;
      if (first == last) {
        zero_grads(task.gaussians, i, task.grads);
        continue;
      }
      PairGrad<T> sums = {};
      Vec2<T> abs2d = {};
      for (int64_t k = first; k < last; ++k) {
        sums = sums + task.pair_grads[task.positions[k]];
        if (task.pair_abs) abs2d = abs2d + task.pair_abs[task.positions[k]];
      }
      ar::project_vjp<F>(camera, task.gaussians, i, task.options, sums, task.grads,
                         task.camera_grads ? &task.camera_grads[chunk] : nullptr);
      if (task.grads.means2d && task.grads.means2d_stride == 4) {
        T* row = task.grads.means2d + i * 4;
        row[2] = T(0.5) * camera.size.x * abs2d.x;
        row[3] = T(0.5) * camera.size.y * abs2d.y;
      }
    }
  });
}

}  // namespace ar::AR_ISA
