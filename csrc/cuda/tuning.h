// A library of numbers: what was chosen by measuring, each with what it trades, and the launch bounds. Kernels,
// launches and pair_guess.h read them. Nothing here needs CUDA's headers.
#pragma once

namespace ar::cuda {

// Devices

/// Threads that a multiprocessor can hold, by __CUDA_ARCH__; of an unknown device the least.
constexpr int resident_threads(int architecture) {
  switch (architecture) {
    case 800:
    case 900:
    case 1000:
    case 1030:
      return 2048;
    case 860:
    case 870:
    case 880:
    case 890:
    case 1100:
    case 1200:
    case 1210:
      return 1536;
    default:
      return 1024;  // 750
  }
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

// Training: ssim.cu, adam.cu, activations.cu, weight.cu

inline constexpr int kSsimThreads = 256, kSsimColumns = 32;
/// Neighbouring sums of a thread: fewer loads from shared memory, against registers, of which doubles take two.
template <typename T> inline constexpr int kSsimRun = sizeof(T) == 4 ? 4 : 1;
/// A thread loads kAdamBytes of each array at once.
inline constexpr int kAdamThreads = 256, kAdamBytes = 16;
inline constexpr int kActivateThreads = 256, kWeightThreads = 128;

}  // namespace ar::cuda
