// Which pixels a splat may reach: a mask of boxes of pixels, and for each warp a list of the staged splats that reach
// its box.
#pragma once

#include "core/bin.h"
#include "core/blend.h"
#include "cuda/tile/pixels.cuh"

namespace ar::cuda {

/// Which of kColumns x kRows boxes of kWide x kHigh pixels, from pixel (x0, y0) on, a splat reaches. Bit b: column b %
/// kColumns, row b / kColumns. May include boxes that it almost reaches: an exact test pays only if weights are
/// expensive.
template <int kWide, int kHigh, int kColumns, int kRows, class F>
__device__ uint32_t reached_boxes(const Splat<F, float>& splat, int x0, int y0) {
  static_assert(kColumns * kRows <= 32);
  uint32_t reached = 0;
  if constexpr (F::kExpensive) {
    const Support<float> support = support_of(splat);
    AR_UNROLL for (int row = 0; row < kRows; ++row) {
      const float y = float(y0 + row * kHigh);
      const Span<float> span = columns_of(support, y, y + float(kHigh - 1));
      AR_UNROLL for (int column = 0; column < kColumns; ++column) {
        const float x = float(x0 + column * kWide);
        reached |= uint32_t(span.lo <= x + float(kWide - 1) && span.hi >= x) << (row * kColumns + column);
      }
    }
  } else {
    const Mat2<float> w = F::ellipse(splat.shape);
    const Vec2<float> middle = {0.5f * (kWide - 1), 0.5f * (kHigh - 1)};
    const Vec2<float> first = {float(x0) - splat.mean.x, float(y0) - splat.mean.y};
    const float distance = float(max(kWide * kColumns, kHigh * kRows)) + max(abs(first.x), abs(first.y));
    const BoxReach<float> box =
        make_box_reach(w, splat.level, {middle.x + float(F::kReach), middle.y + float(F::kReach)}, distance);
    AR_UNROLL for (int row = 0; row < kRows; ++row) {
      const Vec2<float> z = transform(w, Vec2<float>{first.x + middle.x, first.y + (middle.y + float(row * kHigh))});
      AR_UNROLL for (int column = 0; column < kColumns; ++column) {
        const float right = float(column * kWide);
        const Vec2<float> center = {madd(w.xx, right, z.x), madd(w.yx, right, z.y)};
        reached |= uint32_t(reaches_box(box, center)) << (row * kColumns + column);
      }
    }
  }
  return reached;
}

/// Bit b: subtile b of the tile at (x0, y0).
template <class F> __device__ uint32_t subtile_reach(const Splat<F, float>& splat, int x0, int y0) {
  return reached_boxes<kSubtileWide<F>, kSubtileHigh<F>, 2, 4, F>(splat, x0, y0);
}

/// For each warp a list of up to kMost staged splats that reach its pixels: cheaper to walk than a mask. An entry is an
/// index times kUnit (an offset in memory with kUnit = sizeof(splat)); kAhead are read at once.
template <class EntryType, int kUnit, int kAhead, int kWarps, int kMost> struct ReachLists {
  using Entry = EntryType;
  struct alignas(kAhead * sizeof(Entry)) Entries {
    Entry of[kAhead];
  };
  alignas(Entries) Entry of_warps[kWarps][kMost];

  /// Lists splats k in [from, to) with bit `number` in reach[k], which is read up to the next multiple of 32.
  template <class Bits> __device__ int list(const Bits* reach, int from, int to, int number = int(threadIdx.x) / 32) {
    const int warp = threadIdx.x / 32;
    int n = 0;
    for (int k = from; k < to; k += 32) {
      const bool reached = reach[k + lane_id()] >> number & 1;
      const uint32_t all = __ballot_sync(kAllLanes, reached);
      if (reached) of_warps[warp][n + __popc(all & ((1u << lane_id()) - 1))] = Entry((k + lane_id()) * kUnit);
      n += __popc(all);
    }
    __syncwarp();
    return n;
  }
  __device__ static int number_of(Entry entry) { return int(entry) / kUnit; }
  template <class Splat> __device__ static const Splat& splat_of(const Splat* splats, Entry entry) {
    static_assert(sizeof(Splat) % kUnit == 0);
    return *reinterpret_cast<const Splat*>(reinterpret_cast<const char*>(splats) + entry * (sizeof(Splat) / kUnit));
  }
  /// Visits entries [from, to) of this warp. `from` is a multiple of kAhead.
  template <class Visit> __device__ __forceinline__ void for_each(int from, int to, Visit&& visit) const {
    const Entry* list = of_warps[threadIdx.x / 32];
    int k = from;
    if constexpr (kAhead > 1) {
      AR_NO_UNROLL for (; k + kAhead <= to; k += kAhead) {
        const Entries entries = *reinterpret_cast<const Entries*>(list + k);
        AR_UNROLL for (int i = 0; i < kAhead; ++i) visit(entries.of[i]);
      }
    }
    AR_NO_UNROLL for (; k < to; ++k) visit(list[k]);
  }
};

}  // namespace ar::cuda
