// Kernels filter and listed_blend: the forward pass of footprints whose samples move, for lists that are cut
// (cut_lists.h). blend_moment (blend.cu) launches them before moving_blend.
//
// In a small image of a large scene a tile may have hundreds of thousands of splats, most of them smaller than a pixel.
// The time is that of the longest sequence of splats that some sample meets. So filter_kernel first tests all pairs of
// a list side by side, and writes a bit for each pair and pixel (reach_words). Then listed_blend_kernel has a warp for
// a few neighbouring pixels: either each pixel takes its own splats from a queue (queue.cuh), or the warp walks the
// splats that reach any of its pixels, and each lane composites only the ones of its own pixel.
#pragma once

#include "cuda/launch.cuh"
#include "cuda/moment/queue.cuh"

namespace ar::cuda {

inline constexpr int kFilterWords = kFilterPiece / 32;
/// Pairs whose bits a warp reads at once: a word for each lane.
inline constexpr int kListedBatch = 32 * 32;

/// Bit x: the span holds pixel x0 + x of a row of kSide pixels. The differences are exact wherever they decide.
template <int kSide> __device__ uint32_t row_bits(const Span<float>& span, float x0) {
  const int first = int(std::ceil(min(max(span.lo - x0, 0.0f), float(kSide))));
  const int end = int(std::floor(min(max(span.hi - x0, -1.0f), float(kSide - 1)))) + 1;
  return ((1u << end) - 1) & ~((1u << first) - 1);
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

/// A thread per pair of a list that is cut: writes to reach_words which pixels of the tile its splat reaches.
template <class F, int kSide> __global__ void __launch_bounds__(kFilterPiece) filter_kernel(const BlendParams params) {
  wait_for_earlier_kernels();  // first: moving_blend_kernel, which does not wait, reads the plan
  let_next_kernel_begin();
  constexpr int kRowsOfWord = 32 / kSide, kPixels = kSide * kSide, kWords = (kPixels + 31) / 32;
  constexpr int kPieces = moving_segment(F::kSamples, kSide) / kFilterPiece;  // of a segment
  __shared__ uint32_t words[kPixels][kFilterWords];
  const PlanState& plan = *params.plan.state;
  for (int number = blockIdx.x; number < plan.counts.segments * kPieces; number += gridDim.x) {
    const ListSegment segment(plan, params.plan.chunk_order, number / kPieces);
    const TileList list = list_of(params.lists, params.grid, segment.tile);
    const int piece = segment.index * kPieces + number % kPieces, k = piece * kFilterPiece + int(threadIdx.x);
    uint32_t reach[kWords] = {};  // a bit per pixel
    if (k < list.count) {
      const Support<float> support = support_of(load_splat<F>(params.splats, list.splat(k)));
#pragma unroll
      for (int row = 0; row < kSide; ++row) {
        const float y = float(list.y0 + row);
        reach[row / kRowsOfWord] |= row_bits<kSide>(columns_of(support, y, y), float(list.x0))
                                    << row % kRowsOfWord * kSide;
      }
    }
    __syncthreads();  // all have read the words of the last piece
#pragma unroll
    for (int w = 0; w < kWords; ++w) {
      const uint32_t of_pixel = transpose_bits(reach[w]);
      if (kPixels % 32 == 0 || lane_id() < kPixels) words[32 * w + lane_id()][threadIdx.x / 32] = of_pixel;
    }
    __syncthreads();
    for (int i = threadIdx.x; i < kPixels * kFilterWords; i += kFilterPiece) {
      const int pixel = i / kFilterWords, word = i % kFilterWords;
      params.reach_words[pixel_words<F, kSide>(segment.first(), list, pixel) + piece * kFilterWords + word] =
          words[pixel][word];
    }
  }
}

/// The splats that a warp of up to kMostPixels pixels is about to composite, in shared memory.
template <class F, int C, int kMostPixels> struct ListedStage {
  TileSplat<F, C> splats[32];
  int32_t ids[kListedBatch];
  uint16_t numbers[kListedBatch];   ///< of the pairs in the batch
  uint32_t words[kMostPixels][32];  ///< the batch's bits of each pixel

  /// Lists the pairs of a batch that reach any pixel, from `words`, and returns their number. The batch begins at pair
  /// k. All lanes must call it.
  template <class Layout> __device__ int collect(const float* splats_in, const TileList& list, int k) {
    const int lane = lane_id();
    uint32_t word = 0;
#pragma unroll
    for (int i = 0; i < Layout::kPixels; ++i) word |= words[i][lane];
    const int count = __popc(word), up_to = warp_inclusive_sum(count);  // of the words up to this lane's
    int to = up_to - count;
    for (; word != 0; word &= word - 1) numbers[to++] = uint16_t(32 * lane + __ffs(word) - 1);
    const int all = __shfl_sync(kAllLanes, up_to, 31);
    __syncwarp();
#pragma unroll 4
    for (int i = lane; i < all; i += 32) {
      const int32_t id = list.splat(k + numbers[i]);
      ids[i] = id;
      prefetch_splat(splats_in, id);
    }
    return all;
  }

  /// Which of the collected pairs in [from, from + 32), `count` in all, reach this lane's pixel, in the order of
  /// take_first. All lanes must call it.
  template <class Layout> __device__ uint32_t reached(int from, int count) const {
    const int lane = 31 - lane_id(), number = from + lane < count ? numbers[from + lane] : 0;
    uint32_t mine = 0;
#pragma unroll
    for (int i = 0; i < Layout::kPixels; ++i) {
      const bool reaches = from + lane < count && (words[i][number / 32] >> (number % 32) & 1);
      const uint32_t reached = __ballot_sync(kAllLanes, reaches);
      if (lane_id() / Layout::kLanes == i) mine = reached;
    }
    return mine;
  }
};

/// Blends the pixels of a warp, as Layout shares them out, by walking the splats that reach any of them; C channels
/// from `first` on. `first_segment`: the number of the list's first segment. `kKeep`, `kSegment`: as in blend_queued.
template <class F, int C, class Layout, bool kKeep, int kSegment, class Stage>
__device__ void blend_listed(const BlendParams& params, int first, const CutList& cut, const TileList& list,
                             Stage& stage) {
  constexpr int kPixels = Layout::kPixels;
  const int lane = lane_id();
  const TileCheckpoints tile_checkpoints(params.lists, list, params.grid, cut.tile);
  MovingBlend<F, C, Layout, kKeep, true> blend(list, params.grid);
  uint32_t words[kPixels];              // of each pixel, this lane's of a batch
  const auto read_words = [&](int k) {  // of the batch that begins at k
    const int mine = k + 32 * lane;
#pragma unroll
    for (int i = 0; i < kPixels; ++i) {
      const uint32_t* from =
          params.reach_words + pixel_words<F, Layout::kSide>(cut.first, list, Layout::pixel_number(i));
      words[i] = mine < list.count ? from[mine / 32] : 0u;
    }
  };
  CheckpointsAhead<kSegment> checkpoints = {kStateChunk,
                                            params.checkpoints + tile_checkpoints.first * blend.samples.kCheckpoint};
  read_words(0);
  uint32_t open = __ballot_sync(kAllLanes, blend.samples.open());
  for (int k0 = 0; k0 < list.count && open; k0 += kListedBatch) {
#pragma unroll
    for (int i = 0; i < kPixels; ++i) {
      constexpr uint32_t kFirst = kAllLanes >> (32 - Layout::kLanes);  // lanes of the first pixel
      stage.words[i][lane] = open & kFirst << (i * Layout::kLanes) ? words[i] : 0u;
    }
    read_words(k0 + kListedBatch);  // so that the next batch need not wait for memory
    const int count = stage.template collect<Layout>(params.splats, list, k0);
    for (int from = 0; from < count && open; from += 32) {
      __syncwarp();  // all have read the splats before
      if (from + lane < count) {
        const int32_t id = stage.ids[from + lane];
        const Splat<F, float> splat = load_splat<F>(params.splats, id);
        stage.splats[lane] = {cell_terms(splat, list), channels_of<C>(params.channels, splat, id, first)};
      }
      uint32_t left = stage.template reached<Layout>(from, count);
      if (!blend.samples.open()) left = 0;
      __syncwarp();
      // Each step waits for the one before. The next splat, which need not, is read meanwhile.
      int j = __clz(int(left)) % 32;
      TileSplat<F, C> splat = stage.splats[j];
      int k = k0 + stage.numbers[from + j];
      while (left != 0) {
        left ^= 1u << (31 - j);
        j = __clz(int(left)) % 32;
        const TileSplat<F, C> next = stage.splats[j];
        const int next_number = stage.numbers[from + j];
        if (kKeep) checkpoints.store_up_to(k, blend.samples);
        blend.add(splat, k + 1, blend.last);
        splat = next;
        k = k0 + next_number;
      }
      open = __ballot_sync(kAllLanes, blend.samples.open());
    }
    __syncwarp();
  }
  blend.write(params, first);
}

template <class F> inline constexpr int kListedWarps = listed_warps(F::kSamples);

/// How the pixels of a tile are shared out among warps. The quickest of these layouts was found by measurement
/// (docs/performance-log.md, "`moment`: a queue for each pixel" and "`moment`: small tiles, and pixels of four warps").
template <class F, int kSide> struct ListedLayouts {
  static constexpr int kWarps = kListedWarps<F>;
  using Longest = AheadLayout<F, kSide, 1, kWarps>;
  /// Other lists: with one sample they have queues too, with four they are walked, with more there are none.
  static constexpr bool kAhead = F::kSamples == 1, kWalked = F::kSamples == 4;
  using Ahead = AheadLayout<F, kSide, 2>;
  using Long = CellLayout<1, 16, kSide, kWarps>;  ///< from kLongList pairs on
  using Short = CellLayout<1, kWalked ? 4 : 16, kSide, kWarps>;
  /// Blocks of a list. The first blocks of a short list have its pixels.
  static constexpr int kOfLongest = Longest::kBlocks, kOfOthers = Long::kBlocks;
  static_assert(kOfLongest % kOfOthers == 0 && kOfOthers % Short::kBlocks == 0);

  /// Blocks to launch: a multiple of the blocks of one of the longest lists, so that a block has the same pixels in
  /// every tile that it goes on to. In small images moving_blend has little to do, and they need not leave it any room.
  static unsigned blocks(const ListCut& cut, TileGrid grid, int multiprocessors) {
    const int64_t longest = std::min(cut.max_lists, kLongestAtOnce), lists = cut.max_lists;
    const int64_t wanted =
        is_small_image(grid) ? longest * kOfLongest + lists * kOfOthers : kListedWarpsPerSm * multiprocessors / kWarps;
    const int64_t blocks = std::min(wanted, lists * kOfLongest);
    return unsigned((blocks + kOfLongest - 1) / kOfLongest * kOfLongest);
  }
};

/// The splats that a warp is about to composite, in shared memory.
template <class F, int C, int kSide> union WarpStage {
  using Layouts = ListedLayouts<F, kSide>;
  QueuedStage<F, C> queued;
  std::conditional_t<Layouts::kWalked, ListedStage<F, C, Layouts::Short::kPixels>, char> listed;
};

/// A warp per few pixels of a tile whose list is cut, or a block per pixel of the longest lists, which come first.
/// Blends the C channels from `first` on. `kKeep`: stores checkpoints and `last`; `kSegment`: pairs of a segment.
template <class F, int C, int kSide, bool kKeep, int kSegment = moving_segment(F::kSamples, kSide)>
__global__ void __launch_bounds__(32 * kListedWarps<F>) listed_blend_kernel(const BlendParams params, int first) {
  let_next_kernel_begin();  // so that moving_blend_kernel does not wait for filter_kernel either
  wait_for_earlier_kernels();
  using Layouts = ListedLayouts<F, kSide>;
  __shared__ WarpStage<F, C, kSide> stages[Layouts::kWarps];
  WarpStage<F, C, kSide>& stage = stages[threadIdx.x / 32];
  const PlanCounts& counts = params.plan.state->counts;
  const int longest = counts.longest_lists, of_longest = longest * Layouts::kOfLongest;
  const int blocks = of_longest + (counts.cut_lists - longest) * Layouts::kOfOthers;
  for (int block = blockIdx.x; block < blocks; block += gridDim.x) {
    const bool is_longest = block < of_longest;
    const int index = is_longest ? block / Layouts::kOfLongest : longest + (block - of_longest) / Layouts::kOfOthers;
    const CutList cut = params.plan.cut_lists[index];
    const TileList list = list_of(params.lists, params.grid, cut.tile);
    if (is_longest) {
      blend_queued<F, C, typename Layouts::Longest, kKeep, kSegment>(params, first, cut, list, stage.queued);
    } else if constexpr (Layouts::kAhead) {
      blend_queued<F, C, typename Layouts::Ahead, kKeep, kSegment>(params, first, cut, list, stage.queued);
    } else if constexpr (Layouts::kWalked) {
      if (list.count >= kLongList) {
        blend_listed<F, C, typename Layouts::Long, kKeep, kSegment>(params, first, cut, list, stage.listed);
      } else if (block % Layouts::kOfOthers < Layouts::Short::kBlocks) {
        blend_listed<F, C, typename Layouts::Short, kKeep, kSegment>(params, first, cut, list, stage.listed);
      }
    }
  }
}

}  // namespace ar::cuda
