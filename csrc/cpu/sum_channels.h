// Loop of sum_channels, after each window of channels: adds up, per splat, the gradients that blend_vjp made per pair.
#pragma once

#include "cpu/project.h"

namespace ar::AR_ISA {

template <typename T> void sum_channels(const cpu::SumChannelsParams<T>& p) {
  for_each_chunk(p.pairs.splats, p.threads, [&](int64_t, int64_t begin, int64_t end) {
    for (int64_t j = begin; j < end; ++j) {
      T* sums = p.dL_dchannels + (p.by_gaussian ? p.pairs.ids[j] : j) * p.stride + p.first;
      std::fill(sums, sums + p.count, T(0));
      for (int64_t k = p.pairs.splat_offsets[j]; k < p.pairs.splat_offsets[j + 1]; ++k) {
        const T* row = p.channel_sums + p.pairs.positions[k] * p.channel_stride;
        for (int c = 0; c < p.count; ++c) sums[c] += row[c];
      }
    }
  });
}

}  // namespace ar::AR_ISA
