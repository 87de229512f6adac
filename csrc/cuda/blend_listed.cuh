// Kernels of blend for footprints whose samples move, in small images: a warp per pixel, each with a list of its own.
//
// In a small image of a large scene a tile of 8x8 pixels may have hundreds of thousands of splats, most of them smaller
// than a pixel. What takes the time is the longest sequence of splats that some sample meets one after the other. So
// the list of every tile is first filtered, all parts of it side by side, into a bit for each splat and group of
// pixels: whether it reaches them. Then each warp walks the splats of its own group alone, and waits for no other.
#pragma once

#include "cuda/blend_moving.cuh"
#include "cuda/tile_pieces.cuh"

namespace ar::cuda {

/// Pairs of a tile's list that a block of filter_kernel looks at.
inline constexpr int kFilterPiece = 256, kFilterWords = kFilterPiece / 32;
/// Pairs whose bits a warp takes at once: a word for each lane.
inline constexpr int kListedBatch = 32 * 32;

/// A warp has a single pixel. Lanes that have no sample cost less than the splats of other pixels would.
template <class F> using ListedLayout = CellLayout<1, 32, 4>;

/// Words of 32 bits that filter_kernel needs.
template <class Layout> int64_t filter_words(int64_t capacity, TileGrid grid) {
  return max_pieces(capacity, kFilterPiece, grid) * kFilterWords * Layout::kGroups;
}

/// Where the bits of a group of a tile's pixels are: that of pair k is bit k % 32 of word k / 32.
template <class Layout>
__device__ int64_t group_words(const TileLists& lists, const TileList& list, int tile, int group) {
  const int pieces = (list.count + kFilterPiece - 1) / kFilterPiece;
  return (first_piece(lists, kFilterPiece, tile) * Layout::kGroups + group * pieces) * kFilterWords;
}

/// A thread per pair: which groups of pixels its splat reaches.
template <class F, class Layout>
__global__ void __launch_bounds__(kFilterPiece) filter_kernel(const BlendParams params) {
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
    const int64_t first = group_words<Layout>(params.lists, list, piece.tile, group);
    params.reach_words[first + piece.index * kFilterWords + word] = words[group][word];
  }
}

/// What a warp keeps of the splats that it is about to composite.
template <class F, int C> struct ListedStage {
  TileSplat<F, C> splats[32];
  int32_t ids[kListedBatch];
  uint16_t places[kListedBatch];  ///< of the pairs in the batch

  /// Takes the pairs of a batch that begins at k, of which each lane has a word of bits, in order. Returns how many
  /// there are. All lanes must call it.
  __device__ int take(const Splat<F, float>* splats_in, const TileList& list, int k, uint32_t word) {
    const int lane = lane_id(), count = __popc(word);
    const int behind = warp_inclusive_sum(count);  // of the words up to this lane's
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
};

/// A warp per group of a tile's pixels; C channels from `first` on.
template <class F, int C, class Layout>
__global__ void __launch_bounds__(Layout::kThreads) listed_blend_kernel(const BlendParams params, int first) {
  __shared__ ListedStage<F, C> stages[Layout::kWarps];
  ListedStage<F, C>& stage = stages[threadIdx.x / 32];
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const int tile = params.plan.tile_order[blockIdx.x / Layout::kBlocks], lane = lane_id();
  const TileList list = list_of(params.lists, params.grid, tile);
  if (list.overflow) return;
  const StatePlaces places(params.lists, list, params.grid, tile);
  const bool keep = params.transmittance && first == 0;
  const Vec2<float> p = Layout::pixel();
  const Pixel pixel(list, params.grid, p);
  MovingBlend<F, C, Layout, true> blend(pixel.inside);
  const uint32_t* words = params.reach_words + group_words<Layout>(params.lists, list, tile, Layout::group());
  const auto word_of = [&](int k) {  // this lane's of the batch that begins at k
    const int mine = k + 32 * lane;
    return mine < list.count ? words[mine / 32] : 0u;
  };
  int checkpoint = kStateChunk;  // the next one is in front of this pair
  float* to = params.checkpoints + places.first * blend.samples.kCheckpoint;
  uint32_t word = word_of(0);
  bool open = __any_sync(kAllLanes, blend.samples.open());
  for (int k0 = 0; k0 < list.count && open; k0 += kListedBatch) {
    const uint32_t next_word = word_of(k0 + kListedBatch);  // so that the next batch need not wait for memory
    const int count = stage.take(splats, list, k0, word);
    word = next_word;
    for (int from = 0; from < count && open; from += 32) {
      __syncwarp();  // all have read the splats before
      if (from + lane < count) {
        const int32_t id = stage.ids[from + lane];
        const Splat<F, float> splat = splats[id];
        stage.splats[lane] = {tile_terms(splat, list), channels_of<C>(params.channels, splat, id, first)};
      }
      __syncwarp();
      // Each step waits for the one before. What need not, the next splat and how it is seen, is made ready meanwhile.
      const int loaded = min(count - from, 32);
      TileSplat<F, C> splat = stage.splats[0];
      Vec2<float> of_pixel = transform(splat.terms.w, p, splat.terms.node[0]);
      int k = k0 + stage.places[from];
#pragma unroll 2
      for (int j = 1; j <= loaded; ++j) {
        const TileSplat<F, C> next = stage.splats[j % 32];
        const int next_place = stage.places[from + j % 32];
#pragma unroll 1
        for (; keep && checkpoint <= k; checkpoint += kStateChunk, to += blend.samples.kCheckpoint)
          blend.samples.store(to);
        blend.add(splat, of_pixel, k);
        splat = next;
        of_pixel = transform(splat.terms.w, p, splat.terms.node[0]);
        k = k0 + next_place;
      }
      open = __any_sync(kAllLanes, blend.samples.open());
    }
    __syncwarp();
  }
  blend.write(params, first, pixel);
}

}  // namespace ar::cuda
