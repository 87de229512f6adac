// The CPU path for AVX2.
#if defined(__x86_64__)
#include "cpu/kernels_std.h"

#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2,fma,bmi,bmi2"))), apply_to = function)
#else
#pragma GCC push_options
#pragma GCC target("avx2,fma,bmi,bmi2")
#endif

#define AR_ISA avx2
#define AR_LANES 8
#include "cpu/kernels.h"

namespace ar::avx2 {
template void set_blend_stages<float, false>(int, cpu::Stages<float>&);
template void set_projection_and_bin<float>(cpu::Stages<float>&);
}  // namespace ar::avx2

#if defined(__clang__)
#pragma clang attribute pop
#else
#pragma GCC pop_options
#endif
#endif
