// Which lane has which pixel or sample of a tile, what it keeps between splats, and where it writes.
//
// A tile of 16x16 pixels has eight subtiles of 8x4 pixels. Forward a warp has one, in still/vjp.cuh all. Subtile b is
// in column b % 2 and row b / 2 of the tile, and the pixel of lane l in column l % 8 and row l / 8 of the subtile. With
// a Spread (core/footprint/contract.h) a lane has one sample: neighbouring lanes share a pixel of a smaller tile.
#pragma once

#include "core/blend.h"
#include "cuda/tile/lists.cuh"
#include "cuda/warp.cuh"

namespace ar::cuda {

inline constexpr int kTilePixels = kTile * kTile;
inline constexpr int kSubtiles = 8;
inline constexpr int kBlendThreads = 32 * kSubtiles;

/// Of a subtile [px].
template <class F> inline constexpr int kSubtileWide = 8 >> (kTileBits - spread_tile_bits(F::kLanes, true));
template <class F> inline constexpr int kSubtileHigh = kSubtileWide<F> / 2;

/// For kernels that do not evaluate the footprint.
template <int S, int kLanesOfPixel> struct LaneSamples {
  static constexpr int kSamples = S, kLanes = kLanesOfPixel;
};

/// A lane's pixel of subtile b, relative to the tile's first pixel.
template <class F> __device__ Vec2<float> pixel_of(int b, int lane) {
  constexpr int kWide = kSubtileWide<F>, kHigh = kSubtileHigh<F>;
  static_assert(F::kLanes * kWide * kHigh == 32);
  const int pixel = lane / F::kLanes;
  return {float((b & 1) * kWide + pixel % kWide), float((b >> 1) * kHigh + pixel / kWide)};
}
/// The position of a lane's sample in subtile b; `of_first`: in subtile 0. alpha must have the same bits in blend and
/// blend_vjp.
template <class F> __device__ Vec2<float> position_in(int b, Vec2<float> of_first) {
  return {of_first.x + float((b & 1) * kSubtileWide<F>), of_first.y + float((b >> 1) * kSubtileHigh<F>)};
}
/// The same by lane; of a pixel, if the lane has all its samples.
template <class F> __device__ Vec2<float> position_of(int b, int lane) {
  Vec2<float> of_first = pixel_of<F>(0, lane);
  if constexpr (F::kLanes > 1) {
    Vec2<float> node = {0, 0};
    AR_UNROLL for (int s = 0; s < F::kLanes; ++s) {
      if (lane % F::kLanes == s) node = {float(F::node(s).x), float(F::node(s).y)};
    }
    of_first = of_first + node;
  }
  return position_in<F>(b, of_first);
}

struct Pixel {
  int64_t index, image;  ///< of the pixel; number of pixels
  bool inside;

  __device__ Pixel(const TileList& list, TileGrid grid, Vec2<float> p) {
    const int x = list.x0 + int(p.x), y = list.y0 + int(p.y);
    inside = x < grid.width && y < grid.height;
    index = int64_t(y) * grid.width + x;
    image = int64_t(grid.width) * grid.height;
  }
};

template <class F> inline constexpr float kSampleShare = 1.0f / (F::kSamples * F::kLanes);

/// In arrays [samples, height, width].
template <class F> __device__ int64_t sample_index(int64_t image, int64_t pixel, int s) {
  return (F::kLanes > 1 ? lane_id() % F::kLanes : s) * image + pixel;
}
template <class F> __device__ int64_t sample_index(const Pixel& pixel, int s) {
  return sample_index<F>(pixel.image, pixel.index, s);
}

template <class F> __device__ float sum_of_pixel(float x) {
  AR_UNROLL for (int offset = F::kLanes / 2; offset > 0; offset /= 2) x += __shfl_xor_sync(kAllLanes, x, offset);
  return x;
}
template <class F> __device__ bool writes_pixel(int lane) { return lane % F::kLanes == 0; }

template <class F> __device__ float sample_gradient(const BlendVjpParams& params, const Pixel& pixel, int channel) {
  const float* plane = channel < params.channels.count ? params.dL_dimage.plane(channel, pixel.image) : nullptr;
  return pixel.inside && plane ? kSampleShare<F> * plane[pixel.index] : 0.0f;
}

template <int C> struct Values {
  float v[C];

  __device__ void add(float weight, const Values& other) {
    AR_UNROLL for (int c = 0; c < C; ++c) v[c] = madd(weight, other.v[c], v[c]);
  }
  __device__ Values& operator+=(const Values& other) {
    AR_UNROLL for (int c = 0; c < C; ++c) v[c] += other.v[c];
    return *this;
  }
};
template <> struct Values<0> {};

/// Of a lane's S samples between splats. kSets sets of C channels: 1, or S if checkpoints need them. The transmittance
/// of a sample that has stopped is negative.
template <int S, int C, int kSets> struct PixelState {
  float transmittance[S];
  Values<C> channels[kSets];
  int last[S];

  __device__ void start(bool open) {
    AR_UNROLL for (int s = 0; s < S; ++s) transmittance[s] = open ? 1.0f : -1.0f, last[s] = 0;
    clear_channels();
  }
  __device__ void clear_channels() { AR_UNROLL for (int k = 0; k < kSets; ++k) channels[k] = {}; }
  __device__ Values<C> total() const {
    Values<C> sum = channels[0];
    AR_UNROLL for (int k = 1; k < kSets; ++k) sum += channels[k];
    return sum;
  }
  __device__ bool open() const {
    bool any = false;
    AR_UNROLL for (int s = 0; s < S; ++s) any |= transmittance[s] > 0;
    return any;
  }
};

/// composite(s): blend_sample() of sample s.
template <int S, int C, class Composite>
__device__ __forceinline__ void add_samples(Values<C>& sums, const Values<C>& channels, Composite&& composite) {
  float contribution = 0;
  AR_UNROLL for (int s = 0; s < S; ++s) {
    const Blended<float> b = composite(s);
    if constexpr (S == 1) {
      if (b.mask) sums.add(b.if_shown, channels);
    } else if (s == 0) {
      contribution = b.contribution;
    } else if (b.mask) {
      contribution += b.if_shown;
    }
  }
  if (S > 1) sums.add(contribution, channels);
}
template <int C> __device__ Values<C> times(float scale, const Values<C>& values) {
  Values<C> scaled;
  AR_UNROLL for (int c = 0; c < C; ++c) scaled.v[c] = scale * values.v[c];
  return scaled;
}

/// A sample at the end of a chunk.
template <int C> struct alignas(C == 3 ? 16 : 4) Checkpoint {
  Values<C> channels;
  float transmittance;  ///< negative: stopped
};

}  // namespace ar::cuda
