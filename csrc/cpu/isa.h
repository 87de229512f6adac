// The instruction set that a translation unit of the CPU path is compiled for.
//
// kernels_*.cpp define AR_ISA (a namespace) and AR_LANES (floats per register) after switching the
// target with a pragma, then include the loops. Everything compiled for an instruction set lives in
// its namespace: the linker must never merge code for a newer set into the path of an older one.
#pragma once

#if !defined(AR_ISA) || !defined(AR_LANES)
#error "include this from kernels_*.cpp, which choose the instruction set"
#endif

#if AR_LANES >= 8
#include <immintrin.h>
#endif

// One copy of a large function, whatever its callers pass.
#if defined(__clang__)
#define AR_ONE_COPY __attribute__((noinline))
#else
#define AR_ONE_COPY __attribute__((noinline, noclone))
#endif

namespace ar::AR_ISA {
inline constexpr int kLanes = AR_LANES;
}
