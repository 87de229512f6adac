// Kernel of blend_vjp for footprints whose samples move: a block per tile, a lane per few cells of a pixel, back to
// front. In small images it has a block per segment of a tile's list, from what blend_moving_maps.cuh has found.
//
// The state of a sample in front of a splat cannot be had from the state behind it, since the displacement depends on
// itself through alpha. So a warp composites each chunk of 32 splats once more, from the checkpoint that blend has left
// in front of it, keeps where the samples were in front of each splat, and then walks back over those that its pixels
// show.
//
// dL/dalpha is linear in the gradient of the image: of many channels each kernel adds the share of its own to the six
// sums of a pair, which a single block owns. Only MeanSums need all channels at once: where they are wanted, the first
// kernel makes all sums, and reads the channels of the others where they lie.
#pragma once

#include <algorithm>

#include "cuda/blend_moving_grads.cuh"
#include "cuda/blend_moving_maps.cuh"
#include "cuda/blend_moving_sums.cuh"
#include "cuda/launch.cuh"
#include "cuda/tile_pieces.cuh"

namespace ar::cuda {

/// Threads that an SM should hold: bounds the registers, as waiting for the samples in front costs more than a few
/// numbers in memory. With many cells in large images fewer, since the caches do not hold the places of all those.
template <class F, int C, int kSegment>
inline constexpr int kMovingVjpThreads = C > 3                              ? 512
                                         : F::kSamples > 4 && kSegment == 0 ? 768
                                                                            : 1024;

/// Where a lane's samples are in front of each splat of a chunk that reaches its warp.
template <class Layout> using PlacesInFront = Vec2<float>[kStateChunk][Layout::kCells];

/// Composites those of the staged splats [from, from + 32) that reach the warp; the first of them is pair k. Returns
/// those that a sample of the warp shows, and keeps the places of the samples in front of all. `last`: of LastSplats.
template <class F, class Layout, class Stage, class Samples>
__device__ uint32_t replay_chunk(const Stage& stage, int from, int k, const CellCorners<F, Layout>& corners,
                                 const int (&last)[Layout::kCells], Samples& samples, PlacesInFront<Layout>& in_front) {
  uint32_t shown = 0;
  int kept = 0;
  for (uint32_t left = stage.reached(from); left != 0; ++kept) {
    const int bit = take_first(left);
    const auto& terms = stage.splats[from + bit].terms;
    bool any = false;
#pragma unroll
    for (int i = 0; i < Layout::kCells; ++i) {
      const Vec2<float> z = corners.node(terms, i, samples.place[i]);
      in_front[kept][i] = samples.place[i];
      any |= replay_placed_sample<F>(terms, z, exp2(F::log_alpha(terms, z)), k + bit < last[i], UnitCell<F::kSide>(),
                                     samples.transmittance[i], samples.place[i]);
    }
    shown |= uint32_t(any) << bit;
  }
  return warp_or(shown);
}

/// The sums of a pair over a lane's samples.
struct MovingSums {
  PairGrad<float> grad;  ///< before F::collect
  float contribution;
};

/// Takes a lane's samples, and what they carry, from behind pair j of the batch that begins with pair k0 to its front,
/// where they are at `places`. `g_color`: the colour of its splat times the gradient.
template <class F, int C, class Layout, class Samples>
__device__ MovingSums walk_back(TileSplatRef<F, C>& splat, int k0, int j, float g_color,
                                const CellCorners<F, Layout>& corners, const int (&last)[Layout::kCells],
                                const Vec2<float> (&places)[Layout::kCells], Samples& samples,
                                Adjoint (&adjoint)[Layout::kCells]) {
  MovingSums sums = {};
#pragma unroll
  for (int i = 0; i < Layout::kCells; ++i) {
    const Vec2<float> place = places[i];
    const Vec2<float> z = corners.node(splat.terms, i, place);
    const float raw = exp2(F::log_alpha(splat.terms, z));
    const bool composited = raw >= float(kAlphaMin) && k0 + j < last[i];
    const MovingBlendGrad<float> of_sample =
        blend_placed_sample_vjp<F>(splat.terms, z, composited ? raw : 0.0f, UnitCell<F::kSide>(), g_color, place,
                                   samples.transmittance[i], adjoint[i].behind, adjoint[i].dL_dplace);
    const PairGrad<float> grad = {of_sample.of_splat.sums, of_sample.of_splat.weighted};
    sums.grad = i == 0 ? grad : sums.grad + grad;
    sums.contribution = i == 0 ? of_sample.contribution : sums.contribution + of_sample.contribution;
  }
  return sums;
}

/// A block per tile, or with kSegment > 0 per segment of so many pairs of a tile's list, from what the segment gets
/// from behind. `overflow_only`: other kernels do the work, unless there were too many pairs.
template <class F, int C, class Layout, int kSegment = 0>
__global__ void __launch_bounds__(Layout::kThreads, std::max(1, kMovingVjpThreads<F, C, kSegment> / Layout::kThreads))
    moving_vjp_kernel(const BlendVjpParams params, int first, bool overflow_only) {
  wait_for_earlier_kernels();
  using Shared = MovingVjpShared<F, C, Layout, kSegment>;
  using Samples = MovingSamples<F, Layout, (kSegment > 0)>;
  constexpr int S = F::kSamples, kCells = Layout::kCells, kBatch = Shared::kBatch;
  constexpr bool kMany = C > kFewChannels;  // `first` may be above 0, and there may be more channels than C
  static_assert(kSegment % kBatch == 0 && Layout::kBlocks == 1);
  Shared& shared = *reinterpret_cast<Shared*>(dynamic_shared());
  TilePiece piece = {0, 0};
  if constexpr (kSegment > 0) {
    piece = find_piece(params.lists, params.grid, kSegment, blockIdx.x);
  } else {
    piece.tile = listed_tile<S>(params, int(blockIdx.x));
  }
  const int tile = piece.tile;
  if (tile < 0) return;
  const TileList list = list_of(params.lists, params.grid, tile);
  if (overflow_only && !list.overflow) return;
  const int begin = piece.index * kSegment, end = kSegment > 0 ? begin + kSegment : kWholeList;
  const StatePlaces places(params.lists, list, params.grid, tile);
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const int lane = lane_id(), warp = threadIdx.x / 32, channel_count = params.channels.count;
  const bool with_means = params.mean_sums != MeanSums::kNone;
  const bool all_at_once = kMany && with_means && channel_count > C;
  const bool with_shape = !all_at_once || first == 0;
  const Vec2<float> p = Layout::pixel();
  const Pixel pixel(list, params.grid, p);
  const CellCorners<F, Layout> corners(p);
  Samples samples(pixel.inside);

  const LastSplats<F, Layout> lasts(params.last, pixel, shared.last);
  const int (&last)[kCells] = lasts.samples;
  if (first % kChannelGroup == 0 && !list.overflow) {  // pairs that nothing reached
    const int rest = min(list.count, end);
    for (int k = max(lasts.block, begin) + threadIdx.x / kClearThreads; k < rest; k += Layout::kThreads / kClearThreads)
      clear_pair_together<kChannelGroup>(params, list.slot(k), first == 0);
  }

  const SampleGrad<F, C> grad(params, pixel, first);
  Adjoint adjoint[kCells];
#pragma unroll
  for (int i = 0; i < kCells; ++i) {
    adjoint[i] = {grad.through, {0, 0}};
    if (kSegment > 0 && last[i] > end) {
      const MapMemory<F> maps(params.adjoint_maps, Layout::first_sample() + i, Layout::pixel_number());
      adjoint[i] = maps.adjoint(int64_t(blockIdx.x) + 1);
    }
  }

  const int own_sum = sum_of_lane<C>();
  PlacesInFront<Layout> in_front;
  const auto replay = [&](int from, int k) {
    return replay_chunk<F, Layout>(shared.stage, from, k, corners, last, samples, in_front);
  };

  const int stop = min(lasts.block, end);
  int k0 = (stop - 1) / kBatch * kBatch;
  int32_t id = shared.stage.splat_of(list, k0, stop);
  for (int k1 = stop; k1 > begin; k1 = k0, k0 -= kBatch) {
    const int count = k1 - k0;
    if (kSegment == 0 && places.spacing > kStateChunk) {  // with too many pairs: from the checkpoint to the batch
      const int checkpoint = k0 / places.spacing;
      int k = checkpoint * places.spacing;
      samples.load(params.checkpoints + (places.first + checkpoint - 1) * Samples::kCheckpoint, k, last);
      for (; k < k0; k += kBatch) {
        __syncthreads();
        shared.stage.load(splats, params.channels, first, list, shared.stage.splat_of(list, k, k0));
        __syncthreads();
        for (int from = 0; from < kBatch; from += kStateChunk) replay(from, k + from);
      }
    }
    const int32_t next_id = k0 > begin ? shared.stage.splat_of(list, k0 - kBatch, k0) : -1;
    __syncthreads();  // all have read what the last batch left
    shared.load(splats, params, first, list, k0, id, with_means);
    __syncthreads();
    if (next_id >= 0) prefetch(splats + next_id);  // so that the next batch need not wait for memory
    id = next_id;
    const Samples at_batch = samples;
    for (int part_end = Shared::kChunks, part = 0; part_end > 0; part_end = part) {
      part = shared.first_chunk(part_end);
      const int first_slot = shared.first_slot(part);
      for (int from = (part_end - 1) * kStateChunk; from >= part * kStateChunk; from -= kStateChunk) {
        uint32_t shown = 0;
        if (k0 + from < lasts.warp) {
          if (kSegment == 0 && places.spacing > kStateChunk) {
            samples = at_batch;
            for (int ahead = 0; ahead < from; ahead += kStateChunk) replay(ahead, k0 + ahead);
          } else {
            const int64_t number = places.first + (k0 + from) / kStateChunk - 1;
            samples.load(params.checkpoints + number * Samples::kCheckpoint, k0 + from, last);
          }
          shown = replay(from, k0 + from);
        }
        const uint32_t reached = shared.stage.reached(from);
        for (uint32_t mask = shown; mask != 0;) {
          const int bit = 31 - __clz(mask), j = from + bit;
          mask ^= 1u << bit;
          const int kept = __popc(reached >> (31 - bit)) - 1;
          TileSplatRef<F, C> splat = shared.stage.splats[j];
          float* const sums = shared.sums_of(j, first_slot);
          const float g_color = grad.times(splat.channels, params, pixel, [&] { return list.splat(k0 + j); });
          auto [of_pair, contribution] =
              walk_back<F, C, Layout>(splat, k0, j, g_color, corners, last, in_front[kept], samples, adjoint);
          if (with_means && with_shape)
            put_warp_means<Layout>(params, shared.mean_maps[j], of_pair.shape.offset, sums + Shared::kMeans);
          of_pair.shape = F::collect(splat.terms, of_pair.shape, of_pair.weighted);
          put_warp_sums(of_pair, times(contribution, grad.channels), sums + own_sum);
        }
        if (lane == 0) shared.hits[warp][from / kStateChunk] = shown;
      }
      __syncthreads();
      const int first_pair = part * kStateChunk, end_pair = min(count, part_end * kStateChunk);
      if (with_means) {
        shared.template write<Shared::kSums>(params, first, with_shape, list, first_pair, end_pair, first_slot);
      } else {
        shared.template write<Shared::kMeans>(params, first, with_shape, list, first_pair, end_pair, first_slot);
      }
      if (part > 0) __syncthreads();  // all have read the sums
    }
  }
}

}  // namespace ar::cuda
