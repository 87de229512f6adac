// Ends target_avx2.h or target_avx512.h. Functions are compiled for the baseline again.
#if defined(__clang__)
#pragma clang attribute pop
#else
#pragma GCC pop_options
#endif
