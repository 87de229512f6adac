// What a lane of the backward kernels of moment/ carries through a list (VjpLane): `last`, the image's gradient for its
// pixel, and the Adjoint.
#pragma once

#include "cuda/moment/cells.cuh"

namespace ar::cuda {

/// What a kernel for the channels [first, first + C) sums besides these channels. PairGrad is linear in the gradient:
/// each kernel adds its share. MeanSums need all channels: the first kernel makes them, and all of PairGrad.
template <int C> struct WantedSums {
  static constexpr bool kMany = C > kFewChannels;  ///< there may be several kernels
  bool shape;                                      ///< PairGrad
  bool means;                                      ///< MeanSums
  bool others;                                     ///< with the channels of other kernels

  __device__ WantedSums(const BlendVjpParams& params, int first) {
    const bool is_first = !kMany || first == 0;
    shape = is_first || params.mean_sums == MeanSums::kNone;
    means = is_first && params.mean_sums != MeanSums::kNone;
    others = kMany && means && params.channels.count > C;
  }
};

template <class F, int C> struct SampleGrad {
  Values<C> channels;  ///< from `first` on
  float through;       ///< scalar product with the background
  bool with_others;    ///< WantedSums::others

  __device__ void read(const BlendVjpParams& params, const Pixel& pixel, int first, WantedSums<C> wanted) {
    with_others = wanted.others;
    through = 0;
    AR_UNROLL for (int c = 0; c < C; ++c) {
      channels.v[c] = sample_gradient<F>(params, pixel, first + c);
      if (first + c < params.channels.count) through += channels.v[c] * params.background[first + c];
    }
    if (with_others) {
      for (int c = C; c < params.channels.count; ++c)
        through += sample_gradient<F>(params, pixel, c) * params.background[c];
    }
    // Alpha is a channel with background -1.
    if (first == 0 && params.dL_dalpha && pixel.inside) through -= kSampleShare<F> * params.dL_dalpha[pixel.index];
  }

  /// The scalar product with the channels of splat id().
  template <class Id>
  __device__ float times(const Values<C>& color, const BlendVjpParams& params, const Pixel& pixel, Id&& id) const {
    float product = channels.v[0] * color.v[0];
    AR_UNROLL for (int c = 1; c < C; ++c) product = madd(channels.v[c], color.v[c], product);
    if (with_others) {
      const float* row = params.channels.row(id());
      for (int c = C; c < params.channels.count; ++c)
        product = madd(sample_gradient<F>(params, pixel, c), row[c], product);
    }
    return product;
  }
};

/// Pairs up to the last that was composited into each sample, and into any of the warp.
template <class F, class Layout> struct SamplesLast {
  int samples[Layout::kCells], warp = 0;

  __device__ SamplesLast(const int32_t* last, const Pixel& pixel) {
    AR_UNROLL for (int i = 0; i < Layout::kCells; ++i) {
      const int sample = Layout::first_sample() + i;
      samples[i] = pixel.inside && sample < F::kSamples ? last[sample * pixel.image + pixel.index] : 0;
      warp = max(warp, samples[i]);
    }
    warp = warp_max(warp);
  }
  /// All threads must call it.
  __device__ int of_block(int (&of_warps)[Layout::kWarps]) const {
    if (lane_id() == 0) of_warps[threadIdx.x / 32] = warp;
    __syncthreads();
    int block = 0;
    AR_UNROLL for (int w = 0; w < Layout::kWarps; ++w) block = max(block, of_warps[w]);
    return block;
  }
};

struct Adjoint {
  float later;               ///< gradient-weighted colour of all later splats
  Vec2<float> dL_dposition;  ///< times F::kMoveGradUnit
};

template <class F, int C, class Layout, bool kTogether = kSamplesTogether<Layout>> struct VjpLane {
  static constexpr int kCells = Layout::kCells;
  using Samples = MovingSamples<F, Layout, kTogether>;
  Pixel pixel;
  CellCorners<F, Layout> corners;
  Samples samples;
  SamplesLast<F, Layout> last;
  SampleGrad<F, C> grad;
  Adjoint adjoint[kCells];

  __device__ VjpLane(const BlendVjpParams& params, const TileList& list)
      : pixel(list, params.grid, Layout::pixel()),
        corners(Layout::pixel()),
        samples(pixel.inside),
        last(params.last, pixel) {}
  /// After all splats there is only the background.
  __device__ void begin(const BlendVjpParams& params, int first, WantedSums<C> wanted) {
    grad.read(params, pixel, first, wanted);
    AR_UNROLL for (int i = 0; i < kCells; ++i) adjoint[i] = {grad.through, {0, 0}};
  }
};

}  // namespace ar::cuda
