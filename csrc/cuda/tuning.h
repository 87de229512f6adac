// A library of numbers that were chosen by measuring, with what they trade, and of launch bounds. Kernels, launches,
// chunk_plan.h and pair_guess.h read them.
#pragma once

#include <initializer_list>

namespace ar::cuda {

// Devices

/// Threads that a multiprocessor can hold, by __CUDA_ARCH__.
constexpr int resident_threads(int architecture) {
  for (int known : {800, 900, 1000, 1030}) {
    if (architecture == known) return 2048;
  }
  for (int known : {860, 870, 880, 890, 1100, 1200, 1210}) {
    if (architecture == known) return 1536;
  }
  return 1024;  // 750; the least, for unknown devices
}
#if defined(__CUDA_ARCH__)
inline constexpr int kArchitecture = __CUDA_ARCH__;
#else
inline constexpr int kArchitecture = 900;  // the host needs none
#endif
/// The second launch bound: `wanted` resident blocks, or what fits. More blocks hide more latency, with fewer
/// registers.
constexpr int blocks_per_sm(int wanted, int threads, int architecture = kArchitecture) {
  const int fit = resident_threads(architecture) / threads;
  return fit < 1 ? 1 : fit < wanted ? fit : wanted;
}

// Room for pairs: pair_guess.h

/// Frames that are counted, which waits: at first, and after too many pairs.
inline constexpr int kCountedFrames = 32, kRecountedFrames = 8;
/// Per pair of the largest frame so far: memory against frames with too many pairs.
inline constexpr double kRoomPerPair = 1.25;
/// For splats on borders of patches.
inline constexpr double kRoomPerGaussian = 1.125;
/// For small scenes, whose views differ most.
inline constexpr int kReservedRoom = 1 << 16;

// Projection: project.cuh, project_vjp.cuh

/// Shared memory against loads of the camera.
inline constexpr int kProjectThreads = 128;
/// Loads of the camera against an even share of Gaussians.
inline constexpr int kProjectBlocksPerSm = 32;
/// With six blocks a thread would have 80 registers, and spill. The full camera has 168 with three, and spills
/// little; the models of lenses would take more.
inline constexpr int kProjectVjpBlocks = 5, kFullProjectVjpBlocks = 3;
/// A whole warp sums splats with more pairs.
inline constexpr int kManyPairs = 64;
/// Rows that a lane loads at once: registers against waiting.
inline constexpr int kRowsAtOnce = 4;
/// zero_culled_grads takes the room of one block of blend_vjp, which computes beside it.
inline constexpr int kZeroThreads = 128, kZeroBlocksPerSm = 1;
/// Only limits the registers of zero_culled_grads.
inline constexpr int kZeroBlocks = 16;
/// Lanes per splat: most splats have few pairs.
inline constexpr int kSumThreads = 256, kSumLanes = 8;
/// Rows that a lane loads at once, and loads of a lane from which on a block sums a splat.
inline constexpr int kSumRowsAtOnce = 4, kSumManyLoads = 16;

// Binning: bin.cuh

/// Few blocks, because each adds a histogram.
inline constexpr int kCountThreads = 1024, kCountBlocksPerSm = 1;
/// Keys that a thread loads at once: registers against waiting.
inline constexpr int kCountAtOnce = 4;
/// Limits a thread to 48 registers.
inline constexpr int kEmitBlocks = 5;
/// Enough for many long splats.
inline constexpr int kLongBlocksPerSm = 4;
/// Tiles of a block, and lanes that search for each.
inline constexpr int kOffsetTiles = 16, kOffsetLanes = 8;
/// Most bits of a digit, and most digits: fewer passes, or faster ones.
inline constexpr int kTileDigitBits = 8, kTileDigits = 4;

// Sorts: sort.cuh

/// A pass by digits of kBits bits.
template <int kBits> struct SortTuning {
  static constexpr bool kLong = kBits > 8;
  static constexpr int kThreads = kLong ? 512 : 256;  ///< at least one for each value of a digit
  static constexpr int kItems = kLong ? 10 : 12;      ///< per thread: fewer blocks against registers
  static constexpr int kBlocks = kLong ? 2 : 3;       ///< resident, against registers
};
/// Counts of earlier blocks that a thread loads at once.
inline constexpr int kLookBackAtOnce = 8;

// All blending

/// Blocks of 256 threads that fill a multiprocessor. Last bits depend on it, by front_chunks().
inline constexpr int kBlocksPerSm = 8;

// still/: samples that stay

/// Splats between two votes on whether any sample is open.
inline constexpr int kBetweenVotes = 16;
/// Chunks of the front in small images, and the least in others. The tail takes more work, which blocks share.
inline constexpr int kShortFront = 1, kLongFront = 8;

/// Resident blocks of blend_front, tail_through and tail_blend; `samples`: of a lane.
constexpr int front_blocks(int samples, bool expensive) { return samples > 1 ? 1 : expensive ? 4 : 5; }
constexpr int tail_through_blocks(int samples, bool expensive) { return samples > 1 ? 3 : expensive ? 4 : 5; }
constexpr int tail_blend_blocks(int samples) { return samples > 1 ? 3 : 4; }
/// Warps of tail_sum that share the chunks of 32 pixels.
inline constexpr int kTailSumWarps = 4;
/// Chunks whose numbers tail_scan and tail_sum load together.
inline constexpr int kTailLoads = 32, kTailLoadsKept = 16;

/// Warps of a block of blend_vjp: few, against shared memory.
constexpr int vjp_warps(int samples) { return samples == 1 ? 4 : 1; }
/// Resident blocks of blend_vjp. Three channels need registers, of which a fifth block leaves too few.
constexpr int vjp_blocks(int samples, bool expensive, int channels) {
  if (samples > 1) return channels == 3 ? 11 : 1;
  return channels == 3 ? 4 : expensive ? 5 : 6;
}
/// No device holds more.
inline constexpr int kVjpBlocksPerSm = 16;

// channels/: groups of channels

/// Splats between two barriers of blend_groups.
inline constexpr int kGroupBatch = 128;
/// Of blend_groups_vjp: more splats balance its warps, against shared memory.
constexpr int group_vjp_batch(bool small_group) { return small_group ? 64 : 32; }
/// Resident blocks of both.
constexpr int group_blocks(int samples, bool small_group) { return samples > 1 ? 2 : small_group ? 5 : 4; }

// moment/: samples that move

/// Channels that are blended at once where there are more than kFewChannels.
inline constexpr int kMovingChannels = 8;
/// Entries of a warp's list of splats that are read at once.
constexpr int list_ahead(int cells_of_lane) { return cells_of_lane <= 2 ? 4 : 1; }
/// Resident threads of moving_blend.
constexpr int moving_threads(int channels) { return channels == 3 ? 1024 : 0; }

/// In large images lists of so many pairs are cut into segments, or of the share of a block (kListBlocksPerSm) if that
/// is more. A cut list takes more work, which blocks share.
inline constexpr int kLongList = 4096;
inline constexpr int kListBlocksPerSm = 4;
/// Pairs of a segment. Longer segments need fewer maps, shorter ones fill a device with smaller scenes.
constexpr int segment_length(int samples, bool small_tiles) {
  return samples == 1 || small_tiles ? 256 : samples <= 4 ? 512 : 1024;
}
/// For lists of so many pairs a block has a single pixel, not to outlast all others.
constexpr int longest_list(int samples) { return samples <= 4 ? 16384 : 0; }
/// Most segments in large images: kSegments, and the segments of one pair in kPairsPerSegmented.
inline constexpr int kSegments = 4096, kPairsPerSegmented = 4;

/// Pairs that a block of filter_kernel tests at once.
inline constexpr int kFilterPiece = 256;
/// Blocks of filter_kernel and warps of listed_blend in large images: most of the device is left to moving_blend, which
/// begins beside them.
inline constexpr int kFilterBlocksPerSm = 2, kListedWarpsPerSm = 8;
/// Longest lists in small images of which each warp of listed_blend has one task.
inline constexpr int kLongestAtOnce = 128;
/// Warps of listed_blend that share a pixel of the longest lists.
constexpr int listed_warps(int samples) { return samples == 1 ? 1 : 4; }
/// Pairs in the queues of a warp.
inline constexpr int kQueued = 1024;

/// Resident threads of the backward kernels: spills cost less than waiting. `segments`: of cut lists.
constexpr int moving_vjp_threads(int channels, int cells_of_lane, bool segments) {
  return channels > 3 ? 512 : cells_of_lane > 2 && !segments ? 768 : 1024;
}
/// Resident threads of segment_maps.
inline constexpr int kMapThreads = 1024;
/// Earlier positions per lane in shared memory, against the cache.
inline constexpr int kMostInShared = 8;
/// Groups of a segment per warp: fewer, but longer blocks.
constexpr int groups_of_warp(int samples, bool small_tiles) { return samples == 1 || small_tiles ? 1 : 2; }
/// Segments whose maps chain_maps loads at once.
inline constexpr int kMapsAhead = 8;
/// Groups of a tile whose sums are added in shared memory; of more groups in BlendVjpParams::group_sums. And pairs
/// between two barriers.
inline constexpr int kMostSumsInside = 2;
constexpr int segment_batch(bool sums_inside) { return sums_inside ? 64 : 128; }

// Training: ssim.cu, adam.cu, activations.cu, weight.cu

inline constexpr int kSsimThreads = 256, kSsimColumns = 32;
/// Neighbouring sums of a thread: loads from shared memory against registers.
template <typename T> inline constexpr int kSsimRun = sizeof(T) == 4 ? 4 : 1;
/// A thread loads kAdamBytes of each array at once.
inline constexpr int kAdamThreads = 256, kAdamBytes = 16;
inline constexpr int kCorrectThreads = 256, kCorrectPixels = 8;
inline constexpr int kActivateThreads = 256, kWeightThreads = 128;

}  // namespace ar::cuda
