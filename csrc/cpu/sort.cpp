// sort.h, on several threads.
#include "cpu/sort.h"

#include <algorithm>
#include <memory>
#include <numeric>
#include <utility>
#include <vector>

#include "core/bin.h"
#include "cpu/parallel.h"

namespace ar::cpu {
namespace {

/// Numbers that are worth another thread, and kinds per item.
constexpr int64_t kSumBlock = 4096, kSortBlock = 2048, kKindBlock = 256;

}  // namespace

int64_t sum_before(int64_t* numbers, int64_t n, int threads) {
  const int64_t parts = std::clamp<int64_t>(n / kSumBlock, 1, threads);
  std::vector<int64_t> sums(parts);
  parallel_for(parts, threads, [&](int64_t p) {
    const Part part = part_of(n, parts, p);
    sums[p] = std::accumulate(numbers + part.begin, numbers + part.end, int64_t(0));
  });
  const int64_t all = std::accumulate(sums.begin(), sums.end(), int64_t(0));
  std::exclusive_scan(sums.begin(), sums.end(), sums.begin(), int64_t(0));
  parallel_for(parts, threads, [&](int64_t p) {
    const Part part = part_of(n, parts, p);
    std::exclusive_scan(numbers + part.begin, numbers + part.end, numbers + part.begin, sums[p]);
  });
  return all;
}

int64_t place_items(int64_t* counts, int64_t parts, int64_t kinds, int threads, int64_t* firsts) {
  threads = int(std::clamp<int64_t>(parts * kinds / kSumBlock, 1, threads));
  const int64_t blocks = (kinds + kKindBlock - 1) / kKindBlock;
  const auto kinds_of = [&](int64_t b) { return Part{b * kKindBlock, std::min((b + 1) * kKindBlock, kinds)}; };
  parallel_for(blocks, threads, [&](int64_t b) {
    const Part block = kinds_of(b);
    std::fill(firsts + block.begin, firsts + block.end, 0);
    for (int64_t p = 0; p < parts; ++p) {
      for (int64_t k = block.begin; k < block.end; ++k) firsts[k] += counts[p * kinds + k];
    }
  });
  const int64_t all = sum_before(firsts, kinds, threads);
  parallel_for(blocks, threads, [&](int64_t b) {
    const Part block = kinds_of(b);
    int64_t next[kKindBlock];
    std::copy(firsts + block.begin, firsts + block.end, next);
    for (int64_t p = 0; p < parts; ++p) {
      for (int64_t k = block.begin; k < block.end; ++k) {
        int64_t& first = next[k - block.begin];
        const int64_t count = counts[p * kinds + k];
        counts[p * kinds + k] = first;
        first += count;
      }
    }
  });
  return all;
}

/// LSD radix sort with a histogram per part. It is stable, so that parts do not matter.
template <typename T> void sort_by_depth(const T* depths, int64_t n, int threads, int32_t* order) {
  using Key = decltype(depth_bits(T()));
  constexpr int kBits = 11, kBuckets = 1 << kBits;
  struct Entry {
    Key key;
    int32_t index;
  };
  const int64_t parts = std::clamp<int64_t>(n / kSortBlock, 1, threads);
  const std::unique_ptr<Entry[]> memory(new Entry[2 * n]);  // A vector would be filled with zeros.
  Entry *from = memory.get(), *to = from + n;
  std::vector<int64_t> cursors(parts * kBuckets), firsts(kBuckets);
  std::vector<Key> set_in_all(parts), set_in_any(parts);
  parallel_for(parts, threads, [&](int64_t p) {
    Key common = ~Key(0), any = 0;
    const Part part = part_of(n, parts, p);
    for (int64_t i = part.begin; i < part.end; ++i) {
      const Key key = depth_bits(depths[i]);
      common &= key;
      any |= key;
      from[i] = {key, int32_t(i)};
    }
    set_in_all[p] = common;
    set_in_any[p] = any;
  });
  Key common = ~Key(0), any = 0;
  for (int64_t p = 0; p < parts; ++p) {
    common &= set_in_all[p];
    any |= set_in_any[p];
  }
  for (int shift = 0; shift < int(8 * sizeof(Key)); shift += kBits) {
    if ((((any ^ common) >> shift) & (kBuckets - 1)) == 0) continue;  // All keys agree.
    parallel_for(parts, threads, [&](int64_t p) {
      int64_t* count = &cursors[p * kBuckets];
      std::fill(count, count + kBuckets, 0);
      const Part part = part_of(n, parts, p);
      for (int64_t i = part.begin; i < part.end; ++i) ++count[(from[i].key >> shift) & (kBuckets - 1)];
    });
    place_items(cursors.data(), parts, kBuckets, threads, firsts.data());
    parallel_for(parts, threads, [&](int64_t p) {
      int64_t* cursor = &cursors[p * kBuckets];
      const Part part = part_of(n, parts, p);
      for (int64_t i = part.begin; i < part.end; ++i) to[cursor[(from[i].key >> shift) & (kBuckets - 1)]++] = from[i];
    });
    std::swap(from, to);
  }
  parallel_for(parts, threads, [&](int64_t p) {
    const Part part = part_of(n, parts, p);
    for (int64_t i = part.begin; i < part.end; ++i) order[i] = from[i].index;
  });
}

template void sort_by_depth<float>(const float*, int64_t, int, int32_t*);
template void sort_by_depth<double>(const double*, int64_t, int, int32_t*);

}  // namespace ar::cpu
