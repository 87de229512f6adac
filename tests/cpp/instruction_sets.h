// The instruction sets that the CPU path is compiled for, and what the tests call in each.
#pragma once

#include <ostream>
#include <vector>

#include "cpu/stages.h"
#include "pack_ops_table.h"

namespace ar::test {

struct InstructionSet {
  const char* name;
  bool supported;  ///< by this CPU
  PackOps ops;
  const cpu::Stages<float>& (*stages)(int footprint);
};

inline void PrintTo(const InstructionSet& set, std::ostream* out) { *out << set.name; }

const std::vector<InstructionSet>& instruction_sets();

}  // namespace ar::test
