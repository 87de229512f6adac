// Random splats, and lists of them, for the tests of kernels that blend. Include after cuda_on_host.h.
#pragma once

#include <cmath>
#include <random>
#include <vector>

#include "cuda/tile/stage.cuh"

namespace ar::cuda {

inline float uniform(std::mt19937& bits, float low, float high) {
  return std::uniform_real_distribution<float>(low, high)(bits);
}

/// Samples of a pixel, whether a lane has them all or one of them.
template <class F> inline constexpr int kPixelSamples = F::kSamples * F::kLanes;

/// An image of so many pixels, in tiles of the size that kernels for F take.
template <class F> constexpr TileGrid grid_for(int width, int height) {
  return {width, height, spread_tile_bits(F::kLanes, true)};
}

/// The position of sample s of the pixel at p, but for rounding, and the number that F has for it there.
template <class F, class V> Vec2<V> sample_position(Vec2<V> p, int s) {
  if constexpr (F::kLanes > 1) return {p.x + V(float(F::node(s).x)), p.y + V(float(F::node(s).y))};
  return p;
}
template <class F> int sample_number(int s) { return F::kLanes > 1 ? 0 : s; }

/// The number among the kTilePixels lanes of a tile of the lane that has sample s of the tile's pixel (x, y).
template <class F> int lane_of_sample(int x, int y, int s) {
  constexpr int kWide = kSubtileWide<F>, kHigh = kSubtileHigh<F>;
  const int pixel = y % kHigh * kWide + x % kWide;
  return (y / kHigh * 2 + x / kWide) * 32 + pixel * F::kLanes + (F::kLanes > 1 ? s : 0);
}

/// The position of sample s of the tile's pixel (x, y), with the bits that it has in the kernels.
template <class F> Vec2<float> position_in_tile(int x, int y, int s) {
  const int lane = lane_of_sample<F>(x, y, s);
  return position_of<F>(lane / 32, lane % 32);
}

/// Splats anywhere in an image and up to `beyond` px off it, with standard deviations along axes in any direction, of
/// variances from exp(`low`) to exp(`high`) px^2. `prepare` makes a footprint's shape of a covariance.
template <class F, class Prepare>
std::vector<Splat<F, float>> random_splats(std::mt19937& bits, int count, TileGrid grid, float low, float high,
                                           float most_opaque, const Prepare& prepare, float beyond = 0) {
  std::vector<Splat<F, float>> splats(count);
  for (Splat<F, float>& splat : splats) {
    const float a = std::exp(uniform(bits, low, high)), b = std::exp(uniform(bits, low, high));
    const float angle = uniform(bits, 0, 3.14f), c = std::cos(angle), s = std::sin(angle);
    const Cov2d<float> cov = {a * c * c + b * s * s, (a - b) * c * s, a * s * s + b * c * c, a * b};
    splat.mean = {uniform(bits, -beyond, float(grid.width) + beyond),
                  uniform(bits, -beyond, float(grid.height) + beyond)};
    splat.shape = prepare(cov);
    splat.opacity = uniform(bits, 0.02f, most_opaque);
    splat.level = F::level(splat.shape, splat.opacity);
    splat.color = {uniform(bits, 0, 1), uniform(bits, 0, 1), uniform(bits, 0, 1)};
  }
  return splats;
}

inline std::vector<float> random_numbers(std::mt19937& bits, size_t count, float low, float high) {
  std::vector<float> numbers(count);
  for (float& x : numbers) x = uniform(bits, low, high);
  return numbers;
}

/// Splats that every tile lists, with rows of channels, and gradients of their image.
template <class F> struct ListedScene {
  int channels = 0;
  std::vector<Splat<F, float>> splats;
  std::vector<SlotPair> pairs;
  std::vector<int64_t> offsets = {0};
  std::vector<float> rows, background, dL_dimage, dL_dalpha;
  Counts counts = {};

  /// Lists the splats, and draws all else.
  void complete(std::mt19937& bits, int of_channels, TileGrid grid) {
    const size_t count = splats.size(), pixels = size_t(grid.width) * size_t(grid.height);
    channels = of_channels;
    rows = random_numbers(bits, count * size_t(channels), 0, 1);
    background = random_numbers(bits, size_t(channels), 0, 1);
    dL_dimage = random_numbers(bits, size_t(channels) * pixels, -0.5f, 0.5f);
    dL_dalpha = random_numbers(bits, pixels, -0.5f, 0.5f);
    for (int tile = 0; tile < grid.tiles(); ++tile) {
      for (int k = 0; k < int(count); ++k) pairs.push_back({k, int32_t(pairs.size())});
      offsets.push_back(int64_t(pairs.size()));
    }
    counts.pairs = int64_t(pairs.size()), counts.splats = int(count);
  }
};

/// Lists of pairs that lie tile by tile: splats, or splats with slots. They point into what is given.
template <class Pair>
TileLists lists_of(const std::vector<Pair>& pairs, const std::vector<int64_t>& tile_offsets, const Counts& counts) {
  TileLists lists = {};
  lists.pairs = reinterpret_cast<const int32_t*>(pairs.data());
  lists.stride = int(sizeof(Pair) / sizeof(int32_t));
  lists.tile_offsets = tile_offsets.data();
  lists.counts = &counts;
  lists.n = counts.splats;
  lists.capacity = int64_t(pairs.size());
  return lists;
}

/// Makes of lists that all have the same splats those of patches of 4^patch_bits tiles, as where there is no room for
/// them. Their slots are their splats.
inline void share_lists(std::vector<SlotPair>& pairs, std::vector<int64_t>& tile_offsets, Counts& counts, TileGrid grid,
                        int patch_bits = 20) {
  const std::vector<SlotPair> list(pairs.begin(), pairs.begin() + tile_offsets[1]);
  pairs.clear();
  for (int tile = 0; tile < grid.tiles(); ++tile) {
    tile_offsets[tile] = int64_t(pairs.size());
    if (tile % grid.columns() % (1 << patch_bits) == 0 && tile / grid.columns() % (1 << patch_bits) == 0) {
      for (const SlotPair& pair : list) pairs.push_back({pair.splat, pair.splat});
    }
  }
  tile_offsets.back() = int64_t(pairs.size());
  counts.listed = int64_t(pairs.size());
  counts.pairs = counts.listed + 1;
  counts.patch_bits = patch_bits;
}

}  // namespace ar::cuda
