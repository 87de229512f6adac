// distCUDA2 with CUDA. The tree is built level by level: all points are sorted by (node, coordinate along the longest
// side of the node's box), which puts every node's median where its children meet.
#include <cub/device/device_partition.cuh>
#include <cub/device/device_radix_sort.cuh>

#include <stdexcept>
#include <string>

#include "backends.h"
#include "tree.h"

namespace simple_knn::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kCoordinateBits = 32;

void check(cudaError_t error) {
  if (error != cudaSuccess) throw std::runtime_error(std::string("distCUDA2 failed: ") + cudaGetErrorString(error));
}

int blocks_for(int64_t items) { return int((items + kThreads - 1) / kThreads); }
__device__ int64_t thread_index() { return int64_t(blockIdx.x) * kThreads + threadIdx.x; }

struct IsFinite {
  const float* points;
  __device__ bool operator()(int32_t row) const { return is_finite(points + 3 * int64_t(row)); }
};

/// Integers in the order of the floats.
__device__ uint32_t sortable(float v) {
  const uint32_t bits = __float_as_uint(v);
  return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
}

__global__ void __launch_bounds__(kThreads) count_up_kernel(int32_t* rows, int64_t n) {
  const int64_t i = thread_index();
  if (i < n) rows[i] = int32_t(i);
}

/// Boxes of the leaves. `*finite`: how many of the rows are points of the tree, the first ones.
__global__ void __launch_bounds__(kThreads)
    leaf_boxes_kernel(const float* points, const int32_t* rows, const int32_t* finite, int depth, Box* boxes) {
  const int64_t leaf = thread_index(), n = *finite;
  if (leaf >= int64_t(1) << depth) return;
  Box box = empty_box();
  const int64_t end = first_of(leaf + 1, depth, n);
  for (int64_t p = first_of(leaf, depth, n); p < end; ++p) {
    const float* at = points + 3 * int64_t(rows[p]);
    extend(box, at, at);
  }
  boxes[(int64_t(1) << depth) + leaf] = box;
}

/// Boxes of a level from those of the next.
__global__ void __launch_bounds__(kThreads) join_boxes_kernel(int level, Box* boxes) {
  const int64_t i = thread_index(), node = (int64_t(1) << level) + i;
  if (i >= int64_t(1) << level) return;
  Box box = boxes[2 * node];
  extend(box, boxes[2 * node + 1].lo, boxes[2 * node + 1].hi);
  boxes[node] = box;
}

/// What the nodes of a level are split by. Rows that are not in the tree stay behind all others.
__global__ void __launch_bounds__(kThreads)
    keys_kernel(const float* points, const int32_t* rows, int64_t rows_count, const int32_t* finite, int level,
                const Box* boxes, uint64_t* keys) {
  const int64_t p = thread_index(), n = *finite;
  if (p >= rows_count) return;
  if (p >= n) {
    keys[p] = uint64_t(1) << (kCoordinateBits + level);
    return;
  }
  // The last i whose first_of(i) is at most p.
  const int64_t i = (((p + 1) << level) - 1) / n;
  const int axis = longest_side(boxes[(int64_t(1) << level) + i]);
  keys[p] = uint64_t(i) << kCoordinateBits | sortable(points[3 * int64_t(rows[p]) + axis]);
}

__global__ void __launch_bounds__(kThreads)
    gather_kernel(const float* points, const int32_t* rows, int64_t n, Point* gathered) {
  const int64_t p = thread_index();
  if (p >= n) return;
  const int32_t row = rows[p];
  const float* at = points + 3 * int64_t(row);
  gathered[p] = {{at[0], at[1], at[2]}, row};
}

__global__ void __launch_bounds__(kThreads) search_kernel(const Point* points, const Box* boxes, int64_t rows_count,
                                                          const int32_t* finite, int depth, float* out) {
  const int64_t p = thread_index(), n = *finite;
  if (p >= rows_count) return;
  if (p >= n) {
    out[points[p].row] = 0;
    return;
  }
  const int64_t leaf = (((p + 1) << depth) - 1) / n;
  out[points[p].row] = mean_squared_distance({points, boxes, n, depth}, p, leaf);
}

