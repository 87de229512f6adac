// Kernel blend_front: the forward pass of footprints whose samples stay at their nodes, for up to four channels. It
// reads lists, splats and the plan (plan.cuh), and writes images, transmittance, `last` and checkpoints. blend_still
// (still/blend.cu) launches it and the kernels of tail.cuh after it.
//
// The list of a tile is cut into chunks: the first few are the front, the others the tail. Five kernels blend them:
//
//   blend_front    a block per tile composites the chunks of the front in order, until all pixels have stopped. If some
//                  are open after the front and pairs are left, the next kernels finish the tile
//   tail_through   a block per chunk of the tail finds how much light the chunk alone lets through
//   tail_scan      multiplies these numbers up to the transmittance at the begin of each chunk
//   tail_blend     a block per chunk composites it, exactly as if the chunks before had just been composited
//   tail_sum       adds up the chunks
//
// Chunks of the tail are blended side by side, so that a few tiles with long lists, as in small images of large scenes,
// fill the device too. The picture has the same bits with and without a backward pass. For a backward pass (kKeep) a
// checkpoint at the end of each chunk stores the transmittance and the channels of every sample.
#pragma once

#include "cuda/launch.cuh"
#include "cuda/still/output.cuh"
#include "cuda/still/stage.cuh"
#include "cuda/tuning.h"

namespace ar::cuda {

/// A block per tile. `F`: what a lane blends, `C`: channels, 3 in the splats or up to 4 in rows; `kKeep`: stores what
/// the backward pass needs.
template <class F, int C, bool kKeep>
__global__ void __launch_bounds__(kBlendThreads, blocks_per_sm(front_blocks(F::kSamples, F::kExpensive), kBlendThreads))
    blend_front_kernel(const BlendParams params) {
  wait_for_earlier_kernels();
  constexpr int S = F::kSamples, kLength = kChunkLength, kSets = kKeep ? S : 1;
  __shared__ BlendStage<F, C> stage;
  PlanCounts& counts = params.plan.state->counts;
  const int tile = params.plan.tile_order[blockIdx.x], front_length = front_of(params);
  const TileList list = list_of(params.lists, params.grid, tile);
  const Vec2<float> p = position_of<F>(threadIdx.x / 32, lane_id());
  const Pixel pixel(list, params.grid, pixel_of<F>(threadIdx.x / 32, lane_id()));
  const int front = list.of_patch ? list.count : min(list.count, front_length * kLength);
  const bool several = !list.of_patch && list.count > kLength;
  const PixelCheckpoints<S, C, kKeep> checkpoints(params, tile, int(threadIdx.x));
  PixelState<S, C, kSets> state;
  state.start(pixel.inside);
  Values<C> total = {};
  int k = 0, written = 0;
  while (k < front && __syncthreads_or(state.open())) {
    const int count = stage.load(params.splats, params.channels, list, k, front);
    __syncthreads();
    composite_all<F>(stage, count, k, p, state);
    k += count;
    if (several && k % kLength == 0 && k < list.count) {
      if constexpr (kKeep) {
#pragma unroll
        for (int s = 0; s < S; ++s) checkpoints.kept(written, s) = {state.channels[s], state.transmittance[s]};
      }
      ++written;
      total += state.total();
      state.clear_channels();
    }
  }
  const bool more = k == front && front < list.count && __syncthreads_or(state.open());
  if (threadIdx.x == 0) {
    params.tile_open[tile] = more;
    if (more) params.open_tiles[atomicAdd(&counts.open_tiles, 1)] = tile;
  }
#pragma unroll
  for (int s = 0; s < S; ++s)
    if (kKeep && pixel.inside) params.last[sample_index<F>(pixel, s)] = state.last[s];
  if (!more) {
    total += state.total();
    store_pixel<F>(params, pixel, total, state.transmittance);
    if constexpr (kKeep) {
      const Values<C> background = background_of<C>(params);
#pragma unroll
      for (int s = 0; s < S; ++s) {
        Values<C> farther = times(abs(state.transmittance[s]), background);
        farther += state.channels[s];
        accumulate_farther<8>(checkpoints, 0, written, s, farther);
      }
    }
  } else if constexpr (!kKeep) {
    // The tail goes on from the last front chunk's checkpoint.
#pragma unroll
    for (int s = 0; s < S; ++s) checkpoints.transmittance(front_length - 1, s) = state.transmittance[s];
    checkpoints.set_total(front_length - 1, total);
  }
}

}  // namespace ar::cuda
