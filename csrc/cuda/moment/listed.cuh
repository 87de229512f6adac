// Kernels filter and listed_blend: the forward pass for lists that are cut into segments. A tile may have hundreds of
// thousands of splats, most smaller than a pixel. So `filter` writes to reach_words which pairs reach which pixels.
// `listed_blend` composites in a pixel only these, from a queue (queue.cuh), or walks those that reach any of a warp's
// few pixels. It writes what moving_blend does; segment_maps stores the checkpoints within later segments.
#pragma once

#include "cuda/launch.cuh"
#include "cuda/moment/queue.cuh"

namespace ar::cuda {

inline constexpr int kFilterWords = MomentPolicy::kFilterPiece / 32;
/// Pairs whose bits a warp reads at once.
inline constexpr int kListedBatch = 32 * 32;

/// Bit x: the span holds pixel x0 + x. The differences are exact wherever they decide.
template <int kSide> __device__ uint32_t row_bits(const Span<float>& span, float x0) {
  const int first = int(std::ceil(min(max(span.lo - x0, 0.0f), float(kSide))));
  const int end = int(std::floor(min(max(span.hi - x0, -1.0f), float(kSide - 1)))) + 1;
  return ((1u << end) - 1) & ~((1u << first) - 1);
}

/// Bit b of lane l becomes bit l of lane b.
__device__ inline uint32_t transpose_bits(uint32_t bits) {
  AR_UNROLL for (int s = 16; s > 0; s /= 2) {
    const uint32_t lower = kAllLanes / ((1u << s) + 1);  // bits b with b & s = 0
    const bool upper = lane_id() & s;
    const uint32_t others = __shfl_xor_sync(kAllLanes, bits, s), keep = upper ? ~lower : lower;
    bits = (bits & keep) | ((upper ? others >> s : others << s) & ~keep);
  }
  return bits;
}

/// A thread tests a pair. reach_words: as pixel_words() says.
template <class F, int kSide>
__global__ void __launch_bounds__(MomentPolicy::kFilterPiece) filter_kernel(const BlendParams params) {
  wait_for_earlier_kernels();  // first: moving_blend_kernel reads the plan
  let_next_kernel_begin();
  constexpr int kPiece = MomentPolicy::kFilterPiece;
  constexpr int kRowsOfWord = 32 / kSide, kPixels = kSide * kSide, kWords = (kPixels + 31) / 32;
  constexpr int kPieces = moving_segment(F::kSamples, kSide) / kPiece;  // of a segment
  __shared__ uint32_t words[kPixels][kFilterWords];
  const PlanState& plan = *params.plan.state;
  for (int number = blockIdx.x; number < plan.counts.segments * kPieces; number += gridDim.x) {
    const ListSegment segment(plan, params.plan.chunk_order, number / kPieces);
    const TileList list = list_of(params.lists, params.grid, segment.tile);
    const int piece = segment.index * kPieces + number % kPieces, k = piece * kPiece + int(threadIdx.x);
    uint32_t reach[kWords] = {};
    if (k < list.count) {
      const Support<float> support = support_of(load_splat<F>(params.splats, list.splat(k)));
      AR_UNROLL for (int row = 0; row < kSide; ++row) {
        const float y = float(list.y0 + row);
        reach[row / kRowsOfWord] |= row_bits<kSide>(columns_of(support, y, y), float(list.x0))
                                    << row % kRowsOfWord * kSide;
      }
    }
    __syncthreads();  // all have read the last words
    AR_UNROLL for (int w = 0; w < kWords; ++w) {
      const uint32_t of_pixel = transpose_bits(reach[w]);
      if (kPixels % 32 == 0 || lane_id() < kPixels) words[32 * w + lane_id()][threadIdx.x / 32] = of_pixel;
    }
    __syncthreads();
    for (int i = threadIdx.x; i < kPixels * kFilterWords; i += kPiece) {
      const int pixel = i / kFilterWords, word = i % kFilterWords;
      params.reach_words[pixel_words<F, kSide>(segment.first(), list, pixel) + piece * kFilterWords + word] =
          words[pixel][word];
    }
  }
}

template <class F, int C, int kMostPixels> struct ListedStage {
  TileSplat<F, C> splats[32];
  int32_t ids[kListedBatch];
  uint16_t numbers[kListedBatch];  ///< in the batch
  uint32_t words[kMostPixels][32];

  /// Pairs of the batch from pair k on that reach any pixel.
  template <class Layout> __device__ int collect(const float* splats_in, const TileList& list, int k) {
    const int lane = lane_id();
    uint32_t word = 0;
    AR_UNROLL for (int i = 0; i < Layout::kPixels; ++i) word |= words[i][lane];
    const int count = __popc(word), up_to = warp_inclusive_sum(count);
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

  /// Which of the `count` pairs, from `from` on, reach this lane's pixel, for take_first.
  template <class Layout> __device__ uint32_t reached(int from, int count) const {
    const int lane = 31 - lane_id(), number = from + lane < count ? numbers[from + lane] : 0;
    uint32_t mine = 0;
    AR_UNROLL for (int i = 0; i < Layout::kPixels; ++i) {
      const bool reaches = from + lane < count && (words[i][number / 32] >> (number % 32) & 1);
      const uint32_t reached = __ballot_sync(kAllLanes, reaches);
      if (lane_id() / Layout::kLanes == i) mine = reached;
    }
    return mine;
  }
};

template <class F, int C, class Layout, bool kKeep, int kSegment, class Stage>
__device__ void blend_listed(const BlendParams& params, int first, const CutList& cut, const TileList& list,
                             Stage& stage) {
  constexpr int kPixels = Layout::kPixels;
  const int lane = lane_id();
  const TileCheckpoints stored(params.lists, list, params.grid, cut.tile);
  MovingBlend<F, C, Layout, kKeep, true> blend(list, params.grid);
  uint32_t words[kPixels];
  const auto read_words = [&](int k) {
    const int mine = k + 32 * lane;
    AR_UNROLL for (int i = 0; i < kPixels; ++i) {
      const uint32_t* from =
          params.reach_words + pixel_words<F, Layout::kSide>(cut.first, list, Layout::pixel_number(i));
      words[i] = mine < list.count ? from[mine / 32] : 0u;
    }
  };
  CheckpointsAhead<kSegment> checkpoints = {kStateChunk, params.checkpoints + stored.first * blend.samples.kCheckpoint};
  read_words(0);
  uint32_t open = __ballot_sync(kAllLanes, blend.samples.open());
  for (int k0 = 0; k0 < list.count && open; k0 += kListedBatch) {
    AR_UNROLL for (int i = 0; i < kPixels; ++i) {
      constexpr uint32_t kFirst = kAllLanes >> (32 - Layout::kLanes);
      stage.words[i][lane] = open & kFirst << (i * Layout::kLanes) ? words[i] : 0u;
    }
    read_words(k0 + kListedBatch);
    const int count = stage.template collect<Layout>(params.splats, list, k0);
    for (int from = 0; from < count && open; from += 32) {
      __syncwarp();  // all have read the last splats
      if (from + lane < count) {
        const int32_t id = stage.ids[from + lane];
        const Splat<F, float> splat = load_splat<F>(params.splats, id);
        stage.splats[lane] = {cell_terms(splat, list), channels_of<C>(params.channels, splat, id, first)};
      }
      uint32_t left = stage.template reached<Layout>(from, count);
      if (!blend.samples.open()) left = 0;
      __syncwarp();
      // While a step waits for the one before, the next splat is read.
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

template <class F> inline constexpr int kListedWarps = MomentPolicy::listed_warps(F::kSamples);

/// How pixels are spread over warps, as measured: docs/internals/log.md, "The queue" and "Tiles and the longest lists".
template <class F, int kSide> struct ListedLayouts {
  static constexpr int kWarps = kListedWarps<F>;
  using Longest = AheadLayout<F, kSide, 1, kWarps>;
  /// Not for the longest lists: queues with one sample, walks with four. With more there are no such lists.
  static constexpr bool kAhead = F::kSamples == 1, kWalked = F::kSamples == 4;
  using Ahead = AheadLayout<F, kSide, 2>;
  using Long = CellLayout<1, 16, kSide, kWarps>;  ///< from kLongList pairs on
  using Short = CellLayout<1, kWalked ? 4 : 16, kSide, kWarps>;
  /// Of a list; a short list needs fewer.
  static constexpr int kOfLongest = Longest::kBlocks, kOfOthers = Long::kBlocks;
  static_assert(kOfLongest % kOfOthers == 0 && kOfOthers % Short::kBlocks == 0);

  /// A multiple of kOfLongest: a block has the same pixels in each of its tiles.
  static unsigned blocks(const ListCut& cut, TileGrid grid, int multiprocessors) {
    const int64_t longest = std::min(cut.max_lists, MomentPolicy::kLongestAtOnce), lists = cut.max_lists;
    const int64_t wanted = is_small_image(grid) ? longest * kOfLongest + lists * kOfOthers
                                                : MomentPolicy::kListedWarpsPerSm * multiprocessors / kWarps;
    const int64_t blocks = std::min(wanted, lists * kOfLongest);
    return unsigned((blocks + kOfLongest - 1) / kOfLongest * kOfLongest);
  }
};

template <class F, int C, int kSide> union WarpStage {
  using Layouts = ListedLayouts<F, kSide>;
  QueuedStage<F, C> queued;
  std::conditional_t<Layouts::kWalked, ListedStage<F, C, Layouts::Short::kPixels>, char> listed;
};

/// A block has a pixel of a longest list, which come first, or each warp a few pixels of another. Writes the channels
/// [first, first + C).
template <class F, int C, int kSide, bool kKeep, int kSegment = moving_segment(F::kSamples, kSide)>
__global__ void __launch_bounds__(32 * kListedWarps<F>) listed_blend_kernel(const BlendParams params, int first) {
  let_next_kernel_begin();  // moving_blend_kernel need not wait for filter_kernel
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
      if (list.count >= MomentPolicy::kLongList) {
        blend_listed<F, C, typename Layouts::Long, kKeep, kSegment>(params, first, cut, list, stage.listed);
      } else if (block % Layouts::kOfOthers < Layouts::Short::kBlocks) {
        blend_listed<F, C, typename Layouts::Short, kKeep, kSegment>(params, first, cut, list, stage.listed);
      }
    }
  }
}

}  // namespace ar::cuda
