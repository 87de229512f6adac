// A pack of pixels walks the list of its tile in the order along rays (core/order.h), for blend_rays.h and
// blend_rays_vjp.h. Different splats leave the lanes' windows, so their numbers are gathered.
#pragma once

#include <cstring>
#include <limits>
#include <type_traits>
#include <vector>

#include "core/blend.h"
#include "core/order.h"
#include "cpu/replay.h"
#include "cpu/tile.h"

namespace ar::AR_ISA {

/// The splats of a tile's list, prepared when first asked for.
template <class P, typename T> class RayList {
  struct Nothing {};

 public:
  using Terms = typename P::template Terms<T>;
  struct Item {
    TileSplat<P, T> splat;
    RayDepth<T> depth;
    /// Of samples that move.
    std::conditional_t<P::kMoves, PixelReach<P, T>, Nothing> pixel;
    const T* channels;
  };

  template <class Params>
  RayList(const Params& p, int64_t tile)
      : view(p.grid, tile),
        splats_(p.splats),
        depths_(p.order.depths),
        channels_(p.channels),
        pairs_(p.lists.pairs + p.lists.tile_offsets[tile]),
        length_(int32_t(p.lists.tile_offsets[tile + 1] - p.lists.tile_offsets[tile])) {}

  const TileView view;

  const Item& operator[](int32_t place) const { return items_[size_t(place)]; }
  int32_t length() const { return length_; }
  /// False at the end of the list.
  bool has(int32_t place) {
    if (place >= int32_t(items_.size())) prepare();
    return place < length_;
  }

 private:
  void prepare() {
    const int32_t first = int32_t(items_.size()), end = std::min(first + kBatch, length_);
    for (int32_t place = first; place < end; ++place) {
      const int32_t j = pairs_[place];
      if (place + kPrefetch < length_) prefetch_splat(splats_, pairs_[place + kPrefetch]);
      Item item = {tile_splat<P>(splats_, j, view), depths_[j], {}, channels_.row(j)};
      if constexpr (P::kMoves) item.pixel = PixelReach<P, T>::of(item.splat.splat);
      items_.push_back(item);
    }
  }

  const T* splats_;
  const RayDepth<T>* depths_;
  Channels<T> channels_;
  const int32_t* pairs_;
  int32_t length_;
  std::vector<Item> items_;
};

/// visit(lane) for every bit.
template <class Visit> AR_HD void for_each_lane(uint32_t lanes, const Visit& visit) {
  for (; lanes != 0; lanes &= lanes - 1) visit(__builtin_ctz(lanes));
}

/// of(lane) points to kNumbers numbers of the lane's splat. Other lanes are zero.
template <int kNumbers, typename T, class Of>
AR_HD void gather(uint32_t lanes, typename LanesOf<T>::Type (&to)[kNumbers], const Of& of) {
  constexpr int kCount = LanesOf<T>::kCount;
  alignas(64) T numbers[kNumbers][kCount] = {};
  for_each_lane(lanes, [&](int lane) AR_HD_LAMBDA {
    const T* from = of(lane);
    for (int k = 0; k < kNumbers; ++k) numbers[k][lane] = from[k];
  });
  for (int k = 0; k < kNumbers; ++k) to[k] = load(numbers[k], typename LanesOf<T>::Type());
}

/// The walk of the pack whose first pixel is `pixel`.
template <class P, typename T> class RayWalk {
 public:
  using V = typename LanesOf<T>::Type;
  using Entry = WindowEntry<V, kKeptInWindow<P>>;
  static constexpr int kCount = LanesOf<T>::kCount;

  RayWalk(RayList<P, T>& list, int pixel, int window)
      : list_(list),
        pack_(pixel / kCount),
        window_(window),
        at{load(kTilePixelsOf<T>.x + pixel, V()), load(kTilePixelsOf<T>.y + pixel, V())},
        pixel_{V(T(list.view.x0)) + at.x, V(T(list.view.y0)) + at.y} {}

  /// leave(entry, its lanes) for all splats, in order; it returns whether the pack has an open sample.
  template <class Leave> void run(const Leave& leave) {
    const V none(-std::numeric_limits<T>::infinity());
    Entry slots[kMaxRayWindow];
    for (int k = 0; k < window_; ++k) slots[k] = Entry::nothing(none);
    int left = 0;  // Empty again, behind the end of the list.
    for (int32_t place = 0; left < window_; ++place) {
      Entry nearest;
      if (!list_.has(place)) {
        nearest = slots[left++];
      } else if (!enter(place, slots, nearest)) {
        continue;
      }
      const uint32_t lanes = bits(IndexOf<V>(int32_t(-1)) < nearest.place);
      if (lanes != 0 && !leave(nearest, lanes)) return;
    }
  }

 private:
  /// False if no lane shows the splat. Else the nearest of the window leaves it.
  AR_HD bool enter(int32_t place, Entry* slots, Entry& nearest) const {
    const auto& item = list_[place];
    if (!item.splat.reach.has(pack_)) return false;
    const Vec2<T>& mean = item.splat.splat.mean;
    const Vec2<V> d = {pixel_.x - V(mean.x), pixel_.y - V(mean.y)};
    Entry next;
    MaskOf<V> shows;
    if constexpr (P::kMoves) {
      shows = item.pixel.reaches(d);
    } else {
      V largest(T(0));
      for (int s = 0; s < P::kSamples; ++s) {
        next.raw[s] = P::alpha(item.splat.terms, at, s);
        largest = max(largest, next.raw[s]);
      }
      shows = largest >= V(T(kAlphaMin));
    }
    if (bits(shows) == 0) return false;
    next.depth = depth_in_pixel(item.depth, d);
    next.place = IndexOf<V>(place);
    const V none(-std::numeric_limits<T>::infinity());
    nearest = exchange_nearest(slots, window_, select(shows, next, Entry::nothing(none)));
    return true;
  }

  RayList<P, T>& list_;
  const int pack_, window_;

 public:
  const Vec2<V> at;  ///< In the tile [px].

 private:
  const Vec2<V> pixel_;  ///< In the image [px].
};

/// Of samples that move: the terms of the splats in an entry's lanes.
template <class P, typename T>
AR_HD auto gather_terms(const RayList<P, T>& list, uint32_t lanes, const int32_t* places) {
  using V = typename LanesOf<T>::Type;
  using OfLanes = typename P::template Terms<V>;
  constexpr int kNumbers = sizeof(typename P::template Terms<T>) / sizeof(T);
  static_assert(sizeof(OfLanes) == kNumbers * sizeof(V), "terms are numbers of the splat's type alone");
  V numbers[kNumbers];
  gather<kNumbers, T>(lanes, numbers, [&](int lane) AR_HD_LAMBDA {
    return reinterpret_cast<const T*>(&list[places[lane]].splat.terms);
  });
  OfLanes terms;
  std::memcpy(&terms, numbers, sizeof terms);
  return terms;
}

}  // namespace ar::AR_ISA
