// The threads that loops share. OpenMP is not used: an OpenMP loop ends when every thread of its team has come, and the
// first ones spin until then. On a busy machine they take the time that the last one needs to get there. Here the
// calling thread takes items itself, and helpers take others. A loop waits only for helpers that have begun an item.
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

/// For so long a thread looks for what it waits for before it sleeps: the next loop of a picture mostly begins sooner,
/// and to wake a thread up takes about as long.
constexpr std::chrono::microseconds kPatience(100);

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

/// Four fields in one number: seats that are free, helpers that have joined, helpers that are inside, and whether the
/// calling thread sleeps until the last helper has left.
using Seats = uint64_t;
constexpr Seats kInside = 1, kJoined = Seats(1) << 16, kFree = Seats(1) << 32, kAwaited = Seats(1) << 48;
constexpr int kMostThreads = 0x7fff;
constexpr int count(Seats seats, Seats what) { return int(seats / what & 0xffff); }

/// A loop, in memory that is never freed: a helper may look at it when it is over.
struct Loop {
  int64_t items;
  RunItem run;
  const void* body;
  std::exception_ptr error;                  ///< what an item has thrown
  alignas(64) std::atomic<int64_t> next{0};  ///< the first item that nobody has taken
};

/// The helpers are never ended: at the end of the process they sleep.
class Pool {
 public:
  /// Runs all items. As many loops as there are places have helpers at the same time.
  void run(int64_t items, int helpers, RunItem run, const void* body) {
    const int place = take_place();
    if (place == kPlaces) {
      for (int64_t item = 0; item < items; ++item) run(body, item, 0);
      return;
    }
    Loop& loop = loops_[place];
    loop.items = items;
    loop.run = run;
    loop.body = body;
    loop.next.store(0, std::memory_order_relaxed);
    start(helpers);
    seats_[place] = Seats(helpers) * kFree;
    wake(helpers);
    take_items(loop, 0);
    close(place);
    await_helpers(place);
    const std::exception_ptr error = std::exchange(loop.error, nullptr);
    is_taken_[place] = false;
    if (error) std::rethrow_exception(error);
  }

 private:
  static constexpr int kPlaces = 8;

  int take_place() {
    int place = 0;
    while (place < kPlaces && is_taken_[place].exchange(true)) ++place;
    return place;
  }

  /// Has `count` helpers, or as many as the system allows.
  void start(int count) {
    if (started_ >= count) return;
    const std::lock_guard lock(mutex_);
    try {
      for (; started_ < count; ++started_) std::thread([this] { help(); }).detach();
    } catch (const std::exception&) {  // then those that there are do more
    }
  }

  /// Wakes those that are needed beside those that are awake.
  void wake(int helpers) {
    int sleepers = std::min<int>(helpers - looking_, asleep_);
    if (sleepers <= 0) return;
    { const std::lock_guard lock(mutex_); }  // nobody is between looking and falling asleep
    for (; sleepers > 0; --sleepers) wake_.notify_one();
  }

  void await_helpers(int place) {
    const auto have_left = [&] { return count(seats_[place], kInside) == 0; };
    if (spin_until(have_left)) return;
    seats_[place] |= kAwaited;
    std::unique_lock lock(mutex_);
    left_.wait(lock, have_left);
  }

  [[noreturn]] void help() {
    for (;;) {
      int place, thread;
      ++looking_;
      const bool is_there = spin_until([&] { return join(place, thread); });
      --looking_;
      if (!is_there) {
        std::unique_lock lock(mutex_);
        ++asleep_;
        wake_.wait(lock, [&] { return join(place, thread); });
        --asleep_;
      }
      take_items(loops_[place], thread);
      close(place);
      const Seats seats = seats_[place].fetch_sub(kInside);
      if (count(seats, kInside) == 1 && (seats & kAwaited)) {
        {
          const std::lock_guard lock(mutex_);
        }
        left_.notify_all();
      }
    }
  }

  /// Takes a free seat, if there is one.
  bool join(int& place, int& thread) {
    for (place = 0; place < kPlaces; ++place) {
      Seats seats = seats_[place].load();
      while (count(seats, kFree)) {
        if (!seats_[place].compare_exchange_weak(seats, seats - kFree + kJoined + kInside)) continue;
        thread = count(seats, kJoined) + 1;
        return true;
      }
    }
    return false;
  }

  /// Lets nobody else join.
  void close(int place) {
    if (count(seats_[place], kFree)) seats_[place] &= ~(0xffff * kFree);
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
    }
  }

  alignas(64) std::atomic<Seats> seats_[kPlaces] = {};
  alignas(64) std::atomic<int> started_{0}, looking_{0}, asleep_{0};
  std::atomic<bool> is_taken_[kPlaces] = {};
  Loop loops_[kPlaces];
  std::mutex mutex_;
  std::condition_variable wake_, left_;
};

std::atomic<Pool*> the_pool{nullptr};

#if defined(__unix__) || defined(__APPLE__)
// A forked child has none of the helpers. It makes a pool of its own; that of the parent may have been in use.
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
