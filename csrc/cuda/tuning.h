// A library of numbers: what was chosen by measuring, each with what it trades, and the launch bounds. Kernels,
// launches, chunk_plan.h and pair_guess.h read them. Nothing here needs CUDA's headers. Numbers of blocks that should
// fill a device are given per multiprocessor; multiprocessors() (launch.cuh) asks the device how many it has.
#pragma once

#include <initializer_list>

namespace ar::cuda {

// Devices

/// Threads that a multiprocessor can hold, by __CUDA_ARCH__; of an unknown device the least.
constexpr int resident_threads(int architecture) {
  for (int known : {800, 900, 1000, 1030}) {
    if (architecture == known) return 2048;
  }
  for (int known : {860, 870, 880, 890, 1100, 1200, 1210}) {
    if (architecture == known) return 1536;
  }
  return 1024;  // 750
}
#if defined(__CUDA_ARCH__)
inline constexpr int kArchitecture = __CUDA_ARCH__;
#else
inline constexpr int kArchitecture = 900;  // the host needs none
#endif
/// The second launch bound: the blocks `wanted` on a multiprocessor, or what fits. More blocks hide more latency, and
/// leave fewer registers to a thread.
constexpr int blocks_per_sm(int wanted, int threads, int architecture = kArchitecture) {
  const int fit = resident_threads(architecture) / threads;
  return fit < 1 ? 1 : fit < wanted ? fit : wanted;
}

// Room for pairs: pair_guess.h

/// Frames that are counted at first, and after a frame with too many pairs: each waits, and shows another view.
inline constexpr int kCountedFrames = 32, kRecountedFrames = 8;
/// Memory for each pair of the largest frame so far, against frames with too many.
inline constexpr double kRoomPerPair = 1.25;
/// With just 1, splats on the borders of patches would leave only the whole image as a patch.
inline constexpr double kRoomPerGaussian = 1.125;
/// For small scenes, whose views differ most.
inline constexpr int kReservedRoom = 1 << 16;

// Projection: project.cuh, project_vjp.cuh

/// Shared memory of a block, against a camera to load for each.
inline constexpr int kProjectThreads = 128;
/// Four times what fits: a block loads the camera once; more blocks share the Gaussians more evenly.
inline constexpr int kProjectBlocksPerSm = 32;
/// With six a thread would have 80 registers, and spill. The full camera needs all registers.
inline constexpr int kProjectVjpBlocks = 5, kFullProjectVjpBlocks = 1;
/// A warp sums splats with more pairs together: all lanes work, but on one splat after the other.
inline constexpr int kManyPairs = 64;
/// Rows that a lane loads at once: registers, against waiting.
inline constexpr int kRowsAtOnce = 4;
/// `zero_culled_grads` waits for memory while blend_vjp computes beside it. It displaces at most one block of
/// blend_vjp on a multiprocessor.
inline constexpr int kZeroThreads = 128, kZeroBlocksPerSm = 1;
/// Limits the registers of zero_culled_grads; so many blocks never run.
inline constexpr int kZeroBlocks = 16;
/// Lanes for each splat: most splats have few pairs, and more lanes would idle.
inline constexpr int kSumThreads = 256, kSumLanes = 8;
/// Rows that a lane loads at once, and loads from which a block sums a splat together.
inline constexpr int kSumRowsAtOnce = 4, kSumManyLoads = 16;

// Binning: bin.cuh

/// A block adds its histogram to that of all: fewer blocks add less often.
inline constexpr int kCountThreads = 1024, kCountBlocksPerSm = 1;
/// Keys that a thread loads at once: registers, against waiting.
inline constexpr int kCountAtOnce = 4;
/// Limits a thread to 48 registers.
inline constexpr int kEmitBlocks = 5;
/// Enough for a view with many long splats; the others end at once.
inline constexpr int kLongBlocksPerSm = 4;
/// Tiles of a block, and lanes that search for each: more lanes take fewer steps.
inline constexpr int kOffsetTiles = 16, kOffsetLanes = 8;
/// Bits of a digit, and digits, at most. A longer digit saves passes; a pass gets slower.
inline constexpr int kTileDigitBits = 8, kTileDigits = 4;

// Sorts: sort.cuh

/// A pass by digits of kBits bits.
template <int kBits> struct SortTuning {
  static constexpr bool kLong = kBits > 8;
  static constexpr int kThreads = kLong ? 512 : 256;  ///< at least one for each value of a digit
  static constexpr int kItems = kLong ? 10 : 12;      ///< of a thread: fewer blocks, against registers
  static constexpr int kBlocks = kLong ? 2 : 3;       ///< on a multiprocessor: against registers
};
/// Counts of earlier blocks that a thread loads at once.
inline constexpr int kLookBackAtOnce = 8;

// All blending

/// Blocks of 256 threads that a multiprocessor works on side by side, about. So many blocks fill a device: tiles beyond
/// the work of a single one of them are split (front_chunks() of chunk_plan.h), which changes last bits.
inline constexpr int kBlocksPerSm = 8;

// still/: samples that stay

/// Splats that a warp composites between two votes on whether any of its samples is still open.
inline constexpr int kBetweenVotes = 16;
/// Chunks of the front of a tile in small images, and the least in others. A longer front leaves less to the tail,
/// whose kernels work side by side but do more work.
inline constexpr int kShortFront = 1, kLongFront = 8;

/// Resident blocks of blend_front for lanes with `samples` samples, and of tail_through and tail_blend.
constexpr int front_blocks(int samples, bool expensive) { return samples > 1 ? 1 : expensive ? 4 : 5; }
constexpr int tail_through_blocks(int samples, bool expensive) { return samples > 1 ? 3 : expensive ? 4 : 5; }
constexpr int tail_blend_blocks(int samples) { return samples > 1 ? 3 : 4; }
/// Warps of a block of tail_sum, which share the chunks of 32 pixels: a single warp waits for memory most of the time.
inline constexpr int kTailSumWarps = 4;
/// Chunks whose numbers tail_scan and tail_sum load together.
inline constexpr int kTailLoads = 32, kTailLoadsKept = 16;

/// Warps of a block of blend_vjp, each with a chunk of its own: as few as let shared memory hold many blocks.
constexpr int vjp_warps(int samples) { return samples == 1 ? 4 : 1; }
/// Resident blocks of blend_vjp. Where lanes hold pixels in registers, a fifth block would leave each lane too few.
constexpr int vjp_blocks(int samples, bool expensive, int channels) {
  if (samples > 1) return channels == 3 ? 11 : 1;
  return channels == 3 ? 4 : expensive ? 5 : 6;
}
/// Blocks of blend_vjp per multiprocessor, which take chunks until none is left: as many as any device holds.
inline constexpr int kVjpBlocksPerSm = 16;

// channels/: groups of channels

/// Splats between two barriers of blend_groups.
inline constexpr int kGroupBatch = 128;
/// Splats between two barriers of blend_groups_vjp. Its warps do not all meet equally many of them, so more is better,
/// as long as a few blocks fit into shared memory.
constexpr int group_vjp_batch(bool small_group) { return small_group ? 64 : 32; }
/// Resident blocks of both.
constexpr int group_blocks(int samples, bool small_group) { return samples > 1 ? 2 : small_group ? 5 : 4; }

// moment/: samples that move

/// Channels that are blended at once where there are more than kFewChannels.
inline constexpr int kMovingChannels = 8;
/// Entries of a warp's list of splats that are read at a time.
constexpr int list_ahead(int cells_of_lane) { return cells_of_lane <= 2 ? 4 : 1; }
/// Threads of moving_blend that a multiprocessor should hold, by channels.
constexpr int moving_threads(int channels) { return channels == 3 ? 1024 : 0; }

/// Lists of so many pairs are cut into segments in large images, unless the share of a block (kBlocksAtOnce per
/// multiprocessor) of all pairs is larger. To cut a list takes more work than to walk it, but other blocks share it.
inline constexpr int kLongList = 4096;
inline constexpr int kListBlocksPerSm = 4;
/// Pairs of a segment. Longer segments need fewer maps, which count where there are many samples; shorter ones fill a
/// device with smaller scenes.
constexpr int segment_length(int samples, bool small_tiles) {
  return samples == 1 || small_tiles ? 256 : samples <= 4 ? 512 : 1024;
}
/// Lists of so many pairs would outlast all others in the forward pass if a warp had several of their pixels: a block
/// has a single one. With more than four samples that holds for all lists that are cut.
constexpr int longest_list(int samples) { return samples <= 4 ? 16384 : 0; }
/// The largest number of segments in large images: kSegments, and those of one pair in kPairsPerSegmented.
inline constexpr int kSegments = 4096, kPairsPerSegmented = 4;

/// Pairs that a block of filter_kernel tests at a time.
inline constexpr int kFilterPiece = 256;
/// Blocks of filter_kernel, and warps of listed_blend, per multiprocessor in large images: as many as leave most of the
/// device to moving_blend, which begins beside them as soon as all of them have begun.
inline constexpr int kFilterBlocksPerSm = 2, kListedWarpsPerSm = 8;
/// Of so many of the longest lists in small images each warp of listed_blend has one task.
inline constexpr int kLongestAtOnce = 128;
/// Warps of a block of listed_blend, which share a pixel of the longest lists.
constexpr int listed_warps(int samples) { return samples == 1 ? 1 : 4; }
/// Pairs in the queues of a warp.
inline constexpr int kQueued = 1024;

/// Threads of the backward kernels that a multiprocessor should hold: more threads have fewer registers, but waiting
/// for the samples' earlier positions costs more than a few numbers in memory. `segments`: of cut lists.
constexpr int moving_vjp_threads(int channels, int cells_of_lane, bool segments) {
  return channels > 3 ? 512 : cells_of_lane > 2 && !segments ? 768 : 1024;
}
/// Threads of segment_maps that a multiprocessor should hold.
inline constexpr int kMapThreads = 1024;
/// Earlier positions per lane that are in shared memory; more would take more from the cache than they save.
inline constexpr int kMostInShared = 8;
/// Groups of a segment for each warp of its block. With one cell, whose tiles of 8x8 pixels have two groups, a block of
/// one warp would take too long; in tiles of 4x4 pixels fewer warps were slower.
constexpr int groups_of_warp(int samples, bool small_tiles) { return samples == 1 || small_tiles ? 1 : 2; }
/// Segments whose maps chain_maps reads at once, since each of them waits for memory.
inline constexpr int kMapsAhead = 8;
/// Groups of a tile up to which their sums are added up in shared memory; with more groups they would leave room for
/// too few blocks, and are in BlendVjpParams::group_sums. Pairs between two barriers in either case.
inline constexpr int kMostSumsInside = 2;
constexpr int segment_batch(bool sums_inside) { return sums_inside ? 64 : 128; }

// Training: ssim.cu, adam.cu, activations.cu, weight.cu

inline constexpr int kSsimThreads = 256, kSsimColumns = 32;
/// Neighbouring sums of a thread: fewer loads from shared memory, against registers, of which doubles take two.
template <typename T> inline constexpr int kSsimRun = sizeof(T) == 4 ? 4 : 1;
/// A thread loads kAdamBytes of each array at once.
inline constexpr int kAdamThreads = 256, kAdamBytes = 16;
inline constexpr int kActivateThreads = 256, kWeightThreads = 128;

}  // namespace ar::cuda
