// Kernel blend_front: the forward pass of footprints whose samples stay, for up to four channels. It composites the
// front, the first chunks of a list, until all pixels have stopped. The kernels of tail.cuh composite the other chunks
// side by side, so that a few long lists fill the device too (docs/internals/kernels.md, "Forward: front and tail").
#pragma once

#include "cuda/launch.cuh"
#include "cuda/occupancy.h"
#include "cuda/still/output.cuh"
#include "cuda/still/policy.h"
#include "cuda/still/stage.cuh"

namespace ar::cuda {

/// A block per tile. F: what a lane blends. C: 3 channels in the splats, or up to 4 in rows. kKeep: for a backward
/// pass.
template <class F, int C, bool kKeep>
__global__ void __launch_bounds__(kBlendThreads, blocks_per_sm(StillPolicy::kFrontBlocks<F>, kBlendThreads))
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
        AR_UNROLL for (int s = 0; s < S; ++s)
            checkpoints.kept(written, s) = {state.channels[s], state.transmittance[s]};
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
  AR_UNROLL for (int s = 0; s < S; ++s) if (kKeep && pixel.inside) params.last[sample_index<F>(pixel, s)] =
      state.last[s];
  if (!more) {
    total += state.total();
    store_pixel<F>(params, pixel, total, state.transmittance);
    if constexpr (kKeep) {
      const Values<C> background = background_of<C>(params);
      AR_UNROLL for (int s = 0; s < S; ++s) {
        Values<C> farther = times(abs(state.transmittance[s]), background);
        farther += state.channels[s];
        accumulate_farther<8>(checkpoints, 0, written, s, farther);
      }
    }
  } else if constexpr (!kKeep) {
    // The tail begins at the checkpoint of the last front chunk.
    AR_UNROLL for (int s = 0; s < S; ++s) checkpoints.transmittance(front_length - 1, s) = state.transmittance[s];
    checkpoints.set_total(front_length - 1, total);
  }
}

}  // namespace ar::cuda
