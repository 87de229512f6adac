// Compiles the loops of kernels.h for AVX-512, in packs of 16 floats.
#if defined(__x86_64__)
#include "cpu/kernels_std.h"

#include "cpu/target_avx512.h"

#define AR_ISA avx512
#define AR_LANES 16
#include "cpu/kernels.h"

namespace ar::avx512 {
template void set_blend_stages<float, false>(int, cpu::Stages<float>&);
template void set_projection_and_bin<float>(cpu::Stages<float>&);
}  // namespace ar::avx512

#include "cpu/target_end.h"
#endif
