// The kernels of a training step besides rendering. Pointers are device memory. Nothing waits for the device. The order
// of blocks changes no bit. T: float or double.
#pragma once

#include <cuda_runtime_api.h>

#include "core/activations.h"
#include "core/adam.h"
#include "core/color_correction.h"
#include "core/density.h"
#include "core/ssim.h"

namespace ar::cuda {

/// Tiles of an image, fewer than 2^31.
template <typename T> int64_t ssim_blocks(int64_t planes, int height, int width);

/// block_sums: [ssim_blocks, 2], scratch for the loss. Target: T or uint8_t.
template <typename T, typename Target> void ssim(const SsimParams<T, Target>& p, T* block_sums, cudaStream_t stream);
template <typename T, typename Target> void ssim_vjp(const SsimVjpParams<T, Target>& p, cudaStream_t stream);

/// Fewer than 2^31 for as many Gaussians as int32 numbers.
int64_t activate_blocks(int64_t n);
/// block_sums: [activate_blocks], scratch for the penalty.
template <typename T> void activate(const ActivateParams<T>& p, T* block_sums, cudaStream_t stream);
template <typename T> void activate_vjp(const ActivateVjpParams<T>& p, cudaStream_t stream);

/// Fewer than 2^31 for the largest image.
int64_t correct_blocks(int64_t pixels);
template <typename T> void correct_colors(const CorrectParams<T>& p, cudaStream_t stream);
/// block_sums: [correct_blocks, kCorrection + kVignetting], scratch for the sums.
template <typename T> void correct_colors_vjp(const CorrectVjpParams<T>& p, T* block_sums, cudaStream_t stream);

template <typename T> void apply_filter(const FilterParams<T>& p, cudaStream_t stream);
template <typename T> void apply_filter_vjp(const FilterVjpParams<T>& p, cudaStream_t stream);

template <typename T> void observe(const ObserveParams<T>& p, cudaStream_t stream);
template <typename T> void add_noise(const NoiseParams<T>& p, cudaStream_t stream);

/// At least one tensor, and fewer than 2^40 numbers. Sets p.first_item.
template <typename T> void adam(AdamParams<T> p, cudaStream_t stream);

}  // namespace ar::cuda
