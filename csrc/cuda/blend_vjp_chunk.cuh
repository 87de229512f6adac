// A warp's chunk in blend_vjp for up to four channels: its pairs, where its pixels are in the image, and what they are
// behind the chunk.
#pragma once

#include "cuda/blend_vjp_pixels.cuh"

namespace ar::cuda {

/// The pairs [begin, end) of a tile's list.
struct VjpChunk {
  TileList list;
  int begin, end;
  int plane;  ///< of checkpoints, the chunk's first
  const TileGrid& grid;
  int64_t image;     ///< how many pixels the image has
  Vec2<float> size;  ///< of the image [px]

  __device__ __forceinline__ VjpChunk(const BlendVjpParams& params, TileChunk chunk, int length)
      : list(list_of(params.lists, params.grid, chunk.tile)),
        begin(chunk.chunk * length),
        end(list.of_patch ? list.count : min(list.count, begin + length)),
        plane(chunk.plane),
        grid(params.grid),
        image(int64_t(grid.width) * grid.height),
        size({float(grid.width), float(grid.height)}) {}

  /// Number in the image of a lane's pixel of subtile b; -1 outside. No Pixel: with those, kernels of 8 and 16 samples
  /// get more registers.
  template <class F> __device__ int64_t pixel_index(int b, int lane) const {
    const Vec2<float> p = pixel_of<F>(b, lane);
    const int x = list.x0 + int(p.x), y = list.y0 + int(p.y);
    return x < grid.width && y < grid.height ? int64_t(y) * grid.width + x : int64_t(-1);
  }
};

/// The place behind the last pair that was composited into any pixel of the chunk's tile. Those of the subtiles are
/// left in group.subtile_last, to be read behind the next barrier of the warps. `first`: of the warp's samples.
template <class F, class Group>
__device__ __forceinline__ int find_last(const BlendVjpParams& params, const VjpChunk& chunk, int first, Group& group) {
  const int lane = lane_id();
  int tile_last = 0;
#pragma unroll
  for (int b = 0; b < kSubtiles; ++b) {
    const int64_t i = chunk.pixel_index<F>(b, lane);
    int last = 0;
#pragma unroll
    for (int s = 0; s < F::kSamples; ++s) last = max(last, i < 0 ? 0 : params.last[sample_index<F>(chunk.image, i, s)]);
    last = warp_max(last);
    if (lane == 0 && first == 0) group.subtile_last[b] = last;
    tile_last = max(tile_last, last);
  }
  return tile_last;
}

/// Sets the pixels and their samples to what they are behind the chunk. `final`: no pixel has composited anything
/// behind it, so that there is only the background; or else what is there is in `checkpoints`, those at the end of the
/// chunk.
template <class F, int C, Sums kSums>
__device__ __forceinline__ void start_pixels(const BlendVjpParams& params, const VjpChunk& chunk,
                                             const Checkpoint<C>* checkpoints, int first, bool final,
                                             LanePixels<F, C, kSums>& pixels) {
  const int lane = lane_id();
  const float* dL_dplanes[C];  // of three channels all are there
  Values<C> background;
#pragma unroll
  for (int c = 0; c < C; ++c) {
    const bool used = C == 3 || c < params.channels.count;
    dL_dplanes[c] = C == 3 ? params.dL_dimage.first + c * chunk.image
                    : used ? params.dL_dimage.plane(c, chunk.image)
                           : nullptr;
    background.v[c] = used ? params.background[c] : 0;
  }
#pragma unroll
  for (int b = 0; b < kSubtiles; ++b) {
    const int64_t i = chunk.pixel_index<F>(b, lane);
    const float scale = i < 0 ? 0 : kSampleShare<F>;
    Values<C> g;
#pragma unroll
    for (int c = 0; c < C; ++c) g.v[c] = i >= 0 && (C == 3 || dL_dplanes[c]) ? scale * dL_dplanes[c][i] : 0;
    pixels.set_gradient(b, g);
#pragma unroll
    for (int s = 0; s < kVjpSamples<F, kSums>; ++s) {
      const int last = i < 0 ? 0 : params.last[sample_index<F>(chunk.image, i, first + s)];
      float transmittance = 1, behind = 0;
      if (final) {
        transmittance = i < 0 ? 1.0f : params.transmittance[sample_index<F>(chunk.image, i, first + s)];
        behind = dot(g, background);
      } else {
        const Checkpoint<C> c = checkpoints[(first + s) * kTilePixels + b * 32 + lane];
        transmittance = abs(c.transmittance);
        behind = dot(g, c.channels) / transmittance;
      }
      // Alpha is 1 - transmittance: its gradient acts like one more channel whose background is -1.
      if (params.dL_dalpha && i >= 0) {
        const float open = final ? 1 : params.transmittance[sample_index<F>(chunk.image, i, first + s)] / transmittance;
        behind -= scale * params.dL_dalpha[i] * open;
      }
      pixels.sample(s, b) = {transmittance, behind};
      pixels.set_last(s, b, last);
    }
  }
}

}  // namespace ar::cuda
