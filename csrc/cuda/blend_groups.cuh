// Kernel of blend for any number of channels, in groups of 32: a block per tile and group walks the whole list, a pixel
// per lane. The weights are worked out again for every group, which costs less than to keep them. The yardsticks use it
// for any number of channels, as their weights are slow anyway, and so do footprints whose samples move: what a chunk
// of the list does to a sample depends on the displacement that enters it, so that chunks cannot be blended side by
// side.
#pragma once

#include "cuda/composite.cuh"

namespace ar::cuda {

/// Channels [first, first + kChannelGroup) of kBatch splats; zeros where there are no so many.
template <int kBatch> struct GroupChannels {
  int32_t ids[kBatch];
  float4 values[kBatch][kChannelGroup / 4];

  /// A warp per row. `reach` and `ids` of the first `count` rows must be known to all threads.
  __device__ void load(const Channels<float>& channels, int first, int count, const uint8_t* reach) {
    constexpr int kAhead = 4;  // loads before stores, so that they wait together
    const int lane = lane_id(), warp = threadIdx.x / 32;
    const bool used = first + lane < channels.count;
    for (int j0 = warp; j0 < count; j0 += kSubtiles * kAhead) {
      float x[kAhead];
#pragma unroll
      for (int i = 0; i < kAhead; ++i) {
        const int j = j0 + kSubtiles * i;
        x[i] = used && j < count && reach[j] ? channels.row(ids[j])[first + lane] : 0;
      }
#pragma unroll
      for (int i = 0; i < kAhead; ++i) {
        const int j = j0 + kSubtiles * i;
        if (j < count) reinterpret_cast<float*>(values[j])[lane] = x[i];
      }
    }
  }
};

/// `sums` += contribution times values.
__device__ inline void add_channels(float contribution, const float4 (&values)[kChannelGroup / 4],
                                    float (&sums)[kChannelGroup]) {
#pragma unroll
  for (int q = 0; q < kChannelGroup / 4; ++q) {
    const float4 v = values[q];
    sums[4 * q] = madd(contribution, v.x, sums[4 * q]);
    sums[4 * q + 1] = madd(contribution, v.y, sums[4 * q + 1]);
    sums[4 * q + 2] = madd(contribution, v.z, sums[4 * q + 2]);
    sums[4 * q + 3] = madd(contribution, v.w, sums[4 * q + 3]);
  }
}

inline constexpr int kGroupBatch = 128;

/// Whether F is blended by these kernels whatever the number of channels.
template <class F> inline constexpr bool kOnlyGroups = F::kYardstick || F::kMoves;

/// Where the checkpoints of a tile's samples that move are: the one in front of pair i spacing, i > 0, is number first
/// + i - 1. With too many pairs the tiles share equally what room there is.
struct StatePlaces {
  int64_t first;
  int spacing;  ///< a multiple of kStateChunk

