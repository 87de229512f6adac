// The kernels of blend for three colours, run on the host: they give what compositing the list of a tile pixel by pixel
// gives, whether it ends in the front or goes through the tail, with or without what a backward pass needs.
#include <random>

#include "cuda_on_host.h"
// After it: kernels.
#include <gtest/gtest.h>

#include "cuda/still/front.cuh"
#include "cuda/still/tail.cuh"
#include "random_splats.h"

namespace ar::cuda {
namespace {

/// Of the part of an image that is blended: all tiles that begin in it.
constexpr int kWidth = 27, kHeight = 21;
/// Pixels in a row and in a column of an image that has no other part, and of one in which fronts are long.
constexpr int kSmallSide[] = {kWidth, kHeight}, kLargeSide[] = {400, 400};
/// Blocks that the device works on at once.
constexpr int kManyBlocks = kBlocksPerSm * cuda_on_host::kMultiprocessors;

/// `count` random splats, all of which every tile lists. They are up to `beyond` px off the image.
template <class F> std::vector<Splat<F, float>> make_splats(int count, float most_opaque, float beyond) {
  std::mt19937 bits(7);
  const auto prepare = [](const Cov2d<float>& cov) {
    return GaussianFootprint<kPixelSamples<F>, true>::prepare_with(cov, float(kBoxVariance<kPixelSamples<F>>));
  };
  return random_splats<F>(bits, count, {kWidth, kHeight}, -1, 3, most_opaque, prepare, beyond);
}

/// Planes of an image of `sides` pixels.
struct Image {
  int width, pixels;
  std::vector<float> color, alpha, transmittance;
  std::vector<int32_t> last;

