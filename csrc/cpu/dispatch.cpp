// Which instruction set the CPU path runs on.
#include <cstdlib>
#include <cstring>

#include "cpu/tasks.h"

namespace ar {

namespace baseline {
template <typename T> const cpu::Stages<T>* stages(std::string_view footprint);
extern template const cpu::Stages<float>* stages<float>(std::string_view);
}  // namespace baseline
namespace double_precision {
template <typename T> const cpu::Stages<T>* stages(std::string_view footprint);
extern template const cpu::Stages<double>* stages<double>(std::string_view);
}  // namespace double_precision
#if defined(__x86_64__)
namespace avx2 {
template <typename T> const cpu::Stages<T>* stages(std::string_view footprint);
extern template const cpu::Stages<float>* stages<float>(std::string_view);
}  // namespace avx2
namespace avx512 {
template <typename T> const cpu::Stages<T>* stages(std::string_view footprint);
extern template const cpu::Stages<float>* stages<float>(std::string_view);
}  // namespace avx512
#endif

namespace cpu {
namespace {

struct InstructionSet {
  const char* name;
  bool supported;
  const Stages<float>* (*stages)(std::string_view);
};

/// The best supported set, or a worse one that the environment asks for. An unknown or unsupported
/// request changes nothing: a variable left over from another machine must not break a program.
InstructionSet choose() {
  const InstructionSet sets[] = {
#if defined(__x86_64__)
      {"avx512",
       __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") &&
           __builtin_cpu_supports("avx512bw"),
       avx512::stages<float>},
      {"avx2", __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2"),
       avx2::stages<float>},
#endif
      {"baseline", true, baseline::stages<float>},
  };
  const char* wanted = std::getenv("ANALYTIC_RASTERIZER_ISA");
  for (const InstructionSet& set : sets) {
    if (set.supported && wanted && std::strcmp(set.name, wanted) == 0) return set;
  }
  for (const InstructionSet& set : sets) {
    if (set.supported) return set;
  }
  return sets[0];
}

const InstructionSet& chosen() {
  static const InstructionSet set = choose();
  return set;
}

}  // namespace

template <> const Stages<float>* find_stages<float>(std::string_view footprint) { return chosen().stages(footprint); }
template <> const Stages<double>* find_stages<double>(std::string_view footprint) {
  return double_precision::stages<double>(footprint);
}
const char* instruction_set() { return chosen().name; }

}  // namespace cpu
}  // namespace ar
