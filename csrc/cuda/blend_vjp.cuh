// Kernels of blend_vjp for up to four channels.
//
// A warp has a chunk of a tile's list, and goes through it back to front with all pixels of the tile, eight per lane.
// With many samples several warps share a chunk, each with some of the samples. What is where:
//
//   blend_vjp_layout.cuh   how many samples and pixels a warp takes, and what its lanes hold in registers
//   blend_vjp_pixels.cuh   the pixels of a lane, in registers or in shared memory
//   blend_vjp_sums.cuh     the splats that a warp has listed, and sums over its lanes
//   blend_vjp_chunk.cuh    the chunk, and what the pixels are behind it
//   blend_vjp_walk.cuh     the way through its pairs
#pragma once

#include <algorithm>

#include "cuda/blend_vjp_walk.cuh"
#include "cuda/launch.cuh"

namespace ar::cuda {

/// A warp's share of a chunk, back to front over all pixels of the tile: every pair is summed in one place, so the sums
/// need no atomics, whose order would change from run to run. `first`: the first of the samples that the warp takes.
template <class F, int C, Sums kSums>
__device__ __forceinline__ void blend_chunk_vjp(const BlendVjpParams& params, int64_t item, int first,
                                                SharedPixels<F, C, kSums>& shared,
                                                VjpGroup<F, C, kVjpGroup<F, kSums>>& group) {
  constexpr int kLength = chunk_length(F::kSamples);
  LanePixels<F, C, kSums> pixels(shared);
  const VjpChunk chunk(params, params.chunk_order[item], kLength);
  const int tile_last = find_last<F>(params, chunk, first, group);
  if (kSums != Sums::kMeans && !chunk.list.of_patch) {  // pairs that no pixel has composited
    for (int k = max(chunk.begin, min(tile_last, chunk.end)) + lane_id(); k < chunk.end; k += 32)
      clear_pair(params, chunk.list.slot(k));
  }
  if (chunk.begin >= tile_last) return;
  const auto* checkpoints =
      reinterpret_cast<const Checkpoint<C>*>(params.checkpoints + int64_t(chunk.plane) * kTilePixels);
  ChunkWalk<F, C, kSums> walk(params, chunk, first, pixels, group);
  start_pixels(params, chunk, checkpoints, first, tile_last <= chunk.end, pixels);
  walk.run(tile_last);
}

template <class F, int C, Sums kSums>
__global__ void __launch_bounds__(32 * kVjpWarps<F, kSums>, kVjpBlocks<F, C>)
    blend_vjp_kernel(const BlendVjpParams params) {
  wait_for_earlier_kernels();
  constexpr int kWarps = kVjpWarps<F, kSums>, kGroup = kVjpGroup<F, kSums>;
  auto* shared = reinterpret_cast<SharedPixels<F, C, kSums>*>(dynamic_shared());
  auto* groups = reinterpret_cast<VjpGroup<F, C, kGroup>*>(shared + kWarps);
  const int warp = threadIdx.x / 32, first = warp % kGroup * kVjpSamples<F, kSums>;
  const int32_t* firsts = params.plan->counts.chunks.first + sample_class(F::kSamples);
  const int begin = firsts[0], end = firsts[1];
  if constexpr (kTakesChunks<F, kSums>) {
    for (;;) {
      int taken = 0;
      if (lane_id() == 0) taken = atomicAdd(&params.chunks_taken[sample_class(F::kSamples)], 1);
      const int item = begin + shuffle(taken, 0);
      if (item >= end) return;
      blend_chunk_vjp<F, C, kSums>(params, item, first, shared[warp], groups[warp / kGroup]);
    }
  } else {
    const int64_t item = begin + (int64_t(blockIdx.x) * kWarps + warp) / kGroup;
    if (item < end) blend_chunk_vjp<F, C, kSums>(params, item, first, shared[warp], groups[warp / kGroup]);
  }
}

inline constexpr int kClearBlocks = kManyBlocks;
/// As many blocks as any device holds: more would only find that no chunk is left.
inline constexpr unsigned kTakingBlocks = 256 * 8;

template <class F, int C, Sums kSums> void launch_blend_vjp(const BlendVjpParams& p, cudaStream_t stream) {
  constexpr int kWarps = kVjpWarps<F, kSums>, kGroup = kVjpGroup<F, kSums>;
  const size_t bytes = kWarps * sizeof(SharedPixels<F, C, kSums>) + kWarps / kGroup * sizeof(VjpGroup<F, C, kGroup>);
  unsigned blocks = blocks_of(p.max_chunks, kWarps / kGroup);
  if (kTakesChunks<F, kSums>) blocks = std::min(blocks, kTakingBlocks);
  launch(blend_vjp_kernel<F, C, kSums>, {blocks, 32 * kWarps, bytes}, stream, p);
}
template <class F, int C> void blend_vjp_few(const BlendVjpParams& p, cudaStream_t stream) {
  constexpr bool kAtOnce = kVjpGroup<F, Sums::kGrads> == 1;
  if (!kAtOnce || p.mean_sums == MeanSums::kNone) launch_blend_vjp<F, C, Sums::kGrads>(p, stream);
  if (p.mean_sums != MeanSums::kNone) launch_blend_vjp<F, C, kAtOnce ? Sums::kBoth : Sums::kMeans>(p, stream);
}

}  // namespace ar::cuda
