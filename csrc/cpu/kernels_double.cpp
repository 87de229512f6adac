// Compiles the loops of kernels_all.h in double, a pixel at a time, for tests and gradcheck.
#include "cpu/kernels_std.h"

#define AR_ISA double_precision
#define AR_LANES 4
#include "cpu/kernels_all.h"

namespace ar::double_precision {
template cpu::Stages<double> all_stages<double>(int);
}
