// The kernel of blend_vjp for few channels, run on the host: its sums are those of every pixel by itself; warps that
// take chunk after chunk leave what a warp for every chunk leaves, and no chunk is taken twice.
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

/// Random inputs of the kernel. The state that a forward pass would have left is random too. `overflow`: every tile
/// lists all splats, as one chunk, and all tiles add to a row per splat.
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

/// What the kernel should leave in the rows of pairs, in float64, pixel by pixel; and the sums of the absolute values
/// of all terms.
struct ExpectedSums {
  std::vector<double> sums, size;
};
template <class F> ExpectedSums expected_sums(const Scene<F>& scene) {
  constexpr int S = F::kSamples, kLength = chunk_length(S);
  const int pixels = kGrid.width * kGrid.height;
  const Vec2<double> image_size = {double(kGrid.width), double(kGrid.height)};
  ExpectedSums out = {std::vector<double>(size_t(scene.rows) * kPairGradWidth),
                      std::vector<double>(size_t(scene.rows) * kPairGradWidth)};
  for (size_t item = kOthers; item < scene.chunks.size(); ++item) {
    const auto [tile, chunk, plane] = scene.chunks[item];
    const int x0 = tile % kGrid.columns() * kTile, y0 = tile / kGrid.columns() * kTile;
    const auto* list = &scene.pairs[scene.offsets[tile]];
    const int begin = chunk * kLength;
    const int end = std::min(int(scene.offsets[tile + 1] - scene.offsets[tile]), begin + kLength);
    const auto for_each_pixel = [&](auto&& visit) {
      for (int y = 0; y < kTile && y0 + y < kGrid.height; ++y) {
        for (int x = 0; x < kTile && x0 + x < kGrid.width; ++x) visit(x, y, (y0 + y) * kGrid.width + x0 + x);
      }
    };
    int tile_last = 0;
    for_each_pixel([&](int, int, int i) {
      for (int s = 0; s < S; ++s) tile_last = std::max(tile_last, scene.last[s * pixels + i]);
    });
    const bool final = tile_last <= end;  // nothing of a later chunk was composited
    for_each_pixel([&](int x, int y, int i) {
      double g[kColors], transmittance[S], behind[S];
      for (int c = 0; c < kColors; ++c) g[c] = scene.dL_dimage[c * pixels + i] / double(S);
      const int place = (y / 4 * 2 + x / 8) * 32 + y % 4 * 8 + x % 8;  // of its subtile and lane
      for (int s = 0; s < S; ++s) {
        const float* checkpoint = &scene.checkpoints[(size_t(plane) * kTilePixels) + (s * kTilePixels + place) * 4];
        const double at_end = scene.transmittance[s * pixels + i];
        transmittance[s] = final ? at_end : checkpoint[kColors];
        behind[s] = -scene.dL_dalpha[i] / double(S) * at_end / transmittance[s];
        for (int c = 0; c < kColors; ++c)
          behind[s] += g[c] * (final ? scene.background[c] : checkpoint[c] / transmittance[s]);
      }
      for (int k = std::min(end, tile_last) - 1; k >= begin; --k) {
        const auto& [id, row] = list[k];
        const Splat<F, float>& splat = scene.splats[id];
        const GaussianShape<double> shape = {{splat.shape.w.xx, splat.shape.w.xy, splat.shape.w.yx, splat.shape.w.yy},
                                             splat.shape.amp};
        const Vec2<float> origin = {float(x0) - splat.mean.x, float(y0) - splat.mean.y};
        const auto terms = F::terms(shape, double(splat.opacity), {double(origin.x), double(origin.y)});
        const auto float_terms = F::terms(splat.shape, splat.opacity, origin);  // which say what was composited
        const Vec2<double> p = {double(x), double(y)};
        const double color[] = {splat.color.x, splat.color.y, splat.color.z};
        double g_color = 0, contribution = 0, weighted = 0, largest = 0;
        for (int c = 0; c < kColors; ++c) g_color += g[c] * color[c];
        ShapeGrad<double> of_pixel = {{0, 0}, {0, 0, 0}}, absolute = of_pixel;
        for (int s = 0; s < S; ++s) {
          const float alpha = F::alpha(float_terms, Vec2<float>{float(x), float(y)}, s);
          const bool mask = alpha >= float(kAlphaMin) && k < scene.last[s * pixels + i];
          if (!mask) continue;
          const double raw = F::alpha(terms, p, s), of_behind = std::abs(behind[s]);
          const BlendGrad<double> grad = blend_sample_vjp(mask, raw, g_color, transmittance[s], behind[s]);
          F::add_alpha_vjp(terms, p, s, raw, grad.dL_dalpha, of_pixel);
          const double most = transmittance[s] * (std::abs(g_color) + of_behind);
          F::add_alpha_vjp(terms, p, s, raw, most, absolute);
          contribution += grad.contribution;
          weighted += grad.dL_dalpha * raw;
          largest += most * raw;
        }
        double* const sums = &out.sums[size_t(row) * kPairGradWidth];
        double* const size = &out.size[size_t(row) * kPairGradWidth];
        const double values[] = {of_pixel.offset.x, of_pixel.offset.y, of_pixel.shape.xx,
                                 of_pixel.shape.xy, of_pixel.shape.yy, weighted};
        const double sizes[] = {absolute.offset.x, absolute.offset.y, absolute.shape.xx,
                                absolute.shape.xy, absolute.shape.yy, largest};
        // A lane's products of z may cancel in its sums over samples: the size is that of z.
        const double z = std::sqrt(std::abs(sizes[2]) * largest) + std::sqrt(std::abs(sizes[4]) * largest);
        for (int v = 0; v < 6; ++v)
          sums[v] += values[v], size[v] += v == 5 ? largest : z + std::abs(sizes[v]) + largest;
        for (int c = 0; c < kColors; ++c)
          sums[6 + c] += contribution * g[c], size[6 + c] += std::abs(contribution * g[c]);
        const Mat2<double> map = F::mean_map(shape);
        const Vec2<double> means =
            mean_sums_of(scene.params.mean_sums, image_size, transform_transposed(map, of_pixel.offset));
        sums[kPairMeans] += means.x, sums[kPairMeans + 1] += means.y;
        const double norm = std::abs(map.xx) + std::abs(map.xy) + std::abs(map.yx) + std::abs(map.yy);
        const double unit = scene.params.mean_sums == MeanSums::kNorm ? image_size.x : 1;
        for (int v = 0; v < 2; ++v) size[kPairMeans + v] += unit * norm * (z + largest);
      }
    });
  }
  return out;
}

