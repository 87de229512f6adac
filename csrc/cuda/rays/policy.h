// Launch shapes and lengths of loops in the kernels of rays/, with what they trade.
#pragma once

#include <cstdint>

namespace ar::cuda {

struct RayPolicy {
  /// Entries that may have left the window of a pixel before a warp composites them: lanes composite together, against
  /// shared memory.
  static constexpr int kPending = 8;
  /// Entries of a lane whose splats are loaded together: waiting, against registers.
  template <class F> static constexpr int kAtOnce = F::kSamples > 1 ? 1 : 4;

  /// Blocks on a multiprocessor, against registers.
  template <class F> static constexpr int kBlocks = F::kExpensive || F::kSamples > 1 ? 8 : 12;
  template <class F> static constexpr int kVjpBlocks = F::kExpensive || F::kSamples > 1 ? 6 : 10;

  /// Most bytes of a RayLog, and most rows of a warp: lists in which more is composited are walked again.
  static constexpr int64_t kLogBytes = int64_t(384) << 20;
  static constexpr int kLogRows = 256;
};

}  // namespace ar::cuda
