// How much room to make for the pairs of a frame before the device has counted them. Host only.
#pragma once

#include <algorithm>
#include <cstdint>

#include "core/stages.h"

namespace ar::cuda {

/// When the pairs of a frame are counted, for which the host has to wait for the device.
enum class Counting {
  kNever,     ///< there is no room, 0, where nothing at all is known
  kIfNeeded,  ///< where it is better than a guess
  kAlways,
};

/// Remembers the frames of one grid of tiles. A frame that turns out to have more pairs than there is room for is slow,
/// not wrong, so the first frames are counted, and wait for the device; afterwards the largest frame so far, and a
/// reserve, are room enough in all but the rarest cases. The number of Gaussians may change from frame to frame: with
/// more of them than were ever seen the room grows in proportion, with fewer it stays. There is always room for a pair
/// of each, which is what EmitParams needs, and some more, without which splats on the borders of patches would leave
/// no patch but the whole image.
class PairGuess {
 public:
  /// Frames that are counted at the start.
  static constexpr int kCountedFrames = 32;
  /// Frames that are counted after one that had more pairs than room.
  static constexpr int kRecountedFrames = 8;

  /// Room for frame `frame`, at most `most`, or 0: count its pairs.
  int64_t capacity(uint32_t frame, int64_t gaussians, int64_t most, Counting counting) {
    if (most_gaussians_ < 0 || counting == Counting::kAlways) return 0;
    if (counting == Counting::kIfNeeded && to_count_ > 0) return 0;
    double pairs = double(largest_);
    if (gaussians > most_gaussians_) pairs *= double(gaussians) / double(std::max<int64_t>(most_gaussians_, 1));
    const double room = std::max(1.25 * pairs, 1.125 * double(gaussians)) + kReserve;
    recent_[frame % kRecent] = {frame, gaussians, room < double(most) ? int64_t(room) : most};
    return recent_[frame % kRecent].room;
  }

  /// What counting gave.
  void counted(int64_t gaussians, int64_t pairs) {
    learn(gaussians, pairs);
    if (to_count_ > 0) --to_count_;
  }

  /// What the device reported of a frame that was not counted, some frames later.
  void reported(uint32_t frame, int64_t pairs) {
    const Frame& of = recent_[frame % kRecent];
    const bool known = of.room > 0 && of.frame == frame;
    learn(known ? of.gaussians : 0, pairs);
    if (known && pairs > of.room) to_count_ = kRecountedFrames;
    if (known) recent_[frame % kRecent].room = 0;  // once
  }

 private:
  static constexpr int64_t kReserve = 1 << 16;
  /// Frames that the device may be behind without their number of Gaussians being forgotten.
  static constexpr int kRecent = 16;
  struct Frame {
    uint32_t frame;
    int64_t gaussians, room;
  };

  void learn(int64_t gaussians, int64_t pairs) {
    largest_ = std::max(largest_, pairs);
    most_gaussians_ = std::max(most_gaussians_, gaussians);
  }

  int64_t most_gaussians_ = -1, largest_ = 0;
  int to_count_ = kCountedFrames;
  Frame recent_[kRecent] = {};
};

/// The guesses of the grids used last. The device writes the number of pairs of each frame into a word of host
/// memory when it gets there; nobody waits for it. A word says which frame it is of, so that a write that comes after
/// its slot was given to another grid is known as such.
class PairGuesses {
 public:
  static constexpr int kSlots = 64;

  /// `words`: kSlots words of memory that the host reads and devices write.
  explicit PairGuesses(uint64_t* words) : words_(words) { std::fill(words_, words_ + kSlots, uint64_t(0)); }

  /// A frame on its way.
  struct Frame {
    int slot;
    uint32_t number;
    int64_t capacity;  ///< room for its pairs, or 0: count them
    uint64_t* word;    ///< where the device is to write the frame's number << 32 | pairs
  };

  /// `most`: pairs that the frame can have, at least as many as Gaussians.
  Frame begin(int device, TileGrid grid, int64_t gaussians, int64_t most, Counting counting) {
    const int slot = slot_of(device, grid);
    Slot& s = slots_[slot];
    s.used = ++uses_;
    if (++frame_ == 0) ++frame_;  // 0: nothing was written yet
    const uint64_t word = *const_cast<const volatile uint64_t*>(words_ + slot);
    const uint32_t written = uint32_t(word >> 32);
    // Numbers go round; a slot's are those since it was given away.
    if (written != 0 && int32_t(written - s.first_frame) >= 0) s.guess.reported(written, int64_t(word & 0xffffffff));
    const bool is_forced = forced_ > 0 && counting != Counting::kAlways;
    return {slot, frame_,
            is_forced ? std::max(forced_, gaussians) : s.guess.capacity(frame_, gaussians, most, counting),
            words_ + slot};
  }

  /// What counting the pairs of a frame gave.
  void counted(const Frame& frame, int64_t gaussians, int64_t pairs) {
    Slot& s = slots_[frame.slot];
    if (int32_t(frame.number - s.first_frame) >= 0) s.guess.counted(gaussians, pairs);
  }

  /// Makes this room from now on, or that for a pair of each Gaussian, where a frame is not counted; 0: begins anew.
  void force(int64_t capacity) {
    forced_ = capacity;
    for (Slot& s : slots_) s = Slot{};
  }

 private:
  struct Slot {
    int device = -1;
    TileGrid grid = {};
    uint64_t used = 0;
    uint32_t first_frame = 0;
    PairGuess guess;
  };

  /// The slot of a grid, or else the one least recently used, begun anew.
  int slot_of(int device, TileGrid grid) {
    int oldest = 0;
    for (int k = 0; k < kSlots; ++k) {
      const Slot& s = slots_[k];
      if (s.device == device && s.grid == grid) return k;
      if (s.used < slots_[oldest].used) oldest = k;
    }
    slots_[oldest] = Slot{device, grid, 0, frame_ + 1, {}};
    return oldest;
  }

  uint64_t* words_;
  Slot slots_[kSlots];
  uint64_t uses_ = 0;
  uint32_t frame_ = 0;
  int64_t forced_ = 0;
};

}  // namespace ar::cuda
