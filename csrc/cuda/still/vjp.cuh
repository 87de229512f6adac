// Kernel of blend_vjp for footprints whose samples stay at their nodes, for up to four channels. blend_vjp_still
// (still/blend_vjp.cu) launches it.
//
// A warp has a chunk of a tile's list, and goes through it back to front with all pixels of the tile, eight per lane.
// Each pair is summed in one place, so that no atomics are needed, whose order would change from run to run.
//
//   vjp_pixels.cuh   the pixels of a lane, in registers or in shared memory
//   vjp_sums.cuh     the splats that a warp has listed, and sums over its lanes
//   vjp_walk.cuh     the chunk, the state of the pixels after it, and the way through its pairs
#pragma once

#include "cuda/launch.cuh"
#include "cuda/still/vjp_walk.cuh"
#include "cuda/tuning.h"

namespace ar::cuda {

/// A chunk back to front over all pixels of its tile. `item`: its number in the plan's order.
template <class F, int C, bool kMeans>
__device__ __forceinline__ void blend_chunk_vjp(const BlendVjpParams& params, int64_t item, SharedPixels<F, C>& shared,
                                                VjpBatch<F, C>& batch) {
  LanePixels<F, C> pixels(shared);
  const VjpChunk chunk(params, params.chunk_order[item]);
  const int tile_last = find_last<F>(params, chunk, batch);
  if (!chunk.list.of_patch) {  // pairs that no pixel has composited
    for (int k = max(chunk.begin, min(tile_last, chunk.end)) + lane_id(); k < chunk.end; k += 32)
      clear_pair(params, chunk.list.slot(k));
  }
  if (chunk.begin >= tile_last) return;
  const auto* checkpoints =
      reinterpret_cast<const Checkpoint<C>*>(params.checkpoints + int64_t(chunk.plane) * kTilePixels);
  ChunkWalk<F, C, kMeans> walk(params, chunk, pixels, batch);
  start_pixels(params, chunk, checkpoints, tile_last <= chunk.end, pixels);
  walk.run(tile_last);
}

/// What a block keeps in dynamic shared memory.
template <class F, int C> struct VjpShared {
  SharedPixels<F, C> pixels[vjp_warps(F::kSamples)];
  VjpBatch<F, C> batches[vjp_warps(F::kSamples)];
};

/// `F`: what a lane blends, `C`: channels, 3 in the splats or up to 4 in rows; `kMeans`: with MeanSums or without.
/// A warp takes the next chunk when it is done with one, and does not wait for the others of its block.
template <class F, int C, bool kMeans>
__global__ void __launch_bounds__(32 * vjp_warps(F::kSamples),
                                  blocks_per_sm(vjp_blocks(F::kSamples, F::kExpensive, C), 32 * vjp_warps(F::kSamples)))
    blend_vjp_kernel(const BlendVjpParams params) {
  wait_for_earlier_kernels();
  auto& shared = *reinterpret_cast<VjpShared<F, C>*>(dynamic_shared());
  const int warp = threadIdx.x / 32, chunks = params.plan->counts.chunks;
  for (;;) {
    int taken = 0;
    if (lane_id() == 0) taken = atomicAdd(params.chunks_taken, 1);
    const int item = shuffle(taken, 0);
    if (item >= chunks) return;
    blend_chunk_vjp<F, C, kMeans>(params, item, shared.pixels[warp], shared.batches[warp]);
  }
}

}  // namespace ar::cuda
