// Guesses room for a frame's pairs from earlier frames, whose numbers the device has written into host memory.
#pragma once

#include <algorithm>
#include <cstdint>

#include "core/stages.h"

namespace ar::cuda {

struct PairGuessPolicy {
  /// Frames that are counted, which waits: at first, and after too many pairs.
  static constexpr int kCountedFrames = 32, kRecountedFrames = 8;
  /// Per pair of the largest frame so far: memory against frames with too many pairs.
  static constexpr double kRoomPerPair = 1.25;
  /// For splats on borders of patches.
  static constexpr double kRoomPerGaussian = 1.125;
  /// For small scenes, whose views differ most.
  static constexpr int kReservedRoom = 1 << 16;
};

enum class Counting {
  kNever,     ///< no room where nothing is known
  kIfNeeded,  ///< while few frames are known
  kAlways,
};

/// Rounds up to one of eight numbers in each octave: torch's allocator keeps a block for every size.
inline int64_t in_steps(int64_t number) {
  int64_t step = 1;
  while (number > 16 * step) step *= 2;
  return (number + step - 1) / step * step;
}

/// Of a class of images. Too little room is slow, not wrong. The first frames are counted; later ones get the room of
/// the largest so far and a reserve, in steps. More Gaussians or tiles than ever enlarge it in proportion.
class PairGuess : PairGuessPolicy {
 public:
  /// Room for frame `frame`, at most `most`; 0: count its pairs.
  int64_t capacity(uint32_t frame, int64_t gaussians, int64_t tiles, int64_t most, Counting counting) {
    if (largest_.gaussians < 0 || counting == Counting::kAlways) return 0;
    if (counting == Counting::kIfNeeded && to_count_ > 0) return 0;
    const double pairs = double(largest_.pairs) * growth(gaussians, largest_.gaussians) * growth(tiles, largest_.tiles);
    const double room = std::max(kRoomPerPair * pairs, kRoomPerGaussian * double(gaussians)) + kReservedRoom;
    const int64_t stepped = room < double(most) ? std::min(in_steps(int64_t(room)), most) : most;
    recent_[frame % kRecent] = {frame, {gaussians, tiles}, stepped};
    return recent_[frame % kRecent].room;
  }

  void counted(int64_t gaussians, int64_t tiles, int64_t pairs) {
    learn({gaussians, tiles, pairs});
    if (to_count_ > 0) --to_count_;
  }

  void reported(uint32_t frame, int64_t pairs) {
    Frame& of = recent_[frame % kRecent];
    const bool known = of.room > 0 && of.frame == frame;
    Size size = known ? of.size : Size{0, 0};
    size.pairs = pairs;
    learn(size);
    if (!known) return;
    if (pairs > of.room) to_count_ = kRecountedFrames;
    of.room = 0;  // once
  }

 private:
  struct Size {
    int64_t gaussians, tiles, pairs = 0;
  };
  struct Frame {
    uint32_t frame;
    Size size;
    int64_t room;
  };
  static constexpr int kRecent = 16;

  static double growth(int64_t now, int64_t most) {
    return now > most ? double(now) / double(std::max<int64_t>(most, 1)) : 1.0;
  }
  void learn(const Size& size) {
    largest_.gaussians = std::max(largest_.gaussians, size.gaussians);
    largest_.tiles = std::max(largest_.tiles, size.tiles);
    largest_.pairs = std::max(largest_.pairs, size.pairs);
  }

  Size largest_ = {-1, 0};  ///< of all frames, each number by itself; -1: no frame
  int to_count_ = kCountedFrames;
  Frame recent_[kRecent] = {};
};

/// Images that share a guess: with numbers of tiles between the same powers of two.
struct ImageClass {
  int device = -1, tile_bits = 0;
  int octave = 0;  ///< bits of the number of tiles

  ImageClass() = default;
  ImageClass(int device, TileGrid grid) : device(device), tile_bits(grid.tile_bits) {
    while (grid.tiles() >> octave > 0) ++octave;
  }
  bool operator==(const ImageClass& other) const {
    return device == other.device && tile_bits == other.tile_bits && octave == other.octave;
  }
};

/// Of the classes used last, each with a word that the device writes. The frame's number in it tells if the slot has
/// another class by then.
class PairGuesses {
 public:
  static constexpr int kSlots = 64;

  /// [kSlots] in host memory that devices can write.
  explicit PairGuesses(uint64_t* words) : words_(words) { std::fill(words_, words_ + kSlots, uint64_t(0)); }

  struct Frame {
    int slot;
    uint32_t number;
    int64_t tiles;
    int64_t capacity;  ///< as of PairGuess
    uint64_t* word;    ///< for the device to write number << 32 | pairs
  };

  /// `most`: pairs that the frame can have, at least as many as Gaussians.
  Frame begin(int device, TileGrid grid, int64_t gaussians, int64_t most, Counting counting) {
    const int slot = slot_of({device, grid});
    Slot& s = slots_[slot];
    s.used = ++uses_;
    if (++frame_ == 0) ++frame_;  // 0: nothing is written yet
    const uint64_t word = *const_cast<const volatile uint64_t*>(words_ + slot);
    const auto written = uint32_t(word >> 32);
    // Numbers of frames wrap around.
    if (written != 0 && int32_t(written - s.first_frame) >= 0) s.guess.reported(written, int64_t(word & 0xffffffff));
    const int64_t tiles = grid.tiles();
    const bool is_forced = forced_ > 0 && counting != Counting::kAlways;
    const int64_t capacity =
        is_forced ? std::max(forced_, gaussians) : s.guess.capacity(frame_, gaussians, tiles, most, counting);
    return {slot, frame_, tiles, capacity, words_ + slot};
  }

  void counted(const Frame& frame, int64_t gaussians, int64_t pairs) {
    Slot& s = slots_[frame.slot];
    if (int32_t(frame.number - s.first_frame) >= 0) s.guess.counted(gaussians, frame.tiles, pairs);
  }

  /// For tests: room for so many pairs; 0: guesses, anew.
  void force(int64_t capacity) {
    forced_ = capacity;
    for (Slot& s : slots_) s = Slot{};
  }

 private:
  struct Slot {
    ImageClass images;
    uint64_t used = 0;
    uint32_t first_frame = 0;
    PairGuess guess;
  };

  /// Or the least recently used slot, emptied.
  int slot_of(const ImageClass& images) {
    int oldest = 0;
    for (int k = 0; k < kSlots; ++k) {
      if (slots_[k].images == images) return k;
      if (slots_[k].used < slots_[oldest].used) oldest = k;
    }
    slots_[oldest] = Slot{images, 0, frame_ + 1, {}};
    return oldest;
  }

  uint64_t* words_;
  Slot slots_[kSlots];
  uint64_t uses_ = 0;
  uint32_t frame_ = 0;
  int64_t forced_ = 0;
};

}  // namespace ar::cuda
