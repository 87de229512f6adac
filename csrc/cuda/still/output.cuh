// Addresses of a pixel's checkpoints; writes finished pixels, and the checkpoints where blend_vjp starts.
#pragma once

#include "cuda/tile/pixels.cuh"

namespace ar::cuda {

__device__ inline int front_of(const BlendParams& params) {
  return front_chunks(params.grid, params.lists.counts->pairs, params.plan.blocks_at_once);
}

/// The checkpoints (CheckpointLayout) of a pixel.
template <int S, int C, bool kKeep> struct PixelCheckpoints {
  float* base;  ///< first plane of the tile
  int first_chunk, pixel;

  __device__ PixelCheckpoints(const BlendParams& params, int tile, int pixel)
      : base(params.checkpoints + int64_t(params.plan.tile_planes[tile]) * kTilePixels),
        first_chunk(kKeep ? 0 : front_of(params) - 1),
        pixel(pixel) {}

  __device__ Checkpoint<C>& kept(int chunk, int s) const {
    return reinterpret_cast<Checkpoint<C>*>(base)[(int64_t(chunk) * S + s) * kTilePixels + pixel];
  }
  /// Without kKeep: plane k of a chunk, transmittance of every sample, then channels.
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
  /// Of a sample; without kKeep of all samples.
  __device__ Values<C> channels(int chunk, int s) const {
    if constexpr (kKeep) {
      return kept(chunk, s).channels;
    } else {
      Values<C> values;
      AR_UNROLL for (int c = 0; c < C; ++c) values.v[c] = plane(chunk, S + c);
      return values;
    }
  }
  __device__ void set_total(int chunk, const Values<C>& values) const {
    AR_UNROLL for (int c = 0; c < C; ++c) plane(chunk, S + c) = values.v[c];
  }
};

/// For kernels compiled once for all S, C and kKeep.
struct TransmittancePlanes {
  float* base;
  int first_chunk;
  int64_t chunk_stride, sample_stride;

  /// `samples`: of a lane.
  __device__ TransmittancePlanes(const BlendParams& params, int samples, int tile, int pixel) {
    const CheckpointLayout layout = params.layout;
    const int of_sample = layout.keep ? layout.channels + 1 : 1;
    first_chunk = layout.first_chunk(front_of(params));
    chunk_stride = int64_t(layout.planes(samples)) * kTilePixels;
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
  AR_UNROLL for (int c = 0; c < C; ++c) background.v[c] =
      C == 3 || c < params.channels.count ? params.background[c] : 0;
  return background;
}

/// `total`: the channels of its samples in this lane. Samples: a footprint or LaneSamples. All lanes must call it.
template <class Samples, int C>
__device__ void store_pixel(const BlendParams& params, Pixel pixel, Values<C> total,
                            const float (&transmittance)[Samples::kSamples]) {
  float through = 0;
  AR_UNROLL for (int s = 0; s < Samples::kSamples; ++s) {
    through += abs(transmittance[s]);
    if (params.transmittance && pixel.inside)
      params.transmittance[sample_index<Samples>(pixel, s)] = abs(transmittance[s]);
  }
  through = sum_of_pixel<Samples>(through);
  AR_UNROLL for (int c = 0; c < C; ++c) total.v[c] = sum_of_pixel<Samples>(total.v[c]);
  if (!pixel.inside || !writes_pixel<Samples>(lane_id())) return;
  const float scale = kSampleShare<Samples>;
  AR_UNROLL for (int c = 0; c < C; ++c) {
    if (C > 3 && c >= params.channels.count) break;
    params.image.plane(c, pixel.image)[pixel.index] = scale * total.v[c] + scale * through * params.background[c];
  }
  if (params.alpha) params.alpha[pixel.index] = 1 - scale * through;
}

/// Replaces the channels of chunks [first, end) by those of everything farther. `farther`: beyond the last of these.
/// kBatch chunks are loaded before the first store, to wait together.
template <int kBatch, int S, int C>
__device__ void accumulate_farther(const PixelCheckpoints<S, C, true>& checkpoints, int first, int end, int s,
                                   Values<C> farther) {
  for (int last = end - 1; last >= first; last -= kBatch) {
    Values<C> own[kBatch];
    AR_UNROLL for (int k = 0; k < kBatch; ++k) {
      if (last - k >= first) own[k] = checkpoints.kept(last - k, s).channels;
    }
    AR_UNROLL for (int k = 0; k < kBatch; ++k) {
      if (last - k < first) continue;
      checkpoints.kept(last - k, s).channels = farther;
      farther += own[k];
    }
  }
}

}  // namespace ar::cuda
