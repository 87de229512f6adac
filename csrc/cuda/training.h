// The launches of a training step besides rendering, in float and double: loss, activations, optimiser and what density
// control observes. All pointers are views of device memory. Every function enqueues work on a stream and returns; none
// waits for the device, and bits do not depend on the order in which blocks run.
#pragma once

#include <cuda_runtime_api.h>

#include "core/activations.h"
#include "core/adam.h"
#include "core/density.h"
#include "core/ssim.h"

namespace ar::cuda {

/// Blocks that an image is divided into: ssim takes room for two sums of each, if there is a loss. Fewer than 2^31.
template <typename T> int64_t ssim_blocks(int64_t planes, int height, int width);

template <typename T, typename Target> void ssim(const SsimParams<T, Target>& p, T* block_sums, cudaStream_t stream);
template <typename T, typename Target> void ssim_vjp(const SsimVjpParams<T, Target>& p, cudaStream_t stream);

template <typename T> void activate(const ActivateParams<T>& p, cudaStream_t stream);
template <typename T> void activate_vjp(const ActivateVjpParams<T>& p, cudaStream_t stream);

template <typename T> void observe(const ObserveParams<T>& p, cudaStream_t stream);

/// p.first_item need not be set; at least one tensor, and fewer than 2^40 numbers.
template <typename T> void adam(AdamParams<T> p, cudaStream_t stream);

}  // namespace ar::cuda
