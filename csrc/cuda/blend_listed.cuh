// Kernels of blend for footprints whose samples move, in small images: a list for each pixel.
//
// In a small image of a large scene a tile of 8x8 pixels may have hundreds of thousands of splats, most of them smaller
// than a pixel. What takes the time is the longest sequence of splats that some sample meets one after the other. So
// the list of every tile is first filtered, all parts of it side by side, into a bit for each splat and pixel: whether
// it reaches it. Then each warp walks the splats of a few neighbouring pixels, and waits for no other. It takes those
// that reach any of them 32 at a time. Each lane goes through those of its own pixel alone, so that in one step the
// pixels of a warp composite different splats.
#pragma once

#include "cuda/blend_moving.cuh"
#include "cuda/tile_pieces.cuh"

namespace ar::cuda {

/// Pairs of a tile's list that a block of filter_kernel looks at.
inline constexpr int kFilterPiece = 256, kFilterWords = kFilterPiece / 32;
/// Pairs whose bits a warp takes at once: a word for each lane.
inline constexpr int kListedBatch = 32 * 32;

/// How filter_kernel sees a tile: each group has one pixel.
using FilterLayout = CellLayout<1, 32, 4>;
/// A sample per lane, in blocks of a warp, since lists are uneven. The more pixels a warp has, the fewer steps it takes
/// for each of them, and the more of them wait for the longest list: in tiles with long lists, kLong, it has two.
template <class F, bool kLong> using ListedLayout = CellLayout<1, (F::kSamples > 4 || kLong) ? 16 : 4, 1>;
/// Pairs above which a tile's list is long, so that its walk may be what the others end before.
inline constexpr int kLongList = 4096;

/// Words of 32 bits that filter_kernel needs.
inline int64_t filter_words(int64_t capacity, TileGrid grid) {
  return max_pieces(capacity, kFilterPiece, grid) * kFilterWords * kMovingPixels;
}

/// Where the bits of a pixel of a tile are: that of pair k is bit k % 32 of word k / 32.
__device__ inline int64_t pixel_words(const TileLists& lists, const TileList& list, int tile, int pixel_number) {
  const int pieces = (list.count + kFilterPiece - 1) / kFilterPiece;
  return (first_piece(lists, kFilterPiece, tile) * kMovingPixels + pixel_number * pieces) * kFilterWords;
}

/// A thread per pair: which pixels its splat reaches.
template <class F> __global__ void __launch_bounds__(kFilterPiece) filter_kernel(const BlendParams params) {
  using Layout = FilterLayout;
  static_assert(Layout::kPixels == 1);  // so that a group's number is that of its pixel
  __shared__ uint32_t words[Layout::kGroups][kFilterWords];
  const TilePiece piece = find_piece(params.lists, params.grid, kFilterPiece, blockIdx.x);
  if (piece.tile < 0) return;
  const TileList list = list_of(params.lists, params.grid, piece.tile);
  const int k = piece.index * kFilterPiece + int(threadIdx.x);
  typename Layout::Reach reach = 0;
  if (k < list.count) {
    const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
    reach = Layout::reach(support_of(splats[list.splat(k)]), list.x0, list.y0);
  }
#pragma unroll
  for (int from = 0; from < Layout::kGroups; from += 32) {
    uint32_t mine = 0;
#pragma unroll
    for (int g = 0; g < 32 && from + g < Layout::kGroups; ++g) {
      const uint32_t word = __ballot_sync(kAllLanes, reach >> (from + g) & 1);
      if (lane_id() == g) mine = word;
    }
    if (from + lane_id() < Layout::kGroups) words[from + lane_id()][threadIdx.x / 32] = mine;
  }
  __syncthreads();
  for (int i = threadIdx.x; i < Layout::kGroups * kFilterWords; i += kFilterPiece) {
    const int group = i / kFilterWords, word = i % kFilterWords;
    const int64_t first = pixel_words(params.lists, list, piece.tile, group);
    params.reach_words[first + piece.index * kFilterWords + word] = words[group][word];
  }
}

/// What a warp of up to kMostPixels pixels keeps of the splats that it is about to composite.
template <class F, int C, int kMostPixels> struct ListedStage {
  TileSplat<F, C> splats[32];
  int32_t ids[kListedBatch];
  uint16_t places[kListedBatch];    ///< of the pairs in the batch
  uint32_t words[kMostPixels][32];  ///< the batch's bits of each pixel

  /// Takes the pairs of a batch that begins at k, of which each lane has the word of bits of each pixel in `words`, in
  /// order. Returns how many reach any pixel. All lanes must call it.
  template <class Layout> __device__ int take(const Splat<F, float>* splats_in, const TileList& list, int k) {
    const int lane = lane_id();
    uint32_t word = 0;
#pragma unroll
    for (int i = 0; i < Layout::kPixels; ++i) word |= words[i][lane];
    const int count = __popc(word), behind = warp_inclusive_sum(count);  // of the words up to this lane's
    int to = behind - count;
    for (; word != 0; word &= word - 1) places[to++] = uint16_t(32 * lane + __ffs(word) - 1);
    const int all = __shfl_sync(kAllLanes, behind, 31);
    __syncwarp();
#pragma unroll 4
    for (int i = lane; i < all; i += 32) {
      const int32_t id = list.splat(k + places[i]);
      ids[i] = id;
      prefetch(splats_in + id);
    }
    return all;
  }

  /// Of the pairs [from, from + 32) of those that were taken, `count` in all, those that reach this lane's pixel: that
  /// of from + j is bit 31 - j. All lanes must call it.
  template <class Layout> __device__ uint32_t reached(int from, int count) const {
    const int lane = 31 - lane_id(), place = from + lane < count ? places[from + lane] : 0;
    uint32_t mine = 0;
#pragma unroll
    for (int i = 0; i < Layout::kPixels; ++i) {
      const bool reaches = from + lane < count && (words[i][place / 32] >> (place % 32) & 1);
      const uint32_t reached = __ballot_sync(kAllLanes, reaches);
      if (lane_id() / Layout::kLanes == i) mine = reached;
    }
    return mine;
  }
};

/// Blends the pixels of a warp, as Layout shares them out; C channels from `first` on.
template <class F, int C, class Layout>
__device__ void blend_listed(const BlendParams& params, int first, int tile, const TileList& list,
                             ListedStage<F, C, ListedLayout<F, false>::kPixels>& stage) {
  constexpr int kPixels = Layout::kPixels;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const int lane = lane_id();
  const StatePlaces places(params.lists, list, params.grid, tile);
  const bool keep = params.transmittance && first == 0;
  const Vec2<float> p = Layout::pixel();
  const Pixel pixel(list, params.grid, p);
  MovingBlend<F, C, Layout, true> blend(pixel.inside);
  uint32_t words[kPixels];              // of each pixel, this lane's of a batch
  const auto read_words = [&](int k) {  // of the batch that begins at k
    const int mine = k + 32 * lane;
#pragma unroll
    for (int i = 0; i < kPixels; ++i) {
      const uint32_t* from = params.reach_words + pixel_words(params.lists, list, tile, Layout::pixel_number(i));
      words[i] = mine < list.count ? from[mine / 32] : 0u;
    }
  };
  int checkpoint = kStateChunk;  // the next one is in front of this pair
  float* to = params.checkpoints + places.first * blend.samples.kCheckpoint;
  read_words(0);
  uint32_t open = __ballot_sync(kAllLanes, blend.samples.open());
  for (int k0 = 0; k0 < list.count && open; k0 += kListedBatch) {
#pragma unroll
    for (int i = 0; i < kPixels; ++i) {
      constexpr uint32_t kFirst = kAllLanes >> (32 - Layout::kLanes);  // lanes of the first pixel
      stage.words[i][lane] = open & kFirst << (i * Layout::kLanes) ? words[i] : 0u;
    }
    read_words(k0 + kListedBatch);  // so that the next batch need not wait for memory
    const int count = stage.template take<Layout>(splats, list, k0);
    for (int from = 0; from < count && open; from += 32) {
      __syncwarp();  // all have read the splats before
      if (from + lane < count) {
        const int32_t id = stage.ids[from + lane];
        const Splat<F, float> splat = splats[id];
        stage.splats[lane] = {tile_terms(splat, list), channels_of<C>(params.channels, splat, id, first)};
      }
      uint32_t left = stage.template reached<Layout>(from, count);
      if (!blend.samples.open()) left = 0;
      __syncwarp();
      // Each step waits for the one before. What need not, the next splat and how it is seen, is made ready meanwhile.
      int j = __clz(int(left)) % 32;
      TileSplat<F, C> splat = stage.splats[j];
      Vec2<float> of_pixel = transform(splat.terms.w, p, splat.terms.node[0]);
      int k = k0 + stage.places[from + j];
      while (left != 0) {
        left ^= 1u << (31 - j);
        j = __clz(int(left)) % 32;
        const TileSplat<F, C> next = stage.splats[j];
        const int next_place = stage.places[from + j];
#pragma unroll 1
        for (; keep && checkpoint <= k; checkpoint += kStateChunk, to += blend.samples.kCheckpoint)
          blend.samples.store(to);
        blend.add(splat, of_pixel, k);
        splat = next;
        of_pixel = transform(splat.terms.w, p, splat.terms.node[0]);
        k = k0 + next_place;
      }
      open = __ballot_sync(kAllLanes, blend.samples.open());
    }
    __syncwarp();
  }
  blend.write(params, first, pixel);
}

/// Blocks of listed_blend_kernel for each tile.
template <class F> inline constexpr int kListedBlocks = ListedLayout<F, true>::kBlocks;

/// A warp per few pixels of a tile; where its list is short, only the first blocks of a tile have any.
template <class F, int C, int kLongAbove = kLongList>
__global__ void __launch_bounds__(32) listed_blend_kernel(const BlendParams params, int first) {
  using Short = ListedLayout<F, false>;
  using Long = ListedLayout<F, true>;
  static_assert(Short::kThreads == 32 && Long::kThreads == 32 && Long::kBlocks % Short::kBlocks == 0);
  __shared__ ListedStage<F, C, Short::kPixels> stage;
  const int tile = params.plan.tile_order[blockIdx.x / Long::kBlocks];
  const TileList list = list_of(params.lists, params.grid, tile);
  if (list.overflow) return;
  if constexpr (!std::is_same_v<Short, Long>) {
    if (list.count <= kLongAbove) {
      if (int(blockIdx.x) % Long::kBlocks < Short::kBlocks) blend_listed<F, C, Short>(params, first, tile, list, stage);
      return;
    }
  }
  blend_listed<F, C, Long>(params, first, tile, list, stage);
}

}  // namespace ar::cuda
