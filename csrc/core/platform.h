// Macros for differences of compilers and devices.
#pragma once

#if defined(__CUDACC__)
#define AR_HD __host__ __device__ __forceinline__
#define AR_HD_LAMBDA
/// For what is rarely called and long: on a device a call, so that callers keep their registers.
#define AR_HD_CALL __host__ __device__ __noinline__
#else
// Always inlined: the linker might give code for an older instruction set a copy for a newer one.
#define AR_HD inline __attribute__((always_inline))
#define AR_HD_CALL AR_HD
/// For a lambda, between parameters and body.
#define AR_HD_LAMBDA __attribute__((always_inline))
#endif

/// Before a loop whose body should see the index as a constant.
#if defined(__CUDA_ARCH__)
#define AR_UNROLL _Pragma("unroll")
#elif defined(__CUDACC__)
#define AR_UNROLL
#else
#define AR_UNROLL _Pragma("GCC unroll 16")
#endif

/// Before a loop whose body should be in the code once.
#if defined(__CUDA_ARCH__)
#define AR_NO_UNROLL _Pragma("unroll 1")
#elif defined(__CUDACC__)
#define AR_NO_UNROLL
#else
#define AR_NO_UNROLL _Pragma("GCC unroll 1")
#endif
