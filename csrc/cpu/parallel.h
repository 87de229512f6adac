// OpenMP loops. Results never depend on the number of threads: every item writes places of its own.
#pragma once

#include <omp.h>

#include <cstdint>

#include "core/platform.h"

namespace ar::cpu {

/// body(item) for item in [0, items), in any order, on at most `threads` threads. body must not throw.
template <class Body> void parallel_for(int64_t items, int threads, const Body& body) {
#pragma omp parallel for schedule(dynamic) num_threads(threads) if (items > 1 && threads > 1)
  for (int64_t item = 0; item < items; ++item) body(item);
}

/// Bounds of part `p` of `parts` near-equal parts of [0, n).
struct Part {
  int64_t begin, end;
};
AR_HD Part part_of(int64_t n, int64_t parts, int64_t p) { return {n * p / parts, n * (p + 1) / parts}; }

}  // namespace ar::cpu
