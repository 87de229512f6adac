// Compiles the loops of kernels.h for AVX2, in packs of 8 floats.
#if defined(__x86_64__)
#include "cpu/kernels_std.h"

#include "cpu/target_avx2.h"

#define AR_ISA avx2
#define AR_LANES 8
#include "cpu/kernels.h"

namespace ar::avx2 {
template void set_blend_stages<float, false>(int, cpu::Stages<float>&);
template void set_projection_and_bin<float>(cpu::Stages<float>&);
}  // namespace ar::avx2

#include "cpu/target_end.h"
#endif
