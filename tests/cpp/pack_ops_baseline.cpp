#include "cpu/kernels_std.h"
#include "instruction_sets.h"

#define AR_ISA baseline
#define AR_LANES 4
#include "pack_ops.h"
