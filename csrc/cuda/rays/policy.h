// Launch shapes and lengths of loops of rays/, with what they trade.
#pragma once

#include <cstdint>

namespace ar::cuda {

struct RayPolicy {
  /// Entries of a lane between two sorts, against shared memory.
  static constexpr int kPending = 8;
  /// Slots of a window that are read together: waiting, against reads in vain.
  static constexpr int kTogether = 4;
  /// Entries of a lane whose splats are loaded together: waiting, against registers.
  template <class F> static constexpr int kAtOnce = F::kSamples > 1 ? 2 : 4;

  /// Blocks, of a warp, on a multiprocessor, against registers. Some devices hold no more.
  static constexpr int kBlocks = 16;
  /// Of the backward pass, whose blocks share the tiles, against memory for RayLog.
  static constexpr int kVjpBlocks = 18;

  /// Most bytes of a RayLog, and most rows of a warp, a power of two. Lists in which more is composited are walked
  /// again.
  static constexpr int64_t kLogBytes = int64_t(384) << 20;
  static constexpr int kLogRows = 256;
};

}  // namespace ar::cuda
