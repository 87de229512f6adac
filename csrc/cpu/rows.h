// Loops over the rows of the public stages (ProjectedRows): from rows to splats, and from the sums of a splat's pairs
// to the gradient with respect to its row.
#pragma once

#include "cpu/project.h"

namespace ar::AR_ISA {

template <typename T> void shape_rows(const cpu::ShapeRowsParams<T>& p) {
  auto* splats = reinterpret_cast<SplatRow<T>*>(p.splats);
  for_each_chunk(p.n, p.threads, [&](int64_t, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      SplatRow<T> splat = {};
      ProjectedGaussian<T> row;
      if (read_row(p.rows, i, row)) shape_splat(row, p.footprint, p.grid, splat);
      if (p.rows.colors && splat.level > T(0)) {
        splat.color = p.rows.colors[i];
        if (!all_finite(&splat.color.x, 3)) splat = {};
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
      p.dL_dmeans2d[i] = {T(0), T(0)};
      p.dL_dcov2d[i] = {T(0), T(0), T(0)};
      p.dL_dopacities[i] = T(0);
      if (p.absolute) p.absolute[i] = {T(0), T(0)};
      if (first == last) continue;
      PairGrad<T> sums = {};
      for (int64_t k = first; k < last; ++k) {
        const int64_t pair = p.pairs.positions[k];
        sums = sums + *reinterpret_cast<const PairGrad<T>*>(p.pair_grads + pair * p.pair_stride);
        if (p.absolute) p.absolute[i] = p.absolute[i] + p.pair_means[pair];
      }
      const Sym2<T> c = p.rows.cov2d[i];
      const Cov2d<T> cov = {c.xx, c.xy, c.yy, p.rows.dets[i]};
      const ProjectedGrad<T> grad = projected_grad(p.footprint, cov, sums);
      const Sym2<T> dL_dcov = cov_grad(cov, grad.splat);
      p.dL_dmeans2d[i] = grad.splat.dL_dmean;
      p.dL_dcov2d[i] = {dL_dcov.xx, T(2) * dL_dcov.xy, dL_dcov.yy};
      p.dL_dopacities[i] = grad.weighted / p.rows.opacities[i];
    }
  });
}

}  // namespace ar::AR_ISA
