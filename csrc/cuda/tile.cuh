// A library for all kernels of blending: pixels of a lane, list of a tile, reach of a splat, and splats that a block
// stages in shared memory.
//
// A tile of 16x16 pixels has eight subtiles of 8x4 pixels. Forward a warp has one of them, in still/vjp.cuh all.
// Subtile b is in column b % 2 and row b / 2 of the tile. Lane l has the pixel in column l % 8 and row l / 8 of the
// subtile. With a Spread (core/footprint/contract.h) a lane has a sample: neighbouring lanes share a pixel, and the
// tile has fewer pixels.
#pragma once

#include <type_traits>

#include "core/bin.h"
#include "core/blend.h"
#include "cuda/params.h"
#include "cuda/warp.cuh"

namespace ar::cuda {

inline constexpr int kTilePixels = kTile * kTile;
inline constexpr int kSubtiles = 8;
inline constexpr int kBlendThreads = 32 * kSubtiles;

/// Of a subtile [px].
template <class F> inline constexpr int kSubtileWide = 8 >> (kTileBits - spread_tile_bits(F::kLanes, true));
template <class F> inline constexpr int kSubtileHigh = kSubtileWide<F> / 2;

/// Stands for the footprint in kernels that do not evaluate it.
template <int S, int kLanesOfPixel> struct LaneSamples {
  static constexpr int kSamples = S, kLanes = kLanesOfPixel;
};

/// A lane's pixel of subtile b, relative to the tile's first pixel.
template <class F> __device__ Vec2<float> pixel_of(int b, int lane) {
  constexpr int kWide = kSubtileWide<F>, kHigh = kSubtileHigh<F>;
  static_assert(F::kLanes * kWide * kHigh == 32);
  const int pixel = lane / F::kLanes;
  return {float((b & 1) * kWide + pixel % kWide), float((b >> 1) * kHigh + pixel / kWide)};
}
/// The position of a lane's sample in subtile b; `of_first`: in subtile 0. blend and blend_vjp share this addition,
/// because alpha must have the same bits in both.
template <class F> __device__ Vec2<float> position_in(int b, Vec2<float> of_first) {
  return {of_first.x + float((b & 1) * kSubtileWide<F>), of_first.y + float((b >> 1) * kSubtileHigh<F>)};
}
/// The same by lane; of a pixel, if the lane has all its samples.
template <class F> __device__ Vec2<float> position_of(int b, int lane) {
  Vec2<float> of_first = pixel_of<F>(0, lane);
  if constexpr (F::kLanes > 1) {
    Vec2<float> node = {0, 0};
#pragma unroll
    for (int s = 0; s < F::kLanes; ++s) {
      if (lane % F::kLanes == s) node = {float(F::node(s).x), float(F::node(s).y)};
    }
    of_first = of_first + node;
  }
  return position_in<F>(b, of_first);
}

/// All kernels of blending read splats [n, kSplatWidth] here.
template <class F> __device__ Splat<F, float> load_splat(const float* splats, int32_t id) {
  return reinterpret_cast<const Splat<F, float>*>(splats)[id];
}
__device__ inline void prefetch_splat(const float* splats, int32_t id) { prefetch(splats + int64_t(id) * kSplatWidth); }

/// A tile and its list, front to back.
struct TileList {
  int x0, y0;            ///< first pixel
  const int32_t* pairs;  ///< [count, stride] splats (and slots)
  int stride, count;
  bool of_patch;  ///< some splats do not reach this tile

