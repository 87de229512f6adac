// The threads of parallel_for() (parallel.h). A loop of OpenMP ends when every thread has arrived, and on a busy
// machine threads that spin delay the late ones. Here the calling thread runs items, helpers run others, and a loop
// waits only for helpers that have begun.
#include "cpu/parallel.h"

#if defined(__unix__) || defined(__APPLE__)
#include <pthread.h>
#endif

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <exception>
#include <mutex>
#include <thread>
#include <utility>

namespace ar::cpu {
namespace {

/// Threads spin this long before they sleep. The next loop mostly begins sooner, and to wake a thread takes as long.
constexpr std::chrono::microseconds kPatience(100);

template <class There> bool spin_until(const There& there) {
  const auto end = std::chrono::steady_clock::now() + kPatience;
  do {
    for (int i = 0; i < 16; ++i) {
      if (there()) return true;
#if defined(__x86_64__)
      __builtin_ia32_pause();
#endif
    }
  } while (std::chrono::steady_clock::now() < end);
  return there();
}

/// Four fields: helpers inside, helpers that joined, free seats, and whether the calling thread sleeps.
using Seats = uint64_t;
constexpr Seats kInside = 1, kJoined = Seats(1) << 16, kFree = Seats(1) << 32, kAwaited = Seats(1) << 48;
constexpr int kMostThreads = 0x7fff;
constexpr int count(Seats seats, Seats what) { return int(seats / what & 0xffff); }

/// Never freed: a late helper may read it.
struct Loop {
  int64_t items;
  RunItem run;
  const void* body;
  std::exception_ptr error;                  ///< Of an item.
  alignas(64) std::atomic<int64_t> next{0};  ///< Item that no thread has claimed.
};

/// Its helpers never end. Up to kLoops loops have helpers at a time.
class Pool {
 public:
  void run(int64_t items, int helpers, RunItem run, const void* body) {
    const int slot = claim_loop();
    if (slot == kLoops) {
      for (int64_t item = 0; item < items; ++item) run(body, item, 0);
      return;
    }
    Loop& loop = loops_[slot];
    loop.items = items;
    loop.run = run;
    loop.body = body;
    loop.next.store(0, std::memory_order_relaxed);
    start(helpers);
    seats_[slot] = Seats(helpers) * kFree;
    wake(helpers);
    work_on(loop, 0);
    close(slot);
    await_helpers(slot);
    const std::exception_ptr error = std::exchange(loop.error, nullptr);
    is_claimed_[slot] = false;
    if (error) std::rethrow_exception(error);
  }

 private:
  static constexpr int kLoops = 8;

  int claim_loop() {
    int slot = 0;
    while (slot < kLoops && is_claimed_[slot].exchange(true)) ++slot;
    return slot;
  }

  void start(int count) {
    if (started_ >= count) return;
    const std::lock_guard lock(mutex_);
    try {
      for (; started_ < count; ++started_) std::thread([this] { help(); }).detach();
    } catch (const std::exception&) {  // The system allows no more.
    }
  }

  void wake(int helpers) {
    int sleepers = std::min<int>(helpers - looking_, asleep_);
    if (sleepers <= 0) return;
    { const std::lock_guard lock(mutex_); }  // No helper is about to fall asleep.
    for (; sleepers > 0; --sleepers) wake_.notify_one();
  }

  void await_helpers(int slot) {
    const auto have_left = [&] { return count(seats_[slot], kInside) == 0; };
    if (spin_until(have_left)) return;
    seats_[slot] |= kAwaited;
    std::unique_lock lock(mutex_);
    left_.wait(lock, have_left);
  }

  [[noreturn]] void help() {
    for (;;) {
      int slot, thread;
      ++looking_;
      const bool is_there = spin_until([&] { return join(slot, thread); });
      --looking_;
      if (!is_there) {
        std::unique_lock lock(mutex_);
        ++asleep_;
        wake_.wait(lock, [&] { return join(slot, thread); });
        --asleep_;
      }
      work_on(loops_[slot], thread);
      close(slot);
      const Seats seats = seats_[slot].fetch_sub(kInside);
      if (count(seats, kInside) == 1 && (seats & kAwaited)) {
        {
          const std::lock_guard lock(mutex_);
        }
        left_.notify_all();
      }
    }
  }

  /// Claims a free seat.
  bool join(int& slot, int& thread) {
    for (slot = 0; slot < kLoops; ++slot) {
      Seats seats = seats_[slot].load();
      while (count(seats, kFree)) {
        if (!seats_[slot].compare_exchange_weak(seats, seats - kFree + kJoined + kInside)) continue;
        thread = count(seats, kJoined) + 1;
        return true;
      }
    }
    return false;
  }

  /// No other helper may join.
  void close(int slot) {
    if (count(seats_[slot], kFree)) seats_[slot] &= ~(0xffff * kFree);
  }

  void work_on(Loop& loop, int thread) {
    try {
      for (;;) {
        const int64_t item = loop.next.fetch_add(1, std::memory_order_relaxed);
        if (item >= loop.items) return;
        loop.run(loop.body, item, thread);
      }
    } catch (...) {
      const std::lock_guard lock(mutex_);
      if (!loop.error) loop.error = std::current_exception();
    }
  }

  alignas(64) std::atomic<Seats> seats_[kLoops] = {};
  alignas(64) std::atomic<int> started_{0}, looking_{0}, asleep_{0};
  std::atomic<bool> is_claimed_[kLoops] = {};
  Loop loops_[kLoops];
  std::mutex mutex_;
  std::condition_variable wake_, left_;
};

std::atomic<Pool*> the_pool{nullptr};

#if defined(__unix__) || defined(__APPLE__)
// A forked child has no helpers. It makes a new pool, since the parent's may be in use.
[[maybe_unused]] const int kWatchesForks = pthread_atfork(nullptr, nullptr, [] { the_pool = nullptr; });
#endif

Pool& pool() {
  Pool* there = the_pool;
  if (there) return *there;
  Pool* const made = new Pool;
  if (the_pool.compare_exchange_strong(there, made)) return *made;
  delete made;
  return *there;
}

}  // namespace

void run_items(int64_t items, int threads, RunItem run, const void* body) {
  const int wanted = int(std::min<int64_t>({items, threads, kMostThreads}));
  if (wanted > 1) {
    pool().run(items, wanted - 1, run, body);
    return;
  }
  for (int64_t item = 0; item < items; ++item) run(body, item, 0);
}

}  // namespace ar::cpu
