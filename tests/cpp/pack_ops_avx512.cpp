#if defined(__x86_64__)
#include "cpu/kernels_std.h"
#include "pack_ops_table.h"

#include "cpu/target_avx512.h"

#define AR_ISA avx512
#define AR_LANES 16
#include "pack_ops.h"

#include "cpu/target_end.h"
#endif
