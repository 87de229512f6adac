// Batches and resident blocks of channels/, as measured, with what they trade.
#pragma once

namespace ar::cuda {

/// F: what a lane blends. kSmall: of a small group of channels.
struct ChannelsPolicy {
  /// Splats between two barriers of blend_groups.
  static constexpr int kBatch = 128;
  /// Of blend_groups_vjp: more splats balance its warps, against shared memory.
  template <bool kSmall> static constexpr int kVjpBatch = kSmall ? 64 : 32;
  /// Resident blocks of both.
  template <class F, bool kSmall> static constexpr int kBlocks = F::kSamples > 1 ? 2 : kSmall ? 5 : 4;
};

}  // namespace ar::cuda
