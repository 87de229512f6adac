// Loops whose items threads share. Each writes to its own memory: the number of threads changes no result.
#pragma once

#include <cstdint>
#include <type_traits>

#include "core/platform.h"

namespace ar::cpu {

using RunItem = void (*)(const void* body, int64_t item, int thread);
void run_items(int64_t items, int threads, RunItem run, const void* body);

/// body(item) or body(item, thread) for item in [0, items), in any order, on at most `threads` threads, numbered from
/// 0. If body throws, items may be skipped, and this throws. Loops may be nested, and begun by several threads at once.
template <class Body> void parallel_for(int64_t items, int threads, const Body& body) {
  const RunItem run = [](const void* pointer, int64_t item, [[maybe_unused]] int thread) {
    const Body& body = *static_cast<const Body*>(pointer);
    if constexpr (std::is_invocable_v<const Body&, int64_t, int>) {
      body(item, thread);
    } else {
      body(item);
    }
  };
  run_items(items, threads, run, &body);
}

/// Part `p` of `parts` near-equal parts of [0, n).
struct Part {
  int64_t begin, end;
};
AR_HD Part part_of(int64_t n, int64_t parts, int64_t p) { return {n * p / parts, n * (p + 1) / parts}; }

}  // namespace ar::cpu
