// A step of Adam [Kingma and Ba 2015, Algorithm 1] for one number, and how the numbers of several tensors are divided
// among threads. As in torch.optim.Adam epsilon is outside the root.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/platform.h"

namespace ar {

/// AdamParams must fit the 4 KiB of a kernel's arguments.
inline constexpr int kAdamTensors = 16;

template <typename T> struct AdamRule {
  T beta1, one_minus_beta1, beta2, one_minus_beta2, eps;
  T rate;        ///< learning rate / (1 - beta1^step)
  T head_rate;   ///< of the `head` of every row
  T root_scale;  ///< 1 / sqrt(1 - beta2^step)
};

template <typename T> struct AdamTensor {
  int64_t n;         ///< at least 1
  int64_t row_size;  ///< numbers in a row
  int64_t head;      ///< first numbers of a row, with another learning rate
  bool aligned;      ///< all pointers are multiples of 16 bytes
  AdamRule<T> rule;
  const T* grad;  ///< [n]
  T* param;       ///< [n]
  T* exp_avg;     ///< [n]
  T* exp_avg_sq;  ///< [n]
};

template <typename T> struct AdamParams {
  const uint8_t* rows;  ///< of every tensor: a row is updated unless it is 0; null: all rows
  int count;
  AdamTensor<T> tensors[kAdamTensors];
  int64_t first_item[kAdamTensors + 1];  ///< written by divide_work
};

struct AdamPart {
  int tensor;
  int64_t begin, end;
};

/// Into items of `numbers` numbers. Returns how many.
template <typename T> int64_t divide_work(AdamParams<T>& p, int64_t numbers) {
  p.first_item[0] = 0;
  for (int k = 0; k < p.count; ++k) p.first_item[k + 1] = p.first_item[k] + (p.tensors[k].n + numbers - 1) / numbers;
  return p.first_item[p.count];
}

/// An item of divide_work(p, numbers).
template <typename T> AR_HD AdamPart part_of_item(const AdamParams<T>& p, int64_t item, int64_t numbers) {
  int k = 0;
  while (item >= p.first_item[k + 1]) ++k;
  const int64_t begin = (item - p.first_item[k]) * numbers, end = begin + numbers, n = p.tensors[k].n;
  return {k, begin, end < n ? end : n};
}

/// `rate`: rule.rate or rule.head_rate.
template <typename T> AR_HD void adam(const AdamRule<T>& rule, T rate, T grad, T& param, T& exp_avg, T& exp_avg_sq) {
  exp_avg = rule.beta1 * exp_avg + rule.one_minus_beta1 * grad;
  exp_avg_sq = rule.beta2 * exp_avg_sq + rule.one_minus_beta2 * grad * grad;
  param = param - rate * (exp_avg / (std::sqrt(exp_avg_sq) * rule.root_scale + rule.eps));
}

}  // namespace ar
