// Included by the loops of cpu/ in every kernels_*.cpp, which compiles them for one instruction set. That file defines
// AR_ISA, the namespace of this set, so that the linker keeps sets apart, and AR_LANES, the floats of a register.
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
