// What the kernels of blend and blend_vjp share: pixels, lists of tiles, and splats staged for a tile.
//
// A tile's 16x16 pixels are eight subtiles of 8x4, a warp of lanes each: subtile b at column b % 2 and row b / 2, lane
// l at column l % 8 and row l / 8 of it. With a Spread (core/footprint/contract.h) a lane has one sample instead, the
// lanes of a pixel are neighbours, and there are fewer pixels; "a lane's pixel" is then the one of its sample. A splat
// is tested against the subtiles once per tile; warps skip those that do not reach them.
#pragma once

#include <type_traits>

#include "core/bin.h"
#include "core/blend.h"
#include "cuda/side_streams.h"
#include "cuda/stages.h"
#include "cuda/warp.cuh"

namespace ar::cuda {

inline constexpr int kTilePixels = kTile * kTile;
inline constexpr int kSubtiles = 8;
inline constexpr int kBlendThreads = 32 * kSubtiles;

/// Pixels of a subtile side by side, and one below the other. There are fewer where their samples are spread over lanes
/// (Spread of contract.h), so that all 256 lanes of a block have one.
template <class F> inline constexpr int kSubtileWide = 8 >> (kTileBits - spread_tile_bits(F::kLanes, true));
template <class F> inline constexpr int kSubtileHigh = kSubtileWide<F> / 2;

/// A lane's pixel of subtile b, relative to the tile's first.
template <class F> __device__ Vec2<float> pixel_of(int b, int lane) {
  constexpr int kWide = kSubtileWide<F>, kHigh = kSubtileHigh<F>;
  static_assert(F::kLanes * kWide * kHigh == 32);
  const int pixel = lane / F::kLanes;
  return {float((b & 1) * kWide + pixel % kWide), float((b >> 1) * kHigh + pixel / kWide)};
}
/// Where a lane's sample of subtile b is, relative to the tile's first pixel; that of subtile 0 is at `of_first`. Blend
/// and blend_vjp must find the same place to the bit, so both come here: one addition, of a whole number.
template <class F> __device__ Vec2<float> place_in(int b, Vec2<float> of_first) {
  return {of_first.x + float((b & 1) * kSubtileWide<F>), of_first.y + float((b >> 1) * kSubtileHigh<F>)};
}
/// The same by the lane's number. Where a lane has all samples of a pixel, it is the pixel.
template <class F> __device__ Vec2<float> place_of(int b, int lane) {
  Vec2<float> of_first = pixel_of<F>(0, lane);
  if constexpr (F::kLanes > 1) {
    Vec2<float> node = {0, 0};
#pragma unroll
    for (int s = 0; s < F::kLanes; ++s) {
      if (lane % F::kLanes == s) node = {float(F::node(s).x), float(F::node(s).y)};
    }
    of_first = of_first + node;
  }
  return place_in<F>(b, of_first);
}

/// A tile and its list of splats, front to back.
struct TileList {
  int x0, y0;
  const int32_t* pairs;
  int stride, count;
  bool of_patch;  ///< the list is that of a patch: it has splats that do not reach this tile

  __device__ int32_t splat(int k) const { return pairs[int64_t(k) * stride]; }
  __device__ int32_t slot(int k) const { return pairs[int64_t(k) * stride + 1]; }
};

/// Where a tile is among those that share a list.
struct TileInPatch {
  int first_tile;  ///< of the patch
  int tiles;       ///< of the patch, as far as it is in the image
  int index;       ///< of the tile among these

