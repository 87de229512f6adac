// Loops of project, project_rows and their adjoints, over Gaussians (core/project.h). Cam: Camera or FullCamera.
#pragma once

#include <algorithm>

#include "core/order.h"
#include "core/rows.h"
#include "cpu/chunks.h"
#include "cpu/prefetch.h"

namespace ar::AR_ISA {

template <typename T> AR_HD bool all_finite(const T* row, int count) {
  for (int c = 0; c < count; ++c) {
    if (!within(row[c], kMaxColor)) return false;
  }
  return true;
}

template <class Vec> AR_HD Vec* coefficients_of(Vec* shs, int stride, int64_t i) {
  return shs ? shs + i * stride : nullptr;
}

template <template <typename> class Cam, typename T> void count_candidates(const cpu::ProjectParams<T>& p) {
  const Gaussians<T>& g = p.gaussians;
  for_each_chunk(g.n, p.threads, [&](int64_t chunk, int64_t begin, int64_t end) {
    const auto camera = load_camera_as<Cam<T>>(p.camera);
    int64_t count = 0;
    for (int64_t i = begin; i < end; ++i) {
      const bool candidate = may_be_visible(camera, g, i, p.bounds);
      p.candidates[i] = candidate;
      count += candidate;
    }
    p.chunk_offsets[chunk] = count;
  });
}

/// Of RayDepth. One copy, because few calls want it.
template <class Cam, typename T>
AR_ONE_COPY Vec2<T> slope_of(const Cam& camera, const Gaussians<T>& g, int64_t i, DepthKind order) {
  return ray_slope(camera, g, i, project_mean(camera, g.means[i]).view, order);
}

template <template <typename> class Cam, typename T> void project(const cpu::ProjectParams<T>& p) {
  auto* splats = reinterpret_cast<SplatRow<T>*>(p.splats);
  for_each_chunk(p.gaussians.n, p.threads, [&](int64_t chunk, int64_t begin, int64_t end) {
    const auto camera = load_camera_as<Cam<T>>(p.camera);
    int64_t j = p.chunk_offsets[chunk];
    for (int64_t i = begin; i < end; ++i) {
      p.radii[i] = 0;
      if (!p.candidates[i]) continue;
      SplatRow<T> splat = {};
      T depth = T(0);
      p.radii[i] = ar::project(camera, p.gaussians, i, p.footprint, splat, depth);
      if (splat.level > T(0)) {
        if (p.given.data && !all_finite(p.given.row(int32_t(i)), p.given.count)) {
          splat.level = T(0);
          p.radii[i] = 0;
        } else {
          if (p.channels.data) write_channels(p.channels, i, splat.color, depth);
        }
      }
      splats[j] = splat;
      p.depths[j] = depth;
      if (p.slopes && splat.level > T(0)) p.slopes[j] = slope_of(camera, p.gaussians, i, DepthKind::kOfModel);
      p.ids[j] = int32_t(i);
      ++j;
    }
  });
}

/// Writes rows, packed rows or, for who counts them, flags. Radii are those of project(); without colours, these count
/// as finite.
template <template <typename> class Cam, typename T> void project_rows(const cpu::ProjectRowsParams<T>& p) {
  const Gaussians<T>& g = p.gaussians;
  const bool with_color = p.rows.colored || p.packed.rows;
  for_each_chunk(g.n, p.threads, [&](int64_t, int64_t begin, int64_t end) {
    const auto camera = load_camera_as<Cam<T>>(p.camera);
    for (int64_t i = begin; i < end; ++i) {
      ProjectedGaussian<T> projected = {};
      ProjectedMean<T> mean = {};
      SplatRow<T> splat = {};
      int radius = 0;
      if (may_be_visible(camera, g, i, p.bounds, mean) && project_gaussian(camera, g, i, mean, projected))
        radius = shape_splat(projected, p.footprint, camera.grid, splat);
      const bool projects = radius > 0;
      if (projects && with_color && !splat_color(camera, g, i, coefficients_of(g.shs, g.sh_stride, i), splat.color)) {
        splat.color = {T(0), T(0), T(0)};
        if (splat.level > T(0)) radius = 0;
      }
      if (p.packed.rows) {
        if (projects) write_packed(p.packed, i, projected, splat.color, radius);
        continue;
      }
      if (p.rows.slopes && radius > 0) projected.slope = slope_of(camera, g, i, p.rules.order);
      write_row_or_flag(camera, p.rules, p.rows, p.flags, i, mean.view, projected, splat.color, radius);
    }
  });
}

/// Pairs from prefetch to use. Those of a splat are in many tiles.
inline constexpr int64_t kPairsAhead = 16;

/// Of the sums of a splat's pairs, or else of a public row.
template <typename T> struct SplatGradOf {
  FootprintChoice footprint;
  const PairGrad<T>* sums;
  const ProjectedRowGrads<T>* rows;
  int64_t row;

  AR_HD ProjectedGrad<T> operator()(const Cov2d<T>& cov, T opacity) const {
    return sums ? projected_grad(footprint, cov, *sums) : projected_grad(*rows, row, opacity);
  }
};

template <typename T> struct GradsOrSums : GaussianGrads<T> {
  bool add;
  AR_HD bool adds() const { return add; }
  AR_HD bool adds_shs() const { return add; }
};

/// One copy for every kind of gradient: with a full camera it takes ten seconds to compile.
template <class Cam, typename T>
AR_ONE_COPY void gaussian_vjp(const Cam& camera, const Gaussians<T>& g, int64_t i, const SplatGradOf<T>& grad_of,
                              const RowShownGrad<T>& shown, const GradsOrSums<T>& out, CameraGrad<T>* camera_grad) {
  ar::project_vjp(camera, g, i, grad_of, shown, coefficients_of(g.shs, g.sh_stride, i),
                  coefficients_of(out.shs, g.sh_stride, i), out, camera_grad);
}

template <template <typename> class Cam, typename T> void project_vjp(const cpu::ProjectVjpParams<T>& p) {
  const Gaussians<T>& g = p.gaussians;
  const GradsOrSums<T> out = {p.grads, false};
  for_each_chunk(g.n, p.threads, [&](int64_t chunk, int64_t begin, int64_t end) {
    const auto camera = load_camera_as<Cam<T>>(p.camera);
    const int64_t pairs = p.pairs.splat_offsets[p.pairs.splats];
    int64_t j = std::lower_bound(p.pairs.ids, p.pairs.ids + p.pairs.splats, begin) - p.pairs.ids;
    for (int64_t i = begin; i < end; ++i) {
      const bool is_splat = j < p.pairs.splats && p.pairs.ids[j] == i;
      const int64_t first = is_splat ? p.pairs.splat_offsets[j] : 0, last = is_splat ? p.pairs.splat_offsets[j + 1] : 0;
      j += is_splat;
      if (first == last) {
        zero_grads(g, i, p.grads);
        continue;
      }
      PairGrad<T> sums = {};
      RowShownGrad<T> shown = {{}, T(0), DepthKind::kOfModel, DepthKind::kNone};
      Vec2<T> mean_sums = {};
      for (int64_t k = first; k < last; ++k) {
        if (k + kPairsAhead < pairs)
          prefetch_row(p.pair_grads + p.pairs.positions[k + kPairsAhead] * p.pair_stride, p.pair_stride);
        const int64_t pair = p.pairs.positions[k];
        const T* row = p.pair_grads + pair * p.pair_stride;
        sums = sums + *reinterpret_cast<const PairGrad<T>*>(row);
        if (p.pair_colors) shown.color += *reinterpret_cast<const Vec3<T>*>(row + cpu::kPairNumbers);
        if (p.pair_means) mean_sums = mean_sums + p.pair_means[pair];
      }
      if (p.dL_dchannels.data) add_channels_vjp(p.dL_dchannels, i, depth_of(camera, g.means[i]), shown);
      gaussian_vjp(camera, g, i, {p.footprint, &sums, nullptr, 0}, shown, out,
                   p.camera_grads ? &p.camera_grads[chunk] : nullptr);
      write_mean_sums(p.grads, i, camera.size, mean_sums);
    }
  });
}

template <template <typename> class Cam, typename T> void project_rows_vjp(const cpu::ProjectRowsVjpParams<T>& p) {
  const Gaussians<T>& g = p.gaussians;
  const GradsOrSums<T> out = {p.grads, p.add};
  for_each_chunk(g.n, p.threads, [&](int64_t chunk, int64_t begin, int64_t end) {
    const auto camera = load_camera_as<Cam<T>>(p.camera);
    for (int64_t i = begin; i < end; ++i) {
      const int64_t row = p.rows.places.of(i);
      if (row < 0 || !has_gradient(p.rows, row)) {
        zero_grads(g, i, out);
        continue;
      }
      gaussian_vjp(camera, g, i, {{}, nullptr, &p.rows, row}, shown_grad(p.rows, row), out,
                   p.camera_grads ? &p.camera_grads[chunk] : nullptr);
    }
  });
}

}  // namespace ar::AR_ISA
