#include "cuda/pair_guess.h"

#include <gtest/gtest.h>

#include <vector>

namespace ar::cuda {
namespace {

constexpr int64_t kMost = (int64_t(1) << 30) - 1;

/// Renders frames of one image size with a device that is `lag` frames behind, as long as the host does not wait for
/// it.
class Renderer {
 public:
  explicit Renderer(int width = 640, int lag = 2) : width_(width), lag_(lag) {}

  /// Room for a frame with so many pairs; 0 if they were counted.
  int64_t frame(int64_t gaussians, int64_t pairs, Counting counting = Counting::kIfNeeded) {
    const PairGuesses::Frame frame = guesses.begin(0, {width_, 480}, gaussians, kMost, counting);
    queue_.push_back({frame, pairs});
    if (frame.capacity == 0) guesses.counted(frame, gaussians, pairs);
    while (queue_.size() > size_t(frame.capacity == 0 ? 0 : lag_)) write_next();
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
  int width_, lag_;
  std::vector<Queued> queue_;
};

TEST(PairGuessTest, CountsTheFirstFramesAndThenLeavesAReserve) {
  Renderer renderer;
  EXPECT_EQ(renderer.count_frames(1000, 1000000), PairGuess::kCountedFrames);
  const int64_t room = renderer.frame(1000, 1000000);
  EXPECT_GE(room, 1250000);
  EXPECT_LE(room, 1250000 + (1 << 16));
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
    if (counted == PairGuess::kRecountedFrames && next > 0) {
      EXPECT_GE(next, 12 * room);
    }
  }
  EXPECT_EQ(counted, PairGuess::kRecountedFrames);
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
  EXPECT_LE(room, 1700000) << "not 64 times as many";
}

TEST(PairGuessTest, WaitsOnlyWhereItMay) {
  Renderer renderer;
  EXPECT_EQ(renderer.guesses.begin(0, {640, 480}, 1000, kMost, Counting::kNever).capacity, 0) << "nothing is known";
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
  for (int frame = 0; frame < 2 * PairGuess::kCountedFrames; ++frame)
    EXPECT_LE(renderer.guesses.begin(0, {640, 480}, 10, 1 << 20, Counting::kIfNeeded).capacity, 1 << 20);
  renderer.count_frames(10, (int64_t(1) << 32) - 1);
  EXPECT_EQ(renderer.guesses.begin(0, {640, 480}, 10, 1 << 20, Counting::kNever).capacity, 1 << 20);
}

TEST(PairGuessTest, KeepsTheSizesUsedLast) {
  Renderer renderer;
  renderer.count_frames(1000, 1000000);
  for (int width = 1; width < PairGuesses::kSlots; ++width)
    renderer.guesses.begin(0, {width, 480}, 10, kMost, Counting::kIfNeeded);
  EXPECT_GT(renderer.frame(1000, 1000000), 0) << "there was a slot for each";
  for (int width = 1; width <= PairGuesses::kSlots; ++width)
    renderer.guesses.begin(0, {width, 480}, 10, kMost, Counting::kIfNeeded);
  EXPECT_EQ(renderer.frame(1000, 1000000), 0) << "its slot was given away";
}

TEST(PairGuessTest, AWriteThatComesLateIsNotOfTheSlotsNewSize) {
  Renderer renderer;
  renderer.frame(1000, 1000000);
  const PairGuesses::Frame late = renderer.guesses.begin(0, {640, 480}, 1000, kMost, Counting::kNever);
  for (int width = 1; width <= PairGuesses::kSlots; ++width)
    renderer.guesses.begin(0, {width, 480}, 10, kMost, Counting::kIfNeeded);
  int next = -1;  // the size that has the slot now
  for (int width = 1; width <= PairGuesses::kSlots; ++width) {
    const PairGuesses::Frame frame = renderer.guesses.begin(0, {width, 480}, 10, kMost, Counting::kIfNeeded);
    if (frame.slot == late.slot) next = width;
    renderer.guesses.counted(frame, 10, 100);
  }
  ASSERT_GT(next, 0);
  *late.word = uint64_t(late.number) << 32 | 900000000;
  EXPECT_LE(renderer.guesses.begin(0, {next, 480}, 10, kMost, Counting::kNever).capacity, 200000);
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
