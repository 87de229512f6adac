// How much room to make for the pairs of a frame before the device has counted them. Host only.
#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>

namespace ar::cuda {

/// Remembers the frames of one image size. A frame that turns out to have more pairs than there is
/// room for is slow, not wrong, so the first frames are counted, and wait for the device; afterwards
/// the largest frame so far, and a reserve, are room enough in all but the rarest cases.
class PairGuess {
 public:
  /// Frames that are counted at the start, after an overflow, and after a change of scene.
  static constexpr int kCountedFrames = 32;

  explicit PairGuess(int64_t most = std::numeric_limits<int64_t>::max() / 2) : most_(most) {}

  /// Room for a frame, or 0: count its pairs. `seen`: the number of pairs that the device reported
  /// last. Without `may_wait` frames are counted only where nothing at all is known.
  int64_t capacity(int64_t gaussians, int64_t seen, bool may_wait) {
    high_ = std::max(high_, seen);
    if (seen > promised_) {
      counted_frames_ = 0;
      promised_ = std::numeric_limits<int64_t>::max();
    }
    if (gaussians < gaussians_ / 2) *this = PairGuess(most_);
    if (gaussians_ < 0 || (may_wait && counted_frames_ < kCountedFrames)) return 0;
    // Densification brings pairs along before they have been seen.
    const double growth = std::max(1.0, double(gaussians) / double(std::max<int64_t>(gaussians_, 1)));
    const double room = 1.25 * growth * double(high_) + (1 << 16);
    promised_ = room < double(most_) ? int64_t(room) : most_;
    return promised_;
  }

  /// What counting gave.
  void counted(int64_t gaussians, int64_t pairs) {
    gaussians_ = std::max(gaussians_, gaussians);
    high_ = std::max(high_, pairs);
    ++counted_frames_;
  }

 private:
  int64_t most_, gaussians_ = -1, high_ = 0;
  int64_t promised_ = std::numeric_limits<int64_t>::max();  // room of the last frame that was not counted
  int counted_frames_ = 0;
};

}  // namespace ar::cuda
