// A warp walks the list of a tile in the order along rays (core/order.h) for the 8x4 pixels of half a tile, a lane per
// pixel. Lists are not cut: a window sees all of a list.
//
// Lanes show different splats, so each first writes down what enters its window. When one has no room left, all lanes
// sort, and composite what leaves.
#pragma once

#include <limits>

#include "core/order.h"
#include "cuda/launch.cuh"
#include "cuda/rays/policy.h"
#include "cuda/tile/stage.cuh"

namespace ar::cuda {

inline constexpr int kRaySide = 1 << kRayTileBits, kRayHigh = 32 / kRaySide, kRayHalves = kRaySide / kRayHigh;

/// This lane's pixel in the tile.
__device__ inline Vec2<float> ray_pixel(int half) {
  return {float(lane_id() % kRaySide), float(half * kRayHigh + lane_id() / kRaySide)};
}

template <class F> struct alignas(16) RayItem {
  std::conditional_t<F::kMoves, PixelReach<F, float>, typename F::template Terms<float>> of_pixel;
  Vec2<float> mean;
  RayDepth<float> depth;
  int32_t payload;
};

/// Splats of a batch that reach the pixels of the warp.
template <class F> struct RayStage {
  RayItem<F> items[32];
};

/// A splat in a window; payload -1: none.
struct alignas(8) RayEntry {
  float depth = 0;
  int32_t payload = -1;
};

/// Of a lane. From the first slot on: what has left, the window sorted by depth, and what is to enter. What has left,
/// and a slot before all, has the depth kPassed. Slot k is at 32 k: no two lanes meet in a bank.
class RayWindow {
 public:
  /// Slots before `memory` that may be read.
  static constexpr int kTogether = RayPolicy::kTogether;

  __device__ RayWindow(RayEntry* memory, int window) : slots_(memory + 32 + lane_id()), window_(32 * window) {
    slots_[-32].depth = kPassed;
  }

  __device__ __host__ static int64_t bytes(int window) {
    const int rounded = (window + kTogether - 1) / kTogether * kTogether;
    return int64_t(1 + rounded + RayPolicy::kPending) * 32 * int64_t(sizeof(RayEntry));
  }
  __device__ bool full() const { return end_ == window_ + 32 * RayPolicy::kPending; }
  __device__ void drop() { first_ = sorted_ = end_ = 0; }

  __device__ void append(const RayEntry& entry) {
    slots_[end_] = entry;
    end_ += 32;
  }
  /// What was appended enters the window, behind equal depths.
  __device__ void sort() {
    for (; sorted_ < end_; sorted_ += 32) {
      const RayEntry entry = slots_[sorted_];
      int to = sorted_;
      for (bool nearer = true; nearer;) {
        const int from = to;
        RayEntry before[kTogether];
        AR_UNROLL for (int i = 0; i < kTogether; ++i) before[i] = slots_[from - 32 * (i + 1)];
        AR_UNROLL for (int i = 0; i < kTogether; ++i) {
          nearer = nearer & (entry.depth < before[i].depth);
          if (!nearer) continue;
          slots_[from - 32 * i] = before[i];
          to = from - 32 * (i + 1);
        }
      }
      slots_[to] = entry;
      if (sorted_ >= window_) slots_[sorted_ - window_].depth = kPassed;
    }
  }
  /// After sort(): whether something has left. `all`: at the end of the list.
  __device__ bool leaves(bool all) const { return end_ - first_ > (all ? 0 : window_); }
  /// Takes the nearest of those, up to kCount.
  template <int kCount> __device__ void take(bool all, RayEntry (&entries)[kCount]) {
    AR_UNROLL for (int i = 0; i < kCount; ++i) {
      entries[i] = {};
      if (!leaves(all)) continue;
      entries[i] = slots_[first_];
      first_ += 32;
    }
  }
  /// Makes room: the window goes to the first slots.
  __device__ void close_up() {
    end_ -= first_;
    for (int to = 0; to < end_; to += 32 * kTogether) {
      RayEntry entries[kTogether];
      AR_UNROLL for (int i = 0; i < kTogether; ++i) entries[i] = slots_[first_ + to + 32 * i];
      AR_UNROLL for (int i = 0; i < kTogether; ++i) slots_[to + 32 * i] = entries[i];
    }
    sorted_ = end_;
    first_ = 0;
  }

 private:
  static constexpr float kPassed = -std::numeric_limits<float>::infinity();  ///< no entry goes before it

