// The CPU path for every machine, in packs of four.
#include "cpu/kernels_std.h"

#define AR_ISA baseline
#define AR_LANES 4
#include "cpu/kernels.h"

namespace ar::baseline {
template const cpu::Stages<float>* stages<float>(std::string_view);
}
