// Splats that a block loads into shared memory, with their channels.
#pragma once

#include "cuda/tile/reach.cuh"

namespace ar::cuda {

/// splats: [n, kSplatWidth].
template <class F> __device__ Splat<F, float> load_splat(const float* splats, int32_t id) {
  return reinterpret_cast<const Splat<F, float>*>(splats)[id];
}
__device__ inline void prefetch_splat(const float* splats, int32_t id) { prefetch(splats + int64_t(id) * kSplatWidth); }

template <class F, int C> struct alignas(16) TileSplat {
  typename F::template Terms<float> terms;
  Values<C> channels;
};

template <class F, int C> using TileSplatRef = const TileSplat<F, C>;

/// C channels of splat `id`: the three in the splat, or its row from `first` on, then zeros.
template <int C, class F>
__device__ Values<C> channels_of(const Channels<float>& channels, const Splat<F, float>& splat, int32_t id,
                                 int first = 0) {
  if constexpr (C == 0) {
    return {};
  } else if constexpr (C == 3) {
    return {{splat.color.x, splat.color.y, splat.color.z}};
  } else {
    const float* row = channels.row(id) + first;
    if (C == 4 && channels.count == 4 && reinterpret_cast<uintptr_t>(channels.data) % 16 == 0) {
      const float4 v = *reinterpret_cast<const float4*>(row);
      return {{v.x, v.y, v.z, v.w}};
    }
    Values<C> values;
    AR_UNROLL for (int c = 0; c < C; ++c) values.v[c] = first + c < channels.count ? row[c] : 0;
    return values;
  }
}

template <class F> __device__ auto tile_terms(const Splat<F, float>& splat, const TileList& list) {
  return F::terms(splat.shape, splat.opacity, {float(list.x0) - splat.mean.x, float(list.y0) - splat.mean.y});
}

template <class F, int C, int kBatch> struct Stage {
  TileSplat<F, C> splats[kBatch];
  uint8_t reach[kBatch];

  /// Loads pairs [k, k + kBatch), one per thread, and returns how many are before `end`.
  __device__ int load(const float* splats_in, const Channels<float>& channels, const TileList& list, int k, int end) {
    const int t = threadIdx.x;
    if (kBatch == kBlendThreads || t < kBatch) {
      uint32_t bits = 0;
      if (k + t < end) {
        const int32_t id = list.splat(k + t);
        const Splat<F, float> splat = load_splat<F>(splats_in, id);
        bits = subtile_reach<F>(splat, list.x0, list.y0);
        if (bits) splats[t] = {tile_terms(splat, list), channels_of<C>(channels, splat, id)};
      }
      reach[t] = uint8_t(bits);
    }
    return min(end - k, kBatch);
  }

  /// Splats [k, k + 32) that reach a subtile, for take_first().
  __device__ uint32_t reached(int k, int subtile = threadIdx.x / 32) const {
    return __ballot_sync(kAllLanes, reach[k + 31 - lane_id()] >> subtile & 1);
  }
};

}  // namespace ar::cuda
