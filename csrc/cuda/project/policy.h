// Launch shapes of project/, as measured, with what they trade.
#pragma once

namespace ar::cuda {

struct ProjectPolicy {
  /// Shared memory against loads of the camera.
  static constexpr int kThreads = 128;
  /// Loads of the camera against an even share of Gaussians.
  static constexpr int kBlocksPerSm = 32;

  /// project_vjp: with six blocks a thread would have 80 registers, and spill. The full camera has 168 with three, and
  /// spills little; the models of lenses would take more.
  static constexpr int kVjpBlocks = 5, kFullVjpBlocks = 3;
  /// A whole warp sums splats with more pairs.
  static constexpr int kManyPairs = 64;
  /// Rows that a lane loads at once: registers against waiting.
  static constexpr int kRowsAtOnce = 4;

  /// zero_culled_grads takes the room of one block of blend_vjp, which computes beside it.
  static constexpr int kZeroThreads = 128, kZeroBlocksPerSm = 1;
  /// Only limits its registers.
  static constexpr int kZeroBlocks = 16;

  /// sum_channels: lanes per splat, because most splats have few pairs.
  static constexpr int kSumThreads = 256, kSumLanes = 8;
  /// Rows that a lane loads at once, and loads of a lane from which on a block sums a splat.
  static constexpr int kSumRowsAtOnce = 4, kSumManyLoads = 16;
};

}  // namespace ar::cuda
