// Stable order of splats by depth.
#pragma once

#include <cstdint>
#include <vector>

namespace ar::cpu {

/// Indices of `depths` (all >= 0) in ascending order, ties in input order.
template <typename T> void sort_by_depth(const T* depths, int64_t n, int threads, std::vector<int32_t>& order);

}  // namespace ar::cpu
