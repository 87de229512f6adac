// Kernels of blend for footprints whose samples move, for lists that are cut (cut_lists.cuh): a list for each pixel.
//
// In a small image of a large scene a tile of 8x8 pixels may have hundreds of thousands of splats, most of them smaller
// than a pixel. What takes the time is the longest sequence of splats that some sample meets one after the other. So
// the list of a tile is first filtered, all parts of it side by side, into a bit for each splat and pixel: whether it
// reaches it. Then each warp walks the splats of a few neighbouring pixels, and waits for no other. It takes those
// that reach any of them 32 at a time. Each lane goes through those of its own pixel alone, so that in one step the
// pixels of a warp composite different splats.
#pragma once

#include "cuda/blend_moving.cuh"
#include "cuda/cut_lists.cuh"
#include "cuda/launch.cuh"

namespace ar::cuda {

/// Pairs of a tile's list that a block of filter_kernel looks at at a time.
inline constexpr int kFilterPiece = 256, kFilterWords = kFilterPiece / 32;
/// Pairs whose bits a warp takes at once: a word for each lane.
inline constexpr int kListedBatch = 32 * 32;

/// A sample per lane, in blocks of a warp, since lists are uneven. The more pixels a warp has, the fewer steps it takes
/// for each of them, and the more of them wait for the longest list: in tiles with long lists, kLong, it has two. With
/// one sample all lanes of a pixel have it there, and look at as many splats at once (kShared). Elsewhere that takes
/// longer than to leave lanes without a sample (docs/performance-log.md).
template <class F, int kSide, bool kLong>
struct ListedLayout : CellLayout<1, (F::kSamples > 4 || kLong) ? 16 : 4, kSide, 1> {
  using Base = CellLayout<1, (F::kSamples > 4 || kLong) ? 16 : 4, kSide, 1>;
  static constexpr bool kShared = F::kSamples == 1 && kLong;
  __device__ static int first_sample() { return kShared ? 0 : Base::first_sample(); }
  /// This lane's place among those of its sample.
  __device__ static int ahead() { return kShared ? lane_id() % Base::kLanes : 0; }
  __device__ static bool owns() { return ahead() == 0; }
  /// The lanes of this lane's sample.
  __device__ static uint32_t sharers() {
    return ((1u << Base::kLanes) - 1) << (lane_id() / Base::kLanes * Base::kLanes);
  }
};
/// Where the bits of a pixel of a tile of kPixels pixels are: that of pair k is bit k % 32 of word k / 32. `first`: of
/// the segments of the tile's list.
template <class F, int kPixels> __device__ int64_t pixel_words(int first, const TileList& list, int pixel_number) {
  constexpr int kSegment = moving_segment(F::kSamples);
  const int segments = (list.count + kSegment - 1) / kSegment;
  return (int64_t(first) * kPixels + pixel_number * segments) * (kSegment / 32);
}

/// Bit x: the span holds x0 + x, of a row of a tile of kSide pixels that begins at x0. The differences are exact
/// wherever they decide.
template <int kSide> __device__ uint32_t row_bits(const Span<float>& span, float x0) {
  const int first = int(std::ceil(min(max(span.lo - x0, 0.0f), float(kSide))));
  const int behind = int(std::floor(min(max(span.hi - x0, -1.0f), float(kSide - 1)))) + 1;
  return ((1u << behind) - 1) & ~((1u << first) - 1);
}

/// The bits of a warp with lanes and bits exchanged: bit b of lane l becomes bit l of lane b. In step s lanes whose
/// numbers differ by s trade the bits whose numbers do.
__device__ inline uint32_t transpose_bits(uint32_t bits) {
#pragma unroll
  for (int s = 16; s > 0; s /= 2) {
    const uint32_t lower = kAllLanes / ((1u << s) + 1);  // bits b with b & s = 0
    const bool upper = lane_id() & s;
    const uint32_t others = __shfl_xor_sync(kAllLanes, bits, s), keep = upper ? ~lower : lower;
    bits = (bits & keep) | ((upper ? others >> s : others << s) & ~keep);
  }
  return bits;
}

/// A thread per pair of a list that is cut: which pixels its splat reaches.
template <class F, int kSide> __global__ void __launch_bounds__(kFilterPiece) filter_kernel(const BlendParams params) {
  wait_for_earlier_kernels();  // first: moving_blend_kernel, which does not wait, reads the plan
  let_next_kernel_begin();
  constexpr int kRowsOfWord = 32 / kSide, kPixels = kSide * kSide;
  constexpr int kPieces = moving_segment(F::kSamples) / kFilterPiece;  // of a segment
  __shared__ uint32_t words[kPixels][kFilterWords];
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const PlanState& plan = *params.plan.state;
  for (int number = blockIdx.x; number < plan.counts.segments * kPieces; number += gridDim.x) {
    const ListSegment segment(plan, params.plan.chunk_order, number / kPieces);
    const TileList list = list_of(params.lists, params.grid, segment.tile);
    const int piece = segment.index * kPieces + number % kPieces, k = piece * kFilterPiece + int(threadIdx.x);
    uint32_t reach[kPixels / 32] = {};  // a bit per pixel
    if (k < list.count) {
      const Support<float> support = support_of(splats[list.splat(k)]);
#pragma unroll
      for (int row = 0; row < kSide; ++row) {
        const float y = float(list.y0 + row);
        reach[row / kRowsOfWord] |= row_bits<kSide>(columns_of(support, y, y), float(list.x0))
                                    << row % kRowsOfWord * kSide;
      }
    }
    __syncthreads();  // all have read the words of the last piece
#pragma unroll
    for (int w = 0; w < kPixels / 32; ++w) words[32 * w + lane_id()][threadIdx.x / 32] = transpose_bits(reach[w]);
    __syncthreads();
    for (int i = threadIdx.x; i < kPixels * kFilterWords; i += kFilterPiece) {
      const int pixel = i / kFilterWords, word = i % kFilterWords;
      params.reach_words[pixel_words<F, kPixels>(segment.first(), list, pixel) + piece * kFilterWords + word] =
          words[pixel][word];
    }
  }
}

/// What a warp of up to kMostPixels pixels keeps of the splats that it is about to composite.
template <class F, int C, int kMostPixels> struct ListedStage {
  TileSplat<F, C> splats[32];
  int32_t ids[kListedBatch];
  uint16_t places[kListedBatch];    ///< of the pairs in the batch
  uint32_t words[kMostPixels][32];  ///< the batch's bits of each pixel
  uint8_t lists[kMostPixels][32];   ///< of each pixel, the splats that reach it

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

  /// Lists, for each pixel, those of the pairs [from, from + 32) of those that were taken, `count` in all, that reach
  /// it. Returns how many reach this lane's. All lanes must call it.
  template <class Layout> __device__ int list(int from, int count) {
    const int lane = lane_id(), place = from + lane < count ? places[from + lane] : 0;
    int mine = 0;
#pragma unroll
    for (int i = 0; i < Layout::kPixels; ++i) {
      const bool reaches = from + lane < count && (words[i][place / 32] >> (place % 32) & 1);
      const uint32_t reached = __ballot_sync(kAllLanes, reaches);
      if (reaches) lists[i][__popc(reached & ((1u << lane) - 1))] = uint8_t(lane);
      if (lane / Layout::kLanes == i) mine = __popc(reached);
    }
    return mine;
  }

  /// Of the pairs [from, from + 32) of those that were taken, `count` in all, those that reach this lane's pixel, in
  /// the order of take_first. All lanes must call it.
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

/// Composites the splats [from, from + 32) of those that were taken, of which `n` reach the pixels of this lane, into
/// samples that several lanes have; k0: the first pair of the batch. Most splats that reach a pixel do not show in a
/// sample, since they are small: the lanes of a sample look at as many splats at once, and composite the first that
/// shows. Then those behind it are looked at again, since the node has moved. `store(k)` leaves the checkpoints up to
/// pair k.
template <class F, int C, class Layout, bool kKeep, class Blend, class Stage, class Store>
__device__ void blend_ahead(const Stage& stage, int k0, int from, int n, Blend& blend, Store&& store) {
  const int pixel = lane_id() / Layout::kLanes;
  const uint32_t sharers = Layout::sharers();
  float& transmittance = blend.samples.transmittance[0];
  Vec2<float>& place = blend.samples.place[0];
  int next = Layout::ahead();  // of the pixel's list, for this lane
  TileSplat<F, C> splat;
  int k = 0;
  bool live = false;  // there is such a splat, and none behind it was composited
  const auto take = [&] {
    live = next < n && transmittance > 0;
    if (!live) return;
    const int j = stage.lists[pixel][next];
    splat = stage.splats[j];
    k = k0 + stage.places[from + j];
  };
  take();
  while (__any_sync(kAllLanes, live)) {
    float raw = 0;
    Vec2<float> z = {0, 0};
    if (live) {
      z = blend.corners.node(splat.terms, 0, place);
      raw = exp2(F::log_alpha(splat.terms, z));
    }
    const bool hit = raw >= float(kAlphaMin);
    const uint32_t hits = __ballot_sync(kAllLanes, hit) & sharers;
    const int first = hits ? __ffs(int(hits)) - 1 : lane_id();
    float behind = transmittance;
    Vec2<float> moved = place;
    if (hit) {
      const Blended<float> b = blend_placed_sample<F>(splat.terms, z, raw, UnitCell<F::kSide>(), behind, moved);
      if (first == lane_id()) blend.add(b, splat.channels, k);
    }
    const int pair = kKeep ? shuffle(k, first) : 0;
    if (kKeep && hits) store(pair);
    transmittance = shuffle(behind, first);
    place = {shuffle(moved.x, first), shuffle(moved.y, first)};
    live = live && hits != 0 && lane_id() > first && transmittance > 0;
    if (hits == 0 || first % Layout::kLanes == Layout::kLanes - 1) {
      next += Layout::kLanes;
      take();
    }
  }
}

/// Blends the pixels of a warp, as Layout shares them out; C channels from `first` on. `first_segment`: of the list.
template <class F, int C, class Layout, bool kKeep, class Stage>
__device__ void blend_listed(const BlendParams& params, int first, int tile, const TileList& list, int first_segment,
                             Stage& stage) {
  constexpr int kPixels = Layout::kPixels;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const int lane = lane_id();
  const StatePlaces places(params.lists, list, params.grid, tile);
  const Vec2<float> p = Layout::pixel();
  const Pixel pixel(list, params.grid, p);
  MovingBlend<F, C, Layout, kKeep, true> blend(p, pixel.inside);
  uint32_t words[kPixels];              // of each pixel, this lane's of a batch
  const auto read_words = [&](int k) {  // of the batch that begins at k
    const int mine = k + 32 * lane;
#pragma unroll
    for (int i = 0; i < kPixels; ++i) {
      const uint32_t* from =
          params.reach_words + pixel_words<F, Layout::kTilePixels>(first_segment, list, Layout::pixel_number(i));
      words[i] = mine < list.count ? from[mine / 32] : 0u;
    }
  };
  int checkpoint = kStateChunk;  // the next one is in front of this pair
  float* to = params.checkpoints + places.first * blend.samples.kCheckpoint;
  const auto store_up_to = [&](int k) {
#pragma unroll 1
    for (; kKeep && checkpoint <= k; checkpoint += kStateChunk, to += blend.samples.kCheckpoint)
      blend.samples.store(to);
  };
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
        stage.splats[lane] = {cell_terms(splat, list), channels_of<C>(params.channels, splat, id, first)};
      }
      if constexpr (Layout::kShared) {
        const int n = stage.template list<Layout>(from, count);
        __syncwarp();
        blend_ahead<F, C, Layout, kKeep>(stage, k0, from, n, blend, store_up_to);
        open = __ballot_sync(kAllLanes, blend.samples.open());
        continue;
      }
      uint32_t left = stage.template reached<Layout>(from, count);
      if (!blend.samples.open()) left = 0;
      __syncwarp();
      // Each step waits for the one before. The next splat, which need not, is read meanwhile.
      int j = __clz(int(left)) % 32;
      TileSplat<F, C> splat = stage.splats[j];
      int k = k0 + stage.places[from + j];
      while (left != 0) {
        left ^= 1u << (31 - j);
        j = __clz(int(left)) % 32;
        const TileSplat<F, C> next = stage.splats[j];
        const int next_place = stage.places[from + j];
        store_up_to(k);
        blend.add(splat, k + 1, blend.last);
        splat = next;
        k = k0 + next_place;
      }
      open = __ballot_sync(kAllLanes, blend.samples.open());
    }
    __syncwarp();
  }
  if (Layout::kShared && kKeep) {
#pragma unroll
    for (int offset = 1; offset < Layout::kLanes; offset *= 2)
      blend.last[0] = max(blend.last[0], __shfl_xor_sync(kAllLanes, blend.last[0], offset));
  }
  blend.write(params, first, pixel);
}

