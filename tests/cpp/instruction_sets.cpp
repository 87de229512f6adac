#include "instruction_sets.h"

#include <cstring>

namespace ar {

namespace baseline {
extern const test::PackOps kPackOps;
}
#if defined(__x86_64__)
namespace avx2 {
extern const test::PackOps kPackOps;
}
namespace avx512 {
extern const test::PackOps kPackOps;
}
#endif

namespace test {

const std::vector<InstructionSet>& instruction_sets() {
  static const std::vector<InstructionSet> sets = [] {
    std::vector<InstructionSet> all;
    for (const cpu::InstructionSet& set : cpu::instruction_sets()) {
      const PackOps* ops = &baseline::kPackOps;
#if defined(__x86_64__)
      if (std::strcmp(set.name, "avx2") == 0) ops = &avx2::kPackOps;
      if (std::strcmp(set.name, "avx512") == 0) ops = &avx512::kPackOps;
#endif
      all.push_back({set.name, set.supported, *ops, set.stages});
    }
    return all;
  }();
  return sets;
}

}  // namespace test
}  // namespace ar
