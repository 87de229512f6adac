#include "instruction_sets.h"

#define AR_DECLARE(isa)                                                           \
  namespace ar::isa {                                                             \
  extern const test::PackOps kPackOps;                                            \
  template <typename T> const cpu::Stages<T>* stages(std::string_view footprint); \
  extern template const cpu::Stages<float>* stages<float>(std::string_view);      \
  }
AR_DECLARE(baseline)
#if defined(__x86_64__)
AR_DECLARE(avx2)
AR_DECLARE(avx512)
#endif

namespace ar::test {

const std::vector<InstructionSet>& instruction_sets() {
  static const std::vector<InstructionSet> sets = {
      {"baseline", true, baseline::kPackOps, baseline::stages<float>},
#if defined(__x86_64__)
      {"avx2", __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2"),
       avx2::kPackOps, avx2::stages<float>},
      {"avx512",
       __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") &&
           __builtin_cpu_supports("avx512bw"),
       avx512::kPackOps, avx512::stages<float>},
#endif
  };
  return sets;
}

}  // namespace ar::test
