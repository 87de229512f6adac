// In the backward pass a block walks the list of a tile in the order along rays (core/order.h), a lane per pixel.
// RayStage has splats that may enter the windows, RayWindow is the window of a lane, RaySamples its samples. Lists are
// not cut: the window of a pixel sees all of its splats in the list's order.
//
// A window is a ring in shared memory, sorted by depth: what leaves it is at its head. There entries stay until a lane
// of the warp has RayPolicy::kPending of them, so that the lanes composite together.
#pragma once

#include "core/order.h"
#include "cuda/launch.cuh"
#include "cuda/occupancy.h"
#include "cuda/rays/policy.h"
#include "cuda/tile/stage.cuh"

namespace ar::cuda::by_blocks {

inline constexpr int kRaySide = 1 << kRayTileBits, kRayThreads = kRaySide * kRaySide, kRayWarps = kRayThreads / 32;

/// A warp has 8x4 pixels.
struct RayBoxes {
  static constexpr int kWide = 8, kHigh = 4, kColumns = kRaySide / kWide, kRows = kRaySide / kHigh;

  /// Bit w: the splat may reach the pixels of warp w.
  template <class F> __device__ static uint32_t reached(const Splat<F, float>& splat, const TileList& list) {
    return reached_boxes<kWide, kHigh, kColumns, kRows, F>(splat, list.x0, list.y0);
  }
  /// This lane's pixel in the tile.
  __device__ static Vec2<float> pixel() {
    const int warp = threadIdx.x / 32, lane = lane_id();
    return {float(warp % kColumns * kWide + lane % kWide), float(warp / kColumns * kHigh + lane / kWide)};
  }
};

/// Whether entries keep the opacity * weight of their one sample. Others are evaluated again when they leave.
template <class F> inline constexpr bool kKeepsRaw = kKeptInWindow<F> == 1;

template <class F> struct alignas(16) RayItem {
  std::conditional_t<F::kMoves, PixelReach<F, float>, typename F::template Terms<float>> of_pixel;
  Vec2<float> mean;
  RayDepth<float> depth;
  int32_t payload;
};

template <class F> struct RayStage {
  RayItem<F> items[kRayThreads];
  uint32_t reach[kRayThreads];

  /// This thread's pair of the batch that begins at k, or -1.
  __device__ static int32_t splat_of(const TileList& list, int k) {
    const int at = k + int(threadIdx.x);
    return at < list.count ? list.splat(at) : -1;
  }
  /// Splat `id`, or none if it is -1.
  template <class Params>
  __device__ void load(const Params& params, const TileList& list, int32_t id, int32_t payload) {
    const int t = threadIdx.x;
    uint32_t bits = 0;
    if (id >= 0) {
      const Splat<F, float> splat = load_splat<F>(params.splats, id);
      bits = RayBoxes::reached(splat, list);
      if (bits) {
        RayItem<F>& item = items[t];
        if constexpr (F::kMoves) {
          item.of_pixel = PixelReach<F, float>::of(splat);
        } else {
          item.of_pixel = tile_terms(splat, list);
        }
        item.mean = splat.mean;
        item.depth = params.order.depths[id];
        item.payload = payload;
      }
    }
    reach[t] = bits;
  }
  /// Items [k, k + 32) that reach this warp's pixels, for take_first().
  __device__ uint32_t reached(int k) const {
    return __ballot_sync(kAllLanes, reach[k + 31 - lane_id()] >> (threadIdx.x / 32) & 1);
  }
};

/// What leaves a window; payload -1: nothing.
struct RayEntry {
  int32_t payload = -1;
  float raw = 0;
};

/// Of a lane. Slot k of the thread is at k * kRayThreads, so that no two lanes meet in a bank.
template <class F> class RayWindow {
 public:
  __device__ RayWindow(float* memory, int window)
      : depths_(memory + threadIdx.x),
        payloads_(reinterpret_cast<int32_t*>(memory) + plane(window) + threadIdx.x),
        raws_(memory + 2 * plane(window) + threadIdx.x),
        end_(plane(window)),
        window_(window) {}

  __device__ __host__ static int64_t bytes(int window) {
    return int64_t(kKeepsRaw<F> ? 3 : 2) * plane(window) * int64_t(sizeof(float));
  }
  /// Entries beyond `left`, which have left the window if `left` is its size.
  __device__ int beyond(int left) const { return held_ - left; }
  __device__ int window() const { return window_; }
  __device__ void drop() { held_ = 0; }

  /// Behind equal depths. Entries that have left stay in front of it.
  __device__ void enter(float depth, int32_t payload, float raw) {
    int at = head_ + held_ * kRayThreads;
    if (at >= end_) at -= end_;
    for (int k = min(held_, window_); k > 0; --k) {
      const int before = (at == 0 ? end_ : at) - kRayThreads;
      const float nearer = depths_[before];
      if (!(depth < nearer)) break;
      depths_[at] = nearer;
      payloads_[at] = payloads_[before];
      if (kKeepsRaw<F>) raws_[at] = raws_[before];
      at = before;
    }
    depths_[at] = depth;
    payloads_[at] = payload;
    if (kKeepsRaw<F>) raws_[at] = raw;
    ++held_;
  }

  /// Takes the nearest entries beyond `left`, up to kCount.
  template <int kCount> __device__ void take(int left, RayEntry (&entries)[kCount]) {
    const int count = min(max(held_ - left, 0), kCount);
    AR_UNROLL for (int i = 0; i < kCount; ++i) {
      entries[i] = {};
      if (i >= count) continue;
      int at = head_ + i * kRayThreads;
      if (at >= end_) at -= end_;
      entries[i].payload = payloads_[at];
      if (kKeepsRaw<F>) entries[i].raw = raws_[at];
    }
    head_ += count * kRayThreads;
    if (head_ >= end_) head_ -= end_;
    held_ -= count;
  }

 private:
  __device__ __host__ static constexpr int plane(int window) { return (window + RayPolicy::kPending) * kRayThreads; }

  float* const depths_;
  int32_t* const payloads_;
  float* const raws_;
  const int end_, window_;
  int head_ = 0, held_ = 0;
};

/// Of a pixel, all in a lane.
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
  struct Nothing {};
  std::conditional_t<kKeepsRaw<F>, Nothing, typename F::template Terms<float>> terms;
  Vec2<float> z;  ///< of samples that move, at the pixel's centre

