#if defined(__x86_64__)
#include "cpu/kernels_std.h"
#include "pack_ops_table.h"

#include "cpu/target_avx2.h"

#define AR_ISA avx2
#define AR_LANES 8
#include "pack_ops.h"

#include "cpu/target_end.h"
#endif
