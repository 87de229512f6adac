// Loops that threads share: what is relied on for any number of threads and of callers.
#include "cpu/parallel.h"

#include <gtest/gtest.h>
#if defined(__unix__)
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>
#endif

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <fstream>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <thread>
#include <vector>

namespace ar::test {
namespace {

/// Holds up whoever comes until `count` have come. Nobody waits for ever.
class Meeting {
 public:
  explicit Meeting(int count) : missing_(count) {}
  /// Whether all have come.
  bool meet() {
    std::unique_lock lock(mutex_);
    --missing_;
    all_.notify_all();
    return all_.wait_for(lock, std::chrono::minutes(5), [this] { return missing_ <= 0; });
  }

 private:
  std::mutex mutex_;
  std::condition_variable all_;
  int missing_;
};

/// Runs a loop. Whether every item ran once, and no two at the same time with the same number of a thread.
bool runs_every_item_once(int64_t items, int threads) {
  const std::unique_ptr<std::atomic<int>[]> runs(new std::atomic<int>[items]());
  const std::unique_ptr<std::atomic<bool>[]> in_use(new std::atomic<bool>[threads]());
  std::atomic<bool> is_right{true};
  cpu::parallel_for(items, threads, [&](int64_t item, int thread) {
    if (thread < 0 || thread >= threads || in_use[thread].exchange(true)) {
      is_right = false;
      return;
    }
    ++runs[item];
    in_use[thread] = false;
  });
  for (int64_t item = 0; item < items; ++item) is_right = is_right && runs[item] == 1;
  return is_right;
}

TEST(ParallelTest, EveryItemRunsOnce) {
  for (const int threads : {1, 2, 7, 3, 20, 2}) {
    for (const int64_t items : {0, 1, 2, 3, 5000}) {
      EXPECT_TRUE(runs_every_item_once(items, threads)) << items << " items, " << threads << " threads";
    }
  }
}

TEST(ParallelTest, BodiesNeedNoNumberOfTheThread) {
  std::vector<int> out(100);
  cpu::parallel_for(100, 3, [&](int64_t item) { out[item] = int(item); });
  for (int i = 0; i < 100; ++i) EXPECT_EQ(out[i], i);
}

#if defined(_OPENMP)
TEST(ParallelTest, ThreadsWorkAtTheSameTime) {
  for (const int threads : {2, 5}) {
    Meeting meeting(threads);
    std::vector<int> numbers(threads, -1);
    std::atomic<bool> have_met{true};
    cpu::parallel_for(threads, threads, [&](int64_t item, int thread) {
      numbers[item] = thread;
      if (!meeting.meet()) have_met = false;
    });
    EXPECT_TRUE(have_met);
    std::sort(numbers.begin(), numbers.end());
    for (int i = 0; i < threads; ++i) EXPECT_EQ(numbers[i], i);
  }
}

TEST(ParallelTest, LoopsOfTwoCallersDoNotWaitForEachOther) {
  constexpr int kThreads = 4;
  // Four threads stay in the first loop until the second one is over.
  Meeting inside(kThreads + 1), over(kThreads + 1);
  std::thread first([&] { cpu::parallel_for(kThreads, kThreads, [&](int64_t) { inside.meet() && over.meet(); }); });
  EXPECT_TRUE(inside.meet());
  EXPECT_TRUE(runs_every_item_once(1000, kThreads));
  EXPECT_TRUE(over.meet());
  first.join();
}
#endif

TEST(ParallelTest, ManyCallers) {
  std::atomic<int> right{0};
  std::vector<std::thread> callers;
  for (int c = 0; c < 12; ++c) {
    callers.emplace_back([&right, c] {
      for (int i = 0; i < 200; ++i) right += runs_every_item_once(1 + (i * 7 + c) % 40, 2 + (i + c) % 4);
    });
  }
  for (std::thread& caller : callers) caller.join();
  EXPECT_EQ(right, 12 * 200);
}

TEST(ParallelTest, LoopsInsideOfLoops) {
  std::atomic<int> right{0};
  cpu::parallel_for(30, 3, [&](int64_t) { right += runs_every_item_once(20, 4); });
  EXPECT_EQ(right, 30);
}

TEST(ParallelTest, AnExceptionReachesTheCaller) {
  for (const int threads : {1, 2, 5}) {
    for (const int64_t thrower : {0, 50, 99}) {
      std::atomic<int> begun{0}, ended{0};
      const auto loop = [&] {
        cpu::parallel_for(100, threads, [&](int64_t item) {
          ++begun;
          if (item == thrower) throw std::runtime_error("item");
          ++ended;
        });
      };
      EXPECT_THROW(loop(), std::runtime_error);
      EXPECT_EQ(begun, ended + 1);  // the others have been waited for
      EXPECT_TRUE(runs_every_item_once(100, threads));
    }
  }
}

// Not under AddressSanitizer: at a fork another thread may be in its allocator, which then stays locked in the child.
#if defined(__unix__) && !defined(AR_SANITIZED)
/// Whether is_right() in a forked child.
template <class IsRight> bool in_a_child(const IsRight& is_right) {
  const pid_t child = fork();
  if (child == 0) _exit(is_right() ? 0 : 1);
  int status = -1;
  return waitpid(child, &status, 0) == child && WIFEXITED(status) && WEXITSTATUS(status) == 0;
}

/// Whether loops run, all on the thread that began them.
bool runs_alone() {
  const std::thread::id caller = std::this_thread::get_id();
  std::atomic<bool> is_alone{true};
  cpu::parallel_for(1000, 3, [&](int64_t, int thread) {
    if (thread != 0 || std::this_thread::get_id() != caller) is_alone = false;
  });
  return is_alone && runs_every_item_once(1000, 3);
}

TEST(ParallelTest, AForkedChildRunsLoopsOnOneThread) {
  EXPECT_TRUE(runs_every_item_once(1000, 3));
  EXPECT_TRUE(in_a_child(runs_alone));
  EXPECT_TRUE(in_a_child([] { return in_a_child(runs_alone); }));
  EXPECT_TRUE(runs_every_item_once(1000, 3));
}

TEST(ParallelTest, ForkedWhileAnotherThreadIsInALoop) {
  Meeting inside(2), over(2);
  std::thread other([&] {
    cpu::parallel_for(2, 2, [&](int64_t item) {
      if (item == 0) inside.meet() && over.meet();
    });
  });
  EXPECT_TRUE(inside.meet());
  EXPECT_TRUE(in_a_child(runs_alone));
  EXPECT_TRUE(over.meet());
  other.join();
}

#if defined(__linux__)
/// Whether a loop with 40 threads runs where there is no memory for the stack of a thread.
bool runs_without_room() {
  int64_t pages = 0;
  std::ifstream("/proc/self/statm") >> pages;
  const rlim_t room = rlim_t(pages) * sysconf(_SC_PAGESIZE) + (1 << 20);
  const rlimit limit = {room, room};
  return setrlimit(RLIMIT_AS, &limit) == 0 && runs_every_item_once(1000, 40);
}

TEST(ParallelTest, WithoutRoomForThreadsTheCallerDoesAll) {
  ::testing::FLAGS_gtest_death_test_style = "threadsafe";  // The program again, which is no forked child.
  EXPECT_EXIT(_exit(runs_without_room() ? 0 : 1), ::testing::ExitedWithCode(0), "");
}
#endif
#endif

}  // namespace
}  // namespace ar::test
