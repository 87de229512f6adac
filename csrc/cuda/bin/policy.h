// Launch shapes and lengths of loops of bin/, as measured, with what they trade.
#pragma once

namespace ar::cuda {

struct BinPolicy {
  /// count_depths: few blocks, as each adds a histogram. Keys loaded at once: registers against waiting.
  static constexpr int kCountThreads = 1024, kCountBlocksPerSm = 1, kCountAtOnce = 4;

  /// emit_pairs: splats of a thread, for few blocks, as each waits for the one before.
  static constexpr int kEmitThreads = 256, kEmitRows = 2, kEmitSplats = kEmitThreads * kEmitRows;
  /// Limits a thread to 48 registers.
  static constexpr int kEmitBlocks = 5;
  /// Enough for many long splats.
  static constexpr int kLongBlocksPerSm = 4;

  /// Most bits of a digit, and most digits: fewer passes, or faster ones.
  static constexpr int kTileDigitBits = 8, kTileDigits = 4;
  /// Counts of earlier blocks that a thread of a sort loads at once.
  static constexpr int kLookBackAtOnce = 8;
  /// Tiles of a block of tile_offsets, and lanes that search for each.
  static constexpr int kOffsetTiles = 16, kOffsetLanes = 8;
};

template <int kBits> struct SortPolicy {
  static constexpr bool kLong = kBits > 8;
  static constexpr int kThreads = kLong ? 512 : 256;  ///< at least one for each value of a digit
  static constexpr int kItems = kLong ? 10 : 12;      ///< per thread: fewer blocks against registers
  static constexpr int kBlocks = kLong ? 2 : 3;       ///< resident, against registers
};

struct PlanPolicy {
  static constexpr int kCountThreads = 1024, kThreads = 256;
  static constexpr int kTilesAtOnce = 2;  ///< of a thread, whose loads wait together
};

}  // namespace ar::cuda
