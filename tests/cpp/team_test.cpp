// How many threads loops get, in worlds that are only numbers.
#include "cpu/team.h"

#include <gtest/gtest.h>

#include <algorithm>

namespace ar::test {
namespace {

using cpu::TeamSize;

/// Loops of `work` seconds that threads divide among them evenly. With more than `prompt` threads the last one comes
/// `late` seconds after the others.
struct World {
  int prompt;
  double work, late;

  /// Runs a loop. Returns what it took.
  double run(TeamSize& size, int threads) const {
    const int team = size.next(threads);
    EXPECT_GE(team, 1);
    EXPECT_LE(team, threads);
    const double begin = team > prompt ? late : 0, end = work / team;
    const double took = std::max(begin, end);
    size.learn(team, end - begin, took);
    return took;
  }
  /// Runs loops. Returns what they took.
  double run(TeamSize& size, int threads, int loops) const {
    double took = 0;
    for (int i = 0; i < loops; ++i) took += run(size, threads);
    return took;
  }
};

constexpr World kIdle = {1 << 20, 1e-3, 0};
constexpr World kBusy = {1, 1e-3, 20e-3};  // Each loop waits for a turn of the scheduler.

TEST(TeamTest, AllThreadsWhileTheyComeInTime) {
  TeamSize size;
  for (int i = 0; i < 1000; ++i) {
    EXPECT_EQ(size.next(16), 16);
    kIdle.run(size, 16);
  }
}

TEST(TeamTest, NoMoreThanAllowed) {
  TeamSize size;
  kIdle.run(size, 16);
  for (const int threads : {2, 16, 1, 3}) EXPECT_EQ(size.next(threads), threads);
}

TEST(TeamTest, ThreadsThatComeLateAreLeftOut) {
  TeamSize size;
  kBusy.run(size, 16, 100);
  EXPECT_EQ(size.next(16), 1);
}

TEST(TeamTest, ThreadsThatComeInTimeStay) {
  TeamSize size;
  World{4, 1e-3, 20e-3}.run(size, 16, 100);
  EXPECT_EQ(size.next(16), 4);
}

TEST(TeamTest, AWaitThatPaysIsNoReasonToLeaveAThreadOut) {
  TeamSize size;
  World{1, 100e-3, 20e-3}.run(size, 2, 1000);
  EXPECT_EQ(size.next(2), 2);
}

TEST(TeamTest, TrialsCostLittle) {
  for (const int threads : {2, 16}) {
    for (const double work : {10e-6, 1e-3, 15e-3}) {
      const World busy = {1, work, 20e-3};
      TeamSize size;
      busy.run(size, threads, 100);
      // A trial rests until loops took kRest times what it lost, less the credit that it had.
      const int loops = 1000000;
      EXPECT_LE(busy.run(size, threads, loops), loops * work * (1 + 2 / TeamSize::kRest)) << threads << " " << work;
    }
  }
}

TEST(TeamTest, ThreadsComeBack) {
  TeamSize size;
  kBusy.run(size, 16, 100);
  // The first trial follows what the last one lost, and each of the four doublings is one loop.
  double took = 0;
  while (size.next(16) < 16 && took < 10) took += kIdle.run(size, 16);
  EXPECT_LE(took, TeamSize::kRest * (kBusy.late + TeamSize::kCredit) + 10e-3);
}

TEST(TeamTest, StartingThreadsIsNotHeldAgainstThem) {
  TeamSize size;
  size.learn(16, -0.9 * TeamSize::kCredit, 1e-3);
  for (int i = 0; i < 20; ++i) kIdle.run(size, 16);
  EXPECT_EQ(size.next(16), 16);
}

}  // namespace
}  // namespace ar::test
