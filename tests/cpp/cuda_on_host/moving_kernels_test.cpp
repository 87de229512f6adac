// The kernels for samples that move, run on the host: every way of sharing samples out among lanes gives the same, in
// either direction, and it is what compositing pixel by pixel gives.
#include <random>

#include "cuda_on_host.h"
// After it: kernels.
#include <gtest/gtest.h>

#include "core/inspect.h"
#include "cuda/blend_listed.cuh"
#include "cuda/blend_moving_vjp.cuh"

namespace ar::cuda {

namespace {

constexpr int kWidth = 21, kHeight = 18, kPixels = kWidth * kHeight, kColors = 3;
constexpr TileGrid kGrid = {kWidth, kHeight, kMovingTileBits};

/// A random scene, of which every tile lists all splats, or all but one the first `others`.
template <class F> struct Scene {
  std::vector<Splat<F, float>> splats;
  std::vector<SlotPair> pairs;
  std::vector<int64_t> offsets = {0};
  std::vector<float> background = {0.2f, 0.5f, 0.9f}, dL_dimage = std::vector<float>(kColors * kPixels);
  Counts counts = {};
  TileLists lists = {};

  explicit Scene(int count, int others, float most_opaque) : splats(count) {
    std::mt19937 bits(7);
    const auto uniform = [&](float low, float high) { return std::uniform_real_distribution<float>(low, high)(bits); };
    for (Splat<F, float>& splat : splats) {
      const float a = std::exp(uniform(-2, 2)), b = std::exp(uniform(-2, 2)), angle = uniform(0, 3.14f);
      const float c = std::cos(angle), s = std::sin(angle);
      const Cov2d<float> cov = {a * c * c + b * s * s, (a - b) * c * s, a * s * s + b * c * c, a * b};
      splat.mean = {uniform(0, kWidth), uniform(0, kHeight)};
      splat.shape = F::prepare(cov, FootprintOptions{0});
      splat.opacity = uniform(0.02f, most_opaque);
      splat.level = F::level(splat.shape, splat.opacity);
      splat.color = {uniform(0, 1), uniform(0, 1), uniform(0, 1)};
    }
    for (float& x : dL_dimage) x = uniform(-0.5f, 0.5f);
    for (int tile = 0; tile < kGrid.tiles(); ++tile) {
      for (int k = 0; k < (tile == 4 ? count : others); ++k) pairs.push_back({k, int32_t(pairs.size())});
      offsets.push_back(int64_t(pairs.size()));
    }
    counts = {int64_t(pairs.size()), count};
    lists.pairs = &pairs[0].splat;
    lists.stride = 2;
    lists.tile_offsets = offsets.data();
    lists.counts = &counts;
    lists.n = count;
    lists.capacity = int64_t(pairs.size());
  }
};

struct Results {
  std::vector<float> image, alpha, transmittance, pair_grads;
  std::vector<int32_t> last;
};

/// Forwards with one layout, back with another: whole lists, or with kSegment > 0 lists of pixels, shared out as long
/// ones above kLong pairs, and segments of so many pairs.
template <class F, class Forward, class Backward, int kSegment = 0, int kLong = kLongList>
Results run(Scene<F>& scene) {
  constexpr int S = F::kSamples;
  const int tiles = int(kGrid.tiles());
  Results out;
  out.image.resize(kColors * kPixels);
  out.alpha.resize(kPixels);
  out.transmittance.resize(S * kPixels);
  out.last.resize(S * kPixels);
  out.pair_grads.resize(scene.pairs.size() * kPairGradWidth);
  std::vector<float> checkpoints(scene.pairs.size() / kStateChunk * state_planes(S) * kMovingPixels, NAN);
  PlanState state = {};
  std::vector<int32_t> order;
  std::vector<TileChunk> chunks;
  for (int tile = 0; tile < tiles; ++tile) order.push_back(tile), chunks.push_back({tile, 0, 0});
  for (int c = 0; c <= kSampleClasses; ++c) state.counts.chunks.first[c] = c > sample_class(S) ? tiles : 0;

  BlendParams blend = {};
  blend.grid = kGrid;
  blend.splats = &scene.splats[0].mean.x;
  blend.channels.count = kColors;
  blend.background = scene.background.data();
  blend.image = {out.image.data(), kColors, {}};
  blend.alpha = out.alpha.data();
  blend.transmittance = out.transmittance.data();
  blend.last = out.last.data();
  blend.lists = scene.lists;
  blend.plan.tile_order = order.data();
  blend.checkpoints = checkpoints.data();
  std::vector<uint32_t> reach_words(filter_words(scene.lists.capacity, kGrid));
  blend.reach_words = reach_words.data();
  if constexpr (kSegment > 0) {
    cuda_on_host::launch(int(max_pieces(scene.lists.capacity, kFilterPiece, kGrid)), kFilterPiece,
                         [&] { filter_kernel<F>(blend); });
    cuda_on_host::launch(tiles * kListedBlocks<F>, 32, [&] { listed_blend_kernel<F, kColors, kLong>(blend, 0); });
  } else {
    cuda_on_host::launch(tiles, Forward::kThreads, [&] { moving_blend_kernel<F, kColors, Forward>(blend, 0, false); });
  }

  BlendVjpParams vjp = {};
  vjp.grid = kGrid;
  vjp.splats = blend.splats;
  vjp.channels = blend.channels;
  vjp.background = blend.background;
  vjp.transmittance = blend.transmittance;
  vjp.last = blend.last;
  vjp.dL_dimage = {scene.dL_dimage.data(), kColors, {}};
  vjp.lists = scene.lists;
  vjp.plan = &state;
  vjp.chunk_order = chunks.data();
  vjp.max_chunks = tiles;
  vjp.checkpoints = checkpoints.data();
  vjp.pair_grads = out.pair_grads.data();
  vjp.mean_sums = MeanSums::kNorm;
  static_assert(sizeof(MovingVjpShared<F, kColors, Backward>) <= sizeof dynamic_memory);
  if constexpr (kSegment > 0) {
    const int pieces = int(max_pieces(scene.lists.capacity, kSegment, kGrid));
    std::vector<float> maps(size_t(pieces) * AdjointMap::kNumbers * S * kMovingPixels, NAN);
    vjp.adjoint_maps = maps.data();
    cuda_on_host::launch(pieces, Backward::kThreads,
                         [&] { moving_vjp_kernel<F, kColors, Backward, kSegment, true>(vjp, 0, false); });
    cuda_on_host::launch(tiles * S, kMovingPixels, [&] { chain_maps_kernel<F, kSegment>(vjp); });
    cuda_on_host::launch(pieces, Backward::kThreads,
                         [&] { moving_vjp_kernel<F, kColors, Backward, kSegment>(vjp, 0, false); });
  } else {
    cuda_on_host::launch(tiles, Backward::kThreads, [&] { moving_vjp_kernel<F, kColors, Backward>(vjp, 0, false); });
  }
  return out;
}

/// Sums of a hundred terms of order 1, in different orders.
constexpr float kRounding = 100 * 1.2e-7f;

/// The same samples, and the same sums to rounding.
void expect_same(const Results& a, const Results& b) {
  EXPECT_EQ(a.last, b.last);
  EXPECT_EQ(a.transmittance, b.transmittance);
  for (size_t i = 0; i < a.image.size(); ++i) ASSERT_NEAR(a.image[i], b.image[i], kRounding) << i;
  for (size_t i = 0; i < a.pair_grads.size(); ++i) {
    if (i % kPairGradWidth == kPairFourthChannel) continue;  // nothing writes it
    ASSERT_NEAR(a.pair_grads[i], b.pair_grads[i], kRounding * (1 + std::abs(b.pair_grads[i]))) << i;
  }
}

/// Pixel by pixel, in float64.
template <class F> void expect_composited(const Scene<F>& scene, const Results& results) {
  for (int i = 0; i < kPixels; ++i) {
    PixelSummary<double, F> pixel;
    pixel.start(true);
    double color[kColors] = {};
    for (int k = 0; k < int(scene.splats.size()); ++k) {
      const Splat<F, float>& splat = scene.splats[k];
      GaussianShape<double> shape = {{splat.shape.w.xx, splat.shape.w.xy, splat.shape.w.yx, splat.shape.w.yy},
                                     splat.shape.amp};
      const auto terms = F::terms(shape, double(splat.opacity));
      const Vec2<double> d = {i % kWidth - double(splat.mean.x), i / kWidth - double(splat.mean.y)};
      const double weight = pixel.add(terms, d, k).weight;
      const float colors[] = {splat.color.x, splat.color.y, splat.color.z};
      for (int c = 0; c < kColors; ++c) color[c] += weight * colors[c];
    }
    double through = 0;
    for (int s = 0; s < F::kSamples; ++s) through += std::abs(pixel.transmittance[s]) / F::kSamples;
    // A splat that rounding takes over the threshold of 1/255 shows as much.
    EXPECT_NEAR(results.alpha[i], 1 - through, 1.0 / 255);
    for (int c = 0; c < kColors; ++c)
      EXPECT_NEAR(results.image[c * kPixels + i], color[c] + through * scene.background[c], 1.0 / 255);
  }
}

template <class F> class MovingKernels : public testing::Test {};
using Moments = testing::Types<Moment<1>, Moment<4>, Moment<9>, Moment<16>>;
TYPED_TEST_SUITE(MovingKernels, Moments);

TYPED_TEST(MovingKernels, AgreeWhateverTheLayouts) {
  using F = TypeParam;
  using Fine = CellLayout<F::kSamples <= 4 ? 1 : 2, 8>;
  using Forward = EvenLayout<F, false>;
  using Backward = EvenLayout<F, true>;
  Scene<F> scene(150, 150, 0.95f);
  const Results fine = run<F, Fine, Fine>(scene);
  expect_composited(scene, fine);
  expect_same(run<F, Forward, Backward>(scene), fine);
  expect_same(run<F, Fine, Backward>(scene), fine);
}

/// A list of several batches of pairs and segments, in which some samples stay open, and some stop in the midst.
TYPED_TEST(MovingKernels, AgreeInListsOfPixelsAndSegments) {
  using F = TypeParam;
  Scene<F> scene(1100, 70, 0.1f);
  const Results whole = run<F, EvenLayout<F, false>, EvenLayout<F, true>>(scene);
  EXPECT_GT(*std::max_element(whole.last.begin(), whole.last.end()), kListedBatch);
  const auto listed = [&](auto longer) {
    return run<F, EvenLayout<F, false>, SegmentLayout<F>, 64, decltype(longer)::value>(scene);
  };
  const Results short_lists = listed(std::integral_constant<int, kLongList>());
  expect_same(short_lists, whole);
  if (F::kSamples > 4) return;  // long lists are shared out in the same way
  const Results a_long_list = listed(std::integral_constant<int, 1000>());
  EXPECT_EQ(a_long_list.image, short_lists.image);
  EXPECT_EQ(a_long_list.transmittance, short_lists.transmittance);
  EXPECT_EQ(a_long_list.last, short_lists.last);
  EXPECT_EQ(a_long_list.pair_grads, short_lists.pair_grads);
}

}  // namespace
}  // namespace ar::cuda