/// Parts of the scratch memory.
struct Scratch {
  uint64_t* keys[2];  // in the end both together hold the points of the tree
  int32_t* rows[2];
  Box* boxes;
  int32_t* finite;
  void* cub;
  size_t cub_bytes;
  int64_t bytes;
};

template <typename T> T* take(char* memory, int64_t count, int64_t& offset) {
  constexpr int64_t kAlignment = 256;
  T* const part = reinterpret_cast<T*>(memory + offset);
  offset += (count * int64_t(sizeof(T)) + kAlignment - 1) / kAlignment * kAlignment;
  return part;
}

Scratch lay_out(void* memory, int64_t n) {
  Scratch scratch = {};
  char* const bytes = static_cast<char*>(memory);
  scratch.keys[0] = take<uint64_t>(bytes, 2 * n, scratch.bytes);
  scratch.keys[1] = scratch.keys[0] + n;
  for (int32_t*& rows : scratch.rows) rows = take<int32_t>(bytes, n, scratch.bytes);
  scratch.boxes = take<Box>(bytes, int64_t(2) << depth_for(n), scratch.bytes);
  scratch.finite = take<int32_t>(bytes, 1, scratch.bytes);
  cub::DoubleBuffer<uint64_t> keys;
  cub::DoubleBuffer<int32_t> rows;
  size_t sort = 0, partition = 0;
  check(cub::DeviceRadixSort::SortPairs(nullptr, sort, keys, rows, int(n)));
  check(cub::DevicePartition::If(nullptr, partition, scratch.rows[0], scratch.rows[1], scratch.finite, int(n),
                                 IsFinite{nullptr}));
  scratch.cub_bytes = sort > partition ? sort : partition;
  scratch.cub = take<char>(bytes, int64_t(scratch.cub_bytes), scratch.bytes);
  return scratch;
}

}  // namespace

int64_t scratch_bytes(int64_t n) { return lay_out(nullptr, n).bytes; }

void mean_distances(const float* points, int64_t n, void* memory, float* out, CUstream_st* stream) {
  Scratch scratch = lay_out(memory, n);
  const int depth = depth_for(n);
  const int32_t* const finite = scratch.finite;
  const int point_blocks = blocks_for(n), leaf_blocks = blocks_for(int64_t(1) << depth);

  count_up_kernel<<<point_blocks, kThreads, 0, stream>>>(scratch.rows[0], n);
  check(cudaGetLastError());
  check(cub::DevicePartition::If(scratch.cub, scratch.cub_bytes, scratch.rows[0], scratch.rows[1], scratch.finite,
                                 int(n), IsFinite{points}, stream));

  cub::DoubleBuffer<uint64_t> keys(scratch.keys[0], scratch.keys[1]);
  cub::DoubleBuffer<int32_t> rows(scratch.rows[1], scratch.rows[0]);
  for (int level = 0; level <= depth; ++level) {
    leaf_boxes_kernel<<<leaf_blocks, kThreads, 0, stream>>>(points, rows.Current(), finite, depth, scratch.boxes);
    for (int above = depth - 1; above >= level; --above) {
      join_boxes_kernel<<<blocks_for(int64_t(1) << above), kThreads, 0, stream>>>(above, scratch.boxes);
    }
    check(cudaGetLastError());
    if (level == depth) break;
    keys_kernel<<<point_blocks, kThreads, 0, stream>>>(points, rows.Current(), n, finite, level, scratch.boxes,
                                                       keys.Current());
    check(cudaGetLastError());
    check(cub::DeviceRadixSort::SortPairs(scratch.cub, scratch.cub_bytes, keys, rows, int(n), 0,
                                          kCoordinateBits + level + 1, stream));
  }
  // The keys have served: their memory takes the points.
  Point* const gathered = reinterpret_cast<Point*>(scratch.keys[0]);
  gather_kernel<<<point_blocks, kThreads, 0, stream>>>(points, rows.Current(), n, gathered);
  check(cudaGetLastError());
  search_kernel<<<point_blocks, kThreads, 0, stream>>>(gathered, scratch.boxes, n, finite, depth, out);
  check(cudaGetLastError());
}

}  // namespace simple_knn::cuda
