// How many threads a loop gets, without a clock or threads of its own. A loop of OpenMP waits for all of its team;
// beside other programs the last may come after all work is done.
#pragma once

#include <algorithm>
#include <climits>

namespace ar::cpu {

/// Halves the team when loops lose more by waiting for late threads than they gain. Now and then tries twice as many.
/// Times: s.
class TeamSize {
 public:
  /// For the next loop, from 1 to `threads`.
  int next(int threads) {
    if (size_ < threads && rest_ <= 0) {
      size_ = std::min(2 * size_, threads);
      balance_ = kCredit;
    }
    return std::min(size_, threads);
  }

  /// After a loop with a team of this size. `together`: from when the last thread began until the first found no item.
  /// Negative if the last came too late, and the loop waited for nothing.
  void learn(int team, double together, double took) {
    rest_ -= took;
    if (team == 1) return;
    balance_ = kMemory * balance_ + together;
    if (balance_ >= 0) return;
    size_ = team / 2;
    rest_ = kRest * (kCredit - balance_);
    balance_ = 0;
  }

  static constexpr double kCredit = 500e-6;  ///< Of a larger team, which must be started.
  static constexpr double kRest = 32;        ///< Time before the next trial, in parts of what the last one lost.

 private:
  static constexpr double kMemory = 0.9;  ///< Of a loop for those before it.

  int size_ = INT_MAX;
  double balance_ = kCredit;  ///< Gains less losses.
  double rest_ = 0;           ///< Time of loops until a trial.
};

}  // namespace ar::cpu
