#include "torch/pair_guess.h"

#include <gtest/gtest.h>

#include <random>
#include <set>
#include <vector>

namespace ar::cuda {
namespace {

constexpr int64_t kMost = (int64_t(1) << 30) - 1;

constexpr TileGrid kGrid = {640, 480};

/// Renders frames with a device that ends each of them two frames later, as long as the host does not wait for it.
class Renderer {
 public:
  /// Room for a frame with so many pairs; 0 if they were counted.
  int64_t frame(int64_t gaussians, int64_t pairs, Counting counting = Counting::kIfNeeded) {
    return frame(kGrid, gaussians, pairs, counting);
  }
  int64_t frame(TileGrid grid, int64_t gaussians, int64_t pairs, Counting counting = Counting::kIfNeeded) {
    const PairGuesses::Frame frame = guesses.begin(0, grid, gaussians, kMost, counting);
    queue_.push_back({frame, pairs});
    if (frame.capacity == 0) guesses.counted(frame, gaussians, pairs);
    while (queue_.size() > (frame.capacity == 0 ? 0 : kLag)) write_next();
    return frame.capacity;
  }
  /// Frames that are counted until one is guessed.
  int count_frames(int64_t gaussians, int64_t pairs) {
    int frames = 0;
    while (frames < 1000 && frame(gaussians, pairs) == 0) ++frames;
    return frames;
  }

  std::vector<uint64_t> words = std::vector<uint64_t>(PairGuesses::kSlots, 77);
  PairGuesses guesses{words.data()};