  __device__ StatePlaces(const TileLists& lists, const TileList& list, TileGrid grid, int tile)
      : first(list.overflow ? 0 : lists.tile_offsets[tile] / kStateChunk), spacing(kStateChunk) {
    if (!list.overflow) return;
    const int64_t room = lists.capacity / kStateChunk / grid.tiles();
    first = tile * room;
    spacing = int(((list.count - 1) / (room + 1) / kStateChunk + 1) * kStateChunk);
  }
};

/// The samples of a lane's pixel, for the backward pass of a footprint whose samples move.
template <class F> struct MovingSamples {
  static constexpr int S = F::kSamples;
  float transmittance[S];
  SampleState<float, F::kMoves> states[S];

  /// Checkpoint `number` of a thread.
  __device__ static int64_t place(int64_t number, int s) {
    return (number * state_planes(S) + 3 * s) * kTilePixels + threadIdx.x;
  }
  __device__ void store(float* checkpoints, int64_t number) const {
#pragma unroll
    for (int s = 0; s < S; ++s) {
      float* to = checkpoints + place(number, s);
      to[0] = abs(transmittance[s]);
      to[kTilePixels] = states[s].moved.x;
      to[2 * kTilePixels] = states[s].moved.y;
    }
  }
  /// In front of pair k, a multiple of the spacing.
  __device__ void load(const float* checkpoints, const StatePlaces& places, int k) {
#pragma unroll
    for (int s = 0; s < S; ++s) {
      if (k == 0) {
        transmittance[s] = 1;
        states[s] = {};
      } else {
        const float* from = checkpoints + place(places.first + k / places.spacing - 1, s);
        transmittance[s] = from[0];
        states[s].moved = {from[kTilePixels], from[2 * kTilePixels]};
      }
    }
  }
  /// To behind pair k. `last`: pairs up to the last one that each sample composited.
  __device__ void pass(const typename F::template Terms<float>& terms, Vec2<float> p, int k, const int (&last)[S]) {
#pragma unroll
    for (int s = 0; s < S; ++s) replay_sample<F>(terms, p, s, k < last[s], transmittance[s], states[s]);
  }
};

template <class F>
__global__ void __launch_bounds__(kBlendThreads, F::kSamples > 4   ? 1
                                                 : F::kSamples > 1 ? 2
                                                                   : 3) blend_groups_kernel(const BlendParams params) {
  constexpr int S = F::kSamples;
  __shared__ Stage<F, 0, kGroupBatch> stage;
  __shared__ GroupChannels<kGroupBatch> staged;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const int place = tile_place<S>(params, int(blockIdx.x));
  if (place < 0) return;
  const int first = int(blockIdx.y) * kChannelGroup, lane = lane_id();
  const int tile = params.plan.tile_order[place];
  const TileList list = list_of(params.lists, params.grid, tile);
  const Vec2<float> p = pixel_of(threadIdx.x / 32, lane);
  const Pixel pixel(list, params.grid, p);
  MovingSamples<F> samples;
  auto& transmittance = samples.transmittance;
  float sums[kChannelGroup];
  int last[S];
#pragma unroll
  for (int s = 0; s < S; ++s) transmittance[s] = pixel.inside ? 1.0f : -1.0f, samples.states[s] = {}, last[s] = 0;
#pragma unroll
  for (int c = 0; c < kChannelGroup; ++c) sums[c] = 0;
  const auto open = [&] {
    bool any = false;
#pragma unroll
    for (int s = 0; s < S; ++s) any |= transmittance[s] > 0;
    return any;
  };
  for (int k = 0; k < list.count && __syncthreads_or(open()); k += kGroupBatch) {
    if constexpr (F::kMoves) {
      const StatePlaces places(params.lists, list, params.grid, tile);
      if (first == 0 && params.transmittance && k > 0 && k % places.spacing == 0)
        samples.store(params.checkpoints, places.first + k / places.spacing - 1);
    }
    const int count = stage.load(splats, params.channels, list, k, list.count);
    if (int(threadIdx.x) < count) staged.ids[threadIdx.x] = list.splat(k + threadIdx.x);
    __syncthreads();
    staged.load(params.channels, first, count, stage.reach);
    __syncthreads();
    for (int from = 0; from < count; from += 32) {
      if (!__any_sync(kAllLanes, open())) break;
      for (uint32_t mask = stage.reached(from); mask != 0; mask &= mask - 1) {
        const int j = from + __ffs(mask) - 1;
        TileSplatRef<F, 0> splat = stage.splats[j];
        float contribution = 0;
#pragma unroll
        for (int s = 0; s < S; ++s) {
          const Blended<float> b = blend_sample<F>(splat.terms, p, s, transmittance[s], samples.states[s]);
          contribution += b.contribution;
          last[s] = b.mask ? k + j + 1 : last[s];
        }
        if (!__any_sync(kAllLanes, contribution > 0)) continue;
        add_channels(contribution, staged.values[j], sums);
      }
    }
  }
  if (!pixel.inside) return;
  float through = 0;
#pragma unroll
  for (int s = 0; s < S; ++s) {
    through += abs(transmittance[s]);
    if (first == 0 && params.transmittance) {
      params.transmittance[s * pixel.image + pixel.index] = abs(transmittance[s]);
      params.last[s * pixel.image + pixel.index] = last[s];
    }
  }
  const float scale = 1.0f / S;
#pragma unroll
  for (int c = 0; c < kChannelGroup; ++c) {
    if (first + c >= params.channels.count) break;
    params.image.plane(first + c, pixel.image)[pixel.index] =
        scale * sums[c] + scale * through * params.background[first + c];
  }
  if (first == 0 && params.alpha) params.alpha[pixel.index] = 1 - scale * through;
}

/// The three colours in the splats are channels like others here.
template <class Params> Params with_channels(Params p) {
  if (!p.channels.data) p.channels = {p.splats + kSplatColor, kSplatWidth, nullptr, 3};
  return p;
}

template <class F> void blend_groups(const BlendParams& p, cudaStream_t stream) {
  const dim3 blocks(unsigned(p.grid.tiles()), blocks_of(p.channels.count, kChannelGroup));
  blend_groups_kernel<F><<<blocks, kBlendThreads, 0, stream>>>(p);
}

}  // namespace ar::cuda
