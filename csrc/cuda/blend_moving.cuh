// Kernel of blend for footprints whose samples move: a block per tile of 8x8 pixels, a lane per few samples of a pixel.
//
// What a splat does to a sample depends on where the sample is when they meet, so that the chunks of a list cannot be
// blended side by side as in blend.cuh: a block walks its whole list. What fills the device instead is that samples are
// spread over lanes and that tiles are small. It also wastes less: the fewer pixels a warp has, the fewer splats pass
// through it that touch only some of them. Small images take the kernel of blend_listed.cuh in its place.
#pragma once

#include "cuda/composite.cuh"

namespace ar::cuda {

inline constexpr int kMovingPixels = kMovingTile * kMovingTile;
/// Of more channels than lie in the rows of pairs, those that are blended at once.
inline constexpr int kMovingChannels = 8;

/// How the samples of 8x8 pixels are shared out: kCells to a lane, those of a pixel to kLanes neighbours, a power of
/// two, of which the last may have fewer, or none. The pixels of a warp, a group, are a rectangle. A tile's groups are
/// spread over kBlocks blocks of kWarps warps.
template <int kCellsOfLane, int kLanesOfPixel, int kWarpsOfBlock = kLanesOfPixel * kMovingPixels / 32>
struct CellLayout {
  static constexpr int kCells = kCellsOfLane, kLanes = kLanesOfPixel;
  static constexpr int kGroups = kLanes * kMovingPixels / 32;
  static constexpr int kWarps = kWarpsOfBlock, kThreads = 32 * kWarps, kBlocks = kGroups / kWarps;
  static_assert((kLanes & (kLanes - 1)) == 0 && kLanes <= 32 && kGroups % kWarps == 0 && kWarps <= 32);
  static constexpr int kPixels = 32 / kLanes;  ///< of a group
  static constexpr int kWide = kPixels == 32 ? 8 : kPixels >= 8 ? 4 : kPixels >= 2 ? 2 : 1, kHigh = kPixels / kWide;
  static constexpr int kColumns = kMovingTile / kWide;                   ///< groups side by side
  using Reach = std::conditional_t<(kGroups > 32), uint64_t, uint32_t>;  ///< a bit for each group

  /// This warp's group.
  __device__ static int group() { return int(blockIdx.x) % kBlocks * kWarps + int(threadIdx.x) / 32; }
  /// The place of the group's pixel i among the tile's, row by row, whatever the layout.
  __device__ static int pixel_number(int i) {
    const int g = group();
    return (g / kColumns * kHigh + i / kWide) * kMovingTile + g % kColumns * kWide + i % kWide;
  }
  __device__ static int pixel_number() { return pixel_number(lane_id() / kLanes); }  ///< of this thread's pixel
  /// This thread's pixel, relative to the tile's first.
  __device__ static Vec2<float> pixel() {
    const int g = group(), i = lane_id() / kLanes;
    return {float(g % kColumns * kWide + i % kWide), float(g / kColumns * kHigh + i / kWide)};
  }
  /// The first of this thread's samples of its pixel.
  __device__ static int first_sample() { return lane_id() % kLanes * kCells; }

  /// Bit g: the support reaches the pixels of group g of the tile that begins at (x0, y0).
  __device__ static Reach reach(const Support<float>& support, int x0, int y0) {
    Reach reach = 0;
#pragma unroll
    for (int g = 0; g < kGroups; g += kColumns) {
      const float y = float(y0 + g / kColumns * kHigh);
      const Span<float> span = columns_of(support, y, y + float(kHigh - 1));
#pragma unroll
      for (int c = 0; c < kColumns; ++c) {
        const float x = float(x0 + c * kWide);
        reach |= Reach(span.lo <= x + float(kWide - 1) && span.hi >= x) << (g + c);
      }
    }
    return reach;
  }

  /// The sum over the lanes of a pixel, in each of them.
  __device__ static float sum_lanes(float x) {
#pragma unroll
    for (int offset = 1; offset < kLanes; offset *= 2) x += __shfl_xor_sync(kAllLanes, x, offset);
    return x;
  }
};

/// Where the checkpoints of a tile's samples are: the one in front of pair i spacing, i > 0, is number first + i - 1.
/// With too many pairs the tiles share equally what room there is.
struct StatePlaces {
  int64_t first;
  int spacing;  ///< a multiple of kStateChunk

