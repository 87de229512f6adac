// Length of the front and launch shapes of still/, as measured, with what they trade.
#pragma once

namespace ar::cuda {

/// F: what a lane blends. Blocks: resident on a multiprocessor, against registers.
struct StillPolicy {
  /// Splats between votes on whether any sample is open.
  static constexpr int kBetweenVotes = 16;
  /// Chunks of the front in small images, and the least in others. The tail is more work, which blocks share.
  static constexpr int kShortFront = 1, kLongFront = 8;

  template <class F> static constexpr int kFrontBlocks = F::kSamples > 1 ? 1 : F::kExpensive ? 4 : 5;
  template <class F> static constexpr int kTailThroughBlocks = F::kSamples > 1 ? 3 : F::kExpensive ? 4 : 5;
  template <class F> static constexpr int kTailBlendBlocks = F::kSamples > 1 ? 3 : 4;
  /// Warps of tail_sum that share the chunks of 32 pixels.
  static constexpr int kTailSumWarps = 4;
  /// Chunks whose numbers tail_scan and tail_sum load together.
  static constexpr int kTailLoads = 32, kTailLoadsKept = 16;

  /// Warps of a block of blend_vjp: few, against shared memory.
  template <class F> static constexpr int kVjpWarps = F::kSamples == 1 ? 4 : 1;
  /// C: channels. Three need registers, of which a fifth block leaves too few.
  template <class F, int C>
  static constexpr int kVjpBlocks = F::kSamples > 1 ? (C == 3 ? 11 : 1)
                                    : C == 3        ? 4
                                    : F::kExpensive ? 5
                                                    : 6;
  /// No device holds more.
  static constexpr int kVjpBlocksPerSm = 16;
};

}  // namespace ar::cuda
