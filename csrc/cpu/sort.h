// Sorts splats by depth, and adds up counts of stable sorts. Compiled once, for the baseline.
#pragma once

#include <cstdint>

namespace ar::cpu {

/// Sets order [n] to the indices of `depths` (>= 0, with -0 = 0) in ascending order. Ties keep their order.
template <typename T> void sort_by_depth(const T* depths, int64_t n, int threads, int32_t* order);

/// By sums of earlier ones. Returns the sum of all.
int64_t sum_before(int64_t* numbers, int64_t n, int threads);

/// Replaces counts [parts, kinds] by the index of the first item, and sets firsts[kind]. Returns the number of items.
int64_t place_items(int64_t* counts, int64_t parts, int64_t kinds, int threads, int64_t* firsts);

}  // namespace ar::cpu
