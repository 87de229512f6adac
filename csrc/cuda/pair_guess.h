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
  /// Frames that are counted after a smaller change, as by densification.
  static constexpr int kRecountedFrames = 8;

  explicit PairGuess(int64_t most = std::numeric_limits<int64_t>::max() / 2) : most_(most) {}

  /// Room for a frame, or 0: count its pairs. `seen`: the number of pairs that the device reported
  /// last. Without `may_wait` frames are counted only where nothing at all is known.
  int64_t capacity(int64_t gaussians, int64_t seen, bool may_wait) {
    high_ = std::max(high_, seen);
    if (seen > promised_) {
      counted_frames_ = 0;
      promised_ = std::numeric_limits<int64_t>::max();
    }
    if (gaussians / 2 > gaussians_ || gaussians < gaussians_ / 2) *this = PairGuess(most_);
    if (gaussians != gaussians_) counted_frames_ = std::min(counted_frames_, kCountedFrames - kRecountedFrames);
    if (gaussians_ < 0 || (may_wait && counted_frames_ < kCountedFrames)) return 0;
    promised_ = std::min(high_ + high_ / 4 + (1 << 16), most_);
    return promised_;
  }

  /// What counting gave.
  void counted(int64_t gaussians, int64_t pairs) {
    gaussians_ = gaussians;
    high_ = std::max(high_, pairs);
    ++counted_frames_;
  }

 private:
  int64_t most_, gaussians_ = -1, high_ = 0;
  int64_t promised_ = std::numeric_limits<int64_t>::max();  // room of the last frame that was not counted
  int counted_frames_ = 0;
};

}  // namespace ar::cuda
