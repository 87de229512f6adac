// When moment/ cuts lists, length of segments, and launch shapes, as measured, with what they trade.
#pragma once

namespace ar::cuda {

/// `samples`: of a pixel.
struct MomentPolicy {
  /// Channels that are blended at once where there are more than kFewChannels.
  static constexpr int kChannels = 8;
  /// As in StillPolicy.
  static constexpr int kBetweenVotes = 16;
  /// Entries of a warp's list of splats that are read at once.
  static constexpr int list_ahead(int cells_of_lane) { return cells_of_lane <= 2 ? 4 : 1; }
  /// Resident threads of moving_blend.
  static constexpr int blend_threads(int channels) { return channels == 3 ? 1024 : 0; }

  /// In large images lists of so many pairs are cut, or of a block's share (kListBlocksPerSm) if more. Cutting adds
  /// work, which blocks share.
  static constexpr int kLongList = 4096;
  static constexpr int kListBlocksPerSm = 4;
  /// Pairs of a segment. Longer segments need fewer maps, shorter ones fill a device with smaller scenes.
  static constexpr int segment_length(int samples, bool small_tiles) {
    return samples == 1 || small_tiles ? 256 : samples <= 4 ? 512 : 1024;
  }
  /// For lists of so many pairs a block has a single pixel, not to outlast all others.
  static constexpr int longest_list(int samples) { return samples <= 4 ? 16384 : 0; }
  /// Most segments in large images: kSegments, and the segments of one pair in kPairsPerSegmented.
  static constexpr int kSegments = 4096, kPairsPerSegmented = 4;

  /// Pairs that a block of filter tests at once.
  static constexpr int kFilterPiece = 256;
  /// In large images moving_blend, which begins beside filter and listed_blend, needs most of the device.
  static constexpr int kFilterBlocksPerSm = 2, kListedWarpsPerSm = 8;
  /// Longest lists in small images: each warp of listed_blend has one task.
  static constexpr int kLongestAtOnce = 128;
  /// Warps of listed_blend that share a pixel of the longest lists.
  static constexpr int listed_warps(int samples) { return samples == 1 ? 1 : 4; }
  /// Pairs in the queues of a warp.
  static constexpr int kQueued = 1024;

  /// Resident threads of the backward kernels: spills cost less than waiting. `segments`: of cut lists.
  static constexpr int vjp_threads(int channels, int cells_of_lane, bool segments) {
    return channels > 3 ? 512 : cells_of_lane > 2 && !segments ? 768 : 1024;
  }
  /// Resident threads.
  static constexpr int kMapThreads = 1024;
  /// Segments whose maps chain_maps loads at once.
  static constexpr int kMapsAhead = 8;
  /// Earlier positions per lane in shared memory, against the cache.
  static constexpr int kMostInShared = 8;
  /// Groups of a segment per warp: fewer, but longer blocks.
  static constexpr int groups_of_warp(int samples, bool small_tiles) { return samples == 1 || small_tiles ? 1 : 2; }
  /// Most groups of a tile whose sums are added in shared memory, else in group_sums; pairs between two barriers.
  static constexpr int kMostSumsInside = 2;
  static constexpr int segment_batch(bool sums_inside) { return sums_inside ? 64 : 128; }
};

}  // namespace ar::cuda
