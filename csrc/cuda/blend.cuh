// Kernels of blend for up to four channels.
//
// The list of a tile is cut into chunks. The first few chunks are the front, and the others the tail. They are blended
// by five kernels, one after the other:
//
//   blend_front    a block per tile composites the chunks of the front in order, until all pixels have stopped.
//                  If some are open behind the front and there are pairs left, the next kernels finish the tile
//   tail_through   a block per chunk of the tail finds how much light the chunk lets through by itself
//   tail_scan      multiplies these up to the transmittance in front of every chunk
//   tail_blend     a block per chunk composites it, exactly as if the chunks before it had just been composited
//   tail_sum       adds up the chunks
//
// Since chunks of the tail are handled side by side, few tiles with long lists, as in small images of large scenes,
// still fill the device. The last bits of the result depend on nothing but the lists of all tiles.
//
// kKeep says whether what the backward pass needs is kept: at the end of every chunk a checkpoint with the
// transmittance and the channels of every sample.
//
// blend_front and the launches are here, the kernels of the tail in blend_tail.cuh, compositing itself in
// blend_stage.cuh.
#pragma once

#include "cuda/blend_output.cuh"
#include "cuda/blend_stage.cuh"
#include "cuda/blend_tail.cuh"
#include "cuda/launch.cuh"

namespace ar::cuda {

/// A block per tile.
template <class F, int C, bool kKeep>
__global__ void __launch_bounds__(kBlendThreads, kFrontBlocks<F, C>) blend_front_kernel(const BlendParams params) {
  wait_for_earlier_kernels();
  constexpr int S = F::kSamples, kLength = chunk_length(S), kSets = kKeep ? S : 1;
  __shared__ BlendStage<F, C> stage;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  PlanCounts& counts = params.plan.state->counts;
  const int place = tile_place<S>(params, int(blockIdx.x));
  if (place < 0) return;
  const int tile = params.plan.tile_order[place], front_length = front_of<S>(params);
  const TileList list = list_of(params.lists, params.grid, tile);
  const Vec2<float> p = place_of<F>(threadIdx.x / 32, lane_id());
  const Pixel pixel(list, params.grid, pixel_of<F>(threadIdx.x / 32, lane_id()));
  const int front = list.of_patch ? list.count : min(list.count, front_length * kLength);
  const bool several = !list.of_patch && list.count > kLength;
  const PixelCheckpoints<S, C, kKeep> checkpoints(params, tile, int(threadIdx.x));
  PixelState<S, C, kSets> state;
  state.start(pixel.inside);
  Values<C> total = {};
  int k = 0, written = 0;
  while (k < front && __syncthreads_or(state.open())) {
    const int count = stage.load(splats, params.channels, list, k, front);
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
    if (more) open_tiles<S>(params)[atomicAdd(&counts.open_tiles[sample_class(S)], 1)] = tile;
  }
  if (kKeep) store_last<F>(params, pixel, state.last);
  if (!more) {
    total += state.total();
    store_pixel<F>(params, pixel, total, state.transmittance);
    if constexpr (kKeep) {
      const Values<C> background = background_of<C>(params);
#pragma unroll
      for (int s = 0; s < S; ++s) {
        Values<C> behind = times(abs(state.transmittance[s]), background);
        behind += state.channels[s];
        accumulate_behind<8>(checkpoints, 0, written, s, behind);
      }
    }
  } else if constexpr (!kKeep) {
    // The tail goes on from the last front chunk's checkpoint.
#pragma unroll
    for (int s = 0; s < S; ++s) checkpoints.transmittance(front_length - 1, s) = state.transmittance[s];
    checkpoints.set_total(front_length - 1, total);
  }
}

template <class F, int C, bool kKeep> void launch_blend(const BlendParams& p, cudaStream_t stream) {
  constexpr int S = F::kSamples;
  const LaunchShape of_chunks = {kTailBlocks, kBlendThreads}, of_parts = {kTailBlocks, 32},
                    of_sums = {kTailBlocks, kTailSumThreads};
  launch(blend_front_kernel<F, C, kKeep>, {unsigned(p.grid.tiles()), kBlendThreads}, stream, p);
  launch(tail_through_kernel<F>, of_chunks, stream, p);
  launch(tail_scan_kernel<S>, of_parts, stream, p);
  launch(tail_blend_kernel<F, C, kKeep>, of_chunks, stream, p);
  launch(tail_sum_kernel<F, C, kKeep>, of_sums, stream, p);
}
template <class F, int C> void blend_few(const BlendParams& p, cudaStream_t stream) {
  if (p.transmittance) {
    launch_blend<F, C, true>(p, stream);
  } else {
    launch_blend<F, C, false>(p, stream);
  }
}

}  // namespace ar::cuda
