#include "cuda/pair_guess.h"

#include <gtest/gtest.h>

namespace ar::cuda {
namespace {

/// Counts frames until one is guessed, and returns how many.
int count_frames(PairGuess& guess, int64_t gaussians, int64_t pairs) {
  int frames = 0;
  while (guess.capacity(gaussians, pairs, true) == 0) {
    guess.counted(gaussians, pairs);
    if (++frames > 1000) break;
  }
  return frames;
}

TEST(PairGuessTest, CountsTheFirstFramesAndThenLeavesAReserve) {
  PairGuess guess;
  EXPECT_EQ(count_frames(guess, 1000, 1000000), PairGuess::kCountedFrames);
  const int64_t room = guess.capacity(1000, 1000000, true);
  EXPECT_GE(room, 1250000);
  EXPECT_LE(room, 1250000 + (1 << 16));
}

TEST(PairGuessTest, RemembersTheLargestFrame) {
  PairGuess guess;
  guess.counted(1000, 5000000);
  count_frames(guess, 1000, 10);
  EXPECT_GE(guess.capacity(1000, 10, true), 6250000);
}

TEST(PairGuessTest, CountsAgainAfterAnOverflow) {
  PairGuess guess;
  count_frames(guess, 1000, 1000000);
  const int64_t room = guess.capacity(1000, 1000000, true);
  EXPECT_GT(guess.capacity(1000, room, true), 0) << "it fitted";
  EXPECT_EQ(count_frames(guess, 1000, 10 * room), PairGuess::kCountedFrames);
  EXPECT_GE(guess.capacity(1000, 10 * room, true), 12 * room);
}

TEST(PairGuessTest, FollowsTheNumberOfGaussians) {
  PairGuess guess;
  count_frames(guess, 1000, 1000000);
  EXPECT_EQ(count_frames(guess, 1900, 1200000), PairGuess::kRecountedFrames) << "densification";
  EXPECT_GE(guess.capacity(1900, 10, true), 1500000);
  EXPECT_EQ(count_frames(guess, 1000, 300), PairGuess::kRecountedFrames) << "pruning";
  EXPECT_GE(guess.capacity(1000, 10, true), 1500000) << "views differ more than that";
  EXPECT_EQ(count_frames(guess, 400, 300), PairGuess::kCountedFrames) << "another scene";
  EXPECT_LE(guess.capacity(400, 300, true), 375 + (1 << 16));
  EXPECT_EQ(count_frames(guess, 4000, 3000), PairGuess::kCountedFrames) << "another scene";
}

TEST(PairGuessTest, WaitsOnlyWhereItMay) {
  PairGuess guess;
  EXPECT_EQ(guess.capacity(1000, 0, false), 0) << "nothing is known";
  guess.counted(1000, 1000000);
  EXPECT_GT(guess.capacity(1000, 1000000, false), 1250000);
  EXPECT_EQ(guess.capacity(1000, 1000000, true), 0);
}

TEST(PairGuessTest, NeverExceedsTheMost) {
  PairGuess guess(1 << 20);
  EXPECT_EQ(count_frames(guess, 10, int64_t(1) << 40), PairGuess::kCountedFrames);
  EXPECT_EQ(guess.capacity(10, int64_t(1) << 40, false), 1 << 20);
}

}  // namespace
}  // namespace ar::cuda
