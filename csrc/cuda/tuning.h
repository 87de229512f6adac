// Every constant of csrc/cuda that was chosen by measurement, with what it trades. Kernels and launches read them here.
// Nothing in this file changes what is computed, but for the last bits where it says so.
//
// Counts of blocks that should fill a device are given per multiprocessor; multiprocessors() (launch.cuh) asks the
// device for their number. A minimum of resident blocks for __launch_bounds__ goes through blocks_per_sm(), which knows
// what each architecture can hold.
#pragma once

#include <cstddef>
#include <cstdint>

#include "core/platform.h"

namespace ar::cuda {

// --- Architectures -------------------------------------------------------------------------------------------------

/// Threads that a multiprocessor of the architecture being compiled for can hold.
#if !defined(__CUDA_ARCH__) || __CUDA_ARCH__ == 800 || (__CUDA_ARCH__ >= 900 && __CUDA_ARCH__ < 1200)
inline constexpr int kThreadsOfSm = 2048;
#elif __CUDA_ARCH__ < 800
inline constexpr int kThreadsOfSm = 1024;
#else
inline constexpr int kThreadsOfSm = 1536;
#endif

/// The second argument of __launch_bounds__: resident blocks of so many threads that the compiler leaves registers for,
/// as many as wanted and possible.
constexpr int blocks_per_sm(int wanted, int threads) {
  const int most = kThreadsOfSm / threads;
  return wanted < most ? wanted : most > 1 ? most : 1;
}

// --- All blending --------------------------------------------------------------------------------------------------

/// Blocks of 256 threads that a multiprocessor works on side by side, about. So many blocks fill a device: tiles beyond
/// the work of a single one of them are split (front_chunks() of chunk_plan.h), which changes last bits.
inline constexpr int kBlocksOfSm = 8;

// --- still/: samples that stay -------------------------------------------------------------------------------------

/// Splats that a warp composites between two votes on whether any of its samples is still open.
inline constexpr int kBetweenVotes = 16;
/// Chunks of the front of a tile in small images, and the least in others. A longer front leaves less to the tail,
/// whose kernels work side by side but do more work.
inline constexpr int kShortFront = 1, kLongFront = 8;
/// Largest splat in a stage [bytes] that is copied to registers before use.
inline constexpr size_t kSplatInRegisters = 112;

/// Resident blocks of blend_front for lanes with `samples` samples and staged splats of so many bytes.
constexpr int front_blocks(int samples, bool expensive, size_t splat_bytes) {
  return samples > 1 ? 1 : expensive || splat_bytes > 96 ? 4 : 5;
}
/// Resident blocks of tail_through and tail_blend.
constexpr int tail_through_blocks(int samples, bool expensive, size_t splat_bytes) {
  return samples > 1 ? 3 : front_blocks(samples, expensive, splat_bytes);
}
constexpr int tail_blend_blocks(int samples) { return samples > 1 ? 3 : 4; }
/// Warps of a block of tail_sum, which share the chunks of 32 pixels: a single warp waits for memory most of the time.
inline constexpr int kTailSumWarps = 4;
/// Chunks whose numbers tail_scan and tail_sum load together.
inline constexpr int kTailLoads = 32, kTailLoadsKept = 16;

/// Warps of a block of blend_vjp, each with a chunk of its own: as few as let shared memory hold many blocks.
constexpr int vjp_warps(int samples) { return samples <= 2 ? 4 : 1; }
/// Resident blocks of blend_vjp. Where lanes hold pixels in registers, a fifth block would leave each lane too few.
constexpr int vjp_blocks(int samples, bool holds_pixels, bool holds_samples, size_t splat_bytes) {
  return samples > 1 ? (holds_samples ? 11 : 1) : holds_pixels ? 4 : splat_bytes <= 48 ? 6 : 5;
}
/// Blocks of blend_vjp per multiprocessor, which take chunks until none is left: as many as any device holds.
inline constexpr int kVjpBlocksOfSm = 16;

// --- channels/: groups of channels ---------------------------------------------------------------------------------

/// Splats between two barriers of blend_groups.
inline constexpr int kGroupBatch = 128;
/// Splats between two barriers of blend_groups_vjp. Its warps do not all meet equally many of them, so more is better,
/// as long as a few blocks fit into shared memory.
constexpr int group_vjp_batch(bool small_group) { return small_group ? 64 : 32; }
/// Resident blocks of both.
constexpr int group_blocks(int samples, bool small_group) {
  return samples > 4 ? 1 : samples > 1 ? 2 : small_group ? 5 : 4;
}

// --- moment/: samples that move ------------------------------------------------------------------------------------

/// Channels that are blended at once where there are more than kFewChannels.
inline constexpr int kMovingChannels = 8;
/// Entries of a warp's list of splats that are read at a time.
constexpr int list_ahead(int cells_of_lane) { return cells_of_lane <= 2 ? 4 : 1; }
/// Threads of moving_blend that a multiprocessor should hold, by channels.
constexpr int moving_threads(int channels) { return channels == 3 ? 1024 : 0; }

/// Lists of so many pairs are cut into segments in large images, unless the share of a block (kBlocksAtOnce per
/// multiprocessor) of all pairs is larger. To cut a list takes more work than to walk it, but other blocks share it.
inline constexpr int kLongList = 4096;
inline constexpr int kListBlocksOfSm = 4;
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
inline constexpr int kFilterBlocksOfSm = 2, kListedWarpsOfSm = 8;
/// Of so many of the longest lists in small images each warp of listed_blend has one task.
inline constexpr int kLongestAtOnce = 128;
/// Warps of a block of listed_blend, which share a pixel of the longest lists.
constexpr int listed_warps(int samples) { return samples == 1 ? 1 : 4; }
/// Pairs in the queues of a warp.
inline constexpr int kQueued = 1024;

/// Threads of the backward kernels that a multiprocessor should hold: more threads have fewer registers, but waiting for
/// the samples' earlier positions costs more than a few numbers in memory. `segments`: of cut lists.
constexpr int moving_vjp_threads(int channels, int cells_of_lane, bool segments) {
  return channels > 3 ? 512 : cells_of_lane > 2 && !segments ? 768 : 1024;
}
/// Threads of segment_maps that a multiprocessor should hold.
inline constexpr int kMapThreads = 1024;
/// Earlier positions per lane that are in shared memory; more would take more from the cache than they save.
inline constexpr int kMostInShared = 8;
/// Groups of a segment for each warp of its block. With one cell, whose tiles of 8x8 pixels have two groups, a block of
/// one warp would take too long; in tiles of 4x4 pixels fewer warps were slower.
inline constexpr int kMostGroupsOfWarp = 2;
constexpr int groups_of_warp(int samples, bool small_tiles) { return samples == 1 || small_tiles ? 1 : kMostGroupsOfWarp; }
/// Segments whose maps chain_maps reads at once, since each of them waits for memory.
inline constexpr int kMapsAhead = 8;
/// Groups of a tile up to which their sums are added up in shared memory; with more groups they would leave room for too
/// few blocks, and are in BlendVjpParams::group_sums. Pairs between two barriers in either case.
inline constexpr int kMostSumsInside = 2;
constexpr int segment_batch(bool sums_inside) { return sums_inside ? 64 : 128; }

}  // namespace ar::cuda