  __device__ int32_t splat(int k) const { return pairs[int64_t(k) * stride]; }
  __device__ int32_t slot(int k) const { return pairs[int64_t(k) * stride + 1]; }
};

/// A tile among the tiles of its patch.
struct TileInPatch {
  int first_tile;  ///< of the patch
  int tiles;       ///< of the patch
  int index;       ///< of the tile

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

/// Which of kColumns x kRows boxes of kWide x kHigh pixels, from pixel (x0, y0) on, a splat reaches. Bit b: column b %
/// kColumns, row b / kColumns. It may include boxes that the splat almost reaches: an exact test pays only if weights
/// are expensive.
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
    const Vec2<float> middle = {0.5f * (kWide - 1), 0.5f * (kHigh - 1)};
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

/// Bit b: subtile b of the tile at (x0, y0).
template <class F> __device__ uint32_t subtile_reach(const Splat<F, float>& splat, int x0, int y0) {
  return reached_boxes<kSubtileWide<F>, kSubtileHigh<F>, 2, 4, F>(splat, x0, y0);
}

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

/// The state of a lane's S samples between splats. kSets sets of C channels: 1, or S if checkpoints need them. The
/// transmittance of a sample that has stopped is negative.
template <int S, int C, int kSets> struct PixelState {
  float transmittance[S];
  Values<C> channels[kSets];
  int last[S];

  __device__ void start(bool open) {
#pragma unroll
    for (int s = 0; s < S; ++s) transmittance[s] = open ? 1.0f : -1.0f, last[s] = 0;
    clear_channels();
  }
  __device__ void clear_channels() {
#pragma unroll
    for (int k = 0; k < kSets; ++k) channels[k] = {};
  }
  __device__ Values<C> total() const {
    Values<C> sum = channels[0];
#pragma unroll
    for (int k = 1; k < kSets; ++k) sum += channels[k];
    return sum;
  }
  __device__ bool open() const {
    bool any = false;
#pragma unroll
    for (int s = 0; s < S; ++s) any |= transmittance[s] > 0;
    return any;
  }
};

/// Adds what a splat contributes to the S samples of a lane. composite(s): blend_sample() of sample s.
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

/// A staged splat.
template <class F, int C> struct alignas(16) TileSplat {
  typename F::template Terms<float> terms;
  Values<C> channels;
};

template <class F, int C> using TileSplatRef = const TileSplat<F, C>;

/// C channels of splat `id`: the three in the splat, or its row from `first` on, then zeros.
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

/// For each of kWarps warps a list of up to kMost staged splats that reach its pixels: cheaper to walk than a mask. An
/// entry is an index times kUnit: an offset in memory with kUnit = sizeof(splat). kAhead entries are read at once.
template <class EntryType, int kUnit, int kAhead, int kWarps, int kMost> struct ReachLists {
  using Entry = EntryType;
  struct alignas(kAhead * sizeof(Entry)) Entries {
    Entry of[kAhead];
  };
  alignas(Entries) Entry of_warps[kWarps][kMost];

  /// Lists splats k in [from, to) with bit `number` in reach[k], which is read up to the next multiple of 32. Returns
  /// how many there are. All lanes must call it.
  template <class Bits> __device__ int list(const Bits* reach, int from, int to, int number = int(threadIdx.x) / 32) {
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
  __device__ static int number_of(Entry entry) { return int(entry) / kUnit; }
  template <class Splat> __device__ static const Splat& splat_of(const Splat* splats, Entry entry) {
    static_assert(sizeof(Splat) % kUnit == 0);
    return *reinterpret_cast<const Splat*>(reinterpret_cast<const char*>(splats) + entry * (sizeof(Splat) / kUnit));
  }
  /// Visits entries [from, to) of this warp. `from` is a multiple of kAhead.
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

/// Splats that a block works on together.
template <class F, int C, int kBatch> struct Stage {
  TileSplat<F, C> splats[kBatch];
  uint8_t reach[kBatch];

  /// Loads pairs [k, k + kBatch), one per thread, and returns how many are before `end`. splats_in: [n, kSplatWidth].
  __device__ int load(const float* splats_in, const Channels<float>& channels, const TileList& list, int k, int end) {
    const int t = threadIdx.x;
    if (kBatch == kBlendThreads || t < kBatch) {
      uint32_t bits = 0;
      if (k + t < end) {
        const int32_t id = list.splat(k + t);
        const Splat<F, float> splat = load_splat<F>(splats_in, id);
        bits = subtile_reach<F>(splat, list.x0, list.y0);
        if (bits) splats[t] = {tile_terms(splat, list), channels_of<C>(channels, splat, id)};
      }
      reach[t] = uint8_t(bits);
    }
    return min(end - k, kBatch);
  }

  /// Splats [k, k + 32) that reach a subtile, for take_first(). All lanes must call it.
  __device__ uint32_t reached(int k, int subtile = threadIdx.x / 32) const {
    return __ballot_sync(kAllLanes, reach[k + 31 - lane_id()] >> subtile & 1);
  }
};

/// A sample at the end of a chunk.
template <int C> struct alignas(C == 3 ? 16 : 4) Checkpoint {
  Values<C> channels;
  float transmittance;  ///< negative: stopped
};

/// The tile of a chunk that is a whole list; -1: no such chunk. Segments of cut lists have the first numbers.
__device__ inline int listed_tile(const BlendVjpParams& params, int chunk) {
  return chunk < params.plan->counts.chunks ? params.chunk_order[chunk].tile : -1;
}

struct Pixel {
  int64_t index, image;  ///< of the pixel; number of pixels
  bool inside;

  __device__ Pixel(const TileList& list, TileGrid grid, Vec2<float> p) {
    const int x = list.x0 + int(p.x), y = list.y0 + int(p.y);
    inside = x < grid.width && y < grid.height;
    index = int64_t(y) * grid.width + x;
    image = int64_t(grid.width) * grid.height;
  }
};

template <class F> inline constexpr float kSampleShare = 1.0f / (F::kSamples * F::kLanes);

/// In arrays [samples, height, width].
template <class F> __device__ int64_t sample_index(int64_t image, int64_t pixel, int s) {
  return (F::kLanes > 1 ? lane_id() % F::kLanes : s) * image + pixel;
}
template <class F> __device__ int64_t sample_index(const Pixel& pixel, int s) {
  return sample_index<F>(pixel.image, pixel.index, s);
}

template <class F> __device__ float sum_of_pixel(float x) {
#pragma unroll
  for (int offset = F::kLanes / 2; offset > 0; offset /= 2) x += __shfl_xor_sync(kAllLanes, x, offset);
  return x;
}
template <class F> __device__ bool writes_pixel(int lane) { return lane % F::kLanes == 0; }

template <class F> __device__ float sample_gradient(const BlendVjpParams& params, const Pixel& pixel, int channel) {
  const float* plane = channel < params.channels.count ? params.dL_dimage.plane(channel, pixel.image) : nullptr;
  return pixel.inside && plane ? kSampleShare<F> * plane[pixel.index] : 0.0f;
}

/// Zeros in `row` of pair_grads, for a pair that no sample composites.
__device__ inline void clear_pair(const BlendVjpParams& params, int64_t row) {
  auto* numbers = reinterpret_cast<float4*>(params.pair_grads + row * kPairGradWidth);
#pragma unroll
  for (int q = 0; q < kPairGradWidth / 4; ++q) numbers[q] = {0, 0, 0, 0};
}

inline constexpr int kClearThreads = kChannelGroup / 4;

/// The same by kClearThreads neighbouring threads: in pair_grads, if `shapes`, and in channel_sums [rows, kWidth].
template <int kWidth> __device__ void clear_pair_together(const BlendVjpParams& params, int64_t row, bool shapes) {
  const int q = threadIdx.x % kClearThreads;
  const float4 zero = {0, 0, 0, 0};
  if (shapes && q < kPairGradWidth / 4) reinterpret_cast<float4*>(params.pair_grads + row * kPairGradWidth)[q] = zero;
  if (params.channel_sums && q < kWidth / 4) reinterpret_cast<float4*>(params.channel_sums + row * kWidth)[q] = zero;
}

/// Writes to rows [, width]. Lists of patches add, as other tiles add too.
__device__ inline void put_sum(float* rows, int width, bool of_patch, int32_t row, int column, float x) {
  float* place = rows + int64_t(row) * width + column;
  if (of_patch) {
    atomicAdd(place, x);
  } else {
    *place = x;
  }
}

}  // namespace ar::cuda
