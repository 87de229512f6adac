// Loops over public rows: shape_rows() makes splats, row_grads() adds up pairs to the gradient of a row.
#pragma once

#include "cpu/project.h"

namespace ar::AR_ISA {

template <typename T> void shape_rows(const cpu::ShapeRowsParams<T>& p) {
  auto* splats = reinterpret_cast<SplatRow<T>*>(p.splats);
  for_each_chunk(p.n, p.threads, [&](int64_t, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      SplatRow<T> splat = {};
      ProjectedGaussian<T> row;
      if (p.packed ? read_row(p.packed[i], row) : read_row(p.rows, i, row))
        shape_splat(row, p.footprint, p.grid, splat);
      if (p.kept_covs) {
        T* kept = p.kept_covs + 4 * i;
        kept[0] = row.cov.xx, kept[1] = row.cov.xy, kept[2] = row.cov.yy, kept[3] = row.cov.det;
        p.kept_opacities[i] = row.opacity;
      }
      if ((p.packed || p.rows.colors) && splat.level > T(0)) {
        splat.color = p.packed ? p.packed[i].color : p.rows.colors[i];
        if (!p.any_color && !all_finite(&splat.color.x, 3)) splat = {};
      }
      splats[i] = splat;
    }
  });
}

template <typename T> void row_grads(const cpu::RowGradsParams<T>& p) {
  for_each_chunk(p.n, p.threads, [&](int64_t, int64_t begin, int64_t end) {
    int64_t j = std::lower_bound(p.pairs.ids, p.pairs.ids + p.pairs.splats, begin) - p.pairs.ids;
    for (int64_t i = begin; i < end; ++i) {
      const bool is_splat = j < p.pairs.splats && p.pairs.ids[j] == i;
      const int64_t first = is_splat ? p.pairs.splat_offsets[j] : 0, last = is_splat ? p.pairs.splat_offsets[j + 1] : 0;
      j += is_splat;
      Vec2<T> dL_dmean = {T(0), T(0)}, absolute = {T(0), T(0)};
      Sym2<T> dL_dcov = {T(0), T(0), T(0)};
      T dL_dopacity = T(0);
      Vec3<T> color = {T(0), T(0), T(0)};
      PairGrad<T> sums = {};
      for (int64_t k = first; k < last; ++k) {
        const int64_t pair = p.pairs.positions[k];
        const T* row = p.pair_grads + pair * p.pair_stride;
        sums = sums + *reinterpret_cast<const PairGrad<T>*>(row);
        if (p.packed || p.dL_dcolors) color += *reinterpret_cast<const Vec3<T>*>(row + cpu::kPairNumbers);
        if (p.pair_means) absolute = absolute + p.pair_means[pair];
      }
      if (first != last) {
        const Cov2d<T> cov = p.cov(i);
        const ProjectedGrad<T> grad = projected_grad(p.footprint, cov, sums);
        const Sym2<T> of_cov = cov_grad(cov, grad.splat);
        dL_dmean = grad.splat.dL_dmean;
        dL_dcov = {of_cov.xx, T(2) * of_cov.xy, of_cov.yy};
        dL_dopacity = grad.weighted / p.opacity(i);
      }
      if (p.packed) {
        T* to = p.packed + i * p.packed_width;
        write_packed_grad(to, p.packed_width, dL_dmean, dL_dcov, dL_dopacity, color, absolute);
        continue;
      }
      p.dL_dmeans2d[i] = dL_dmean;
      p.dL_dcov2d[i] = dL_dcov;
      p.dL_dopacities[i] = dL_dopacity;
      if (p.absolute) p.absolute[i] = absolute;
      if (p.dL_dcolors) p.dL_dcolors[i] = color;
    }
  });
}

}  // namespace ar::AR_ISA
