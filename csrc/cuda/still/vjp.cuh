// Kernel blend_vjp: the backward pass of footprints whose samples stay, for up to four channels. A warp goes back
// through a chunk with all pixels of the tile, eight per lane: it makes the sums of a pair without atomics, whose order
// varies, but for tiles of a patch.
#pragma once

#include "cuda/launch.cuh"
#include "cuda/occupancy.h"
#include "cuda/still/policy.h"
#include "cuda/still/vjp_walk.cuh"

namespace ar::cuda {

template <class F, int C> struct VjpShared {
  static_assert(sizeof(TileSplat<F, C>) <= 112, "a splat in use is copied to registers");
  SharedPixels<F, C> pixels[StillPolicy::kVjpWarps<F>];
  VjpBatch<F, C> batches[StillPolicy::kVjpWarps<F>];
};

/// Parameters as of blend_front_kernel. kMeans: with MeanSums. Warps claim chunks.
template <class F, int C, bool kMeans>
__global__ void __launch_bounds__(32 * StillPolicy::kVjpWarps<F>,
                                  blocks_per_sm(StillPolicy::kVjpBlocks<F, C>, 32 * StillPolicy::kVjpWarps<F>))
    blend_vjp_kernel(const BlendVjpParams params) {
  wait_for_earlier_kernels();
  auto& shared = *reinterpret_cast<VjpShared<F, C>*>(dynamic_shared());
  const int warp = threadIdx.x / 32, chunks = params.plan->counts.chunks;
  for (;;) {
    int taken = 0;
    if (lane_id() == 0) taken = atomicAdd(params.chunks_taken, 1);
    const int item = shuffle(taken, 0);
    if (item >= chunks) return;
    LanePixels<F, C> pixels(shared.pixels[warp]);
    VjpBatch<F, C>& batch = shared.batches[warp];
    const VjpChunk chunk(params, params.chunk_order[item]);
    const int tile_last = find_last<F>(params, chunk, batch);
    if (!chunk.list.of_patch) {  // pairs that no pixel has composited
      for (int k = max(chunk.begin, min(tile_last, chunk.end)) + lane_id(); k < chunk.end; k += 32)
        clear_pair(params, chunk.list.slot(k));
    }
    if (chunk.begin >= tile_last) continue;
    const auto* checkpoints =
        reinterpret_cast<const Checkpoint<C>*>(params.checkpoints + int64_t(chunk.plane) * kTilePixels);
    ChunkWalk<F, C, kMeans> walk(params, chunk, pixels, batch);
    start_pixels(params, chunk, checkpoints, tile_last <= chunk.end, pixels);
    walk.run(tile_last);
  }
}

}  // namespace ar::cuda
