// The loops of a training step besides rendering, in float and double, compiled once, for the baseline. Bits do not
// depend on `threads`.
#pragma once

#include "core/activations.h"
#include "core/adam.h"
#include "core/color_correction.h"
#include "core/density.h"
#include "core/ssim.h"

namespace ar::cpu {

template <typename T, typename Target> void ssim(const SsimParams<T, Target>& p, int threads);
template <typename T, typename Target> void ssim_vjp(const SsimVjpParams<T, Target>& p, int threads);

template <typename T> void activate(const ActivateParams<T>& p, int threads);
template <typename T> void activate_vjp(const ActivateVjpParams<T>& p, int threads);

template <typename T> void correct_colors(const CorrectParams<T>& p, int threads);
template <typename T> void correct_colors_vjp(const CorrectVjpParams<T>& p, int threads);

template <typename T> void apply_filter(const FilterParams<T>& p, int threads);
template <typename T> void apply_filter_vjp(const FilterVjpParams<T>& p, int threads);

template <typename T> void observe(const ObserveParams<T>& p, int threads);
template <typename T> void add_noise(const NoiseParams<T>& p, int threads);

/// Sets p.first_item.
template <typename T> void adam(AdamParams<T> p, int threads);

}  // namespace ar::cpu