/// In large images, blocks of filter_kernel and warps of listed_blend_kernel: as many as leave most of a large device
/// to the kernel that is to begin beside them, which only does when all of them have begun.
inline constexpr int kFilterBlocks = 264, kListedWarps = 1056;
/// Blocks of listed_blend_kernel for each tile.
template <class F, int kSide> inline constexpr int kListedBlocks = ListedLayout<F, kSide, true>::kBlocks;

/// A warp per few pixels of a tile whose list is cut; where it is not kLongFrom pairs long, only the first blocks of a
/// tile have any. There may be blocks for fewer tiles than are blended.
template <class F, int C, int kSide, bool kKeep, int kLongFrom = kLongList>
__global__ void __launch_bounds__(32) listed_blend_kernel(const BlendParams params, int first) {
  let_next_kernel_begin();  // so that moving_blend_kernel does not wait for filter_kernel either
  wait_for_earlier_kernels();
  using Short = ListedLayout<F, kSide, false>;
  using Long = ListedLayout<F, kSide, true>;
  static_assert(Short::kThreads == 32 && Long::kThreads == 32 && Long::kBlocks % Short::kBlocks == 0);
  __shared__ ListedStage<F, C, Short::kPixels> stage;
  const int lists = params.plan.state->counts.cut_lists;
  for (int place = int(blockIdx.x) / Long::kBlocks; place < lists; place += int(gridDim.x) / Long::kBlocks) {
    const CutList cut = params.plan.cut_lists[place];
    const TileList list = list_of(params.lists, params.grid, cut.tile);
    if constexpr (Short::kLanes != Long::kLanes) {
      if (list.count < kLongFrom) {
        if (int(blockIdx.x) % Long::kBlocks < Short::kBlocks)
          blend_listed<F, C, Short, kKeep>(params, first, cut.tile, list, cut.first, stage);
        continue;
      }
    }
    blend_listed<F, C, Long, kKeep>(params, first, cut.tile, list, cut.first, stage);
  }
}

}  // namespace ar::cuda
