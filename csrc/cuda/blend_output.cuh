// What the kernels of blend for up to four channels leave in memory: a list of the tiles that are still open,
// checkpoints at the ends of chunks, and finished pixels.
#pragma once

#include "cuda/composite.cuh"

namespace ar::cuda {

/// List of the tiles with S samples that blend_front left open.
template <int S> __device__ int32_t* open_tiles(const BlendParams& params) {
  return params.open_tiles + sample_class(S) * params.grid.tiles();
}

/// Chunks of the front of a tile with S samples.
template <int S> __device__ int front_of(const BlendParams& params) {
  return front_chunks(params.grid, params.lists.counts->pairs, S);
}

/// Checkpoints of a pixel of a tile, with the layout of CheckpointLayout.
template <int S, int C, bool kKeep> struct PixelCheckpoints {
  float* base;  ///< of the tile's first plane
  int first_chunk, pixel;

  __device__ PixelCheckpoints(const BlendParams& params, int tile, int pixel)
      : base(params.checkpoints + int64_t(params.plan.tile_planes[tile]) * kTilePixels),
        first_chunk(kKeep ? 0 : front_of<S>(params) - 1),
        pixel(pixel) {}

  __device__ Checkpoint<C>& kept(int chunk, int s) const {
    return reinterpret_cast<Checkpoint<C>*>(base)[(int64_t(chunk) * S + s) * kTilePixels + pixel];
  }
  /// Plane k of a chunk without a backward pass: transmittance of every sample, then the channels.
  __device__ float& plane(int chunk, int k) const {
    return base[(int64_t(chunk - first_chunk) * (S + C) + k) * kTilePixels + pixel];
  }

  __device__ float& transmittance(int chunk, int s) const {
    if constexpr (kKeep) {
      return kept(chunk, s).transmittance;
    } else {
      return plane(chunk, s);
    }
  }
  /// Channels of a sample or, without a backward pass, of all.
  __device__ Values<C> channels(int chunk, int s) const {
    if constexpr (kKeep) {
      return kept(chunk, s).channels;
    } else {
      Values<C> values;
#pragma unroll
      for (int c = 0; c < C; ++c) values.v[c] = plane(chunk, S + c);
      return values;
    }
  }
  __device__ void set_total(int chunk, const Values<C>& values) const {
#pragma unroll
    for (int c = 0; c < C; ++c) plane(chunk, S + c) = values.v[c];
  }
};

/// A pixel's transmittance in the checkpoints, with or without a backward pass: for kernels that are compiled once for
/// any number of channels.
template <int S> struct TransmittancePlanes {
  float* base;
  int first_chunk;
  int64_t chunk_stride, sample_stride;

  __device__ TransmittancePlanes(const BlendParams& params, int tile, int pixel) {
    const CheckpointLayout layout = params.layout;
    const int of_sample = layout.keep ? layout.channels + 1 : 1;
    first_chunk = layout.first_chunk(front_of<S>(params));
    chunk_stride = int64_t(layout.planes(S)) * kTilePixels;
    sample_stride = int64_t(of_sample) * kTilePixels;
    base =
        params.checkpoints + int64_t(params.plan.tile_planes[tile]) * kTilePixels + pixel * of_sample + of_sample - 1;
  }
  __device__ float& at(int chunk, int s) const {
    return base[(chunk - first_chunk) * chunk_stride + s * sample_stride];
  }
};

template <int C> __device__ Values<C> background_of(const BlendParams& params) {
  Values<C> background;
#pragma unroll
  for (int c = 0; c < C; ++c) background.v[c] = C == 3 || c < params.channels.count ? params.background[c] : 0;
  return background;
}

/// Writes a pixel whose samples are complete. `total` is the sum of their channels. All lanes of a warp must call it.
template <class F, int C>
__device__ void store_pixel(const BlendParams& params, Pixel pixel, Values<C> total,
                            const float (&transmittance)[F::kSamples]) {
  float through = 0;
#pragma unroll
  for (int s = 0; s < F::kSamples; ++s) {
    through += abs(transmittance[s]);
    if (params.transmittance && pixel.inside) params.transmittance[sample_index<F>(pixel, s)] = abs(transmittance[s]);
  }
  through = sum_of_pixel<F>(through);
#pragma unroll
  for (int c = 0; c < C; ++c) total.v[c] = sum_of_pixel<F>(total.v[c]);
  if (!pixel.inside || !writes_pixel<F>(lane_id())) return;
  const float scale = kSampleShare<F>;
#pragma unroll
  for (int c = 0; c < C; ++c) {
    if (C > 3 && c >= params.channels.count) break;
    params.image.plane(c, pixel.image)[pixel.index] = scale * total.v[c] + scale * through * params.background[c];
  }
  if (params.alpha) params.alpha[pixel.index] = 1 - scale * through;
}
template <class F> __device__ void store_last(const BlendParams& params, Pixel pixel, const int (&last)[F::kSamples]) {
  if (!pixel.inside) return;
#pragma unroll
  for (int s = 0; s < F::kSamples; ++s) params.last[sample_index<F>(pixel, s)] = last[s];
}

/// Turns the checkpoints of a sample's chunks [first, end), which hold the channels of the chunk itself, into the
/// channels of everything behind the chunk, from which blend_vjp starts. `behind`: the channels of what is behind all
/// of them. These are sums of positive terms, which do not cancel. kBatch: chunks that are loaded before the first
/// store, so that the loads wait for memory together.
template <int kBatch, int S, int C>
__device__ void accumulate_behind(const PixelCheckpoints<S, C, true>& checkpoints, int first, int end, int s,
                                  Values<C> behind) {
  for (int last = end - 1; last >= first; last -= kBatch) {
    Values<C> own[kBatch];
#pragma unroll
    for (int k = 0; k < kBatch; ++k) {
      if (last - k >= first) own[k] = checkpoints.kept(last - k, s).channels;
    }
#pragma unroll
    for (int k = 0; k < kBatch; ++k) {
      if (last - k < first) continue;
      checkpoints.kept(last - k, s).channels = behind;
      behind += own[k];
    }
  }
}

}  // namespace ar::cuda
