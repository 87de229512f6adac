// distCUDA2 on the CPU. The tree is built by tasks and searched by a loop; no result depends on which thread does what.
#include <algorithm>

#include "backends.h"
#include "tree.h"

namespace simple_knn::cpu {
namespace {

/// Nodes of fewer points are built by one task.
constexpr int64_t kTaskSize = 1 << 14;
/// Leaves that a thread searches at a time.
constexpr int kChunk = 256;

int64_t box_count(int64_t n) { return int64_t(2) << depth_for(n); }

template <int axis> void split_at_median(Point* begin, Point* middle, Point* end) {
  std::nth_element(begin, middle, end, [](const Point& a, const Point& b) { return a.at[axis] < b.at[axis]; });
}

class Builder {
 public:
  Builder(Point* points, Box* boxes, int64_t n, int depth) : points_(points), boxes_(boxes), n_(n), depth_(depth) {}

  void build(int64_t i, int level) const {
    Point *begin = points_ + first_of(i, level, n_), *end = points_ + first_of(i + 1, level, n_);
    Box box = empty_box();
    for (const Point* p = begin; p < end; ++p) extend(box, p->at, p->at);
    boxes_[(int64_t(1) << level) + i] = box;
    if (level == depth_) return;
    Point* middle = points_ + first_of(2 * i + 1, level + 1, n_);
    switch (longest_side(box)) {
      case 0:
        split_at_median<0>(begin, middle, end);
        break;
      case 1:
        split_at_median<1>(begin, middle, end);
        break;
      default:
        split_at_median<2>(begin, middle, end);
    }
    // By value: a task may run after this call has returned.
    const Builder self = *this;
#pragma omp task if (end - begin > kTaskSize)
    self.build(2 * i, level + 1);
    build(2 * i + 1, level + 1);
  }

 private:
  Point* points_;
  Box* boxes_;
  int64_t n_;
  int depth_;
};

}  // namespace

int64_t scratch_bytes(int64_t n) { return n * int64_t(sizeof(Point)) + box_count(n) * int64_t(sizeof(Box)); }

void mean_distances(const float* points, int64_t n, void* scratch, float* out, int threads) {
  Point* kept = static_cast<Point*>(scratch);
  Box* boxes = reinterpret_cast<Box*>(kept + n);
  int64_t count = 0;
  for (int64_t row = 0; row < n; ++row) {
    const float* at = points + 3 * row;
    if (is_finite(at)) {
      kept[count++] = {{at[0], at[1], at[2]}, int32_t(row)};
    } else {
      out[row] = 0;
    }
  }
  const Tree tree = {kept, boxes, count, depth_for(count)};
  const Builder builder(kept, boxes, count, tree.depth);
#pragma omp parallel num_threads(threads) if (threads > 1 && count > kTaskSize)
  {
#pragma omp single
    builder.build(0, 0);
#pragma omp for schedule(dynamic, kChunk)
    for (int64_t leaf = 0; leaf < int64_t(1) << tree.depth; ++leaf) {
      const int64_t end = first_of(leaf + 1, tree.depth, count);
      for (int64_t p = first_of(leaf, tree.depth, count); p < end; ++p) {
        out[kept[p].row] = mean_squared_distance(tree, p, leaf);
      }
    }
  }
}

}  // namespace simple_knn::cpu
