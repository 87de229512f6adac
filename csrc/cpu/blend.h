// Loop of blend. In a tile a step is a splat, and a pack is a block of pixels (tile.h).
#pragma once

#include <cmath>

#include "core/blend.h"
#include "cpu/parallel.h"
#include "cpu/replay.h"
#include "cpu/tile.h"

namespace ar::AR_ISA {

template <int kSamples, typename T> PackSet<T> find_open(const T (&transmittance)[kSamples][kTilePixels]) {
  using V = typename LanesOf<T>::Type;
  PackSet<T> open = {};
  for (int pack = 0; pack < Packs<T>::kCount; ++pack) {
    V largest(T(0));
    for (int s = 0; s < kSamples; ++s) largest = max(largest, load(transmittance[s] + pack * Packs<T>::kLanes, V()));
    open.add(pack, bits(largest > V(T(0))) != 0);
  }
  return open;
}

/// Sums over samples to images. `colors`: as blend_tile() leaves them. Transmittances may be negative.
template <int kSamples, typename T>
void store_pixels(const cpu::BlendParams<T>& p, const TileView& view, T (&transmittance)[kSamples][kTilePixels],
                  const int32_t (&last)[kSamples][kTilePixels], T* colors) {
  using V = typename LanesOf<T>::Type;
  constexpr int kCount = LanesOf<T>::kCount;
  const int channels = p.channels.count;
  const int64_t size = int64_t(p.grid.width) * p.grid.height;
  alignas(64) T through[kTilePixels] = {};  // Mean transmittance.
  for (int s = 0; s < kSamples; ++s) {
    for (int i = 0; i < kTilePixels; ++i) {
      transmittance[s][i] = std::abs(transmittance[s][i]);
      through[i] += transmittance[s][i] / T(kSamples);
    }
    if (p.transmittance) store_tile<T>(view, p.grid, transmittance[s], p.transmittance + s * size);
    if (p.last) store_tile<T>(view, p.grid, last[s], p.last + s * size);
  }
  alignas(64) T plane[kTilePixels];
  for (int channel = 0; channel < channels; ++channel) {
    const V samples(T{kSamples}), background(p.background[channel]);
    for (int i = 0; i < kTilePixels; i += kCount) {
      const V sum = load(channels_at(colors, i, channels) + channel * kCount, V());
      store(plane + i, sum / samples + load(through + i, V()) * background);
    }
    store_tile<T>(view, p.grid, plane, p.image.plane(channel, size));
  }
  if (p.alpha) {
    for (int i = 0; i < kTilePixels; ++i) through[i] = T(1) - through[i];
    store_tile<T>(view, p.grid, through, p.alpha);
  }
}

/// `colors`: scratch.
template <class P, typename T> AR_ONE_COPY void blend_tile(const cpu::BlendParams<T>& p, int64_t tile, T* colors) {
  using V = typename LanesOf<T>::Type;
  constexpr int kCount = LanesOf<T>::kCount, kSamples = P::kSamples;
  const TileView view(p.grid, tile);
  const TilePixels<T>& of_tile = kTilePixelsOf<T>;
  const int channels = p.channels.count;
  const bool three = channels == 3, keeps = p.last != nullptr;
  alignas(64) T transmittance[kSamples][kTilePixels];
  alignas(64) int32_t last[kSamples][kTilePixels] = {};
  using Places = TilePlaces<P, T>;
  Places moving;
  std::fill_n(colors, channels * kTilePixels, T(0));
  for (int s = 0; s < kSamples; ++s) {
    std::fill_n(transmittance[s], kTilePixels, T(-1));  // Outside the image.
    for_each_run<T>(view, p.grid, [&](int first, int64_t, int count) AR_HD_LAMBDA {
      std::fill_n(transmittance[s] + first, count, T(1));
    });
  }
  const int32_t* pairs = p.lists.pairs;
  const int64_t begin = p.lists.tile_offsets[tile], end = p.lists.tile_offsets[tile + 1];
  TileSplat<P, T> batch[kBatch];
  for (int64_t first = begin; first < end; first += kBatch) {
    const PackSet<T> open = find_open<kSamples, T>(transmittance);
    if (open.is_empty()) break;
    const int count = int(std::min<int64_t>(kBatch, end - first));
    for (int i = 0; i < count; ++i) {
      const int64_t ahead = first + i + kPrefetch;
      if (ahead < end) prefetch_splat(p.splats, pairs[ahead]);
      batch[i] = tile_splat<P>(p.splats, pairs[first + i], view);
    }
    for (int i = 0; i < count; ++i) {
      const auto& terms = batch[i].terms;
      const T* shown = p.channels.row(pairs[first + i]);
      const Vec3<V> color = three_channels<V>(shown, three);
      const IndexOf<V> index(int32_t(first + i - begin + 1));
      for_each_pack(batch[i].reach, open, [&](int pixel) AR_HD_LAMBDA {
        const Vec2<V> at = {load(of_tile.x + pixel, V()), load(of_tile.y + pixel, V())};
        V contribution(T(-0.0));  // The compiler knows that -0 + x is x.
        if constexpr (P::kMoves) {
          const Vec2<V> z = P::whitened(terms, at, 0);
          bool hit = false;
          for (int group_first = 0; group_first < kSamples; group_first += Places::kGroup) {
            typename Places::Group group;
            // With one sample, compositing in vain is faster than this branch.
            if (!moving.look(terms, z, group_first, pixel, group) && kSamples > 1) continue;
            hit = true;
            AR_UNROLL for (int j = 0; j < Places::kGroup; ++j) {
              const int s = group_first + j;
              V t = load(transmittance[s] + pixel, V());
              Vec2<V> place = moving.places.at(s, pixel);
              const Blended<V> blended =
                  blend_placed_sample<P>(terms, group.z[j], exp2(group.log_alpha[j]), moving.bounds(s), t, place);
              store(transmittance[s] + pixel, t);
              moving.places.set(s, pixel, place);
              contribution = contribution + blended.contribution;
              if (keeps) {
                store_index(last[s] + pixel, select(blended.mask, index, load_index(last[s] + pixel, V())));
              }
            }
          }
          if (!hit) return;
        } else {
          AR_UNROLL for (int s = 0; s < kSamples; ++s) {
            V t = load(transmittance[s] + pixel, V());
            const Blended<V> blended = blend_sample(P::alpha(terms, at, s), t);
            store(transmittance[s] + pixel, t);
            contribution = contribution + blended.contribution;
            if (keeps) {
              store_index(last[s] + pixel, select(blended.mask, index, load_index(last[s] + pixel, V())));
            }
          }
        }
        T* to = channels_at(colors, pixel, channels);
        const auto add = [&](int channel, V value) {
          T* sum = to + channel * kCount;
          store(sum, madd(contribution, value, load(sum, V())));
        };
        if (three) {
          add(0, color.x), add(1, color.y), add(2, color.z);
        } else {
          for (int channel = 0; channel < channels; ++channel) add(channel, V(shown[channel]));
        }
      });
    }
  }
  store_pixels<kSamples>(p, view, transmittance, last, colors);
}

template <class P, typename T> void blend(const cpu::BlendParams<T>& p) {
  cpu::parallel_for(p.grid.tiles(), p.threads, [&](int64_t tile, int thread) {
    blend_tile<P, T>(p, tile, p.scratch + thread * int64_t(p.channels.count) * kTilePixels);
  });
}

}  // namespace ar::AR_ISA
