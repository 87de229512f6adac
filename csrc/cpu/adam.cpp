// adam of training.h: a step on several tensors at once.
#include "core/adam.h"

#include <algorithm>

#include "cpu/parallel.h"
#include "cpu/training.h"

namespace ar::cpu {
namespace {

constexpr int64_t kNumbers = 16384;

template <typename T> void update(const AdamTensor<T>& t, T rate, int64_t begin, int64_t end) {
  // A local rule, and pointers that the op has found not to overlap, let the compiler vectorise the loop.
  const AdamRule<T> rule = t.rule;
  const T* __restrict grad = t.grad;
  T* __restrict param = t.param, * __restrict exp_avg = t.exp_avg, * __restrict exp_avg_sq = t.exp_avg_sq;
  for (int64_t i = begin; i < end; ++i) ar::adam(rule, rate, grad[i], param[i], exp_avg[i], exp_avg_sq[i]);
}

template <typename T> void update_rows(const uint8_t* rows, const AdamTensor<T>& t, int64_t begin, int64_t end) {
  for (int64_t row = begin / t.row_size; begin < end; ++row) {
    const int64_t next = std::min(end, (row + 1) * t.row_size);
    if (!rows || rows[row]) {
      const int64_t body = std::clamp(row * t.row_size + t.head, begin, next);
      update(t, t.rule.head_rate, begin, body);
      update(t, t.rule.rate, body, next);
    }
    begin = next;
  }
}

}  // namespace

template <typename T> void adam(AdamParams<T> p, int threads) {
  parallel_for(divide_work(p, kNumbers), threads, [&](int64_t item) {
    const AdamPart part = part_of_item(p, item, kNumbers);
    const AdamTensor<T>& t = p.tensors[part.tensor];
    const bool by_row = p.rows || t.head > 0;
    by_row ? update_rows(p.rows, t, part.begin, part.end) : update(t, t.rule.rate, part.begin, part.end);
  });
}

template void adam(AdamParams<float>, int);
template void adam(AdamParams<double>, int);

}  // namespace ar::cpu
