// Kernels for tiles that blend_front leaves open. tail_through finds how much light each chunk lets through, tail_scan
// multiplies this up to the transmittance before each chunk, tail_blend composites each from there, and tail_sum adds
// them up and writes images.
#pragma once

#include "cuda/launch.cuh"
#include "cuda/occupancy.h"
#include "cuda/still/output.cuh"
#include "cuda/still/policy.h"
#include "cuda/still/stage.cuh"

namespace ar::cuda {

/// visit(chunk, its list, its end in the list) for the block's tail chunks of open tiles.
template <class Visit> __device__ __forceinline__ void for_each_tail_chunk(const BlendParams& params, Visit&& visit) {
  const int items = params.plan.state->counts.tail;
  for (int item = blockIdx.x; item < items; item += gridDim.x) {
    const TileChunk tail = params.plan.tail[item];
    if (!params.tile_open[tail.tile]) continue;
    const TileList list = list_of(params.lists, params.grid, tail.tile);
    const int end = min(list.count, (tail.chunk + 1) * kChunkLength);
    visit(tail, list, end);
  }
}

/// What each tail chunk alone lets through, without a threshold. F: what a lane blends.
template <class F>
__global__ void __launch_bounds__(kBlendThreads, blocks_per_sm(StillPolicy::kTailThroughBlocks<F>, kBlendThreads))
    tail_through_kernel(const BlendParams params) {
  wait_for_earlier_kernels();
  constexpr int S = F::kSamples;
  __shared__ BlendStage<F, 0> stage;
  const Vec2<float> p = position_of<F>(threadIdx.x / 32, lane_id());
  for_each_tail_chunk(params, [&](const TileChunk& tail, const TileList& list, int end) {
    float transmittance[S];
    AR_UNROLL for (int s = 0; s < S; ++s) transmittance[s] = 1;
    for (int k = tail.chunk * kChunkLength; k < end; k += stage.kBatch) {
      __syncthreads();
      const int count = stage.load(params.splats, params.channels, list, k, end);
      __syncthreads();
      stage.for_each_listed(0, stage.list_reached(count), [&](TileSplatRef<F, 0> splat, auto) {
        AR_UNROLL for (int s = 0; s < S; ++s) transmittance[s] -=
            transmittance[s] * effective_alpha(F::alpha(splat.terms, p, s));
      });
    }
    const TransmittancePlanes planes(params, S, tail.tile, int(threadIdx.x));
    AR_UNROLL for (int s = 0; s < S; ++s) planes.at(tail.chunk, s) = transmittance[s];
  });
}

/// With less transmittance the next splat stops a sample. The margin covers rounding, which differs between chunks and
/// splats.
inline constexpr float kNearlyStopped = float(kTransmittanceMin * (1 + kAlphaMin / 2));

__device__ inline int chunks_of(const BlendParams& params, int tile) {
  const int64_t* pairs = params.lists.tile_offsets + tile;
  return int((pairs[1] - pairs[0] + kChunkLength - 1) / kChunkLength);
}

/// Of 32 pixels, a block each.
inline constexpr int kTailParts = kTilePixels / 32;

/// Transmittance before a chunk is negative if the sample has stopped. `samples`: of a lane.
__global__ void __launch_bounds__(32) tail_scan_kernel(const BlendParams params, int samples) {
  wait_for_earlier_kernels();
  constexpr int kBatch = StillPolicy::kTailLoads;
  const int items = params.plan.state->counts.open_tiles * samples * kTailParts;
  for (int item = blockIdx.x; item < items; item += gridDim.x) {
    const int tile = params.open_tiles[item / (samples * kTailParts)], s = item / kTailParts % samples;
    const int chunks = chunks_of(params, tile), front = front_of(params);
    const TransmittancePlanes planes(params, samples, tile, item % kTailParts * 32 + lane_id());
    float transmittance = planes.at(front - 1, s), next[kBatch];
    const auto load = [&](int first) {
      AR_UNROLL for (int k = 0; k < kBatch; ++k) {
        if (first + k < chunks) next[k] = planes.at(first + k, s);
      }
    };
    load(front);
    for (int first = front; first < chunks; first += kBatch) {
      float through[kBatch];
      AR_UNROLL for (int k = 0; k < kBatch; ++k) through[k] = next[k];
      load(first + kBatch);  // after stores it would wait
      AR_UNROLL for (int k = 0; k < kBatch; ++k) {
        if (first + k >= chunks) break;
        planes.at(first + k, s) = transmittance;
        if (transmittance > 0) transmittance *= through[k];
        if (transmittance < kNearlyStopped) transmittance = -abs(transmittance);
      }
    }
  }
}

/// Channels of each tail chunk and transmittance at its end: zero if the sample had stopped before. F, C, kKeep: as in
/// blend_front.
template <class F, int C, bool kKeep>
__global__ void __launch_bounds__(kBlendThreads, blocks_per_sm(StillPolicy::kTailBlendBlocks<F>, kBlendThreads))
    tail_blend_kernel(const BlendParams params) {
  wait_for_earlier_kernels();
  constexpr int S = F::kSamples, kSets = kKeep ? S : 1;
  __shared__ BlendStage<F, C> stage;
  const Vec2<float> p = position_of<F>(threadIdx.x / 32, lane_id());
  for_each_tail_chunk(params, [&](const TileChunk& tail, const TileList& list, int end) {
    const PixelCheckpoints<S, C, kKeep> checkpoints(params, tail.tile, int(threadIdx.x));
    PixelState<S, C, kSets> state;
    state.start(false);
    bool started[S];
    AR_UNROLL for (int s = 0; s < S; ++s) {
      const float transmittance = checkpoints.transmittance(tail.chunk, s);
      started[s] = transmittance > 0;
      if (started[s]) state.transmittance[s] = transmittance;
    }
    int k = tail.chunk * kChunkLength;
    while (k < end && __syncthreads_or(state.open())) {
      const int count = stage.load(params.splats, params.channels, list, k, end);
      __syncthreads();
      composite_all<F>(stage, count, k, p, state);
      k += count;
    }
    const Pixel pixel(list, params.grid, pixel_of<F>(threadIdx.x / 32, lane_id()));
    AR_UNROLL for (int s = 0; s < S; ++s) {
      const float transmittance = started[s] ? state.transmittance[s] : 0;
      if constexpr (kKeep) {
        checkpoints.kept(tail.chunk, s) = {state.channels[s], transmittance};
        if (pixel.inside && state.last[s] > 0) atomicMax(&params.last[sample_index<F>(pixel, s)], state.last[s]);
      } else {
        checkpoints.transmittance(tail.chunk, s) = transmittance;
      }
    }
    if constexpr (!kKeep) checkpoints.set_total(tail.chunk, state.channels[0]);
    __syncthreads();
  });
}

inline constexpr int kTailSumThreads = 32 * StillPolicy::kTailSumWarps;

/// Adds chunks up, and writes pixels. Samples: LaneSamples. C, kKeep: as in blend_front.
template <class Samples, int C, bool kKeep>
__global__ void __launch_bounds__(kTailSumThreads) tail_sum_kernel(const BlendParams params) {
  wait_for_earlier_kernels();
  constexpr int kWarps = StillPolicy::kTailSumWarps;
  constexpr int S = Samples::kSamples, kBatch = kKeep ? StillPolicy::kTailLoadsKept : StillPolicy::kTailLoads;
  __shared__ float sums[kWarps][C][32], lasts[kWarps][32];
  const int warp = int(threadIdx.x) / 32, lane = lane_id();
  const Values<C> background = background_of<C>(params);
  const int items = params.plan.state->counts.open_tiles * kTailParts;
  for (int item = blockIdx.x; item < items; item += gridDim.x) {
    const int tile = params.open_tiles[item / kTailParts], part = item % kTailParts;
    const PixelCheckpoints<S, C, kKeep> checkpoints(params, tile, part * 32 + lane);
    const int front = front_of(params), chunks = chunks_of(params, tile);
    const int share = (chunks - front + kWarps - 1) / kWarps;
    int begin = min(front + int(threadIdx.x / 32) * share, chunks);  // of the warp's chunks
    const int end = min(begin + share, chunks);
    if (warp == 0) begin = checkpoints.first_chunk;
    Values<C> total = {};
    float transmittance[S];
    AR_UNROLL for (int s = 0; s < S; ++s) {
      const bool has_channels = kKeep || s == 0;
      Values<C> sum = {};
      float last = 0;  // transmittance after the last chunk that the sample reached
      for (int first = begin; first < end; first += kBatch) {
        Values<C> own[kBatch];
        float ends[kBatch];
        AR_UNROLL for (int k = 0; k < kBatch; ++k) {
          ends[k] = 0;
          if (first + k >= end) continue;
          if (has_channels) own[k] = checkpoints.channels(first + k, s);
          ends[k] = checkpoints.transmittance(first + k, s);
        }
        AR_UNROLL for (int k = 0; k < kBatch; ++k) {
          if (has_channels && first + k < end) sum += own[k];
          if (ends[k] != 0) last = ends[k];
        }
      }
      lasts[warp][lane] = last;
      AR_UNROLL for (int c = 0; c < C; ++c) sums[warp][c][lane] = sum.v[c];
      __syncthreads();
      for (int w = 0; w < kWarps; ++w) {
        if (lasts[w][lane] != 0) last = lasts[w][lane];
        AR_UNROLL for (int c = 0; c < C; ++c) total.v[c] += sums[w][c][lane];
      }
      transmittance[s] = last;
      if constexpr (kKeep) {
        Values<C> farther = times(abs(last), background);
        for (int w = kWarps - 1; w > warp; --w) {
          AR_UNROLL for (int c = 0; c < C; ++c) farther.v[c] += sums[w][c][lane];
        }
        accumulate_farther<kBatch>(checkpoints, begin, end, s, farther);
      }
      __syncthreads();  // before the next sums
    }
    const TileList list = list_of(params.lists, params.grid, tile);
    if (warp == 0)
      store_pixel<Samples>(params, Pixel(list, params.grid, pixel_of<Samples>(part, lane)), total, transmittance);
  }
}

}  // namespace ar::cuda
