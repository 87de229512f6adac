// What the tests call of one instruction set. Without the core's headers, which pack_ops_*.cpp include with the target
// switched.
#pragma once

#include <cstdint>

namespace ar::test {

/// Operations of one instruction set's Pack on `lanes` floats.
struct PackOps {
  using Map = void (*)(const float* a, const float* b, const float* c, float* out);
  int lanes;
  Map exp2, erfc, sqrt, abs, min, max, madd;
  Map select;  ///< a < b ? b : c
  float (*sum)(const float* a);
  void (*sum_lanes)(const float* a, float* sums);    ///< of eight packs, one behind the other
  uint32_t (*bits)(const float* a, const float* b);  ///< of a < b
  /// Some lanes of a, stored and loaded again; returns how many numbers that took.
  int (*keep_lanes)(uint32_t lanes, const float* a, const float* otherwise, float* out);
  /// Which pixels of a tile of an image, row by row, lie in packs that a splat of `point` is said to reach. `splat`: a
  /// SplatRow<float>.
  void (*reach)(const float* splat, int width, int height, int64_t tile, bool* reached);
};

}  // namespace ar::test
