// The instruction sets that the CPU path is compiled for, and what the tests call in each.
#pragma once

#include <cstdint>
#include <ostream>
#include <vector>

#include "cpu/stages.h"

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
};

struct InstructionSet {
  const char* name;
  bool supported;  ///< by this CPU
  PackOps ops;
  const cpu::Stages<float>& (*stages)(int footprint);
};

inline void PrintTo(const InstructionSet& set, std::ostream* out) { *out << set.name; }

const std::vector<InstructionSet>& instruction_sets();

}  // namespace ar::test