  __device__ TileInPatch(const TileLists& lists, TileGrid grid, int tile) {
    const int bits = int(lists.counts->patch_bits), side = 1 << bits, columns = grid.columns();
    const int row = tile / columns, column = tile % columns;
    const int first_row = row >> bits << bits, first_column = column >> bits << bits;
    const int width = min(side, columns - first_column);
    first_tile = first_row * columns + first_column;
    tiles = width * min(side, grid.rows() - first_row);
    index = (row - first_row) * width + column - first_column;
  }
};

__device__ inline TileList list_of(const TileLists& lists, TileGrid grid, int tile) {
  TileList list;
  list.x0 = tile % grid.columns() << grid.tile_bits;
  list.y0 = tile / grid.columns() << grid.tile_bits;
  list.of_patch = lists.counts->in_patches(lists.capacity);
  list.stride = lists.stride;
  const int64_t* offsets = lists.tile_offsets + (list.of_patch ? TileInPatch(lists, grid, tile).first_tile : tile);
  list.pairs = lists.pairs + offsets[0] * lists.stride;
  list.count = int(offsets[1] - offsets[0]);
  return list;
}

/// Which boxes of kWide x kHigh pixels a splat reaches. Some that it passes closely may be among them; only where
/// weights are expensive, exact extents are worth what they cost. There are kColumns boxes side by side and kRows of
/// these one below the other, the first pixel at (x0, y0). Box b is at column b % kColumns and row b / kColumns.
template <int kWide, int kHigh, int kColumns, int kRows, class F>
__device__ uint32_t reached_boxes(const Splat<F, float>& splat, int x0, int y0) {
  static_assert(kColumns * kRows <= 32);
  uint32_t reached = 0;
  if constexpr (F::kExpensive) {
    const Support<float> support = support_of(splat);
#pragma unroll
    for (int row = 0; row < kRows; ++row) {
      const float y = float(y0 + row * kHigh);
      const Span<float> span = columns_of(support, y, y + float(kHigh - 1));
#pragma unroll
      for (int column = 0; column < kColumns; ++column) {
        const float x = float(x0 + column * kWide);
        reached |= uint32_t(span.lo <= x + float(kWide - 1) && span.hi >= x) << (row * kColumns + column);
      }
    }
  } else {
    const Mat2<float> w = F::ellipse(splat.shape);
    const Vec2<float> middle = {0.5f * (kWide - 1), 0.5f * (kHigh - 1)};  // of a box, from its first pixel
    const Vec2<float> first = {float(x0) - splat.mean.x, float(y0) - splat.mean.y};
    const float distance = float(max(kWide * kColumns, kHigh * kRows)) + max(abs(first.x), abs(first.y));
    const BoxReach<float> box =
        make_box_reach(w, splat.level, {middle.x + float(F::kReach), middle.y + float(F::kReach)}, distance);
#pragma unroll
    for (int row = 0; row < kRows; ++row) {
      const Vec2<float> z = transform(w, Vec2<float>{first.x + middle.x, first.y + (middle.y + float(row * kHigh))});
#pragma unroll
      for (int column = 0; column < kColumns; ++column) {
        const float right = float(column * kWide);
        const Vec2<float> center = {madd(w.xx, right, z.x), madd(w.yx, right, z.y)};
        reached |= uint32_t(reaches_box(box, center)) << (row * kColumns + column);
      }
    }
  }
  return reached;
}

/// Bit b: the splat reaches subtile b, or passes it closely.
template <class F> __device__ uint32_t subtile_reach(const Splat<F, float>& splat, int x0, int y0) {
  return reached_boxes<kSubtileWide<F>, kSubtileHigh<F>, 2, 4, F>(splat, x0, y0);
}

/// Values of C channels.
template <int C> struct Values {
  float v[C];

  __device__ void add(float weight, const Values& other) {
#pragma unroll
    for (int c = 0; c < C; ++c) v[c] = madd(weight, other.v[c], v[c]);
  }
  __device__ Values& operator+=(const Values& other) {
#pragma unroll
    for (int c = 0; c < C; ++c) v[c] += other.v[c];
    return *this;
  }
};
template <> struct Values<0> {};

/// Adds what a splat contributes in the S samples of a lane. composite(s) composites it into sample s and returns what
/// blend_sample does. A branch around a single addition becomes a predicate, which costs nothing.
template <int S, int C, class Composite>
__device__ __forceinline__ void add_samples(Values<C>& sums, const Values<C>& channels, Composite&& composite) {
  float contribution = 0;
#pragma unroll
  for (int s = 0; s < S; ++s) {
    const Blended<float> b = composite(s);
    if constexpr (S == 1) {
      if (b.mask) sums.add(b.if_shown, channels);
    } else if (s == 0) {
      contribution = b.contribution;
    } else if (b.mask) {
      contribution += b.if_shown;
    }
  }
  if (S > 1) sums.add(contribution, channels);
}
template <int C> __device__ Values<C> times(float scale, const Values<C>& values) {
  Values<C> scaled;
#pragma unroll
  for (int c = 0; c < C; ++c) scaled.v[c] = scale * values.v[c];
  return scaled;
}

/// What the pixels of a tile need of a splat: its terms, and C channels.
template <class F, int C> struct alignas(16) TileSplat {
  typename F::template Terms<float> terms;
  Values<C> channels;
};

/// A staged splat in use: copied to registers, unless it has too many numbers.
template <class F, int C>
using TileSplatRef = std::conditional_t<sizeof(TileSplat<F, C>) <= 112, const TileSplat<F, C>, const TileSplat<F, C>&>;

/// The channels of a splat: three lie in it; of more, those that there are in rows from `first` on, and zeros.
template <int C, class F>
__device__ Values<C> channels_of(const Channels<float>& channels, const Splat<F, float>& splat, int32_t id,
                                 int first = 0) {
  if constexpr (C == 0) {
    return {};
  } else if constexpr (C == 3) {
    return {{splat.color.x, splat.color.y, splat.color.z}};
  } else {
    const float* row = channels.row(id) + first;
    if (C == 4 && channels.count == 4 && reinterpret_cast<uintptr_t>(channels.data) % 16 == 0) {
      const float4 v = *reinterpret_cast<const float4*>(row);
      return {{v.x, v.y, v.z, v.w}};
    }
    Values<C> values;
#pragma unroll
    for (int c = 0; c < C; ++c) values.v[c] = first + c < channels.count ? row[c] : 0;
    return values;
  }
}

/// For each warp of a block a list of up to kMost staged splats that reach its pixels, which costs less per splat than
/// to look for the next bit of a mask. A list holds the numbers of splats times kUnit, and is read kAhead entries at a
/// time: where kUnit is the size of a splat, an entry is its place in memory.
template <class EntryType, int kUnit, int kAhead, int kWarps, int kMost> struct ReachLists {
  using Entry = EntryType;
  struct alignas(kAhead * sizeof(Entry)) Entries {
    Entry of[kAhead];
  };
  alignas(Entries) Entry of_warps[kWarps][kMost];

  /// Lists those of the staged splats [from, to) that reach this warp's pixels, and returns how many there are. Bit w
  /// of reach[k]: splat k reaches those of warp w; all up to the next multiple of 32 are read. All lanes must call it.
  template <class Bits> __device__ int list(const Bits* reach, int from, int to) {
    return list(reach, from, to, int(threadIdx.x) / 32);
  }
  /// Those whose bit `number` is set.
  template <class Bits> __device__ int list(const Bits* reach, int from, int to, int number) {
    const int warp = threadIdx.x / 32;
    int n = 0;
    for (int k = from; k < to; k += 32) {
      const bool reached = reach[k + lane_id()] >> number & 1;
      const uint32_t all = __ballot_sync(kAllLanes, reached);
      if (reached) of_warps[warp][n + __popc(all & ((1u << lane_id()) - 1))] = Entry((k + lane_id()) * kUnit);
      n += __popc(all);
    }
    __syncwarp();
    return n;
  }
  /// The number of a listed splat.
  __device__ static int number_of(Entry entry) { return int(entry) / kUnit; }
  /// The splat itself, which is staged in `splats`.
  template <class Splat> __device__ static const Splat& splat_of(const Splat* splats, Entry entry) {
    static_assert(sizeof(Splat) % kUnit == 0);
    return *reinterpret_cast<const Splat*>(reinterpret_cast<const char*>(splats) + entry * (sizeof(Splat) / kUnit));
  }
  /// Calls visit(entry) for those in [from, to) of the list of this warp; `from` is a multiple of kAhead.
  template <class Visit> __device__ __forceinline__ void for_each(int from, int to, Visit&& visit) const {
    const Entry* list = of_warps[threadIdx.x / 32];
    int k = from;
    if constexpr (kAhead > 1) {
#pragma unroll 1
      for (; k + kAhead <= to; k += kAhead) {
        const Entries entries = *reinterpret_cast<const Entries*>(list + k);
#pragma unroll
        for (int i = 0; i < kAhead; ++i) visit(entries.of[i]);
      }
    }
#pragma unroll 1
    for (; k < to; ++k) visit(list[k]);
  }
};

template <class F> __device__ auto tile_terms(const Splat<F, float>& splat, const TileList& list) {
  return F::terms(splat.shape, splat.opacity, {float(list.x0) - splat.mean.x, float(list.y0) - splat.mean.y});
}

/// Up to kBatch splats of a tile that a block works on together, a thread for each.
template <class F, int C, int kBatch> struct Stage {
  TileSplat<F, C> splats[kBatch];
  uint8_t reach[kBatch];

  /// Loads splats [k, k + kBatch) of the list; returns how many there are before `end`.
  __device__ int load(const Splat<F, float>* splats_in, const Channels<float>& channels, const TileList& list, int k,
                      int end) {
    const int t = threadIdx.x;
    if (kBatch == kBlendThreads || t < kBatch) {
      uint32_t bits = 0;
      if (k + t < end) {
        const int32_t id = list.splat(k + t);
        const Splat<F, float> splat = splats_in[id];
        bits = subtile_reach<F>(splat, list.x0, list.y0);
        if (bits) splats[t] = {tile_terms(splat, list), channels_of<C>(channels, splat, id)};
      }
      reach[t] = uint8_t(bits);
    }
    return min(end - k, kBatch);
  }

  /// Of the splats [k, k + 32), those that reach a subtile, in the order of take_first. All lanes must call it.
  __device__ uint32_t reached(int k, int subtile) const {
    return __ballot_sync(kAllLanes, reach[k + 31 - lane_id()] >> subtile & 1);
  }
  /// The same for this warp's subtile.
  __device__ uint32_t reached(int k) const { return reached(k, threadIdx.x / 32); }
};

/// A sample at the end of a chunk, kept for a backward pass.
template <int C> struct alignas(C == 3 ? 16 : 4) Checkpoint {
  Values<C> channels;
  float transmittance;  ///< negated where the sample has stopped
};

/// Whether a tile is blended with S samples.
template <int S> __device__ bool has_samples(const TileLists& lists, int tile) {
  return !lists.tile_samples || lists.tile_samples[tile] == S;
}

/// Place in the plan's order of tiles of block `block` of a kernel for tiles with S samples; -1 if there is none.
template <int S, class Params> __device__ int tile_place(const Params& params, int block) {
  if (!params.lists.tile_samples) return block;
  const SampleParts& tiles = params.plan.state->counts.tiles;
  const int place = tiles.first[sample_class(S)] + block;
  return place < tiles.first[sample_class(S) + 1] ? place : -1;
}

/// The tile of block `block` of a kernel of blend_vjp for tiles with S samples whose lists are walked as a whole; -1 if
/// there is none. Where lists are cut, blocks are numbered with the segments of those first, then the lists that are
/// not.
template <int S> __device__ int listed_tile(const BlendVjpParams& params, int block) {
  const SampleParts& tiles = params.plan->counts.chunks;  // a chunk is a tile's whole list
  const int place = tiles.first[sample_class(S)] + block;
  return place < tiles.first[sample_class(S) + 1] ? params.chunk_order[place].tile : -1;
}

/// The numbers of a pixel's samples, and of its image.
struct Pixel {
  int64_t index, image;  ///< of the pixel, and how many there are
  bool inside;

