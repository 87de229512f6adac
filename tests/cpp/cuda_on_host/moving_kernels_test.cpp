// The kernels for samples that move, run on the host: every way of sharing samples out among lanes gives the same, in
// either direction, and it is what compositing pixel by pixel gives.
#include "cuda_on_host.h"
// After it: kernels.
#include <gtest/gtest.h>

#include "core/inspect.h"
#include "cuda/bin/plan.cuh"
#include "cuda/moment/listed.cuh"
#include "cuda/moment/maps.cuh"
#include "cuda/moment/vjp_segments.cuh"
#include "cuda/moment/vjp_walk.cuh"
#include "cuda/moment/walk.cuh"
#include "random_splats.h"

namespace ar::cuda {

namespace {

constexpr int kWidth = 21, kHeight = 18, kPixels = kWidth * kHeight, kColors = 3;
constexpr TileGrid kGrid = {kWidth, kHeight, kMovingTileBits};
constexpr int kMost = 1 << 20;

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
      for (int k = 0; k < (tile == (grid.tiles() - 1) / 2 ? count : others); ++k)
        pairs.push_back({k, int32_t(pairs.size())});
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

/// The plan of a scene's lists.
struct Plan {
  PlanState state;
  std::vector<TileChunk> chunks;
  std::vector<int32_t> order, planes;
  std::vector<CutList> lists;
  ChunkPlan view = {};