template <class F, Sums kSums> void expect_sums_of_pixels(MeanSums mean_sums) {
  SCOPED_TRACE(testing::Message() << F::kSamples << " samples, MeanSums " << int(mean_sums));
  Scene<F> scene(mean_sums, false);
  std::vector<float> sums(size_t(scene.rows) * kPairGradWidth, NAN);
  scene.template run<kSums>(2, kOthers, int(scene.chunks.size()), sums);
  const ExpectedSums expected = expected_sums(scene);
  int compared = 0;
  for (size_t i = 0; i < sums.size(); ++i) {
    const int column = int(i % kPairGradWidth);
    if (column >= (kSums == Sums::kGrads ? kPairMeans : kPairMeans + 2)) continue;
    // Each of up to 256 splats divides the transmittance, and adds to what is behind: a few roundings for each of them.
    // Sums of means, whose sizes are bounds far above them, are held to fewer.
    const double roundings = column < kPairMeans ? 4 * 256 : 256;
    const double error = std::abs(sums[i] - expected.sums[i]), tolerance = roundings * 0x1p-24 * expected.size[i];
    // What no pixel shows is exactly zero.
    ASSERT_LE(error, tolerance) << "column " << column << " of row " << i / kPairGradWidth << ": " << sums[i];
    compared += expected.size[i] > 0;
  }
  ASSERT_GT(compared, int(sums.size()) / 10);
}

template <class F> class BlendVjpKernel : public testing::Test {};
using Gaussians = testing::Types<GaussianPixels<1>, GaussianPixels<4>>;
TYPED_TEST_SUITE(BlendVjpKernel, Gaussians);

TYPED_TEST(BlendVjpKernel, SumsAreThoseOfThePixels) {
  expect_sums_of_pixels<TypeParam, Sums::kGrads>(MeanSums::kNone);
  expect_sums_of_pixels<TypeParam, Sums::kBoth>(MeanSums::kAbsolute);
  expect_sums_of_pixels<TypeParam, Sums::kBoth>(MeanSums::kNorm);
}

TYPED_TEST(BlendVjpKernel, FewWarpsLeaveWhatAWarpForEachChunkLeaves) {
  for (const bool overflow : {false, true}) {
    expect_the_same_from_few_warps<TypeParam, Sums::kGrads>(overflow);
    expect_the_same_from_few_warps<TypeParam, Sums::kBoth>(overflow);
  }
}

}  // namespace
}  // namespace ar::cuda
