// A step of Adam [Kingma and Ba 2015, Algorithm 1] with the epsilon outside of the root, as torch.optim.Adam has it: of
// several tensors at once, each with a learning rate and a count of steps of its own.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/platform.h"

namespace ar {

/// Tensors that one launch updates. They and what belongs to them are the arguments of a kernel, of at most 4 KiB.
inline constexpr int kAdamTensors = 16;

/// The numbers of a step.
template <typename T> struct AdamRule {
  T beta1, one_minus_beta1, beta2, one_minus_beta2, eps;
  T rate;        ///< learning rate / (1 - beta1^step)
  T head_rate;   ///< the same of the first numbers of every row
  T root_scale;  ///< 1 / sqrt(1 - beta2^step)
};

/// A tensor, and the rule for it.
template <typename T> struct AdamTensor {
  int64_t n;         ///< numbers in it, at least 1
  int64_t row_size;  ///< numbers in one of its rows
  int64_t head;      ///< the first numbers of a row, which have a learning rate of their own; 0: none
  bool aligned;      ///< whether all its pointers are multiples of 16 bytes
  AdamRule<T> rule;
  const T* grad;  ///< [n]
  T* param;       ///< [n]
  T* exp_avg;     ///< [n]
  T* exp_avg_sq;  ///< [n]
};

template <typename T> struct AdamParams {
  const uint8_t* rows;  ///< rows that are not 0 are updated, the same of all tensors; null: all
  int count;            ///< of the tensors
  AdamTensor<T> tensors[kAdamTensors];
  int64_t first_item[kAdamTensors + 1];  ///< work items of the tensors: see divide_work
};

/// Numbers [begin, end) of a tensor.
struct AdamPart {
  int tensor;
  int64_t begin, end;
};

/// Divides the tensors into work items of `numbers` numbers of one tensor, and returns how many there are.
template <typename T> int64_t divide_work(AdamParams<T>& p, int64_t numbers) {
  p.first_item[0] = 0;
  for (int k = 0; k < p.count; ++k) p.first_item[k + 1] = p.first_item[k] + (p.tensors[k].n + numbers - 1) / numbers;
  return p.first_item[p.count];
}

/// A work item of divide_work(p, numbers).
template <typename T> AR_HD AdamPart part_of_item(const AdamParams<T>& p, int64_t item, int64_t numbers) {
  int k = 0;
  while (item >= p.first_item[k + 1]) ++k;
  const int64_t begin = (item - p.first_item[k]) * numbers, end = begin + numbers, n = p.tensors[k].n;
  return {k, begin, end < n ? end : n};
}

/// Updates one number with one of the rates of `rule`.
template <typename T> AR_HD void adam(const AdamRule<T>& rule, T rate, T grad, T& param, T& exp_avg, T& exp_avg_sq) {
  exp_avg = rule.beta1 * exp_avg + rule.one_minus_beta1 * grad;
  exp_avg_sq = rule.beta2 * exp_avg_sq + rule.one_minus_beta2 * grad * grad;
  param = param - rate * (exp_avg / (std::sqrt(exp_avg_sq) * rule.root_scale + rule.eps));
}

}  // namespace ar
