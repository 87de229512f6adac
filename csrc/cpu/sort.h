// Stable order of splats by depth, and the sums of stable counting sorts.
#pragma once

#include <cstdint>

namespace ar::cpu {

/// Sets order [n] to the indices of `depths` (all >= 0, with -0 = 0) in ascending order, ties in input order.
template <typename T> void sort_by_depth(const T* depths, int64_t n, int threads, int32_t* order);

/// Replaces each of n numbers by the sum of those before it, and returns the sum of all.
int64_t sum_before(int64_t* numbers, int64_t n, int threads);

/// Of a counting sort in parts, where `counts` [parts, kinds] are the items of each kind in each part: replaces each
/// count by the place of the first of its items, and sets firsts[kind] to that of the first of the kind. Returns the
/// number of all items.
int64_t place_items(int64_t* counts, int64_t parts, int64_t kinds, int threads, int64_t* firsts);

}  // namespace ar::cpu
