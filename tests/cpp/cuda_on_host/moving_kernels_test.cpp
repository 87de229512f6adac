// The kernels for samples that move, run on the host: every way of sharing samples out among lanes gives the same, in
// either direction, and it is what compositing pixel by pixel gives.
#include "cuda_on_host.h"
// After it: kernels.
#include <gtest/gtest.h>

#include "core/inspect.h"
#include "cuda/blend_listed.cuh"
#include "cuda/blend_moving_maps.cuh"
#include "cuda/blend_moving_vjp.cuh"
#include "random_splats.h"

namespace ar::cuda {

namespace {

constexpr int kWidth = 21, kHeight = 18, kPixels = kWidth * kHeight, kColors = 3;
constexpr TileGrid kGrid = {kWidth, kHeight, kMovingTileBits};

/// A random scene, of which every tile lists all splats, or all but one the first `others`.
template <class F> struct Scene {
  std::vector<Splat<F, float>> splats;
  std::vector<SlotPair> pairs;
  std::vector<int64_t> offsets = {0};
  TileGrid grid;
  std::vector<float> background = {0.2f, 0.5f, 0.9f}, dL_dimage = std::vector<float>(kColors * kPixels);
  Counts counts = {};
  TileLists lists = {};

  Scene(int count, int others, float most_opaque, TileGrid grid = kGrid) : grid(grid) {
    std::mt19937 bits(7);
    splats = random_splats<F>(bits, count, grid, -2, 2, most_opaque,
                              [](const Cov2d<float>& cov) { return F::prepare(cov, FootprintOptions{0}); });
    for (float& x : dL_dimage) x = uniform(bits, -0.5f, 0.5f);
    for (int tile = 0; tile < grid.tiles(); ++tile) {
      for (int k = 0; k < (tile == 4 ? count : others); ++k) pairs.push_back({k, int32_t(pairs.size())});
      offsets.push_back(int64_t(pairs.size()));
    }
    counts = {int64_t(pairs.size()), count};
    lists = lists_of(pairs, offsets, counts);
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
  const int tiles = int(scene.grid.tiles());
  Results out;
  out.image.resize(kColors * kPixels);
  out.alpha.resize(kPixels);
  out.transmittance.resize(S * kPixels);
  out.last.resize(S * kPixels);
  out.pair_grads.resize(scene.pairs.size() * kPairGradWidth);
  std::vector<float> checkpoints(scene.pairs.size() / kStateChunk * state_planes(S) * Forward::kTilePixels, NAN);
  PlanState state = {};
  std::vector<int32_t> order;
  std::vector<TileChunk> chunks;
  for (int tile = 0; tile < tiles; ++tile) order.push_back(tile), chunks.push_back({tile, 0, 0});
  for (int c = 0; c <= kSampleClasses; ++c) state.counts.chunks.first[c] = c > sample_class(S) ? tiles : 0;

  BlendParams blend = {};
  blend.grid = scene.grid;
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
  const auto render = [&](BlendParams p, auto keep) {
    constexpr bool kKeep = decltype(keep)::value;
    if constexpr (kSegment > 0) {
      cuda_on_host::launch(int(max_pieces(scene.lists.capacity, kFilterPiece, kGrid)), kFilterPiece,
                           [&] { filter_kernel<F>(p); });
      cuda_on_host::launch(tiles * kListedBlocks<F>, 32, [&] { listed_blend_kernel<F, kColors, kKeep, kLong>(p, 0); });
    } else {
      cuda_on_host::launch(tiles, Forward::kThreads,
                           [&] { moving_blend_kernel<F, kColors, Forward, kKeep>(p, 0, false); });
    }
  };
  render(blend, std::true_type());
  std::vector<float> image_alone(kColors * kPixels);
  BlendParams alone = blend;
  alone.image.first = image_alone.data();
  alone.transmittance = nullptr, alone.last = nullptr, alone.checkpoints = nullptr;
  render(alone, std::false_type());
  EXPECT_EQ(image_alone, out.image);

  BlendVjpParams vjp = {};
  vjp.grid = scene.grid;
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
  // Some of the places of a chunk in shared memory, the others not.
  constexpr int kInShared = PlacesInFront<Backward>::kUnit;
  static_assert(sizeof(MovingVjpShared<F, kColors, Backward, kSegment>) + kInShared * PlacesInFront<Backward>::kBytes <=
                sizeof dynamic_memory);
  if constexpr (kSegment > 0) {
    const int pieces = int(max_pieces(scene.lists.capacity, kSegment, kGrid));
    std::vector<float> maps(size_t(pieces) * SegmentMap::kNumbers * S * kMovingPixels, NAN);
    vjp.adjoint_maps = maps.data();
    cuda_on_host::launch(pieces * MapLayout<F>::kBlocks, MapLayout<F>::kThreads,
                         [&] { segment_maps_kernel<F, kColors, kSegment>(vjp, 0); });
    cuda_on_host::launch(tiles * S, kMovingPixels, [&] { chain_maps_kernel<F, kSegment>(vjp); });
    cuda_on_host::launch(pieces, Backward::kThreads,
                         [&] { moving_vjp_kernel<F, kColors, Backward, kSegment>(vjp, 0, false, kInShared); });
  } else {
    cuda_on_host::launch(tiles, Backward::kThreads,
                         [&] { moving_vjp_kernel<F, kColors, Backward>(vjp, 0, false, kInShared); });
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

/// The rows of pairs, added up for each splat.
template <class F> std::vector<double> sums_of_splats(const Scene<F>& scene, const Results& results) {
  std::vector<double> sums(scene.splats.size() * kPairGradWidth);
  for (const SlotPair& pair : scene.pairs) {
    for (int c = 0; c < kPairGradWidth; ++c) {
      if (c == kPairFourthChannel) continue;  // nothing writes it
      sums[pair.splat * kPairGradWidth + c] += results.pair_grads[size_t(pair.slot) * kPairGradWidth + c];
    }
  }
  return sums;
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
  using Forward = EvenLayout<F, false, true>;
  using Backward = EvenLayout<F, true, true>;
  Scene<F> scene(150, 150, 0.95f);
  const Results fine = run<F, Fine, Fine>(scene);
  expect_composited(scene, fine);
  expect_same(run<F, Forward, Backward>(scene), fine);
  expect_same(run<F, Fine, Backward>(scene), fine);
}

TEST(MovingKernelsOfOneCell, AgreeWhateverTheTiles) {
  using F = Moment<1>;
  Scene<F> fine(150, 150, 0.95f), coarse(150, 150, 0.95f, {kWidth, kHeight});
  const Results a = run<F, EvenLayout<F, false, true>, EvenLayout<F, true, true>>(fine);
  const Results b = run<F, EvenLayout<F, false, false>, EvenLayout<F, true, false>>(coarse);
  EXPECT_EQ(a.last, b.last);
  for (int i = 0; i < kPixels; ++i) ASSERT_NEAR(a.transmittance[i], b.transmittance[i], kRounding) << i;
  for (size_t i = 0; i < a.image.size(); ++i) ASSERT_NEAR(a.image[i], b.image[i], kRounding) << i;
  const std::vector<double> of_fine = sums_of_splats(fine, a), of_coarse = sums_of_splats(coarse, b);
  for (size_t i = 0; i < of_fine.size(); ++i)
    ASSERT_NEAR(of_coarse[i], of_fine[i], 3 * kRounding * (1 + std::abs(of_fine[i]))) << i;
}

TEST(MovingKernelsOfOneCell, HaveCoarseTilesForOneCellInLargeImagesOnly) {
  EXPECT_EQ(moving_grid(1, 1920, 1080).side(), kTile);
  EXPECT_EQ(moving_grid(4, 1920, 1080).side(), kMovingTile);
  EXPECT_EQ(moving_grid(1, 512, 512).side(), kTile);
  EXPECT_EQ(moving_grid(1, 512, 504).side(), kMovingTile);
}

/// A list of several batches of pairs and segments, in which some samples stay open, and some stop in the midst.
TYPED_TEST(MovingKernels, AgreeInListsOfPixelsAndSegments) {
  using F = TypeParam;
  Scene<F> scene(1100, 70, 0.1f);
  const Results whole = run<F, EvenLayout<F, false, true>, EvenLayout<F, true, true>>(scene);
  EXPECT_GT(*std::max_element(whole.last.begin(), whole.last.end()), kListedBatch);
  const auto listed = [&](auto segment, auto longer) {
    return run<F, EvenLayout<F, false, true>, SegmentLayout<F>, decltype(segment)::value, decltype(longer)::value>(
        scene);
  };
  const std::integral_constant<int, 64> segment;
  const Results short_lists = listed(segment, std::integral_constant<int, kLongList>());
  expect_same(short_lists, whole);
  const std::integral_constant<int, kMovingSegment<F>> as_rendered;
  expect_same(listed(as_rendered, std::integral_constant<int, kLongList>()), whole);
  if (F::kSamples > 4) return;  // long lists are shared out in the same way
  const Results a_long_list = listed(segment, std::integral_constant<int, 1000>());
  // Colours are added up by other lanes.
  for (size_t i = 0; i < a_long_list.image.size(); ++i)
    ASSERT_NEAR(a_long_list.image[i], short_lists.image[i], kRounding) << i;
  EXPECT_EQ(a_long_list.transmittance, short_lists.transmittance);
  EXPECT_EQ(a_long_list.last, short_lists.last);
  EXPECT_EQ(a_long_list.pair_grads, short_lists.pair_grads);
}

}  // namespace
}  // namespace ar::cuda
