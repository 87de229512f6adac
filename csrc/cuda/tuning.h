// A library: the numbers of csrc/cuda that were chosen by measuring, each with what it trades. Kernels, their launches
// and the guess of pairs read them. Nothing here needs CUDA's headers, so that tests on the host read them too.
#pragma once

namespace ar::cuda {

// Devices

/// Threads that a multiprocessor can hold at once. `architecture`: ten times the compute capability and a zero, as in
/// __CUDA_ARCH__. Of an unknown device, the least.
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
      return 1024;  // 7.5
  }
}
#if defined(__CUDA_ARCH__)
inline constexpr int kArchitecture = __CUDA_ARCH__;
#else
inline constexpr int kArchitecture = 900;  // the host reads no launch bound
#endif
/// The second number of __launch_bounds__: blocks of so many threads that a multiprocessor should hold at once, of
/// those `wanted` as many as fit. More blocks hide more latency; each thread gets fewer registers.
constexpr int blocks_per_sm(int wanted, int threads, int architecture = kArchitecture) {
  const int fit = resident_threads(architecture) / threads;
  return fit < 1 ? 1 : fit < wanted ? fit : wanted;
}

// Room for pairs (pair_guess.h)

/// Frames of a class of images whose pairs are counted before the host guesses: more of them see more views, and in
/// each the host waits for the device.
inline constexpr int kCountedFrames = 32;
/// The same after a frame with more pairs than room.
inline constexpr int kRecountedFrames = 8;
/// Room for each pair of the largest frame so far: more memory, against frames whose tiles share lists.
inline constexpr double kRoomPerPair = 1.25;
/// Room for each Gaussian at least. With exactly 1, splats on the borders of patches would leave no patch but the whole
/// image.
inline constexpr double kRoomPerGaussian = 1.125;
/// Room in any case, for scenes so small that a new view may have many times the pairs.
inline constexpr int kReservedRoom = 1 << 16;

// Projection (project.cuh, project_vjp.cuh)

/// Threads of the kernels with a thread per Gaussian or row. Their shared memory, with the harmonics of every thread,
/// grows with them.
inline constexpr int kProjectThreads = 128;
/// Blocks of `project` on each multiprocessor, four times as many as fit. A block loads the camera once, for all of its
/// Gaussians; more blocks share the Gaussians more evenly.
inline constexpr int kProjectBlocksPerSm = 32;
/// Blocks of project_vjp on a multiprocessor. With six a thread would have 80 registers, and spill.
inline constexpr int kProjectVjpBlocks = 5;
/// The same for a camera with a lens, which needs more registers.
inline constexpr int kFullProjectVjpBlocks = 1;
/// A splat with more pairs than this is summed by its whole warp. Below, 32 splats side by side keep more lanes busy.
inline constexpr int kManyPairs = 64;
/// Rows of pair gradients that a lane loads before it waits for the first: registers, against latency.
inline constexpr int kRowsAtOnce = 4;
/// zero_culled_grads runs beside blend_vjp, which computes while this kernel waits for memory. So it has few blocks, of
/// few threads and registers: all of its blocks on a multiprocessor displace at most one of blend_vjp.
inline constexpr int kZeroThreads = 128, kZeroBlocksPerSm = 1;
/// Blocks of it that could be on a multiprocessor at once: this limits its registers alone.
inline constexpr int kZeroResidentBlocks = 16;
/// Threads of a block of sum_channels, and lanes of each splat. More lanes would idle, as most splats have few pairs;
/// fewer would take longer over the others.
inline constexpr int kSumThreads = 256, kSumLanes = 8;
/// Rows that a lane of sum_channels loads before it waits for the first.
inline constexpr int kSumRowsAtOnce = 4;
/// The threads of a block share a splat where each lane would otherwise load this many times kSumRowsAtOnce rows.
inline constexpr int kSumManyLoads = 16;

// Binning (bin.cuh)

/// Threads of a block of count_depths, and blocks on each multiprocessor. A block has a histogram of its own, and adds
/// it to that of all in the end: fewer blocks add less often.
inline constexpr int kCountThreads = 1024, kCountBlocksPerSm = 1;
/// Keys that a thread of count_depths loads before it waits for the first.
inline constexpr int kCountAtOnce = 4;
/// Blocks of emit_pairs that a multiprocessor should hold at once: five fit into its shared memory.
inline constexpr int kEmitBlocks = 5;
/// Blocks of emit_long_pairs on each multiprocessor: enough to spread the few long splats, and few that find none.
inline constexpr int kLongBlocksPerSm = 4;
/// Tiles of a block of tile_offsets, and lanes that search for the first pair of each: more lanes need fewer steps.
inline constexpr int kOffsetTiles = 16, kOffsetLanes = 8;
/// Most bits of a digit in the sort by tile. Digits of eight bits save passes, digits of seven have fewer counts; no
/// sort needs more passes than the number of its last tile has such digits.
inline constexpr int kTileDigitBits = 8, kTileDigits = 4;

// Sorts (sort.cuh)

/// A pass of a sort by digits of kBits bits.
template <int kBits> struct SortTuning {
  static constexpr bool kLong = kBits > 8;
  /// Threads of a block: at least one for each value of a digit.
  static constexpr int kThreads = kLong ? 512 : 256;
  /// Items of a thread: more items mean fewer blocks that wait for earlier ones, and more registers.
  static constexpr int kItems = kLong ? 10 : 12;
  /// Blocks on a multiprocessor at once: this limits the registers of a thread.
  static constexpr int kBlocks = kLong ? 2 : 3;
};
/// Counts of earlier blocks that a thread loads before it waits for the first.
inline constexpr int kLookBackAtOnce = 8;

// Training (ssim.cu, adam.cu, activations.cu, weight.cu)

/// Threads of a block of ssim, which has this many pixels, times kSsimRun.
inline constexpr int kSsimThreads = 256;
/// Columns of pixels of a block of ssim.
inline constexpr int kSsimColumns = 32;
/// Neighbouring window sums that a thread makes from values in registers: more sums read less of shared memory. Doubles
/// would need too many registers.
template <typename T> inline constexpr int kSsimRun = sizeof(T) == 4 ? 4 : 1;
/// Threads of a block of adam; each loads kAdamBytes of every array at once.
inline constexpr int kAdamThreads = 256, kAdamBytes = 16;
/// Threads of the kernels with a thread per Gaussian, and of those with a thread per weight.
inline constexpr int kActivateThreads = 256, kWeightThreads = 128;

}  // namespace ar::cuda
