// Which family of kernels blends a footprint, in which tiles. forward.cu and backward.cu ask for the family, csrc/torch
// for sizes of memory. A test compares the names in Route with the kernels that are launched.
//
//   footprint                            channels   tiles                           family
//
//   point, mip, box 1, cumulant,         up to 4    16x16, a lane per pixel         still/
//     analytic
//   box 4, kSpreadImageTiles or more     up to 4    16x16, four samples in a lane   still/
//   box 4, fewer tiles                   up to 4    8x8, a lane per sample          still/
//   box 16                               up to 4    4x4, a lane per sample          still/
//   all of these                         more       the same                        channels/
//   kGeneric: erf, exact, and            any        16x16, a lane per pixel         channels/
//     analytic, frame_gradient "paper"
//   moment 1                             any        16x16; 8x8 in small images      moment/
//   moment 4                             any        8x8                             moment/
//   moment 16                            any        8x8; 4x4 in small images        moment/
//   kAlongRays, in that order            up to 4    8x8, a lane per pixel           rays/
#pragma once

#include <algorithm>
#include <array>
#include <type_traits>

#include "core/footprint/registry.h"
#include "cuda/moment/cut_lists.h"
#include "cuda/params.h"

namespace ar::cuda {

enum class Family { kStill, kMoment, kChannels, kRays };

/// log2 of the side of tiles [px].
template <class F> constexpr int tile_bits_of(bool small_image) {
  return F::kMoves ? moving_tile_bits(F::kSamples, small_image) : spread_tile_bits(spread_lanes<F>(), small_image);
}
template <class F, class Visit> void with_tile_side(TileGrid grid, Visit&& visit) {
  constexpr int kLarge = 1 << tile_bits_of<F>(false), kSmall = 1 << tile_bits_of<F>(true);
  if constexpr (kLarge != kSmall) {
    if (grid.side() == kLarge) return visit(std::integral_constant<int, kLarge>());
  }
  visit(std::integral_constant<int, kSmall>());
}
/// f(F{}), or f(F::Spread{}) where a lane blends one sample.
template <class F, class Function> void with_lanes(TileGrid grid, Function&& f) {
  with_tile_side<F>(grid, [&](auto side) {
    using OfLane = std::conditional_t<(side < kTile), typename F::Spread, F>;
    f(OfLane{});
  });
}
/// Calls f(PixelsOf<F>{}), which kernels are compiled for.
template <class Function> void visit_pixels(int footprint, Function&& f) {
  visit_footprint(footprint, Footprints{}, [&](auto chosen) { f(PixelsOf<decltype(chosen)>{}); });
}

/// `rays`: in the order along rays.
template <class F> constexpr Family family_of(int64_t channels, bool rays = false) {
  if (rays) return Family::kRays;
  if (F::kMoves) return Family::kMoment;
  return F::kGeneric || channels > kFewChannels ? Family::kChannels : Family::kStill;
}
inline Family family_at(int footprint, int64_t channels, bool rays = false) {
  Family found = Family::kStill;
  visit_pixels(footprint, [&](auto f) { found = family_of<decltype(f)>(channels, rays); });
  return found;
}
/// Calls f(F{}) if splats may be ordered along rays.
template <class Function> void visit_along_rays(int footprint, Function&& f) {
  visit_pixels(footprint, [&](auto chosen) {
    if constexpr (decltype(chosen)::kAlongRays) f(chosen);
  });
}
/// The same, if kFamily has kernels for it.
template <Family kFamily, class Function> void visit_lanes(int footprint, TileGrid grid, Function&& f) {
  visit_pixels(footprint, [&](auto pixels) {
    using F = decltype(pixels);
    if constexpr (!F::kMoves && (kFamily == Family::kChannels || !F::kGeneric)) with_lanes<F>(grid, f);
  });
}

/// Calls f(F{}, side) if samples move.
template <class Function> void visit_tiles(int footprint, TileGrid grid, Function&& f) {
  visit_pixels(footprint, [&](auto chosen) {
    using F = decltype(chosen);
    if constexpr (F::kMoves) with_tile_side<F>(grid, [&](auto side) { f(chosen, side); });
  });
}

/// What still/ and moment/ are compiled for.
constexpr int compiled_channels(bool in_splats) { return in_splats ? 3 : kFewChannels; }
template <class T, class Function> void with_few_channels(const Channels<T>& channels, Function&& f) {
  if (!channels.data) return f(std::integral_constant<int, compiled_channels(true)>());
  f(std::integral_constant<int, compiled_channels(false)>());
}

struct Route {
  Family family;
  int samples;          ///< of a pixel
  int samples_of_lane;  ///< 1 with F::Spread
  ListCut cut;
  // Kernels of the family, in order of launches.
  std::array<const char*, 5> forward;
  std::array<const char*, 4> backward;
};

/// `capacity`: room for pairs.
inline Route route_of(int footprint, int64_t channels, int64_t capacity, TileGrid grid, int multiprocessors,
                      bool rays = false) {
  Route route = {};
  visit_pixels(footprint, [&](auto f) {
    using F = decltype(f);
    route.family = family_of<F>(channels, rays);
    route.samples = route.samples_of_lane = F::kSamples;
    route.cut = {route.family != Family::kStill};
    if (rays) {
      route.forward = {"blend_rays_kernel"};
      route.backward = {"blend_rays_vjp_kernel"};
      return;
    }
    if constexpr (F::kMoves) {
      route.cut = moving_list_cut(F::kSamples, capacity, grid, multiprocessors);
      const bool cuts = route.cut.max_segments > 0;
      route.forward = {"moving_blend_kernel"};
      route.backward = {"moving_vjp_kernel"};
      if (cuts) route.forward = {"filter_kernel", "listed_blend_kernel", "moving_blend_kernel"};
      if (cuts)
        route.backward = {"segment_maps_kernel", "chain_maps_kernel", "segment_vjp_kernel", "moving_vjp_kernel"};
    } else {
      with_lanes<F>(grid, [&](auto of_lane) { route.samples_of_lane = decltype(of_lane)::kSamples; });
      if (route.family == Family::kChannels) {
        route.forward = {"blend_groups_kernel"};
        route.backward = {"blend_groups_vjp_kernel"};
      } else {
        route.forward = {"blend_front_kernel", "tail_through_kernel", "tail_scan_kernel", "tail_blend_kernel",
                         "tail_sum_kernel"};
        route.backward = {"blend_vjp_kernel"};
      }
    }
  });
  return route;
}

template <class F> constexpr int group_width(int left) {
  return F::kGeneric || F::kMoves || left > kSmallGroup ? kChannelGroup : kSmallGroup;
}
inline int channel_group(int footprint, int left) {
  int width = 0;
  visit_pixels(footprint, [&](auto f) { width = group_width<decltype(f)>(left); });
  return width;
}

inline int64_t max_reach_words(const ListCut& cut, TileGrid grid) {
  return int64_t(cut.max_segments) * (cut.segment / 32) * grid.side() * grid.side();
}
inline int64_t max_adjoint_maps(int samples, const ListCut& cut, TileGrid grid) {
  return int64_t(cut.max_segments) * kMapNumbers * samples * grid.side() * grid.side();
}

}  // namespace ar::cuda
