// The k-d tree over the points and the search in it, for host and device.
//
// The tree is balanced and needs no pointers: node i of level l holds the points at positions [i n / 2^l, (i + 1) n /
// 2^l), which its two children share out. A node is split at its median along the longest side of the box around its
// points, so that neither outliers nor clusters nor duplicates make it deeper than log2(n / kLeafSize) levels.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>

#ifdef __CUDACC__
#define KNN_HD __host__ __device__ __forceinline__
#else
#define KNN_HD inline
#endif

namespace simple_knn {

/// A leaf holds at most this many points and, where no point is bad, more than half as many: four or more, so that
/// points that lie in one place find three neighbours at distance 0 in their own leaf.
constexpr int kLeafSize = 8;
constexpr int kNeighbors = 3;
/// Levels are counted in the bits of an integer, and points by int32_t.
constexpr int64_t kMaxPoints = std::numeric_limits<int32_t>::max();

struct alignas(16) Point {
  float at[3];
  int32_t row;  // of the caller's tensor
};

/// Smallest and largest coordinates. Without points: infinity and -infinity.
struct alignas(8) Box {
  float lo[3], hi[3];
};

// Not fmaxf and fminf, which are calls on the host because of what they do with NaN; no NaN comes here.
KNN_HD float larger(float a, float b) { return a > b ? a : b; }
KNN_HD float smaller(float a, float b) { return a < b ? a : b; }

KNN_HD Box empty_box() {
  constexpr float kInf = std::numeric_limits<float>::infinity();
  return {{kInf, kInf, kInf}, {-kInf, -kInf, -kInf}};
}

KNN_HD void extend(Box& box, const float* lo, const float* hi) {
  for (int a = 0; a < 3; ++a) {
    box.lo[a] = smaller(lo[a], box.lo[a]);
    box.hi[a] = larger(hi[a], box.hi[a]);
  }
}

KNN_HD int longest_side(const Box& box) {
  int longest = 0;
  float length = -1;
  for (int a = 0; a < 3; ++a) {
    const float half = 0.5f * box.hi[a] - 0.5f * box.lo[a];  // the whole may overflow
    if (half > length) length = half, longest = a;
  }
  return longest;
}

/// Levels below the root of a tree over n points.
KNN_HD int depth_for(int64_t n) {
  int depth = 0;
  while (n > int64_t(kLeafSize) << depth) ++depth;
  return depth;
}

/// Nodes are numbered as in a heap: the root is 1, the children of k are 2 k and 2 k + 1.
struct Tree {
  const Point* points;
  const Box* boxes;
  int64_t n;
  int depth;
};

/// Position of the first point of node i of a level.
KNN_HD int64_t first_of(int64_t i, int level, int64_t n) { return (i * n) >> level; }

KNN_HD bool is_finite(const float* at) {
  for (int a = 0; a < 3; ++a) {
    if (!(fabsf(at[a]) <= std::numeric_limits<float>::max())) return false;
  }
  return true;
}

/// Squared distance; 5 roundings, so within 5 * 2^-24 of the exact one, relatively.
KNN_HD float squared_distance(const float* a, const float* b) {
  const float x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2];
  return x * x + y * y + z * z;
}

/// At most squared_distance(at, p) of every point p in the box, also as rounded: rounding is monotone, and this rounds
/// the same sum of no larger terms. So skipping boxes by it changes no bit of the result.
KNN_HD float lower_bound(const Box& box, const float* at) {
  float side[3];
  for (int a = 0; a < 3; ++a) side[a] = larger(larger(box.lo[a] - at[a], at[a] - box.hi[a]), 0);
  return side[0] * side[0] + side[1] * side[1] + side[2] * side[2];
}

/// The three smallest numbers seen, in ascending order.
struct Smallest {
  float value[kNeighbors] = {std::numeric_limits<float>::infinity(), std::numeric_limits<float>::infinity(),
                             std::numeric_limits<float>::infinity()};
  KNN_HD float bound() const { return value[kNeighbors - 1]; }
  KNN_HD void add(float v) {
    if (!(v < value[2])) return;
    value[2] = v < value[1] ? value[1] : v;
    value[1] = v < value[0] ? value[0] : (v < value[1] ? v : value[1]);
    value[0] = v < value[0] ? v : value[0];
  }
};

KNN_HD void scan_leaf(const Tree& tree, int64_t leaf, int64_t self, Smallest& smallest) {
  const int64_t end = first_of(leaf + 1, tree.depth, tree.n);
  for (int64_t p = first_of(leaf, tree.depth, tree.n); p < end; ++p) {
    const float d = squared_distance(tree.points[self].at, tree.points[p].at);
    if (p != self) smallest.add(d);
  }
}

/// Mean squared distance from the point at position `self`, in leaf `leaf`, to the three nearest others, or to those
/// that there are; 0 where there is none.
///
/// The search goes from the point's own leaf to the root. At every node on the way it visits the subtree of the
/// sibling, nearer child first, unless its box is too far away. Bit l of `done` says whether at level l both siblings
/// have been dealt with, which takes the place of a stack.
KNN_HD float mean_squared_distance(const Tree& tree, int64_t self, int64_t leaf) {
  Smallest smallest;
  scan_leaf(tree, leaf, self, smallest);
  const float* at = tree.points[self].at;
  int64_t node = (int64_t(1) << tree.depth) + leaf;
  uint32_t done = 0;
  for (int level = tree.depth; level > 0;) {
    if (done >> level & 1) {
      node >>= 1;
      --level;
      continue;
    }
    done |= 1u << level;
    node ^= 1;
    if (!(lower_bound(tree.boxes[node], at) < smallest.bound())) continue;
    while (level < tree.depth) {
      const float left = lower_bound(tree.boxes[2 * node], at), right = lower_bound(tree.boxes[2 * node + 1], at);
      if (!(smaller(left, right) < smallest.bound())) break;
      node = 2 * node + (right < left);
      ++level;
      done &= ~(1u << level);
    }
    if (level == tree.depth) scan_leaf(tree, node - (int64_t(1) << tree.depth), self, smallest);
  }
  const int64_t neighbors = tree.n - 1 < kNeighbors ? tree.n - 1 : kNeighbors;
  double sum = 0;  // in double: the sum of three may overflow where their mean does not
  for (int k = 0; k < neighbors; ++k) sum += smallest.value[k];
  return neighbors > 0 ? float(sum / double(neighbors)) : 0.0f;
}

}  // namespace simple_knn