  __device__ StatePlaces(const TileLists& lists, const TileList& list, TileGrid grid, int tile)
      : first(list.overflow ? 0 : lists.tile_offsets[tile] / kStateChunk), spacing(kStateChunk) {
    if (!list.overflow) return;
    const int64_t room = lists.capacity / kStateChunk / grid.tiles();
    first = tile * room;
    spacing = int(((list.count - 1) / (room + 1) / kStateChunk + 1) * kStateChunk);
  }
};

/// A lane's samples on their way through a list. `kTogether`: the samples of a pixel are neighbours in a checkpoint, as
/// they are among the lanes of warps with few pixels; else the pixels of a sample are.
template <class F, class Layout, bool kTogether = false> struct MovingSamples {
  static constexpr int kCells = Layout::kCells;
  float transmittance[kCells];
  Vec2<float> place[kCells];     ///< of the node [px from the pixel's centre]
  Bounds<float> bounds[kCells];  ///< of the place

  /// In front of all splats.
  __device__ explicit MovingSamples(bool inside) {
#pragma unroll
    for (int i = 0; i < kCells; ++i) {
      transmittance[i] = inside && exists(i) ? 1.0f : -1.0f;
      place[i] = node(i);
      bounds[i] = F::template cell<float>(Layout::first_sample() + i);
    }
  }
  __device__ static bool exists(int i) { return Layout::first_sample() + i < F::kSamples; }
  __device__ static Vec2<float> node(int i) { return F::template node<float>(Layout::first_sample() + i); }
  __device__ bool open() const {
    bool any = false;
#pragma unroll
    for (int i = 0; i < kCells; ++i) any |= transmittance[i] > 0;
    return any;
  }

  static constexpr int kCheckpoint = state_planes(F::kSamples) * kMovingPixels;           ///< numbers of a checkpoint
  static constexpr int kPlane = kTogether ? F::kSamples * kMovingPixels : kMovingPixels;  ///< from a plane to the next
  /// Where a checkpoint has sample i of this pixel: its transmittance, and its place in the two planes behind.
  __device__ static int in_checkpoint(int i) {
    const int sample = Layout::first_sample() + i, pixel = Layout::pixel_number();
    return kTogether ? pixel * F::kSamples + sample : 3 * sample * kMovingPixels + pixel;
  }
  __device__ void store(float* checkpoint) const {
#pragma unroll
    for (int i = 0; i < kCells; ++i) {
      if (!exists(i)) continue;
      float* to = checkpoint + in_checkpoint(i);
      to[0] = abs(transmittance[i]);
      to[kPlane] = place[i].x;
      to[2 * kPlane] = place[i].y;
    }
  }
  /// In front of pair k, where `checkpoint` is, unless k is 0. Samples that have composited their last splat, `last`
  /// pairs from the first, may have no checkpoint there, and need none.
  __device__ void load(const float* checkpoint, int k, const int (&last)[kCells]) {
#pragma unroll
    for (int i = 0; i < kCells; ++i) {
      transmittance[i] = 1;
      place[i] = node(i);
      if (k == 0 || k >= last[i]) continue;
      const float* from = checkpoint + in_checkpoint(i);
      transmittance[i] = from[0];
      place[i] = {from[kPlane], from[2 * kPlane]};
    }
  }
};

/// Up to kBatch splats of a tile that a block works on together.
template <class F, int C, class Layout, int kBatch> struct MovingStage {
  static_assert(kBatch <= Layout::kThreads && Layout::kBlocks == 1);
  TileSplat<F, C> splats[kBatch];
  uint32_t reach[kBatch];

  /// This thread's splat of those in [k, k + kBatch) and before `end` of the list, or -1.
  __device__ static int32_t splat_of(const TileList& list, int k, int end) {
    const int t = threadIdx.x;
    return t < kBatch && k + t < end ? list.splat(k + t) : -1;
  }
  /// Loads the splats, `id` = splat_of(), with channels from `first` on.
  __device__ void load(const Splat<F, float>* splats_in, const Channels<float>& channels, int first,
                       const TileList& list, int32_t id) {
    uint32_t bits = 0;
    if (id >= 0) {
      const Splat<F, float> splat = splats_in[id];
      bits = Layout::reach(support_of(splat), list.x0, list.y0);  // a block has all groups of its tile
      if (bits) splats[threadIdx.x] = {tile_terms(splat, list), channels_of<C>(channels, splat, id, first)};
    }
    if (threadIdx.x < kBatch) reach[threadIdx.x] = bits;
  }

  /// Of the splats [k, k + 32), those that reach this warp's pixels: that of k + j is bit 31 - j. All must call it.
  __device__ uint32_t reached(int k) const {
    return __ballot_sync(kAllLanes, reach[k + 31 - lane_id()] >> (threadIdx.x / 32) & 1);
  }
};

/// Takes the first splat out of `reached`, as MovingStage has them, and returns its number: the highest bit is found
/// with one slow instruction, the lowest with two.
__device__ inline int take_first(uint32_t& reached) {
  const int first = __clz(int(reached));
  reached ^= 1u << (31 - first);
  return first;
}

/// A lane's share of blending a pixel.
template <class F, int C, class Layout, bool kTogether = false> struct MovingBlend {
  static constexpr int kCells = Layout::kCells;
  MovingSamples<F, Layout, kTogether> samples;
  Values<C> sums = {};
  int last[kCells] = {};

  __device__ explicit MovingBlend(bool inside) : samples(inside) {}

  /// Composites pair k into the samples of a pixel, whose whitened coordinates for the splat are of_pixel.
  __device__ void add(TileSplatRef<F, C>& splat, Vec2<float> of_pixel, int k) {
    float contribution = 0;
#pragma unroll
    for (int i = 0; i < kCells; ++i) {
      const Vec2<float> z = F::whitened_node(splat.terms, of_pixel, samples.place[i]);
      const Blended<float> b = blend_placed_sample<F>(splat.terms, z, exp2(F::log_alpha(splat.terms, z)),
                                                      samples.bounds[i], samples.transmittance[i], samples.place[i]);
      contribution = i == 0 ? b.contribution : contribution + b.contribution;
      last[i] = b.mask ? k + 1 : last[i];
    }
    sums.add(contribution, splat.channels);
  }

  /// Adds the lanes of each pixel up and writes its images. All lanes must call it.
  __device__ void write(const BlendParams& params, int first, const Pixel& pixel) {
    const bool keep = params.transmittance && first == 0;
    float through = 0;
#pragma unroll
    for (int i = 0; i < kCells; ++i) {
      if (!samples.exists(i)) continue;
      through += abs(samples.transmittance[i]);
      if (!keep || !pixel.inside) continue;
      const int64_t place = (Layout::first_sample() + i) * pixel.image + pixel.index;
      params.transmittance[place] = abs(samples.transmittance[i]);
      params.last[place] = last[i];
    }
    through = Layout::sum_lanes(through);
#pragma unroll
    for (int c = 0; c < C; ++c) sums.v[c] = Layout::sum_lanes(sums.v[c]);
    if (!pixel.inside || Layout::first_sample() > 0) return;
    const float scale = 1.0f / F::kSamples;
#pragma unroll
    for (int c = 0; c < C; ++c) {
      if (first + c >= params.channels.count) break;
      params.image.plane(first + c, pixel.image)[pixel.index] =
          scale * sums.v[c] + scale * through * params.background[first + c];
    }
    if (first == 0 && params.alpha) params.alpha[pixel.index] = 1 - scale * through;
  }
};

/// A block per tile; C channels from `first` on, of three in so few registers that an SM holds 1024 threads.
/// `overflow_only`: another kernel blends the tiles, unless there were too many pairs.
template <class F, int C, class Layout>
__global__ void __launch_bounds__(Layout::kThreads, C == 3 ? 1024 / Layout::kThreads : 1)
    moving_blend_kernel(const BlendParams params, int first, bool overflow_only) {
  constexpr int kBatch = Layout::kThreads < 256 ? Layout::kThreads : 256;
  __shared__ MovingStage<F, C, Layout, kBatch> stage;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const int tile = params.plan.tile_order[blockIdx.x];
  const TileList list = list_of(params.lists, params.grid, tile);
  if (overflow_only && !list.overflow) return;
  const StatePlaces places(params.lists, list, params.grid, tile);
  const bool keep = params.transmittance && first == 0;
  const Vec2<float> p = Layout::pixel();
  const Pixel pixel(list, params.grid, p);
  MovingBlend<F, C, Layout> blend(pixel.inside);
  int32_t id = stage.splat_of(list, 0, list.count);
  for (int k = 0; k < list.count && __syncthreads_or(blend.samples.open()); k += kBatch) {
    const int count = min(list.count - k, kBatch);
    const int32_t next_id = stage.splat_of(list, k + kBatch, list.count);
    stage.load(splats, params.channels, first, list, id);
    __syncthreads();
    if (next_id >= 0) prefetch(splats + next_id);  // so that the next batch need not wait for memory
    id = next_id;
    for (int from = 0; from < count; from += 32) {
      if (!__any_sync(kAllLanes, blend.samples.open())) break;
      if (keep && k + from > 0 && (k + from) % places.spacing == 0)
        blend.samples.store(params.checkpoints +
                            (places.first + (k + from) / places.spacing - 1) * blend.samples.kCheckpoint);
      for (uint32_t left = stage.reached(from); left != 0;) {
        const int j = from + take_first(left);
        TileSplatRef<F, C> splat = stage.splats[j];
        blend.add(splat, transform(splat.terms.w, p, splat.terms.node[0]), k + j);
      }
    }
  }
  blend.write(params, first, pixel);
}

/// Samples shared out so that there is least to do, forwards and backwards.
template <class F, bool kBackward>
using EvenLayout =
    std::conditional_t<F::kSamples == 1, CellLayout<1, 1>,
                       std::conditional_t<F::kSamples == 4, CellLayout<2, 2>,
                                          std::conditional_t<F::kSamples == 9 && !kBackward, CellLayout<5, 2>,
                                                             CellLayout<(F::kSamples + 3) / 4, 4>>>>;

/// Small images are blended by blend_listed.cuh and differentiated in segments (blend_moving_vjp.cuh): their few tiles
/// have long lists, and the time is that of the longest.
inline bool is_small_image(TileGrid grid) { return grid.tiles() < 4096; }

}  // namespace ar::cuda
