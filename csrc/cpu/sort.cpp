#include "cpu/sort.h"

#include <algorithm>
#include <cstring>
#include <memory>
#include <utility>

#include "cpu/parallel.h"

namespace ar::cpu {
namespace {

/// Unsigned integers in the order of positive floats.
uint32_t depth_key(float depth) {
  uint32_t key;
  std::memcpy(&key, &depth, sizeof key);
  return key;
}
uint64_t depth_key(double depth) {
  uint64_t key;
  std::memcpy(&key, &depth, sizeof key);
  return key;
}

}  // namespace

/// LSD radix sort with a histogram per part: stable, so the result does not depend on their number.
template <typename T> void sort_by_depth(const T* depths, int64_t n, int threads, std::vector<int32_t>& order) {
  using Key = decltype(depth_key(T()));
  constexpr int kBits = 11, kBuckets = 1 << kBits;
  struct Entry {
    Key key;
    int32_t index;
  };
  const int64_t parts = threads;
  const std::unique_ptr<Entry[]> memory(new Entry[2 * n]);  // not a vector, which one thread would fill with zeros
  Entry *from = memory.get(), *to = from + n;
  std::vector<int64_t> cursors(parts * kBuckets);
  std::vector<Key> set_in_all(parts), set_in_any(parts);
  parallel_for(parts, threads, [&](int64_t p) {
    Key common = ~Key(0), any = 0;
    const Part part = part_of(n, parts, p);
    for (int64_t i = part.begin; i < part.end; ++i) {
      const Key key = depth_key(depths[i]);
      common &= key;
      any |= key;
      from[i] = {key, int32_t(i)};
    }
    set_in_all[p] = common;
    set_in_any[p] = any;
  });
  Key common = ~Key(0), any = 0;  // bits set in every key, in any key
  for (int64_t p = 0; p < parts; ++p) {
    common &= set_in_all[p];
    any |= set_in_any[p];
  }
  for (int shift = 0; shift < int(8 * sizeof(Key)); shift += kBits) {
    if ((((any ^ common) >> shift) & (kBuckets - 1)) == 0) continue;  // all keys agree on this digit
    parallel_for(parts, threads, [&](int64_t p) {
      int64_t* count = &cursors[p * kBuckets];
      std::fill(count, count + kBuckets, 0);
      const Part part = part_of(n, parts, p);
      for (int64_t i = part.begin; i < part.end; ++i) ++count[(from[i].key >> shift) & (kBuckets - 1)];
    });
    int64_t total = 0;
    for (int b = 0; b < kBuckets; ++b) {
      for (int64_t p = 0; p < parts; ++p) {
        const int64_t count = cursors[p * kBuckets + b];
        cursors[p * kBuckets + b] = total;
        total += count;
      }
    }
    parallel_for(parts, threads, [&](int64_t p) {
      int64_t* cursor = &cursors[p * kBuckets];
      const Part part = part_of(n, parts, p);
      for (int64_t i = part.begin; i < part.end; ++i) to[cursor[(from[i].key >> shift) & (kBuckets - 1)]++] = from[i];
    });
    std::swap(from, to);
  }
  order.resize(n);
  parallel_for(parts, threads, [&](int64_t p) {
    const Part part = part_of(n, parts, p);
    for (int64_t i = part.begin; i < part.end; ++i) order[i] = from[i].index;
  });
}

template void sort_by_depth<float>(const float*, int64_t, int, std::vector<int32_t>&);
template void sort_by_depth<double>(const double*, int64_t, int, std::vector<int32_t>&);

}  // namespace ar::cpu
