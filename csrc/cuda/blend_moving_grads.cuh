// What the kernels of blend_vjp for footprints whose samples move read of a lane's pixel: the gradient with respect to
// its samples, and where the last splats are that were composited into them.
#pragma once

#include "cuda/blend_moving.cuh"

namespace ar::cuda {

/// The gradient with respect to a sample of a lane's pixel.
template <class F, int C> struct SampleGrad {
  Values<C> channels;  ///< from `first` on
  float through = 0;   ///< what the background gives
  /// Several kernels have the channels, and this one, the first, adds those of the others to the gradient of alpha.
  bool with_others;

  __device__ SampleGrad(const BlendVjpParams& params, const Pixel& pixel, int first)
      : with_others(C > kFewChannels && params.mean_sums != MeanSums::kNone && params.channels.count > C &&
                    first == 0) {
#pragma unroll
    for (int c = 0; c < C; ++c) {
      channels.v[c] = sample_gradient<F>(params, pixel, first + c);
      if (first + c < params.channels.count) through += channels.v[c] * params.background[first + c];
    }
    if (with_others) {
      for (int c = C; c < params.channels.count; ++c)
        through += sample_gradient<F>(params, pixel, c) * params.background[c];
    }
    // Alpha is 1 - transmittance: its gradient acts like one more channel whose background is -1.
    if (first == 0 && params.dL_dalpha && pixel.inside) through -= kSampleShare<F> * params.dL_dalpha[pixel.index];
  }

  /// Its scalar product with the colour of a splat, `id()`.
  template <class Id>
  __device__ float times(const Values<C>& color, const BlendVjpParams& params, const Pixel& pixel, Id&& id) const {
    float product = channels.v[0] * color.v[0];
#pragma unroll
    for (int c = 1; c < C; ++c) product = madd(channels.v[c], color.v[c], product);
    if (with_others) {
      const float* row = params.channels.row(id());
      for (int c = C; c < params.channels.count; ++c)
        product = madd(sample_gradient<F>(params, pixel, c), row[c], product);
    }
    return product;
  }
};

/// The place behind the last splat that was composited, in its tile's list: into each of a lane's samples, and into any
/// of its warp.
template <class F, class Layout> struct SamplesLast {
  int samples[Layout::kCells], warp = 0;

  /// All lanes must call it.
  __device__ SamplesLast(const int32_t* last, const Pixel& pixel) {
#pragma unroll
    for (int i = 0; i < Layout::kCells; ++i) {
      const int sample = Layout::first_sample() + i;
      samples[i] = pixel.inside && sample < F::kSamples ? last[sample * pixel.image + pixel.index] : 0;
      warp = max(warp, samples[i]);
    }
    warp = warp_max(warp);
  }
};
/// And into any of its block.
template <class F, class Layout> struct LastSplats : SamplesLast<F, Layout> {
  using SamplesLast<F, Layout>::warp;
  int block = 0;

  /// `of_warps`: in shared memory. All threads of a block must call it.
  __device__ LastSplats(const int32_t* last, const Pixel& pixel, int (&of_warps)[Layout::kWarps])
      : SamplesLast<F, Layout>(last, pixel) {
    if (lane_id() == 0) of_warps[threadIdx.x / 32] = warp;
    __syncthreads();
#pragma unroll
    for (int w = 0; w < Layout::kWarps; ++w) block = max(block, of_warps[w]);
  }
};

}  // namespace ar::cuda
