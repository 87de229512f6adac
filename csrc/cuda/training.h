// The functions of a training step besides rendering, for torch/training_cuda.cpp; ssim.cu, activations.cu and adam.cu
// have them. Pointers are views of device memory. Every function enqueues kernels on a stream, and does not wait. Bits
// do not depend on the order in which blocks run. T: float or double.
#pragma once

#include <cuda_runtime_api.h>

#include "core/activations.h"
#include "core/adam.h"
#include "core/density.h"
#include "core/ssim.h"

namespace ar::cuda {

/// Tiles of an image, fewer than 2^31.
template <typename T> int64_t ssim_blocks(int64_t planes, int height, int width);

/// block_sums: [ssim_blocks, 2], scratch for the loss. Target: T or uint8_t.
template <typename T, typename Target> void ssim(const SsimParams<T, Target>& p, T* block_sums, cudaStream_t stream);
template <typename T, typename Target> void ssim_vjp(const SsimVjpParams<T, Target>& p, cudaStream_t stream);

template <typename T> void activate(const ActivateParams<T>& p, cudaStream_t stream);
template <typename T> void activate_vjp(const ActivateVjpParams<T>& p, cudaStream_t stream);

template <typename T> void observe(const ObserveParams<T>& p, cudaStream_t stream);

/// At least one tensor, and fewer than 2^40 numbers. Sets p.first_item.
template <typename T> void adam(AdamParams<T> p, cudaStream_t stream);

}  // namespace ar::cuda