  RayEntry* const slots_;
  const int window_;
  int first_ = 0, sorted_ = 0, end_ = 0;
};

/// Of a pixel.
template <class F> struct RaySamples {
  static constexpr int S = F::kSamples;
  float transmittance[S];                 ///< negative: the sample has stopped
  Vec2<float> places[F::kMoves ? S : 1];  ///< of samples that move, from the pixel's centre [px]

  __device__ explicit RaySamples(bool inside) {
    AR_UNROLL for (int s = 0; s < S; ++s) {
      transmittance[s] = inside ? 1.0f : -1.0f;
      if constexpr (F::kMoves) places[s] = F::template node<float>(s);
    }
  }
  __device__ bool open() const {
    bool any = false;
    AR_UNROLL for (int s = 0; s < S; ++s) any |= transmittance[s] > 0;
    return any;
  }
};

/// What a lane evaluates of a splat that leaves its window, in its pixel at p.
template <class F> struct LeavingSplat {
  typename F::template Terms<float> terms;
  Vec2<float> z;  ///< of samples that move, at the pixel's centre

  /// Also in the backward pass, to the same bits.
  __device__ void set(const Splat<F, float>& splat, const TileList& list, Vec2<float> p) {
    terms = tile_terms(splat, list);
    if constexpr (F::kMoves) z = F::whitened(terms, p, 0);
  }
  /// Of sample s, where it moves at `place`: opacity * weight, and whitened coordinates.
  __device__ float raw(Vec2<float> p, int s, Vec2<float> place, Vec2<float>& at) const {
    if constexpr (F::kMoves) {
      at = F::whitened_node(terms, z, place);
      return exp2(F::log_alpha(terms, at));
    } else {
      return F::alpha(terms, p, s);
    }
  }
};

/// Composites an entry into sample s. Also returns its opacity * weight.
template <class F>
__device__ Blended<float> blend_leaving(const LeavingSplat<F>& splat, const RayEntry& entry, Vec2<float> p, int s,
                                        RaySamples<F>& samples, float& raw) {
  Vec2<float> at = {0, 0};
  const float seen = splat.raw(p, s, samples.places[F::kMoves ? s : 0], at);
  raw = entry.payload >= 0 ? seen : 0;
  if constexpr (F::kMoves) {
    return blend_placed_sample<F>(splat.terms, at, raw, F::template cell<float>(s), samples.transmittance[s],
                                  samples.places[s]);
  } else {
    return blend_sample(raw, samples.transmittance[s]);
  }
}

/// Walks the list for half of the tile. All lanes must call it; those not `open` (an int, as a bool takes longer) only
/// load splats. payload_of(place, splat): what entries carry. leave(entries) composites them in order in the whole
/// warp, and returns whether the lane has an open sample. `memory` is behind a RayStage.
template <class F, class Params, class PayloadOf, class Leave>
__device__ void walk_rays(const Params& params, const TileList& list, RayStage<F>& stage, RayEntry* memory, int half,
                          int open, PayloadOf&& payload_of, Leave&& leave) {
  static_assert(sizeof(RayStage<F>) >= RayWindow::kTogether * 32 * sizeof(RayEntry));
  RayWindow window(memory, params.order.window);
  const auto settle = [&](bool all) {
    window.sort();
    while (__any_sync(kAllLanes, window.leaves(all))) {
      RayEntry entries[RayPolicy::kAtOnce<F>];
      window.take(all, entries);
      open = leave(entries);
      if (!open) window.drop();
    }
    if (!all) window.close_up();
  };
  const int lane = lane_id();
  const Vec2<float> p = ray_pixel(half);
  // The same bits in tiles of all sizes.
  const Vec2<float> pixel = {float(list.x0) + p.x, float(list.y0) + p.y};
  // Loads a batch while the warp walks the one before.
  const auto splat_of = [&](int place) { return place < list.count ? list.splat(place) : -1; };
  Splat<F, float> splat = {};
  RayDepth<float> depth = {};
  int32_t id = splat_of(lane), next = splat_of(32 + lane);
  const auto load = [&] {
    if (id >= 0) splat = load_splat<F>(params.splats, id), depth = params.order.depths[id];
  };
  load();
  for (int k = 0; k < list.count && __any_sync(kAllLanes, open); k += 32) {
    const bool reaches =
        id >= 0 && reached_boxes<kRaySide, kRayHigh, 1, 1, F>(splat, list.x0, list.y0 + half * kRayHigh) != 0;
    const uint32_t reached = __ballot_sync(kAllLanes, reaches);
    if (reaches) {
      RayItem<F>& item = stage.items[__popc(reached & ((1u << lane) - 1))];
      if constexpr (F::kMoves) {
        item.of_pixel = PixelReach<F, float>::of(splat);
      } else {
        item.of_pixel = tile_terms(splat, list);
      }
      item.mean = splat.mean;
      item.depth = depth;
      item.payload = payload_of(k + lane, id);
    }
    id = next;
    next = splat_of(k + 64 + lane);
    load();
    __syncwarp();
    const int count = __popc(reached);
    for (int i = 0; i < count; ++i) {
      const RayItem<F>& item = stage.items[i];
      const Vec2<float> d = {pixel.x - item.mean.x, pixel.y - item.mean.y};
      bool shows = false;
      if constexpr (F::kMoves) {
        shows = item.of_pixel.reaches(d);
      } else {
        AR_UNROLL for (int s = 0; s < F::kSamples; ++s) shows |= F::alpha(item.of_pixel, p, s) >= float(kAlphaMin);
      }
      if (shows & (open != 0)) window.append({depth_in_pixel(item.depth, d), item.payload});
      if (!__any_sync(kAllLanes, window.full())) continue;
      settle(false);
      if (!__any_sync(kAllLanes, open)) break;
    }
    __syncwarp();
  }
  settle(true);
}

}  // namespace ar::cuda
