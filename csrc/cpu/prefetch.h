// Prefetches rows that are read at random.
#pragma once

#include "core/stages.h"
#include "cpu/isa.h"

namespace ar::AR_ISA {

/// The row may lie in two cache lines.
template <typename T> AR_HD void prefetch_row(const T* row, int64_t width) {
  __builtin_prefetch(row);
  __builtin_prefetch(row + width - 1);
}

template <typename T> AR_HD void prefetch_splat(const T* splats, int32_t j) {
  prefetch_row(splats + int64_t(j) * kSplatWidth, kSplatWidth);
}

}  // namespace ar::AR_ISA
