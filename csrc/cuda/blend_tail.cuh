// The four kernels of blend that finish the tiles that blend_front has left open, as described in blend.cuh.
#pragma once

#include "cuda/blend_output.cuh"
#include "cuda/blend_stage.cuh"
#include "cuda/launch.cuh"

namespace ar::cuda {

/// Multiplies the transmittance by what the splats in shared memory let through, without a threshold at which to stop.
template <class F, int C>
__device__ void pass_all(BlendStage<F, C>& stage, int count, Vec2<float> p, float (&transmittance)[F::kSamples]) {
  const int reached = stage.list_reached(count);
  stage.for_each_listed(0, reached, [&](TileSplatRef<F, C> splat, auto) {
#pragma unroll
    for (int s = 0; s < F::kSamples; ++s)
      transmittance[s] -= transmittance[s] * effective_alpha(F::alpha(splat.terms, p, s));
  });
}

/// Calls visit(chunk, list of its tile, end of the chunk in it) for the tail chunks, with S samples, of the open tiles.
/// Blocks share them.
template <int S, class Visit>
__device__ __forceinline__ void for_each_tail_chunk(const BlendParams& params, Visit&& visit) {
  const int items = params.plan.state->counts.tail;
  for (int item = blockIdx.x; item < items; item += gridDim.x) {
    const TileChunk tail = params.plan.tail[item];
    if (!has_samples<S>(params.lists, tail.tile) || !params.tile_open[tail.tile]) continue;
    const TileList list = list_of(params.lists, params.grid, tail.tile);
    const int end = min(list.count, (tail.chunk + 1) * chunk_length(S));
    visit(tail, list, end);
  }
}

/// Writes the transmittance of each tail chunk alone.
template <class F>
__global__ void __launch_bounds__(kBlendThreads, kTailThroughBlocks<F>) tail_through_kernel(const BlendParams params) {
  wait_for_earlier_kernels();
  constexpr int S = F::kSamples, kLength = chunk_length(S);
  __shared__ BlendStage<F, 0> stage;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const Vec2<float> p = place_of<F>(threadIdx.x / 32, lane_id());
  for_each_tail_chunk<S>(params, [&](const TileChunk& tail, const TileList& list, int end) {
    float transmittance[S];
#pragma unroll
    for (int s = 0; s < S; ++s) transmittance[s] = 1;
    for (int k = tail.chunk * kLength; k < end; k += stage.kBatch) {
      __syncthreads();
      const int count = stage.load(splats, params.channels, list, k, end);
      __syncthreads();
      pass_all<F>(stage, count, p, transmittance);
    }
    const TransmittancePlanes<S> planes(params, tail.tile, int(threadIdx.x));
#pragma unroll
    for (int s = 0; s < S; ++s) planes.at(tail.chunk, s) = transmittance[s];
  });
}

/// A sample with less transmittance than this would be stopped by the next splat that it meets, since alpha is at least
/// kAlphaMin, and so it may count as stopped already. The margin above kTransmittanceMin is for the rounding of
/// products of chunks, which differs from that of single splats.
inline constexpr float kNearlyStopped = float(kTransmittanceMin * (1 + kAlphaMin / 2));

__device__ inline int chunks_of(const BlendParams& params, int tile, int length) {
  return int((params.lists.tile_offsets[tile + 1] - params.lists.tile_offsets[tile] + length - 1) / length);
}

/// The kernels that go through all tail chunks of a tile have a pixel per lane, and a block for each 32 pixels: those
/// of a long list are spread over several multiprocessors, as one alone reads too slowly. A part of a tile is 32
/// pixels.
inline constexpr int kTailParts = kTilePixels / 32;

/// Turns the transmittance of each chunk into that in front of the chunk, negative where a sample has stopped before.
/// Blocks share the parts of the open tiles.
template <int S> __global__ void __launch_bounds__(32) tail_scan_kernel(const BlendParams params) {
  wait_for_earlier_kernels();
  constexpr int kBatch = 32;
  const int items = params.plan.state->counts.open_tiles[sample_class(S)] * S * kTailParts;
  for (int item = blockIdx.x; item < items; item += gridDim.x) {
    const int tile = open_tiles<S>(params)[item / (S * kTailParts)], s = item / kTailParts % S;
    const int chunks = chunks_of(params, tile, chunk_length(S)), front = front_of<S>(params);
    const TransmittancePlanes<S> planes(params, tile, item % kTailParts * 32 + lane_id());
    float transmittance = planes.at(front - 1, s), next[kBatch];
    const auto load = [&](int first) {
#pragma unroll
      for (int k = 0; k < kBatch; ++k) {
        if (first + k < chunks) next[k] = planes.at(first + k, s);
      }
    };
    load(front);
    for (int first = front; first < chunks; first += kBatch) {
      float through[kBatch];
#pragma unroll
      for (int k = 0; k < kBatch; ++k) through[k] = next[k];
      load(first + kBatch);  // before the stores, behind which loads would wait
#pragma unroll
      for (int k = 0; k < kBatch; ++k) {
        if (first + k >= chunks) break;
        planes.at(first + k, s) = transmittance;
        if (transmittance > 0) transmittance *= through[k];
        if (transmittance < kNearlyStopped) transmittance = -abs(transmittance);
      }
    }
  }
}

/// Writes the channels of each tail chunk and the transmittance at its end, which is zero where the sample had stopped
/// before the chunk.
template <class F, int C, bool kKeep>
__global__ void __launch_bounds__(kBlendThreads, kTailBlendBlocks<F>) tail_blend_kernel(const BlendParams params) {
  wait_for_earlier_kernels();
  constexpr int S = F::kSamples, kLength = chunk_length(S), kSets = kKeep ? S : 1;
  __shared__ BlendStage<F, C> stage;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const Vec2<float> p = place_of<F>(threadIdx.x / 32, lane_id());
  for_each_tail_chunk<S>(params, [&](const TileChunk& tail, const TileList& list, int end) {
    const PixelCheckpoints<S, C, kKeep> checkpoints(params, tail.tile, int(threadIdx.x));
    PixelState<S, C, kSets> state;
    state.start(false);
    bool started[S];
#pragma unroll
    for (int s = 0; s < S; ++s) {
      const float transmittance = checkpoints.transmittance(tail.chunk, s);
      started[s] = transmittance > 0;
      if (started[s]) state.transmittance[s] = transmittance;
    }
    int k = tail.chunk * kLength;
    while (k < end && __syncthreads_or(state.open())) {
      const int count = stage.load(splats, params.channels, list, k, end);
      __syncthreads();
      composite_all<F>(stage, count, k, p, state);
      k += count;
    }
    const Pixel pixel(list, params.grid, pixel_of<F>(threadIdx.x / 32, lane_id()));
#pragma unroll
    for (int s = 0; s < S; ++s) {
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

/// Warps of a block that share the tail chunks of a part, since one alone waits for memory most of the time.
inline constexpr int kTailSumWarps = 4, kTailSumThreads = 32 * kTailSumWarps;

/// The tail chunks [first, end) of a warp.
struct TailShare {
  int first, end;

  __device__ TailShare(int front, int chunks) {
    const int share = (chunks - front + kTailSumWarps - 1) / kTailSumWarps;
    first = min(front + int(threadIdx.x / 32) * share, chunks);
    end = min(first + share, chunks);
  }
};

/// Adds the chunks of the open tiles. Blocks share the parts of the tiles. The order of the sum depends on the number
/// of tail chunks alone, so that the picture is the same with and without a backward pass.
template <class F, int C, bool kKeep>
__global__ void __launch_bounds__(kTailSumThreads) tail_sum_kernel(const BlendParams params) {
  wait_for_earlier_kernels();
  constexpr int S = F::kSamples, kBatch = kKeep ? 16 : 32;  // chunks that are loaded together, into registers
  __shared__ float sums[kTailSumWarps][C][32], lasts[kTailSumWarps][32];
  const int warp = int(threadIdx.x) / 32, lane = lane_id();
  const Values<C> background = background_of<C>(params);
  const int items = params.plan.state->counts.open_tiles[sample_class(S)] * kTailParts;
  for (int item = blockIdx.x; item < items; item += gridDim.x) {
    const int tile = open_tiles<S>(params)[item / kTailParts], part = item % kTailParts;
    const PixelCheckpoints<S, C, kKeep> checkpoints(params, tile, part * 32 + lane);
    TailShare share(front_of<S>(params), chunks_of(params, tile, chunk_length(S)));
    if (warp == 0) share.first = checkpoints.first_chunk;
    Values<C> total = {};
    float transmittance[S];
#pragma unroll
    for (int s = 0; s < S; ++s) {
      const bool has_channels = kKeep || s == 0;
      Values<C> sum = {};
      float last = 0;  // at the end of the last of these chunks that the sample reached
      for (int first = share.first; first < share.end; first += kBatch) {
        Values<C> own[kBatch];
        float ends[kBatch];
#pragma unroll
        for (int k = 0; k < kBatch; ++k) {
          ends[k] = 0;
          if (first + k >= share.end) continue;
          if (has_channels) own[k] = checkpoints.channels(first + k, s);
          ends[k] = checkpoints.transmittance(first + k, s);
        }
#pragma unroll
        for (int k = 0; k < kBatch; ++k) {
          if (has_channels && first + k < share.end) sum += own[k];
          if (ends[k] != 0) last = ends[k];
        }
      }
      lasts[warp][lane] = last;
#pragma unroll
      for (int c = 0; c < C; ++c) sums[warp][c][lane] = sum.v[c];
      __syncthreads();
      for (int w = 0; w < kTailSumWarps; ++w) {
        if (lasts[w][lane] != 0) last = lasts[w][lane];
#pragma unroll
        for (int c = 0; c < C; ++c) total.v[c] += sums[w][c][lane];
      }
      transmittance[s] = last;
      if constexpr (kKeep) {
        Values<C> behind = times(abs(last), background);
        for (int w = kTailSumWarps - 1; w > warp; --w) {
#pragma unroll
          for (int c = 0; c < C; ++c) behind.v[c] += sums[w][c][lane];
        }
        accumulate_behind<kBatch>(checkpoints, share.first, share.end, s, behind);
      }
      __syncthreads();  // before the next sums
    }
    const TileList list = list_of(params.lists, params.grid, tile);
    if (warp == 0) store_pixel<F>(params, Pixel(list, params.grid, pixel_of<F>(part, lane)), total, transmittance);
  }
}

/// Blocks of the kernels of the tail, which share the work.
inline constexpr int kTailBlocks = kManyBlocks;

}  // namespace ar::cuda
