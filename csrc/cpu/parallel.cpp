// The threads that loops share. OpenMP is not used: at the end of a loop every thread of its team must have come, and
// the first ones spin until then. On a busy machine the last one may have to wait for its turn until those that wait for
// it have used up theirs. Here threads take items while there are some. The one that began the loop takes them as well,
// so that it waits for no thread that has not begun an item.
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
#include <vector>

namespace ar::cpu {
namespace {

/// For so long a thread looks for what it waits for before it sleeps: about what it takes to wake it up. Within a
/// picture the next loop mostly begins sooner.
constexpr std::chrono::microseconds kPatience(50);

/// Whether `there()` became true while the thread had patience.
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

struct Loop {
  const int64_t items;
  const RunItem run;
  const void* const body;
  int free_seats;           ///< so many threads may still join
  std::atomic<int64_t> next{0};  ///< the first item that nobody has taken
  int next_thread = 1;           ///< the number of the next one that joins
  std::atomic<int> helpers{0};   ///< that have joined and not left
  std::exception_ptr error = {};  ///< what an item has thrown
};

/// Threads that are never ended: at the end of the process they sleep.
class Pool {
 public:
  /// Returns when all items have been run.
  void run(Loop& loop) {
    int to_wake = 0;
    {
      const std::lock_guard lock(mutex_);
      start_threads(loop.free_seats);
      loops_.push_back(&loop);
      open_.store(int(loops_.size()), std::memory_order_release);
      to_wake = std::min(loop.free_seats, asleep_);
    }
    for (; to_wake > 0; --to_wake) wake_.notify_one();
    take_items(loop, 0);
    {
      const std::lock_guard lock(mutex_);
      close(loop);
    }
    const auto have_left = [&] { return loop.helpers.load(std::memory_order_acquire) == 0; };
    if (!spin_until(have_left)) {
      std::unique_lock lock(mutex_);
      left_.wait(lock, have_left);
    }
    if (loop.error) std::rethrow_exception(loop.error);
  }

 private:
  /// As many as the system allows.
  void start_threads(int count) {
    try {
      for (; threads_ < count; ++threads_) std::thread([this] { help(); }).detach();
    } catch (const std::exception&) {  // then those that there are do more
    }
  }

  [[noreturn]] void help() {
    for (;;) {
      int thread;
      Loop& loop = join(thread);
      take_items(loop, thread);
      bool is_last;
      {
        const std::lock_guard lock(mutex_);
        close(loop);
        is_last = loop.helpers.fetch_sub(1, std::memory_order_release) == 1;  // from here on the loop may be gone
      }
      if (is_last) left_.notify_all();
      spin_until([this] { return open_.load(std::memory_order_acquire) > 0; });
    }
  }

  /// Waits for a loop and takes a seat in it.
  Loop& join(int& thread) {
    std::unique_lock lock(mutex_);
    ++asleep_;
    wake_.wait(lock, [this] { return !loops_.empty(); });
    --asleep_;
    Loop& loop = *loops_.front();
    thread = loop.next_thread++;
    loop.helpers.fetch_add(1, std::memory_order_relaxed);
    if (--loop.free_seats == 0) close(loop);
    return loop;
  }

  /// Lets nobody else join.
  void close(const Loop& loop) {
    loops_.erase(std::remove(loops_.begin(), loops_.end(), &loop), loops_.end());
    open_.store(int(loops_.size()), std::memory_order_release);
  }

  void take_items(Loop& loop, int thread) {
    try {
      for (;;) {
        const int64_t item = loop.next.fetch_add(1, std::memory_order_relaxed);
        if (item >= loop.items) return;
        loop.run(loop.body, item, thread);
      }
    } catch (...) {
      const std::lock_guard lock(mutex_);
      if (!loop.error) loop.error = std::current_exception();
      loop.next.store(loop.items, std::memory_order_relaxed);
    }
  }

  std::mutex mutex_;  ///< of everything below and what is in loops but for what is atomic
  std::condition_variable wake_, left_;
  std::vector<Loop*> loops_;  ///< with free seats, in the order in which they began
  std::atomic<int> open_{0};  ///< their number
  int threads_ = 0, asleep_ = 0;
};

std::atomic<Pool*> the_pool{nullptr};

#if defined(__unix__) || defined(__APPLE__)
// A forked child has none of the threads. It makes a pool of its own; that of the parent may have been in use.
[[maybe_unused]] const int kWatchesForks = pthread_atfork(nullptr, nullptr, [] { the_pool = nullptr; });
#endif

Pool& pool() {
  Pool* there = the_pool.load(std::memory_order_acquire);
  if (there) return *there;
  Pool* const made = new Pool;
  if (the_pool.compare_exchange_strong(there, made)) return *made;
  delete made;
  return *there;
}

}  // namespace

void run_items(int64_t items, int threads, RunItem run, const void* body) {
  const int wanted = int(std::min<int64_t>(items, threads));
  if (wanted <= 1) {
    for (int64_t item = 0; item < items; ++item) run(body, item, 0);
    return;
  }
  Loop loop{items, run, body, wanted - 1};
  pool().run(loop);
}

}  // namespace ar::cpu