 private:
  struct Queued {
    PairGuesses::Frame frame;
    int64_t pairs;
  };
  void write_next() {
    *queue_.front().frame.word = uint64_t(queue_.front().frame.number) << 32 | uint64_t(queue_.front().pairs);
    queue_.erase(queue_.begin());
  }
  static constexpr size_t kLag = 2;
  std::vector<Queued> queue_;
};

TEST(PairGuessTest, CountsTheFirstFramesAndThenLeavesAReserve) {
  Renderer renderer;
  EXPECT_EQ(renderer.count_frames(1000, 1000000), PairGuessPolicy::kCountedFrames);
  const int64_t room = renderer.frame(1000, 1000000);
  EXPECT_GE(room, 1250000);
  EXPECT_LE(room, (1250000 + (1 << 16)) * 9 / 8);
}

TEST(PairGuessTest, RoomHasEightSizesInAnOctave) {
  std::set<int64_t> sizes;
  for (int64_t number = 1 << 20; number < 1 << 21; number += 997) {
    const int64_t stepped = in_steps(number);
    EXPECT_GE(stepped, number);
    EXPECT_LE(stepped, number + number / 8);
    sizes.insert(stepped);
  }
  EXPECT_EQ(sizes.size(), 9u) << "both ends of the octave";
  for (int64_t number = 0; number <= 16; ++number) EXPECT_EQ(in_steps(number), number);
  Renderer renderer;
  renderer.count_frames(1000, 1000000);
  sizes.clear();
  for (int64_t pairs = 1000000; pairs < 2000000; pairs += 10000) sizes.insert(renderer.frame(1000, pairs));
  EXPECT_LE(sizes.size(), 10u);
}

TEST(PairGuessTest, RemembersTheLargestFrame) {
  Renderer renderer;
  renderer.frame(1000, 5000000);
  renderer.count_frames(1000, 10);
  EXPECT_GE(renderer.frame(1000, 10), 6250000);
}

TEST(PairGuessTest, CountsAgainAfterAnOverflowAndOnlyThen) {
  Renderer renderer;
  renderer.count_frames(1000, 1000000);
  const int64_t room = renderer.frame(1000, 1000000);
  for (int k = 0; k < 10; ++k) EXPECT_GT(renderer.frame(1000, room), 0) << "it fits";
  const int64_t larger = renderer.frame(1000, 10 * room);
  EXPECT_LT(larger, 10 * room) << "the frame that nobody could foresee";
  int counted = 0;
  for (int k = 0; k < 100; ++k) {
    const int64_t next = renderer.frame(1000, 10 * room);
    counted += next == 0;
    if (counted == PairGuessPolicy::kRecountedFrames && next > 0) {
      EXPECT_GE(next, 12 * room);
    }
  }
  EXPECT_EQ(counted, PairGuessPolicy::kRecountedFrames);
}

TEST(PairGuessTest, GuessesWhateverTheNumberOfGaussians) {
  Renderer renderer;
  renderer.count_frames(100000, 1000000);
  for (int frame = 0; frame < 200; ++frame) {  // two models, and a level of detail that moves
    const int64_t n = frame % 2 ? 400000 + 1000 * (frame % 7) : 100000 - 1000 * (frame % 5), pairs = 10 * n;
    EXPECT_GE(renderer.frame(n, pairs), pairs) << "frame " << frame;
  }
}

TEST(PairGuessTest, GrowsInProportionOnlyUntilTheDeviceHasSpoken) {
  Renderer renderer;
  renderer.count_frames(1000, 1000000);
  int64_t room = 0;
  for (int64_t n = 1000; n < 64000; n += n / 20) room = renderer.frame(n, 1000000 + n);  // splats shrink as they divide
  EXPECT_GE(room, 1250000);
  EXPECT_LE(room, 1700000 * 9 / 8) << "in steps, but not 64 times as many";
}

TEST(PairGuessTest, WaitsOnlyWhereItMay) {
  Renderer renderer;
  EXPECT_EQ(renderer.guesses.begin(0, kGrid, 1000, kMost, Counting::kNever).capacity, 0) << "nothing is known";
  renderer.frame(1000, 1000000);
  EXPECT_GE(renderer.frame(1000, 1000000, Counting::kNever), 1250000);
  EXPECT_EQ(renderer.frame(1000, 1000000), 0);
}

TEST(PairGuessTest, ALargerFrameThatIsCountedAnywayIsNoReasonToCountOthers) {
  Renderer renderer;
  renderer.count_frames(1000, 1000000);
  EXPECT_EQ(renderer.frame(1000, 100000000, Counting::kAlways), 0);
  for (int frame = 0; frame < 10; ++frame) EXPECT_GE(renderer.frame(1000, 1000000), 125000000);
}

TEST(PairGuessTest, NeverExceedsTheMost) {
  Renderer renderer;
  for (int frame = 0; frame < 2 * PairGuessPolicy::kCountedFrames; ++frame)
    EXPECT_LE(renderer.guesses.begin(0, kGrid, 10, 1 << 20, Counting::kIfNeeded).capacity, 1 << 20);
  renderer.count_frames(10, (int64_t(1) << 32) - 1);
  EXPECT_EQ(renderer.guesses.begin(0, kGrid, 10, 1 << 20, Counting::kNever).capacity, 1 << 20);
}

/// Photos that all differ in size, with as many pairs as their tiles and their views make.
TEST(PairGuessTest, WaitsInFewFramesOfACollectionWithASizePerPhoto) {
  constexpr int kPhotos = 200, kGaussians = 500000, kSizeClasses = 2;  // 2508 to 7500 tiles
  struct Photo {
    TileGrid grid;
    int64_t pairs;
  };
  std::mt19937 bits(5);
  std::vector<Photo> photos;
  for (int k = 0; k < kPhotos; ++k) {
    const TileGrid grid = {900 + int(bits() % 700), 700 + int(bits() % 500)};
    photos.push_back({grid, grid.tiles() * int64_t(400 + bits() % 400)});
  }
  Renderer renderer;
  int waits[3] = {}, overflows = 0;
  for (int& of_round : waits) {
    for (const Photo& photo : photos) {
      const int64_t room = renderer.frame(photo.grid, kGaussians, photo.pairs);
      of_round += room == 0;
      overflows += room > 0 && room < photo.pairs;
      EXPECT_LE(room, 4 * (photo.pairs + kGaussians));
    }
  }
  EXPECT_LE(overflows, 2);
  EXPECT_LE(waits[0] + waits[1],
            kSizeClasses * PairGuessPolicy::kCountedFrames + overflows * PairGuessPolicy::kRecountedFrames);
  EXPECT_EQ(waits[2], 0);
}

TEST(PairGuessTest, GrowsInProportionToTheTilesUntilTheDeviceHasSpoken) {
  const TileGrid small = {16 * 40, 16 * 30}, large = {16 * 50, 16 * 40};  // 1200 and 2000 tiles
  Renderer renderer;
  while (renderer.frame(small, 1000, 1200000) == 0) {}
  EXPECT_GE(renderer.frame(large, 1000, 1300000), 2500000);
  for (int k = 0; k < 3; ++k) renderer.frame(large, 1000, 1300000);
  EXPECT_LE(renderer.frame(large, 1000, 1300000), 1700000 * 9 / 8);
}

TEST(PairGuessTest, CountsAnewForImagesOfAnotherClassOfSizes) {
  Renderer renderer;
  renderer.count_frames(1000, 1000000);
  EXPECT_EQ(renderer.frame({320, 240}, 1000, 10), 0) << "a preview does not get the room of the picture";
  EXPECT_EQ(renderer.frame({1280, 960}, 1000, 10), 0);
  EXPECT_GT(renderer.frame({672, 448}, 1000, 1000000), 0) << "nearly the same size";
}

/// A key of its own for each device.
TEST(PairGuessTest, KeepsTheSizesUsedLast) {
  Renderer renderer;
  renderer.count_frames(1000, 1000000);
  for (int device = 1; device < PairGuesses::kSlots; ++device)
    renderer.guesses.begin(device, kGrid, 10, kMost, Counting::kIfNeeded);
  EXPECT_GT(renderer.frame(1000, 1000000), 0) << "there was a slot for each";
  for (int device = 1; device <= PairGuesses::kSlots; ++device)
    renderer.guesses.begin(device, kGrid, 10, kMost, Counting::kIfNeeded);
  EXPECT_EQ(renderer.frame(1000, 1000000), 0) << "its slot was given away";
}

TEST(PairGuessTest, AWriteThatComesLateIsNotOfTheSlotsNewDevice) {
  Renderer renderer;
  renderer.frame(1000, 1000000);
  const PairGuesses::Frame late = renderer.guesses.begin(0, kGrid, 1000, kMost, Counting::kNever);
  for (int device = 1; device <= PairGuesses::kSlots; ++device)
    renderer.guesses.begin(device, kGrid, 10, kMost, Counting::kIfNeeded);
  int next = -1;  // the device that has the slot now
  for (int device = 1; device <= PairGuesses::kSlots; ++device) {
    const PairGuesses::Frame frame = renderer.guesses.begin(device, kGrid, 10, kMost, Counting::kIfNeeded);
    if (frame.slot == late.slot) next = device;
    renderer.guesses.counted(frame, 10, 100);
  }
  ASSERT_GT(next, 0);
  *late.word = uint64_t(late.number) << 32 | 900000000;
  EXPECT_LE(renderer.guesses.begin(next, kGrid, 10, kMost, Counting::kNever).capacity, 200000);
}

TEST(PairGuessTest, HasRoomForAPairOfEveryGaussian) {
  Renderer renderer;
  renderer.count_frames(5000000, 1000);  // nearly all of them out of sight
  EXPECT_GE(renderer.frame(5000000, 1000), 5000000);
  EXPECT_GE(renderer.frame(5000000, 1000, Counting::kNever), 5000000);
  renderer.guesses.force(64);
  EXPECT_EQ(renderer.frame(1000, 10), 1000);
}

TEST(PairGuessTest, ForcedRoomIsForgottenWithAllElse) {
  Renderer renderer;
  renderer.count_frames(1000, 1000000);
  renderer.guesses.force(2000);
  EXPECT_EQ(renderer.frame(1000, 1000000), 2000);
  EXPECT_EQ(renderer.frame(1000, 1000000, Counting::kAlways), 0);
  renderer.guesses.force(0);
  EXPECT_EQ(renderer.frame(1000, 1000000), 0);
}

}  // namespace
}  // namespace ar::cuda
