// The CPU path for AVX-512.
#if defined(__x86_64__)
#include "cpu/kernels_std.h"

#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2,fma,bmi,bmi2,avx512f,avx512dq,avx512vl,avx512bw"))), \
                             apply_to = function)
#else
// GCC 12's own avx512fintrin.h and avxintrin.h trip these warnings (GCC bug 105593).
#pragma GCC diagnostic ignored "-Wuninitialized"
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"
#pragma GCC push_options
#pragma GCC target("avx2,fma,bmi,bmi2,avx512f,avx512dq,avx512vl,avx512bw")
#endif

#define AR_ISA avx512
#define AR_LANES 16
#include "cpu/kernels.h"

namespace ar::avx512 {
template void set_blend_stages<float, false>(int, cpu::Stages<float>&);
template void set_projection_and_bin<float>(cpu::Stages<float>&);
}  // namespace ar::avx512

#if defined(__clang__)
#pragma clang attribute pop
#else
#pragma GCC pop_options
#endif
#endif
