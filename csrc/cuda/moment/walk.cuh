// Kernel moving_blend: the forward pass for lists that are not cut. A block walks the whole list of a tile.
#pragma once

#include "cuda/launch.cuh"
#include "cuda/moment/cells.cuh"

namespace ar::cuda {

template <class Layout, int C>
inline constexpr int kMovingBlocks =
    blocks_per_sm(std::max(MomentPolicy::blend_threads(C) / Layout::kThreads, 1), Layout::kThreads);

/// Block b has tile plan.tile_order[b], unless its list is cut; the last block only waits
/// (begin_beside_earlier_kernels). Writes the channels [first, first + C). `beside`: listed_blend_kernel was launched
/// just before.
template <class F, int C, class Layout, bool kKeep>
__global__ void __launch_bounds__(Layout::kThreads, kMovingBlocks<Layout, C>)
    moving_blend_kernel(const BlendParams params, int first, bool beside) {
  if (begin_beside_earlier_kernels(beside)) return;
  constexpr int kBatch = Layout::kThreads < 256 ? Layout::kThreads : 256;
  constexpr int kListed = kKeep ? kStateChunk : kBatch;
  // Against registers for last entries of many samples.
  constexpr bool kLists = !kKeep || Layout::kCells <= 2;
  using Stage = MovingStage<F, C, Layout, kBatch, kListed, true>;
  __shared__ Stage stage;
  const int tile = params.plan.tile_order[blockIdx.x];
  const bool is_cut = int(blockIdx.x) < params.plan.state->counts.cut_lists;
  const TileList list = list_of(params.lists, params.grid, tile);
  // With too many pairs no list is cut. One condition saves registers.
  if (is_cut && !list.of_patch) return;
  const TileCheckpoints stored(params.lists, list, params.grid, tile);
  MovingBlend<F, C, Layout, kKeep> blend(list, params.grid);
  int32_t id = stage.splat_of(list, 0, list.count);
  for (int k = 0; k < list.count && __syncthreads_or(blend.samples.open()); k += kBatch) {
    const int count = min(list.count - k, kBatch);
    const int32_t next_id = stage.splat_of(list, k + kBatch, list.count);
    stage.load(params, first, list, id);
    __syncthreads();
    if (next_id >= 0) prefetch_splat(params.splats, next_id);
    id = next_id;
    for (int from = 0; from < count; from += kListed) {
      if (kKeep && !__any_sync(kAllLanes, blend.samples.open())) break;
      if (kKeep && k + from > 0 && (k + from) % stored.spacing == 0)
        blend.samples.store(params.checkpoints +
                            (stored.first + (k + from) / stored.spacing - 1) * blend.samples.kCheckpoint);
      if constexpr (kLists) {
        constexpr int kCells = Layout::kCells;
        const int listed = stage.lists.list(stage.reach, from, min(count, from + kListed));
        int shown[kCells];  // last entry that each sample shows
        AR_UNROLL for (int i = 0; i < kCells; ++i) shown[i] = -1;
        for (int n = 0; n < listed; n += MomentPolicy::kBetweenVotes) {
          if (!__any_sync(kAllLanes, blend.samples.open())) break;
          stage.lists.for_each(n, min(listed, n + MomentPolicy::kBetweenVotes), [&](uint32_t entry) {
            TileSplatRef<F, C> splat = Stage::Lists::splat_of(stage.splats, entry);
            blend.add(splat, int(entry), shown);
          });
        }
        AR_UNROLL for (int i = 0; kKeep && i < kCells; ++i) if (shown[i] >= 0) blend.last[i] =
            k + Stage::Lists::number_of(uint32_t(shown[i])) + 1;
        __syncwarp();  // all have read the list
      } else {
        const bool reaches = stage.reach[from + 31 - lane_id()] >> (threadIdx.x / 32) & 1;
        for (uint32_t left = __ballot_sync(kAllLanes, reaches); left != 0;) {
          const int j = from + take_first(left);
          TileSplatRef<F, C> splat = stage.splats[j];
          blend.add(splat, k + j + 1, blend.last);
        }
      }
    }
  }
  blend.write(params, first);
}

}  // namespace ar::cuda