  template <class F>
  Plan(const Scene<F>& scene, const ListCut& cut)
      : chunks(size_t(scene.grid.tiles() + cut.max_segments)),
        order(size_t(scene.grid.tiles())),
        planes(order.size()),
        lists(size_t(cut.max_lists)) {
    view.state = &state;
    view.chunk_order = chunks.data();
    view.tile_order = order.data();
    view.tile_planes = planes.data();
    view.cut_lists = lists.data();
    view.blocks_at_once = kBlocksPerSm * cuda_on_host::kMultiprocessors;
    cuda_on_host::launch(PlanState::kCounters, PlanPolicy::kCountThreads,
                         [&] { count_work_kernel(scene.lists, scene.grid.tiles(), cut, &state); });
    cuda_on_host::launch(1, PlanPolicy::kThreads,
                         [&] { plan_kernel(scene.lists, scene.grid, F::kSamples, cut, {kColors, true}, view); });
  }
};

/// Whole lists forwards with one layout, back with another. With kSegment > 0 those of `long_from` pairs or more are
/// cut: forwards into lists of pixels, those of `longest_from` with a warp or more for each pixel; back into segments
/// of so many pairs.
template <class F, class Forward, class Backward, int kSegment = 0>
Results run(Scene<F>& scene, int long_from = 0, int longest_from = MomentPolicy::longest_list(F::kSamples)) {
  constexpr int S = F::kSamples, kSide = Forward::kSide;
  static_assert(Backward::kSide == kSide);
  const int tiles = int(scene.grid.tiles());
  Results out;
  out.image.resize(kColors * kPixels);
  out.alpha.resize(kPixels);
  out.transmittance.resize(S * kPixels);
  out.last.resize(S * kPixels);
  out.pair_grads.resize(scene.pairs.size() * kPairGradWidth);
  std::vector<float> checkpoints(scene.pairs.size() / kStateChunk * state_planes(S) * Forward::kTilePixels, NAN);
  const auto cut_into = [&](int segment) {
    if (kSegment == 0) return ListCut{true};
    return ListCut{true, long_from, kMost, segment, int(scene.lists.capacity / segment) + tiles, tiles, longest_from};
  };
  const ListCut cut = cut_into(moving_segment(S, kSide)), cut_back = cut_into(kSegment);
  const Plan plan(scene, cut), plan_back(scene, cut_back);

  BlendParams blend = {};
  blend.grid = scene.grid;
  blend.splats = reinterpret_cast<const float*>(scene.splats.data());
  blend.channels.count = kColors;
  blend.background = scene.background.data();
  blend.image = {out.image.data(), kColors, {}};
  blend.alpha = out.alpha.data();
  blend.transmittance = out.transmittance.data();
  blend.last = out.last.data();
  blend.lists = scene.lists;
  blend.plan = plan.view;
  blend.checkpoints = checkpoints.data();
  std::vector<uint32_t> reach_words(size_t(cut.max_segments) * (moving_segment(S, kSide) / 32) * Forward::kTilePixels);
  blend.reach_words = reach_words.data();
  const auto render = [&](BlendParams p, auto keep) {
    constexpr bool kKeep = decltype(keep)::value;
    if constexpr (kSegment > 0) {
      // Fewer blocks than pieces and tiles.
      cuda_on_host::launch(cut.max_segments / 2, MomentPolicy::kFilterPiece, [&] { filter_kernel<F, kSide>(p); });
      cuda_on_host::launch(ListedLayouts<F, kSide>::kOfLongest, 32 * kListedWarps<F>,
                           [&] { listed_blend_kernel<F, kColors, kSide, kKeep, kSegment>(p, 0); });
    }
    cuda_on_host::launch(tiles + 1, Forward::kThreads,
                         [&] { moving_blend_kernel<F, kColors, Forward, kKeep>(p, 0, false); });
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
  vjp.plan = &plan_back.state;
  vjp.chunk_order = plan_back.chunks.data();
  vjp.cut_lists = plan_back.lists.data();
  vjp.checkpoints = checkpoints.data();
  int32_t segments_claimed = -1;  // chain_maps_kernel has to set it to zero
  vjp.chunks_taken = &segments_claimed;
  vjp.pair_grads = out.pair_grads.data();
  vjp.mean_sums = MeanSums::kNorm;
  if constexpr (kSegment > 0) {
    using Maps = MapLayout<F, kSide>;
    const int segments = cut_back.max_segments;
    std::vector<float> maps(size_t(segments) * SegmentMap::kNumbers * S * Forward::kTilePixels, NAN);
    vjp.adjoint_maps = maps.data();
    cuda_on_host::launch(segments * Maps::kBlocks, Maps::kThreads,
                         [&] { segment_maps_kernel<F, kColors, kSide, kSegment>(vjp, 0); });
    cuda_on_host::launch(tiles * S, kSide * kSide, [&] { chain_maps_kernel<F, kSide, kSegment>(vjp); });
    using Layout = ClaimedLayout<F, kSide>;
    using Shared = SegmentVjpShared<F, kColors, Layout, kSegment>;
    constexpr int kBlocks = 3, kInShared = EarlierPositions<Layout>::kUnit;  // fewer blocks than segments
    static_assert(sizeof(Shared) + kInShared * EarlierPositions<Layout>::kBytes <= sizeof dynamic_memory);
    std::vector<typename Shared::SumsOfGroup> group_sums(kBlocks * Layout::kGroups);
    vjp.group_sums = &group_sums[0][0][0];
    cuda_on_host::launch(kBlocks, Layout::kThreads,
                         [&] { segment_vjp_kernel<F, kColors, Layout, kSegment>(vjp, 0, kInShared); });
  }
  // Some positions of a chunk in shared memory, the others not.
  constexpr int kInShared = EarlierPositions<Backward>::kUnit;
  static_assert(sizeof(MovingVjpShared<F, kColors, Backward>) + kInShared * EarlierPositions<Backward>::kBytes <=
                sizeof dynamic_memory);
  cuda_on_host::launch(tiles, Backward::kThreads, [&] { moving_vjp_kernel<F, kColors, Backward>(vjp, 0, kInShared); });
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
      GaussianShape<double> shape = {
          {splat.shape.w.xx, splat.shape.w.yx, splat.shape.w.yy}, splat.shape.amp, splat.shape.x_given_y};
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
using Moments = testing::Types<Moment<1>, Moment<4>, Moment<16>>;
TYPED_TEST_SUITE(MovingKernels, Moments);

TYPED_TEST(MovingKernels, AgreeWhateverTheLayouts) {
  using F = TypeParam;
  using Fine = CellLayout<F::kSamples <= 4 ? 1 : 2, 8>;
  using Even = EvenLayout<F, kMovingTile>;
  Scene<F> scene(150, 150, 0.95f);
  const Results fine = run<F, Fine, Fine>(scene);
  expect_composited(scene, fine);
  expect_same(run<F, Even, Even>(scene), fine);
  expect_same(run<F, Fine, Even>(scene), fine);
}

/// Tiles of kFine pixels a side, and of twice as many.
template <class F, int kFine> void expect_same_in_other_tiles(TileGrid fine_grid, TileGrid coarse_grid) {
  constexpr int kCoarse = 2 * kFine;
  Scene<F> fine(150, 150, 0.95f, fine_grid), coarse(150, 150, 0.95f, coarse_grid);
  const Results a = run<F, EvenLayout<F, kFine>, EvenLayout<F, kFine>>(fine);
  const Results b = run<F, EvenLayout<F, kCoarse>, EvenLayout<F, kCoarse>>(coarse);
  EXPECT_EQ(a.last, b.last);
  for (size_t i = 0; i < a.transmittance.size(); ++i)
    ASSERT_NEAR(a.transmittance[i], b.transmittance[i], kRounding) << i;
  for (size_t i = 0; i < a.image.size(); ++i) ASSERT_NEAR(a.image[i], b.image[i], kRounding) << i;
  const std::vector<double> of_fine = sums_of_splats(fine, a), of_coarse = sums_of_splats(coarse, b);
  for (size_t i = 0; i < of_fine.size(); ++i)
    ASSERT_NEAR(of_coarse[i], of_fine[i], 3 * kRounding * (1 + std::abs(of_fine[i]))) << i;
}

constexpr TileGrid kLargeTiles = {kWidth, kHeight}, kSmallTiles = {kWidth, kHeight, kMovingTileBits - 1};
TEST(MovingKernelsInOtherTiles, Agree) {
  expect_same_in_other_tiles<Moment<1>, kMovingTile>(kGrid, kLargeTiles);
  expect_same_in_other_tiles<Moment<16>, kMovingTile / 2>(kSmallTiles, kGrid);
}

TEST(MovingKernelsInOtherTiles, AreForTheNumberOfCellsAndTheImage) {
  EXPECT_EQ(moving_grid(1, 1920, 1080).side(), kTile);
  EXPECT_EQ(moving_grid(4, 1920, 1080).side(), kMovingTile);
  EXPECT_EQ(moving_grid(1, 512, 512).side(), kTile);
  EXPECT_EQ(moving_grid(1, 512, 504).side(), kMovingTile);
  EXPECT_EQ(moving_grid(4, 512, 504).side(), kMovingTile);
  EXPECT_EQ(moving_grid(16, 512, 512).side(), kMovingTile);
  EXPECT_EQ(moving_grid(16, 512, 504).side(), kMovingTile / 2);
}

/// A list of several batches of pairs and segments, in which some samples stay open, and some stop in the midst: as a
/// whole, and cut.
template <class F, int kSide> void expect_same_if_cut(TileGrid grid) {
  using Even = EvenLayout<F, kSide>;
  Scene<F> scene(1100, 70, 0.1f, grid);
  const Results whole = run<F, Even, Even>(scene);
  EXPECT_GT(*std::max_element(whole.last.begin(), whole.last.end()), std::max(kListedBatch, MomentPolicy::kQueued));
  const Results short_lists = run<F, Even, Even, 64>(scene);
  expect_same(short_lists, whole);
  expect_same(run<F, Even, Even, moving_segment(F::kSamples, kSide)>(scene), whole);
  // The long list alone, beside others that are not cut.
  expect_same(run<F, Even, Even, 64>(scene, 1024), whole);
  if (MomentPolicy::longest_list(F::kSamples) == 0) return;  // all were among the longest
  const Results a_long_list = run<F, Even, Even, 64>(scene, 0, 512);
  // Colours are added up by other lanes.
  for (size_t i = 0; i < a_long_list.image.size(); ++i)
    ASSERT_NEAR(a_long_list.image[i], short_lists.image[i], kRounding) << i;
  EXPECT_EQ(a_long_list.transmittance, short_lists.transmittance);
  EXPECT_EQ(a_long_list.last, short_lists.last);
  EXPECT_EQ(a_long_list.pair_grads, short_lists.pair_grads);
}
TYPED_TEST(MovingKernels, AgreeInListsOfPixelsAndSegments) { expect_same_if_cut<TypeParam, kMovingTile>(kGrid); }
TEST(MovingKernelsInOtherTiles, AgreeInListsOfPixelsAndSegments) {
  expect_same_if_cut<Moment<1>, kTile>(kLargeTiles);
  expect_same_if_cut<Moment<16>, kMovingTile / 2>(kSmallTiles);
}

/// No two tiles have a checkpoint in the same place, or one beyond the room for all.
template <class F> void expect_checkpoints_apart(const Scene<F>& scene) {
  std::vector<int> owner(scene.lists.capacity / kStateChunk, -1);
  for (int tile = 0; tile < scene.grid.tiles(); ++tile) {
    const TileList list = list_of(scene.lists, scene.grid, tile);
    const TileCheckpoints places(scene.lists, list, scene.grid, tile);
    for (int k = places.spacing; k < list.count; k += places.spacing) {
      const int64_t at = places.first + k / places.spacing - 1;
      ASSERT_TRUE(at >= 0 && at < int64_t(owner.size())) << tile;
      ASSERT_EQ(owner[at], -1) << tile;
      owner[at] = tile;
    }
  }
}

/// The larger a patch, the fewer checkpoints has each of its tiles: some, two, and one.
template <class F, int kSide> void expect_same_if_tiles_share_lists(TileGrid grid) {
  using Even = EvenLayout<F, kSide>;
  for (const auto& [count, patch_bits] : {std::pair(701, 1), {700, 2}, {300, 20}}) {
    SCOPED_TRACE(testing::Message() << count << " splats, patches of 4^" << patch_bits << " tiles");
    Scene<F> scene(count, count, 0.02f, grid);
    const Results own = run<F, Even, Even>(scene);
    EXPECT_GT(*std::max_element(own.last.begin(), own.last.end()), count * 9 / 10);
    const std::vector<double> expected = sums_of_splats(scene, own);
    Scene<F> shared = scene;
    share_lists(shared.pairs, shared.offsets, shared.counts, shared.grid, patch_bits);
    shared.lists = lists_of(shared.pairs, shared.offsets, shared.counts);
    expect_checkpoints_apart(shared);
    const Results results = run<F, Even, Even>(shared);
    EXPECT_EQ(results.last, own.last);
    EXPECT_EQ(results.transmittance, own.transmittance);
    for (size_t i = 0; i < own.image.size(); ++i) ASSERT_NEAR(results.image[i], own.image[i], kRounding) << i;
    for (size_t i = 0; i < expected.size(); ++i)
      ASSERT_NEAR(results.pair_grads[i], expected[i], kRounding * (1 + std::abs(expected[i]))) << i;
  }
}

TYPED_TEST(MovingKernels, AgreeWhereTilesShareLists) {
  expect_same_if_tiles_share_lists<TypeParam, kMovingTile>(kGrid);
}
TEST(MovingKernelsInOtherTiles, AgreeWhereTilesShareLists) {
  expect_same_if_tiles_share_lists<Moment<1>, kTile>(kLargeTiles);
  expect_same_if_tiles_share_lists<Moment<16>, kMovingTile / 2>(kSmallTiles);
}

/// Nothing is read of splats that are not there, which AddressSanitizer would see.
TYPED_TEST(MovingKernels, ShowTheBackgroundOfAnEmptyScene) {
  using F = TypeParam;
  using Even = EvenLayout<F, kMovingTile>;
  Scene<F> scene(0, 0, 0.95f);
  for (const Results& r : {run<F, Even, Even>(scene), run<F, Even, Even, 64>(scene)}) {
    for (int i = 0; i < kColors * kPixels; ++i) ASSERT_EQ(r.image[i], scene.background[i / kPixels]);
  }
}

}  // namespace
}  // namespace ar::cuda
