// parallel_for(): threads of OpenMP, as many as team.h says, take items from a shared counter. Without OpenMP the
// calling thread runs all.
#include "cpu/parallel.h"

#if defined(_OPENMP)
#include <omp.h>
#include <pthread.h>

#include <atomic>
#include <exception>
#include <limits>
#include <mutex>
#include <system_error>
#include <thread>
#include <unordered_map>
#include <vector>

#include "cpu/team.h"
#endif

namespace ar::cpu {
namespace {

void run_alone(int64_t items, RunItem run, const void* body) {
  for (int64_t item = 0; item < items; ++item) run(body, item, 0);
}

#if defined(_OPENMP)
// GNU's OpenMP waits for threads that a forked child does not have.
std::atomic<bool> is_forked{false};
[[maybe_unused]] const int kWatchesForks = pthread_atfork(nullptr, nullptr, [] { is_forked = true; });

/// By loop of the program, since a short one waits for threads that are in time for a long one. Never freed: threads
/// may outlive main().
struct Teams {
  std::mutex mutex;
  std::unordered_map<RunItem, TeamSize> sizes;
};
Teams& teams = *new Teams;

/// `wanted`, or as many threads as the system has room for: GNU's OpenMP would end the process.
int threads_with_room(int wanted) {
  thread_local int proven = 1;
  if (wanted <= proven) return wanted;
  std::vector<std::thread> threads;
  std::mutex all_are_there;
  {
    const std::lock_guard lock(all_are_there);
    try {
      while (int(threads.size()) < wanted - 1) {
        threads.emplace_back([&] { const std::lock_guard wait(all_are_there); });
      }
    } catch (const std::system_error&) {}
  }
  for (std::thread& thread : threads) thread.join();
  proven = int(threads.size()) + 1;
  return proven;
}

/// Returns `together` of TeamSize::learn().
double run_with(int team, int64_t items, RunItem run, const void* body) {
  std::atomic<int64_t> next{0};
  std::mutex mutex;
  std::exception_ptr error;
  double last_begin = 0, first_end = std::numeric_limits<double>::infinity();
#pragma omp parallel num_threads(team) reduction(max : last_begin) reduction(min : first_end)
  {
    last_begin = omp_get_wtime();
    const int thread = omp_get_thread_num();
    try {
      for (int64_t item; (item = next.fetch_add(1, std::memory_order_relaxed)) < items;) run(body, item, thread);
    } catch (...) {
      const std::lock_guard lock(mutex);
      if (!error) error = std::current_exception();
    }
    first_end = omp_get_wtime();
  }
  if (error) std::rethrow_exception(error);
  return first_end - last_begin;
}
#endif

}  // namespace

#if defined(_OPENMP)
void run_items(int64_t items, int threads, RunItem run, const void* body) {
  if (items <= 1 || threads <= 1 || is_forked || omp_in_parallel()) {
    run_alone(items, run, body);
    return;
  }
  TeamSize* size;
  int team;
  {
    const std::lock_guard lock(teams.mutex);
    size = &teams.sizes[run];
    team = size->next(threads);
  }
  team = threads_with_room(team);
  const double begin = omp_get_wtime();
  double together = 0;
  if (team > 1) {
    together = run_with(team, items, run, body);
  } else {
    run_alone(items, run, body);
  }
  const double took = omp_get_wtime() - begin;
  const std::lock_guard lock(teams.mutex);
  size->learn(team, together, took);
}
#else
void run_items(int64_t items, int, RunItem run, const void* body) { run_alone(items, run, body); }
#endif

}  // namespace ar::cpu