  __device__ Pixel(const TileList& list, TileGrid grid, Vec2<float> p) {
    const int x = list.x0 + int(p.x), y = list.y0 + int(p.y);
    inside = x < grid.width && y < grid.height;
    index = int64_t(y) * grid.width + x;
    image = int64_t(grid.width) * grid.height;
  }
};

/// The share of one sample in its pixel.
template <class F> inline constexpr float kSampleShare = 1.0f / (F::kSamples * F::kLanes);

/// Place of sample s of this lane's pixel in an array of [samples, H, W].
template <class F> __device__ int64_t sample_index(int64_t image, int64_t pixel, int s) {
  return (F::kLanes > 1 ? lane_id() % F::kLanes : s) * image + pixel;
}
template <class F> __device__ int64_t sample_index(const Pixel& pixel, int s) {
  return sample_index<F>(pixel.image, pixel.index, s);
}

/// The sum over the lanes that a pixel's samples are spread over.
template <class F> __device__ float sum_of_pixel(float x) {
#pragma unroll
  for (int offset = F::kLanes / 2; offset > 0; offset /= 2) x += __shfl_xor_sync(kAllLanes, x, offset);
  return x;
}
/// Whether a lane writes what its pixel has once.
template <class F> __device__ bool writes_pixel(int lane) { return lane % F::kLanes == 0; }

/// The gradient with respect to a channel of one of a pixel's samples.
template <class F> __device__ float sample_gradient(const BlendVjpParams& params, const Pixel& pixel, int channel) {
  const float* plane = channel < params.channels.count ? params.dL_dimage.plane(channel, pixel.image) : nullptr;
  return pixel.inside && plane ? kSampleShare<F> * plane[pixel.index] : 0.0f;
}

/// Zeros for a pair that no sample composites, in `row` of pair_grads: by one thread.
__device__ inline void clear_pair(const BlendVjpParams& params, int64_t row) {
  auto* numbers = reinterpret_cast<float4*>(params.pair_grads + row * kPairGradWidth);
#pragma unroll
  for (int q = 0; q < kPairGradWidth / 4; ++q) numbers[q] = {0, 0, 0, 0};
}

/// Threads that clear_pair_together takes for a pair.
inline constexpr int kClearThreads = kChannelGroup / 4;

/// The same by kClearThreads neighbouring threads, all of which must call it, for a pair that has a row of channel_sums
/// too, of kWidth numbers. That of pair_grads is cleared with `shapes`.
template <int kWidth> __device__ void clear_pair_together(const BlendVjpParams& params, int64_t row, bool shapes) {
  const int q = threadIdx.x % kClearThreads;
  const float4 zero = {0, 0, 0, 0};
  if (shapes && q < kPairGradWidth / 4) reinterpret_cast<float4*>(params.pair_grads + row * kPairGradWidth)[q] = zero;
  if (params.channel_sums && q < kWidth / 4) reinterpret_cast<float4*>(params.channel_sums + row * kWidth)[q] = zero;
}

/// Sums gradients of a splat in row `row` of pairs, or of splats, where all tiles add to it.
__device__ inline void put_sum(float* rows, int width, bool of_patch, int32_t row, int column, float x) {
  float* place = rows + int64_t(row) * width + column;
  if (of_patch) {
    atomicAdd(place, x);
  } else {
    *place = x;
  }
}

/// log2 of the side of the tiles that F has [px].
template <class F> constexpr int tile_bits_of(bool small_image) {
  return F::kMoves ? moving_tile_bits(F::kSamples, small_image) : spread_tile_bits(spread_lanes<F>(), small_image);
}
/// Calls `visit` with the side of the grid's tiles, one of those that F has, as a constant.
template <class F, class Visit> void with_tile_side(TileGrid grid, Visit&& visit) {
  constexpr int kLarge = 1 << tile_bits_of<F>(false), kSmall = 1 << tile_bits_of<F>(true);
  if constexpr (kLarge != kSmall) {
    if (grid.side() == kLarge) return visit(std::integral_constant<int, kLarge>());
  }
  visit(std::integral_constant<int, kSmall>());
}

/// Calls f with what F, whose samples do not move, is blended as in tiles of this grid: F::Spread, or F itself.
template <class F, class Function> void with_lanes(TileGrid grid, Function&& f) {
  with_tile_side<F>(grid, [&](auto side) {
    using Blended = std::conditional_t<(side < kTile), typename F::Spread, F>;
    f(Blended{});
  });
}

/// Calls f(F{}, stream) for the footprint F of every kind of tile: where samples are chosen those of Boxes, side by
/// side, as a few tiles of many samples would else keep the device waiting.
template <class F, class Boxes, class Function> void for_each_tile_footprint(cudaStream_t stream, Function&& f) {
  if constexpr (std::is_same_v<F, Adaptive>) {
    const SideStreams<3> sides(stream);
    int k = 0;
    for_each_footprint(Boxes{}, [&](auto tile_footprint) { f(tile_footprint, sides.stream(k++)); });
  } else {
    f(PixelsOf<F>{}, stream);
  }
}

/// Calls f(F{}, stream) for the pixels of the footprint at place `footprint` of the registry.
template <class Boxes, class Function> void visit_tile_footprints(int footprint, cudaStream_t stream, Function&& f) {
  visit_footprint(footprint, Footprints{},
                  [&](auto chosen) { for_each_tile_footprint<decltype(chosen), Boxes>(stream, f); });
}

}  // namespace ar::cuda
