// Compiles the loops of kernels_all.h for every machine, in packs of 4 floats.
#include "cpu/kernels_std.h"

#define AR_ISA baseline
#define AR_LANES 4
#include "cpu/kernels_all.h"

namespace ar::baseline {
template cpu::Stages<float> all_stages<float>(int);
}
