// Many channels in a small image, where few tiles have long lists: a block per tile would leave most of the device
// idle. A tile's list is cut into segments, which are blended side by side. The kernels of blend.cuh go first,
// for three channels whose values are discarded: they find the last splat of every sample and the transmittance between
// chunks, where segments begin.
#pragma once

#include "cuda/blend.cuh"
#include "cuda/blend_groups.cuh"
#include "cuda/launch.cuh"

namespace ar::cuda {

/// A block's segment: the part [begin, end) of the list of a tile.
template <class F> struct Segment {
  static constexpr int S = F::kSamples;
  TileList list;
  Vec2<float> p;
  Pixel pixel;  ///< of this lane
  int tile, number, begin, end;
  int tile_last;  ///< place behind the last splat that any pixel composited
  int last[S];    ///< of this lane's samples

  /// All threads of a block must call it.
  __device__ Segment(const TileLists& lists, TileGrid grid, int tile, int number, int count, const int32_t* lasts)
      : list(list_of(lists, grid, tile)),
        p(place_of<F>(threadIdx.x / 32, lane_id())),
        pixel(list, grid, pixel_of<F>(threadIdx.x / 32, lane_id())),
        tile(tile),
        number(number) {
    __shared__ int block_last;
    if (threadIdx.x == 0) block_last = 0;
    __syncthreads();
    int own_last = 0;
#pragma unroll
    for (int s = 0; s < S; ++s) {
      last[s] = pixel.inside ? lasts[sample_index<F>(pixel, s)] : 0;
      own_last = max(own_last, last[s]);
    }
    own_last = warp_max(own_last);
    if (lane_id() == 0) atomicMax(&block_last, own_last);
    __syncthreads();
    tile_last = block_last;
    // Whole chunks each, as even as can be; a list that tiles share has no chunks, and is the last segment.
    const int length = list.of_patch ? kWholeList : chunk_length(S), chunks = (tile_last + length - 1) / length;
    begin = number * chunks / count * length;
    end = number + 1 == count ? tile_last : (number + 1) * chunks / count * length;
  }
};

/// Calls visit(values of the channels, contribution of each sample) for every splat of the segment that a sample of the
/// warp composited. `transmittance`: of this lane's samples in front of the segment.
template <class F, int C, class Visit>
__device__ void walk_segment(const Splat<F, float>* splats, const Channels<float>& channels, int first_channel,
                             const Segment<F>& segment, float (&transmittance)[F::kSamples], Visit&& visit) {
  constexpr int S = F::kSamples;
  __shared__ Stage<F, 0, kGroupBatch> stage;
  __shared__ GroupChannels<kGroupBatch, C> staged;
  for (int k = segment.begin; k < segment.end; k += kGroupBatch) {
    __syncthreads();
    const int count = stage.load(splats, channels, segment.list, k, segment.end);
    if (int(threadIdx.x) < count) staged.ids[threadIdx.x] = segment.list.splat(k + threadIdx.x);
    __syncthreads();
    staged.load(channels, first_channel, count, stage.reach);
    __syncthreads();
    for (int from = 0; from < count; from += 32) {
      for (uint32_t left = stage.reached(from); left != 0;) {
        const int j = from + take_first(left);
        TileSplatRef<F, 0> splat = stage.splats[j];
        float contributions[S];
        bool any = false;
#pragma unroll
        for (int s = 0; s < S; ++s) {
          const float raw = F::alpha(splat.terms, segment.p, s);
          const bool hit = raw >= float(kAlphaMin) && k + j < segment.last[s];
          contributions[s] = hit ? transmittance[s] * effective_alpha(raw) : 0;
          transmittance[s] -= contributions[s];
          any |= hit;
        }
        if (__any_sync(kAllLanes, any)) visit(staged.ids[j], staged.values[j], contributions);
      }
    }
  }
}

/// A block per tile and segment. Writes what the segment adds to the channels [first, first + C) of each lane, times
/// the samples. `in_chunks`: of the kernels that went first.
template <class F, int C>
__global__ void __launch_bounds__(kBlendThreads, F::kSamples > 4 ? 1 : 2)
    segment_blend_kernel(const BlendParams params, const BlendParams in_chunks, int first) {
  wait_for_earlier_kernels();
  constexpr int S = F::kSamples;
  const Segments& segments = params.segments;
  const int place = tile_place<S>(params, int(blockIdx.x) / segments.count);
  if (place < 0) return;
  const Segment<F> segment(params.lists, params.grid, params.plan.tile_order[place], int(blockIdx.x) % segments.count,
                           segments.count, params.last);
  const PixelCheckpoints<S, 3, true> checkpoints(in_chunks, segment.tile, int(threadIdx.x));
  using Share = ChannelShare<C>;
  float transmittance[S];
  Share sums = {};
#pragma unroll
  for (int s = 0; s < S; ++s) {
    const bool open = segment.last[s] > segment.begin;
    transmittance[s] = 1;
    if (segment.begin > 0 && open)
      transmittance[s] = abs(checkpoints.transmittance(segment.begin / chunk_length(S) - 1, s));
    if (first == 0) segments.transmittance_at(segment.tile, segment.number, s)[threadIdx.x] = transmittance[s];
  }
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  walk_segment<F, C>(splats, params.channels, first, segment, transmittance,
                     [&](int32_t, const Eighth<C>(&values)[8], const float (&contributions)[S]) {
                       float contribution = contributions[0];
#pragma unroll
                       for (int s = 1; s < S; ++s) contribution += contributions[s];
                       sums.add(contribution, values);
                     });
#pragma unroll
  for (int k = 0; k < Share::kOwn; ++k) {
    float* plane = segments.sum_at(segment.tile, segment.number, Share::channel(k)) + threadIdx.x / 32 * 32;
#pragma unroll
    for (int i = 0; i < Share::kPixels; ++i) plane[Share::lane_of(i)] = sums.v[i][k];
  }
}

/// Adds the segments of a group of `width` channels up, of tiles with as many samples as F has. A block per tile.
template <class F>
__global__ void __launch_bounds__(kTilePixels) segment_sum_kernel(const BlendParams params, int first, int width) {
  wait_for_earlier_kernels();
  const int tile = int(blockIdx.x);
  if (!has_samples<F::kSamples>(params.lists, tile)) return;
  const TileList list = list_of(params.lists, params.grid, tile);
  const Pixel pixel(list, params.grid, pixel_of<F>(threadIdx.x / 32, lane_id()));
  const bool writes = pixel.inside && writes_pixel<F>(lane_id());
  const Segments& segments = params.segments;
  const float scale = kSampleShare<F>;
  float through = 0;
  for (int s = 0; s < F::kSamples && pixel.inside; ++s) through += params.transmittance[sample_index<F>(pixel, s)];
  through = sum_of_pixel<F>(through);
  for (int c = 0; c < width && first + c < params.channels.count; ++c) {
    float sum = 0;
    for (int k = 0; k < segments.count; ++k) sum += segments.sum_at(tile, k, c)[threadIdx.x];
    sum = sum_of_pixel<F>(sum);
    if (!writes) continue;
    params.image.plane(first + c, pixel.image)[pixel.index] =
        scale * sum + scale * through * params.background[first + c];
  }
}

/// `in_chunks`: parameters of the kernels that go first, for the three colours in the splats, as for a backward pass.
template <class F> void blend_segments(const BlendParams& p, const BlendParams& in_chunks, cudaStream_t stream) {
  blend_few<F, 3>(in_chunks, stream);
  const unsigned tiles = unsigned(p.grid.tiles());
  for (int first = 0, width; first < p.channels.count; first += width) {
    width = group_width<F>(p.channels.count - first);
    const auto kernel =
        width == kSmallGroup ? segment_blend_kernel<F, kSmallGroup> : segment_blend_kernel<F, kChannelGroup>;
    launch(kernel, {tiles * p.segments.count, kBlendThreads}, stream, p, in_chunks, first);
    launch(segment_sum_kernel<F>, {tiles, kTilePixels}, stream, p, first, width);
  }
}

}  // namespace ar::cuda
