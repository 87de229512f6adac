// Chooses the instruction set, once per process, and fills tables of stages (stages.h).
#include <cstdlib>
#include <cstring>
#include <vector>

#include "cpu/stages.h"

namespace ar {

namespace baseline {
template <typename T> cpu::Stages<T> all_stages(int footprint);
extern template cpu::Stages<float> all_stages<float>(int);
}  // namespace baseline
namespace double_precision {
template <typename T> cpu::Stages<T> all_stages(int footprint);
extern template cpu::Stages<double> all_stages<double>(int);
}  // namespace double_precision
#if defined(__x86_64__)
namespace avx2 {
template <typename T, bool kReferences> void set_blend_stages(int footprint, cpu::Stages<T>& stages);
extern template void set_blend_stages<float, false>(int, cpu::Stages<float>&);
template <typename T> void set_projection_and_bin(cpu::Stages<T>& stages);
extern template void set_projection_and_bin<float>(cpu::Stages<float>&);
}  // namespace avx2
namespace avx512 {
template <typename T, bool kReferences> void set_blend_stages(int footprint, cpu::Stages<T>& stages);
extern template void set_blend_stages<float, false>(int, cpu::Stages<float>&);
template <typename T> void set_projection_and_bin(cpu::Stages<T>& stages);
extern template void set_projection_and_bin<float>(cpu::Stages<float>&);
}  // namespace avx512
#endif

namespace cpu {
namespace {

template <class Make> auto make_tables(const Make& make) {
  std::vector<decltype(make(0))> tables;
  for_each_footprint(Footprints{}, [&](auto) { tables.push_back(make(int(tables.size()))); });
  return tables;
}

const Stages<float>& baseline_stages(int footprint) {
  static const auto tables = make_tables(baseline::all_stages<float>);
  return tables[footprint];
}

#if defined(__x86_64__)
const Stages<float>& avx2_stages(int footprint) {
  static const auto tables = make_tables([](int i) {
    Stages<float> stages = baseline_stages(i);
    avx2::set_blend_stages<float, false>(i, stages);
    avx2::set_projection_and_bin(stages);
    return stages;
  });
  return tables[footprint];
}
const Stages<float>& avx512_stages(int footprint) {
  static const auto tables = make_tables([](int i) {
    Stages<float> stages = baseline_stages(i);
    avx512::set_blend_stages<float, false>(i, stages);
    avx512::set_projection_and_bin(stages);
    return stages;
  });
  return tables[footprint];
}
#endif

/// The best supported set, or that of the environment if supported: one from another machine must break no program.
const InstructionSet& choose() {
  const char* wanted = std::getenv("ANALYTIC_RASTERIZER_ISA");
  for (const InstructionSet& set : instruction_sets()) {
    if (set.supported && wanted && std::strcmp(set.name, wanted) == 0) return set;
  }
  for (const InstructionSet& set : instruction_sets()) {
    if (set.supported) return set;
  }
  return instruction_sets().back();
}

const InstructionSet& chosen() {
  static const InstructionSet& set = choose();
  return set;
}

}  // namespace

const std::vector<InstructionSet>& instruction_sets() {
  static const std::vector<InstructionSet> sets = {
#if defined(__x86_64__)
      {"avx512",
       __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") &&
           __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
           __builtin_cpu_supports("bmi2"),
       avx512_stages},
      {"avx2", __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2"),
       avx2_stages},
#endif
      {"baseline", true, baseline_stages},
  };
  return sets;
}

template <> const Stages<float>& stages_of<float>(int footprint) { return chosen().stages(footprint); }
template <> const Stages<double>& stages_of<double>(int footprint) {
  static const auto tables = make_tables(double_precision::all_stages<double>);
  return tables[footprint];
}
const char* instruction_set() { return chosen().name; }

}  // namespace cpu
}  // namespace ar
