// The instruction set of a translation unit. kernels_*.cpp switch the target, define AR_ISA (a namespace) and AR_LANES
// (floats per register), and include the loops. The linker cannot merge code of two sets, which have two namespaces.
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
