// How much room a frame gets for its pairs before the device has counted them. bin (torch/backend_cuda.cpp) asks before
// each frame; the device writes the number of pairs into host memory later (PairFeedback), and the next frame reads it.
// Host code only.
#pragma once

#include <algorithm>
#include <cstdint>

#include "core/stages.h"
#include "cuda/tuning.h"

namespace ar::cuda {

/// When the host waits for the device to count the pairs of a frame.
enum class Counting {
  kNever,     ///< the room is 0 where nothing is known
  kIfNeeded,  ///< while too few frames are known for a guess
  kAlways,
};

/// Remembers the frames of similar images (ImageClass). A frame with more pairs than room is slow, not wrong. So the
/// first frames are counted; later ones get the pairs of the largest frame so far and a reserve. More Gaussians or more
/// tiles than ever seen enlarge the room in proportion; fewer of them leave it as it is. There is always room for a
/// pair of every Gaussian, which EmitParams needs.
class PairGuess {
 public:
  /// Room for the pairs of frame `frame`, at most `most`; 0: count them.
  int64_t capacity(uint32_t frame, int64_t gaussians, int64_t tiles, int64_t most, Counting counting) {
    if (largest_.gaussians < 0 || counting == Counting::kAlways) return 0;
    if (counting == Counting::kIfNeeded && to_count_ > 0) return 0;
    const double pairs = double(largest_.pairs) * growth(gaussians, largest_.gaussians) * growth(tiles, largest_.tiles);
    const double room = std::max(kRoomPerPair * pairs, kRoomPerGaussian * double(gaussians)) + kReservedRoom;
    recent_[frame % kRecent] = {frame, {gaussians, tiles}, room < double(most) ? int64_t(room) : most};
    return recent_[frame % kRecent].room;
  }

  /// The pairs of a frame for which the host has waited.
  void counted(int64_t gaussians, int64_t tiles, int64_t pairs) {
    learn({gaussians, tiles, pairs});
    if (to_count_ > 0) --to_count_;
  }

  /// The pairs of a frame that was not counted, which the device has reported some frames later.
  void reported(uint32_t frame, int64_t pairs) {
    Frame& of = recent_[frame % kRecent];
    const bool known = of.room > 0 && of.frame == frame;
    Size size = known ? of.size : Size{0, 0};
    size.pairs = pairs;
    learn(size);
    if (!known) return;
    if (pairs > of.room) to_count_ = kRecountedFrames;
    of.room = 0;  // a second report of the frame is no news
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
  /// Frames that are remembered until the device reports them.
  static constexpr int kRecent = 16;

  static double growth(int64_t now, int64_t most) {
    return now > most ? double(now) / double(std::max<int64_t>(most, 1)) : 1.0;
  }
  void learn(const Size& size) {
    largest_.gaussians = std::max(largest_.gaussians, size.gaussians);
    largest_.tiles = std::max(largest_.tiles, size.tiles);
    largest_.pairs = std::max(largest_.pairs, size.pairs);
  }

  Size largest_ = {-1, 0};  ///< the most of each, of whatever frame; -1: none is known
  int to_count_ = kCountedFrames;
  Frame recent_[kRecent] = {};
};

/// Images that share a guess: those of a device whose numbers of tiles lie between the same two powers of two. A
/// collection of photos may have a size per photo, and has few classes.
struct ImageClass {
  int device = -1, tile_bits = 0;
  int octave = 0;  ///< of the number of tiles: the bits that it needs

  ImageClass() = default;
  ImageClass(int device, TileGrid grid) : device(device), tile_bits(grid.tile_bits) {
    while (grid.tiles() >> octave > 0) ++octave;
  }
  bool operator==(const ImageClass& other) const {
    return device == other.device && tile_bits == other.tile_bits && octave == other.octave;
  }
};

/// The guesses of the classes of images used last, each with a word of host memory. The device writes the number of a
/// frame and its pairs there when it gets to it; nobody waits. A slot may have been given to another class by then: the
/// frame's number tells.
class PairGuesses {
 public:
  static constexpr int kSlots = 64;

  /// `words`: [kSlots] in memory that the host reads and devices write.
  explicit PairGuesses(uint64_t* words) : words_(words) { std::fill(words_, words_ + kSlots, uint64_t(0)); }

  /// A frame on its way.
  struct Frame {
    int slot;
    uint32_t number;
    int64_t tiles;
    int64_t capacity;  ///< room for its pairs; 0: count them
    uint64_t* word;    ///< where the device writes number << 32 | pairs
  };

  /// `most`: pairs that the frame can have, at least as many as Gaussians.
  Frame begin(int device, TileGrid grid, int64_t gaussians, int64_t most, Counting counting) {
    const int slot = slot_of({device, grid});
    Slot& s = slots_[slot];
    s.used = ++uses_;
    if (++frame_ == 0) ++frame_;  // 0: the device has written nothing yet
    const uint64_t word = *const_cast<const volatile uint64_t*>(words_ + slot);
    const auto written = uint32_t(word >> 32);
    // A difference, because the numbers of frames wrap around.
    if (written != 0 && int32_t(written - s.first_frame) >= 0) s.guess.reported(written, int64_t(word & 0xffffffff));
    const int64_t tiles = grid.tiles();
    const bool is_forced = forced_ > 0 && counting != Counting::kAlways;
    const int64_t capacity =
        is_forced ? std::max(forced_, gaussians) : s.guess.capacity(frame_, gaussians, tiles, most, counting);
    return {slot, frame_, tiles, capacity, words_ + slot};
  }

  /// The pairs of a frame for which the host has waited.
  void counted(const Frame& frame, int64_t gaussians, int64_t pairs) {
    Slot& s = slots_[frame.slot];
    if (int32_t(frame.number - s.first_frame) >= 0) s.guess.counted(gaussians, frame.tiles, pairs);
  }

  /// For tests: frames that need not be counted get this room from now on, or room for a pair of each Gaussian if that
  /// is more. 0: guesses again. Both forget all frames so far.
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

  /// The slot of a class of images, or else the least recently used slot, emptied.
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