  Image(const int (&sides)[2], int samples)
      : width(sides[0]),
        pixels(sides[0] * sides[1]),
        color(3 * pixels),
        alpha(pixels),
        transmittance(samples * pixels),
        last(samples * pixels) {}
};

constexpr float kBackground[] = {0.2f, 0.5f, 0.9f};

/// A splat after the other, pixel by pixel.
template <class F> Image expected_image(const std::vector<Splat<F, float>>& splats, const int (&sides)[2]) {
  constexpr int S = kPixelSamples<F>;
  const int side = grid_for<F>(kWidth, kHeight).side();
  Image out(sides, S);
  for (int pixel = 0; pixel < out.pixels; ++pixel) {
    const int x = pixel % out.width, y = pixel / out.width;
    if (x / side * side >= kWidth || y / side * side >= kHeight) continue;
    TileList list = {};
    list.x0 = x / side * side, list.y0 = y / side * side;
    double color[3] = {}, through = 0;
    for (int s = 0; s < S; ++s) {
      const Vec2<float> position = position_in_tile<F>(x - list.x0, y - list.y0, s);
      float transmittance = 1;
      for (size_t k = 0; k < splats.size(); ++k) {
        const float raw = F::alpha(tile_terms(splats[k], list), position, sample_number<F>(s));
        const Blended<float> b = blend_sample(raw, transmittance);
        if (!b.mask) continue;
        const Vec3<float>& c = splats[k].color;
        color[0] += b.contribution * c.x, color[1] += b.contribution * c.y, color[2] += b.contribution * c.z;
        out.last[s * out.pixels + pixel] = int32_t(k) + 1;
      }
      out.transmittance[s * out.pixels + pixel] = std::abs(transmittance);
      through += std::abs(transmittance) / S;
    }
    for (int c = 0; c < 3; ++c) out.color[c * out.pixels + pixel] = float(color[c] / S + through * kBackground[c]);
    out.alpha[pixel] = float(1 - through);
  }
  return out;
}

/// What the kernels make. Only the first tiles have lists.
template <class F, bool kKeep> Image blended_image(const std::vector<Splat<F, float>>& splats, const int (&sides)[2]) {
  constexpr int S = F::kSamples;
  const TileGrid grid = grid_for<F>(sides[0], sides[1]);
  Image out(sides, kPixelSamples<F>);
  const int tiles = int(grid.tiles()), count = int(splats.size()), chunks = (count + kChunkLength - 1) / kChunkLength;
  std::vector<int32_t> pairs, order, planes(tiles), open(tiles), open_tiles(tiles);
  std::vector<int64_t> offsets = {0};
  std::vector<TileChunk> tail;
  PlanState state = {};
  BlendParams p = {};
  p.layout = {3, kKeep};
  for (int tile = 0; tile < tiles; ++tile) {
    const int x = tile % grid.columns() * grid.side(), y = tile / grid.columns() * grid.side();
    if (x < kWidth && y < kHeight) {
      order.insert(order.begin(), tile);
      for (int k = 0; k < count; ++k) pairs.push_back(k);
    }
    offsets.push_back(int64_t(pairs.size()));
  }
  const int front = front_chunks(grid, int64_t(pairs.size()), kManyBlocks);
  for (int tile : order) {
    planes[tile] = state.counts.planes;
    state.counts.planes += p.layout.tile_planes(front, S, chunks);
    for (int chunk = front; chunk < chunks; ++chunk) tail.push_back({tile, chunk, 0});
  }
  state.counts.tail = int32_t(tail.size());
  const Counts counts = {int64_t(pairs.size()), count};
  std::vector<float> checkpoints(size_t(state.counts.planes) * kTilePixels, NAN);
  p.grid = grid;
  p.splats = &splats[0].mean.x;
  p.channels.count = 3;
  p.background = kBackground;
  p.image = {out.color.data(), 3, {}};
  p.alpha = out.alpha.data();
  if (kKeep) p.transmittance = out.transmittance.data(), p.last = out.last.data();
  p.lists = lists_of(pairs, offsets, counts);
  p.plan.state = &state;
  p.plan.tile_order = order.data();
  p.plan.tile_planes = planes.data();
  p.plan.tail = tail.data();
  p.plan.blocks_at_once = kManyBlocks;
  p.tile_open = open.data();
  p.open_tiles = open_tiles.data();
  p.checkpoints = checkpoints.data();
  cuda_on_host::launch(int(order.size()), kBlendThreads, [&] { blend_front_kernel<F, 3, kKeep>(p); });
  cuda_on_host::launch(3, kBlendThreads, [&] { tail_through_kernel<F>(p); });
  cuda_on_host::launch(3, 32, [&] { tail_scan_kernel(p, S); });
  cuda_on_host::launch(3, kBlendThreads, [&] { tail_blend_kernel<F, 3, kKeep>(p); });
  cuda_on_host::launch(3, kTailSumThreads, [&] { tail_sum_kernel<LaneSamples<S, F::kLanes>, 3, kKeep>(p); });
  return out;
}

template <class F, bool kKeep>
void expect_blended(int count, float most_opaque, bool exact, float beyond = 4, const int (&sides)[2] = kSmallSide) {
  const std::vector<Splat<F, float>> splats = make_splats<F>(count, most_opaque, beyond);
  const Image expected = expected_image<F>(splats, sides), image = blended_image<F, kKeep>(splats, sides);
  for (size_t i = 0; i < expected.color.size(); ++i) ASSERT_NEAR(image.color[i], expected.color[i], 1e-5) << i;
  for (size_t i = 0; i < expected.alpha.size(); ++i) ASSERT_NEAR(image.alpha[i], expected.alpha[i], 1e-5) << i;
  if (!kKeep) return;
  ASSERT_EQ(image.last, expected.last);
  for (size_t i = 0; i < expected.transmittance.size(); ++i) {
    if (exact) {
      ASSERT_EQ(image.transmittance[i], expected.transmittance[i]) << i;
    }
    ASSERT_NEAR(image.transmittance[i], expected.transmittance[i], 1e-5) << i;
  }
}

template <class F> void expect_front_and_tail() {
  // Samples stop, in the front.
  expect_blended<F, true>(kChunkLength - 3, 0.9f, true);
  expect_blended<F, false>(kChunkLength - 3, 0.9f, true);
  expect_blended<F, true>(5, 0.9f, true);
  // None stops, so that no rounding decides where, and the tail has all the other chunks.
  expect_blended<F, true>(3 * kChunkLength + 70, 0.02f, false);
  expect_blended<F, false>(3 * kChunkLength + 70, 0.02f, false);
}

TEST(BlendKernels, OneSample) { expect_front_and_tail<GaussianPixels<1>>(); }
TEST(BlendKernels, ManyChunks) {
  using F = GaussianPixels<1>;
  constexpr int kCount = 70 * kChunkLength + 1;
  expect_blended<F, true>(kCount, 0.02f, false, 80);
  expect_blended<F, false>(kCount, 0.02f, false, 80);
}
TEST(BlendKernels, FrontsOfSeveralChunks) {
  const auto expect_long_front = [](auto f) {
    using F = decltype(f);
    const TileGrid grid = grid_for<F>(kLargeSide[0], kLargeSide[1]);
    const int front = front_chunks(grid, 0, kManyBlocks) * kChunkLength;
    ASSERT_GT(front, kChunkLength);
    for (const int count : {front - 3, front + 2 * kChunkLength + 70}) {
      expect_blended<F, true>(count, 0.02f, false, 80, kLargeSide);
      expect_blended<F, false>(count, 0.02f, false, 80, kLargeSide);
    }
  };
  expect_long_front(GaussianPixels<1>());
  expect_long_front(GaussianPixels<4>());
  expect_long_front(GaussianSample<4>());
}
TEST(BlendKernels, FourSamplesInALane) { expect_front_and_tail<GaussianPixels<4>>(); }
TEST(BlendKernels, SamplesSpreadOverLanes) {
  expect_front_and_tail<GaussianSample<4>>();
  expect_front_and_tail<GaussianSample<16>>();
}

}  // namespace
}  // namespace ar::cuda
