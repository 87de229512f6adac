#include "cpu/kernels_std.h"
#include "pack_ops_table.h"

#define AR_ISA baseline
#define AR_LANES 4
#include "pack_ops.h"
