// The CPU path in double precision, one pixel at a time.
#include "cpu/kernels_std.h"

#define AR_ISA double_precision
#define AR_LANES 4
#include "cpu/kernels.h"

namespace ar::double_precision {
template const cpu::Stages<double>* stages<double>(std::string_view);
}