  /// Without kKeepsRaw. Also in the backward pass, to the same bits.
  __device__ void set(const Splat<F, float>& splat, const TileList& list, Vec2<float> p) {
    if constexpr (!kKeepsRaw<F>) terms = tile_terms(splat, list);
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

/// Composites an entry into sample s.
template <class F>
__device__ Blended<float> blend_leaving(const LeavingSplat<F>& splat, const RayEntry& entry, Vec2<float> p, int s,
                                        RaySamples<F>& samples) {
  if constexpr (kKeepsRaw<F>) {
    return blend_sample(entry.raw, samples.transmittance[s]);
  } else {
    Vec2<float> at = {0, 0};
    const float seen = splat.raw(p, s, samples.places[F::kMoves ? s : 0], at);
    const float raw = entry.payload >= 0 ? seen : 0;
    if constexpr (F::kMoves) {
      return blend_placed_sample<F>(splat.terms, at, raw, F::template cell<float>(s), samples.transmittance[s],
                                    samples.places[s]);
    } else {
      return blend_sample(raw, samples.transmittance[s]);
    }
  }
}

/// Walks the list. All threads of the block must call it; lanes with `open` false only load splats. payload_of(place,
/// splat): what entries carry. leave(entries), called by whole warps: composites them in order, and returns whether the
/// lane has an open sample.
template <class F, class Params, class PayloadOf, class Leave>
__device__ void walk_rays(const Params& params, const TileList& list, RayStage<F>& stage, float* memory, Vec2<float> p,
                          bool open, PayloadOf&& payload_of, Leave&& leave) {
  RayWindow<F> window(memory, params.order.window);
  const auto take = [&](int left, int most) {
    while (__any_sync(kAllLanes, window.beyond(left) > most)) {
      RayEntry entries[RayPolicy::kAtOnce<F>];
      window.take(left, entries);
      open = leave(entries);
      if (!open) window.drop();
      most = 0;
    }
  };
  // The same bits in tiles of all sizes.
  const Vec2<float> pixel = {float(list.x0) + p.x, float(list.y0) + p.y};
  int32_t next = RayStage<F>::splat_of(list, 0);
  for (int k = 0; k < list.count && __syncthreads_or(open); k += kRayThreads) {
    const int32_t id = next;
    next = RayStage<F>::splat_of(list, k + kRayThreads);
    stage.load(params, list, id, payload_of(k + int(threadIdx.x), id));
    if (next >= 0) {
      prefetch_splat(params.splats, next);
      prefetch(params.order.depths + next);
    }
    __syncthreads();
    for (int from = 0; from < kRayThreads; from += 32) {
      if (!__any_sync(kAllLanes, open)) break;
      for (uint32_t left = stage.reached(from); left != 0;) {
        const RayItem<F>& item = stage.items[from + take_first(left)];
        const Vec2<float> d = {pixel.x - item.mean.x, pixel.y - item.mean.y};
        float largest = 0;
        bool shows;
        if constexpr (F::kMoves) {
          shows = item.of_pixel.reaches(d);
        } else {
          AR_UNROLL for (int s = 0; s < F::kSamples; ++s) {
            const float raw = F::alpha(item.of_pixel, p, s);
            largest = s == 0 ? raw : max(largest, raw);
          }
          shows = largest >= float(kAlphaMin);
        }
        if (shows & open) window.enter(depth_in_pixel(item.depth, d), item.payload, largest);
        take(window.window(), RayPolicy::kPending - 1);
      }
    }
  }
  take(0, 0);
}

}  // namespace ar::cuda::by_blocks
