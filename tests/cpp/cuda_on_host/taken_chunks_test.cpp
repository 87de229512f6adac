// The kernel of blend_vjp for few channels, run on the host: warps that take chunk after chunk leave what a warp for
// every chunk leaves, and no chunk is taken twice.
#include "cuda_on_host.h"
// After it: kernels.
#include <gtest/gtest.h>

#include "cuda/blend_vjp.cuh"
#include "random_splats.h"

namespace ar::cuda {
namespace {

constexpr TileGrid kGrid = {4 * kTile - 3, 3 * kTile - 5};
constexpr int kColors = 3, kOthers = 2;  ///< chunks in front of those of the kernel's samples

std::vector<float> random_numbers(std::mt19937& bits, size_t count, float low, float high) {
  std::vector<float> numbers(count);
  for (float& x : numbers) x = uniform(bits, low, high);
  return numbers;
}

/// Random inputs of the kernel. The state that a forward pass would have left is random too: what a chunk's sums are
/// does not matter here, only that they are always the same. `overflow`: every tile lists all splats, as one chunk, and
/// all tiles add to a row per splat.
template <class F> struct Scene {
  static constexpr int S = F::kSamples, kLength = chunk_length(S);

  std::vector<Splat<F, float>> splats;
  std::vector<SlotPair> pairs;
  std::vector<int64_t> offsets = {0};
  std::vector<int32_t> order, last;
  std::vector<TileChunk> chunks;
  std::vector<float> background = {0.2f, 0.5f, 0.9f}, dL_dimage, dL_dalpha, transmittance, checkpoints;
  PlanState plan = {};
  Counts counts = {};
  BlendVjpParams params = {};
  int rows;

  Scene(MeanSums mean_sums, bool overflow) {
    std::mt19937 bits(7);
    const int count = overflow ? 40 : kLength + 60, tiles = int(kGrid.tiles()), pixels = kGrid.width * kGrid.height;
    splats = random_splats<F>(bits, count, kGrid, -1, 3, 0.9f, [](const Cov2d<float>& cov) {
      return GaussianFootprint<S, true>::prepare_with(cov, 1 / 12.0f);
    });
    for (int k = 0; k < count; ++k) order.push_back(k);
    for (int k = 0; k < kOthers; ++k) chunks.push_back({k, 0, 0});
    int planes = 0;
    for (int tile = 0; tile < tiles; ++tile) {
      const int length = overflow ? count : tile % 4 == 1 ? kLength + 10 + tile : 5 * tile % 37;
      for (int k = 0; k < length; ++k) pairs.push_back({(k + tile) % count, int32_t(pairs.size())});
      offsets.push_back(int64_t(pairs.size()));
      for (int chunk = 0; chunk * kLength < length; ++chunk, planes += 4 * S) {  // of kColors + 1 numbers
        chunks.push_back({tile, chunk, planes});
      }
    }
    rows = overflow ? count : int(pairs.size());
    counts = {int64_t(pairs.size()), count};
    dL_dimage = random_numbers(bits, kColors * pixels, -0.5f, 0.5f);
    dL_dalpha = random_numbers(bits, pixels, -0.5f, 0.5f);
    transmittance = random_numbers(bits, S * pixels, 0.01f, 1);
    checkpoints = random_numbers(bits, size_t(planes) * kTilePixels, 0.01f, 1);
    for (int i = 0; i < S * pixels; ++i) last.push_back(int(uniform(bits, 0, 1.2f * count)));
    params.grid = kGrid;
    params.splats = &splats[0].mean.x;
    params.channels.count = kColors;
    params.background = background.data();
    params.transmittance = transmittance.data();
    params.last = last.data();
    params.dL_dimage = {dL_dimage.data(), kColors, {}};
    params.dL_dalpha = dL_dalpha.data();
    params.lists = lists_of(pairs, offsets, counts);
    params.lists.order = order.data();
    params.lists.capacity -= overflow;
    params.plan = &plan;
    params.chunk_order = chunks.data();
    params.checkpoints = checkpoints.data();
    params.mean_sums = mean_sums;
  }

  /// Runs `blocks` blocks for chunks [first, end) and adds to `sums`. Returns how often a warp asked for a chunk.
  template <Sums kSums> int run(int blocks, int first, int end, std::vector<float>& sums) {
    for (int c = 0; c <= kSampleClasses; ++c) plan.counts.chunks.first[c] = c > sample_class(S) ? end : first;
    int32_t taken[kSampleClasses] = {};
    params.chunks_taken = taken;
    params.pair_grads = sums.data();
    for (float4& numbers : dynamic_memory) numbers = {NAN, NAN, NAN, NAN};
    cuda_on_host::launch(blocks, 32 * kVjpWarps<F, kSums>, [&] { blend_vjp_kernel<F, kColors, kSums>(params); });
    return taken[sample_class(S)];
  }
};

template <class F, Sums kSums> void expect_the_same_from_few_warps(bool overflow) {
  SCOPED_TRACE(testing::Message() << F::kSamples << " samples, Sums " << int(kSums) << ", overflow " << overflow);
  static_assert(kTakesChunks<F, kSums>);
  constexpr int kBlocks = 2, kWarps = kBlocks * kVjpWarps<F, kSums>;
  constexpr int kColumns = kSums == Sums::kGrads ? kPairMeans : kPairMeans + 2;
  Scene<F> scene(kSums == Sums::kGrads ? MeanSums::kNone : MeanSums::kNorm, overflow);
  const int end = int(scene.chunks.size());
  ASSERT_GT(end - kOthers, kWarps);
  const size_t numbers = size_t(scene.rows) * kPairGradWidth;
  // A warp for every chunk: a row of a pair is written by one of them and 0 in the others.
  std::vector<double> expected(numbers), size(numbers);
  for (int chunk = kOthers; chunk < end; ++chunk) {
    std::vector<float> sums(numbers);
    scene.template run<kSums>(1, chunk, chunk + 1, sums);
    for (size_t i = 0; i < numbers; ++i) expected[i] += sums[i], size[i] += std::abs(sums[i]);
  }
  ASSERT_GT(*std::max_element(size.begin(), size.end()), 0);
  std::vector<float> sums(numbers, overflow ? 0 : NAN);
  // Every chunk once, and every warp once more, to find that none is left.
  EXPECT_EQ(scene.template run<kSums>(kBlocks, kOthers, end, sums), end - kOthers + kWarps);
  for (size_t i = 0; i < numbers; ++i) {
    if (int(i % kPairGradWidth) >= kColumns) continue;
    // What tiles add to a row is added in another order: a rounding for each of them.
    const double rounding = overflow ? double(end) * 0x1p-24 * size[i] : 0;
    ASSERT_LE(std::abs(sums[i] - expected[i]), rounding) << "row " << i / kPairGradWidth << " of " << scene.rows;
  }
}

template <class F> class TakenChunks : public testing::Test {};
using Gaussians = testing::Types<GaussianPixels<1>, GaussianPixels<4>>;
TYPED_TEST_SUITE(TakenChunks, Gaussians);

TYPED_TEST(TakenChunks, AreThoseOfAWarpForEachOfThem) {
  for (const bool overflow : {false, true}) {
    expect_the_same_from_few_warps<TypeParam, Sums::kGrads>(overflow);
    expect_the_same_from_few_warps<TypeParam, Sums::kBoth>(overflow);
  }
}

}  // namespace
}  // namespace ar::cuda
