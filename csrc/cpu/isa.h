// For the loops of cpu/. Every kernels_*.cpp compiles them for one instruction set, and defines AR_ISA, its namespace,
// so that the linker keeps sets apart, and AR_LANES, the floats of a register.
#pragma once

#if !defined(AR_ISA) || !defined(AR_LANES)
#error "include this from kernels_*.cpp, which choose the instruction set"
#endif

#if AR_LANES >= 8
#include <immintrin.h>
#endif

// One copy for all callers.
#if defined(__clang__)
#define AR_ONE_COPY __attribute__((noinline))
#else
#define AR_ONE_COPY __attribute__((noinline, noclone))
#endif

namespace ar::AR_ISA {
inline constexpr int kLanes = AR_LANES;
}
