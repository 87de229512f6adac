// Prefetching of rows that are read in an order that is random in memory.
#pragma once

#include "core/stages.h"
#include "cpu/isa.h"

namespace ar::AR_ISA {

/// Asks for a row of `width` numbers, which may lie in two lines of the cache.
template <typename T> AR_HD void prefetch_row(const T* row, int64_t width) {
  __builtin_prefetch(row);
  __builtin_prefetch(row + width - 1);
}

/// Asks for row j of `splats`.
template <typename T> AR_HD void prefetch_splat(const T* splats, int32_t j) {
  prefetch_row(splats + int64_t(j) * kSplatWidth, kSplatWidth);
}

}  // namespace ar::AR_ISA
