// The kernel of blend_vjp for few channels, run on the host: its sums are those of every pixel by itself, within what
// float32 may be off; warps that take chunk after chunk leave what a warp for every chunk leaves, and no chunk is taken
// twice.
#include "cuda_on_host.h"
// After it: kernels.
#include <gtest/gtest.h>

#include "core/footprint/registry.h"
#include "cuda/still/vjp.cuh"
#include "random_splats.h"
#include "rounded.h"

namespace ar::cuda {
namespace {

constexpr int kWidth = 4 * kTile - 3, kHeight = 3 * kTile - 5, kPixels = kWidth * kHeight;

/// The footprint that is projected for pixels of F.
template <class F> struct ProjectedFor {
  using Footprint = F;
};
template <int S> struct ProjectedFor<GaussianPixels<S>> {
  using Footprint = Box<S>;
};
template <int S> struct ProjectedFor<GaussianSample<S>> {
  using Footprint = Box<S>;
};

/// Random inputs of the kernel for C channels. The state that a forward pass would have left is random too. `overflow`:
/// all tiles share one list, of one chunk, and add to a row per splat.
template <class F, int C> struct Scene {
  static constexpr int S = F::kSamples;
  static constexpr TileGrid kGrid = grid_for<F>(kWidth, kHeight);

  std::vector<Splat<F, float>> splats;
  std::vector<SlotPair> pairs;
  std::vector<int64_t> offsets = {0};
  std::vector<int32_t> last;
  std::vector<TileChunk> chunks;
  std::vector<float> background = {0.2f, 0.5f, 0.9f, 0.4f}, channels, dL_dimage, dL_dalpha, transmittance, checkpoints;
  PlanState plan = {};
  Counts counts = {};
  BlendVjpParams params = {};
  int rows;

  Scene(MeanSums mean_sums, bool overflow) {
    std::mt19937 bits(7);
    const int count = overflow ? 40 : kChunkLength + 60, tiles = int(kGrid.tiles());
    using Projected = typename ProjectedFor<F>::Footprint;
    const auto prepare = [](const Cov2d<float>& cov) { return Projected::prepare(cov, {}); };
    for (const auto& splat : random_splats<Projected>(bits, count, kGrid, -1, 3, 0.9f, prepare))
      splats.push_back({splat.mean, splat.shape, splat.opacity, splat.level, splat.color});
    int planes = 0;
    for (int tile = 0; tile < tiles; ++tile) {
      const int length = overflow ? count : tile % 4 == 1 ? kChunkLength + 10 + tile : 5 * tile % 37;
      for (int k = 0; k < length; ++k) pairs.push_back({(k + tile) % count, int32_t(pairs.size())});
      offsets.push_back(int64_t(pairs.size()));
      for (int chunk = 0; chunk * kChunkLength < length; ++chunk, planes += (C + 1) * S) {
        chunks.push_back({tile, chunk, planes});
      }
    }
    rows = overflow ? count : int(pairs.size());
    counts = {int64_t(pairs.size()), count};
    dL_dimage = random_numbers(bits, C * kPixels, -0.5f, 0.5f);
    dL_dalpha = random_numbers(bits, kPixels, -0.5f, 0.5f);
    transmittance = random_numbers(bits, kPixelSamples<F> * kPixels, 0.01f, 1);
    checkpoints = random_numbers(bits, size_t(planes) * kTilePixels, 0.01f, 1);
    for (int i = 0; i < kPixelSamples<F> * kPixels; ++i) {  // some to the end of their lists
      const int x = i % kPixels % kWidth, y = i % kPixels / kWidth;
      const int tile = y / kGrid.side() * kGrid.columns() + x / kGrid.side();
      const int length = int(offsets[tile + 1] - offsets[tile]);
      last.push_back(std::min(int(uniform(bits, 0, 1.2f * length)), length));
    }
    params.grid = kGrid;
    params.splats = &splats[0].mean.x;
    params.channels.count = C;
    if (C != 3) {
      channels = random_numbers(bits, size_t(C) * count, 0, 1);
      params.channels.data = channels.data();
      params.channels.stride = C;
    }
    params.background = background.data();
    params.transmittance = transmittance.data();
    params.last = last.data();
    params.dL_dimage = {dL_dimage.data(), C, {}};
    params.dL_dalpha = dL_dalpha.data();
    if (overflow) share_lists(pairs, offsets, counts, kGrid);
    params.lists = lists_of(pairs, offsets, counts);
    params.plan = &plan;
    params.chunk_order = chunks.data();
    params.checkpoints = checkpoints.data();
    params.mean_sums = mean_sums;
  }

  /// Channel c of a splat.
  float channel(int splat, int c) const {
    const Vec3<float>& color = splats[splat].color;
    return C != 3 ? channels[size_t(splat) * C + c] : c == 0 ? color.x : c == 1 ? color.y : color.z;
  }

  /// Runs `blocks` blocks for chunks [first, end) and adds to `sums`. Returns how often a warp asked for a chunk.
  template <bool kMeans> int run(int blocks, int first, int end, std::vector<float>& sums) {
    static_assert(sizeof(VjpShared<F, C>) <= sizeof dynamic_memory);
    plan.counts.chunks = end;
    int32_t taken = first;
    params.chunks_taken = &taken;
    params.pair_grads = sums.data();
    for (float4& numbers : dynamic_memory) numbers = {NAN, NAN, NAN, NAN};
    cuda_on_host::launch(blocks, 32 * StillPolicy::kVjpWarps<F>, [&] { blend_vjp_kernel<F, C, kMeans>(params); });
    return taken - first;
  }
};

template <class F, bool kMeans> void expect_the_same_from_few_warps(bool overflow) {
  SCOPED_TRACE(testing::Message() << F::kSamples << " samples, MeanSums " << kMeans << ", overflow " << overflow);
  constexpr int kBlocks = 2, kWarps = kBlocks * StillPolicy::kVjpWarps<F>;
  constexpr int kColumns = kMeans ? kPairMeans + 2 : kPairMeans;
  Scene<F, 3> scene(kMeans ? MeanSums::kNorm : MeanSums::kNone, overflow);
  const int end = int(scene.chunks.size());
  ASSERT_GT(end, kWarps);
  const size_t numbers = size_t(scene.rows) * kPairGradWidth;
  // A warp for every chunk: a row of a pair is written by one of them and 0 in the others.
  std::vector<double> expected(numbers), size(numbers);
  for (int chunk = 0; chunk < end; ++chunk) {
    std::vector<float> sums(numbers);
    scene.template run<kMeans>(1, chunk, chunk + 1, sums);
    for (size_t i = 0; i < numbers; ++i) expected[i] += sums[i], size[i] += std::abs(sums[i]);
  }
  ASSERT_GT(*std::max_element(size.begin(), size.end()), 0);
  std::vector<float> sums(numbers, overflow ? 0 : NAN);
  // Every chunk once, and every warp once more, to find that none is left.
  EXPECT_EQ(scene.template run<kMeans>(kBlocks, 0, end, sums), end + kWarps);
  for (size_t i = 0; i < numbers; ++i) {
    if (int(i % kPairGradWidth) >= kColumns) continue;
    // What tiles add to a row is added in another order: a rounding for each of them.
    const double rounding = overflow ? double(end) * 0x1p-24 * size[i] : 0;
    ASSERT_LE(std::abs(sums[i] - expected[i]), rounding) << "row " << i / kPairGradWidth << " of " << scene.rows;
  }
}

/// A sum in float64, and a bound of the error that float32 makes in its terms and in adding them.
struct Sum {
  double value = 0, error = 0;
  void add(Rounded term) { value += term.value, error += term.error; }
};

/// The same numbers of a splat's shape, without an error.
template <class F> typename F::template Shape<Rounded> exactly(const typename F::template Shape<float>& shape) {
  float numbers[kShapeWidth];
  Rounded exact[kShapeWidth];
  typename F::template Shape<Rounded> out;
  static_assert(sizeof shape == sizeof numbers && sizeof out == sizeof exact);
  std::memcpy(numbers, &shape, sizeof shape);
  std::copy(std::begin(numbers), std::end(numbers), std::begin(exact));
  std::memcpy(static_cast<void*>(&out), exact, sizeof exact);
  return out;
}

/// A splat of a tile's list.
template <class F> struct ListedTerms {
  typename F::template Terms<Rounded> terms;
  typename F::template Terms<float> in_float;  ///< which say what was composited
  Mat2<Rounded> mean_map;
  int splat, row;
};

/// What the kernel should leave in the rows of pairs, pixel by pixel.
///
/// Each sample's terms are worked out by themselves, in the order of the kernel's operations as far as it is theirs, by
/// numbers that bound their errors. What adding them does to the kernel's sums is counted in Rounded::summed(): in a
/// lane those over S samples and eight pixels; then those over 32 lanes, in five steps.
template <class F, int C> std::vector<Sum> expected_sums(const Scene<F, C>& scene) {
  constexpr int kInLane = (kSubtiles + 1) * F::kSamples, kAcross = 5;
  constexpr TileGrid kGrid = Scene<F, C>::kGrid;
  constexpr int kAll = kPixelSamples<F>, kSide = 1 << kGrid.tile_bits;
  const Vec2<Rounded> image_size = {double(kWidth), double(kHeight)};
  std::vector<Sum> out(size_t(scene.rows) * kPairGradWidth);
  for (size_t item = 0; item < scene.chunks.size(); ++item) {
    const auto [tile, chunk, plane] = scene.chunks[item];
    const int x0 = tile % kGrid.columns() * kSide, y0 = tile / kGrid.columns() * kSide, begin = chunk * kChunkLength;
    const int end = std::min(int(scene.offsets[tile + 1] - scene.offsets[tile]), begin + kChunkLength);
    std::vector<ListedTerms<F>> listed;
    for (int k = begin; k < end; ++k) {
      const auto& [id, row] = scene.pairs[scene.offsets[tile] + k];
      const Splat<F, float>& splat = scene.splats[id];
      const Vec2<float> origin = {float(x0) - splat.mean.x, float(y0) - splat.mean.y};
      const auto shape = exactly<F>(splat.shape);
      listed.push_back({F::terms(shape, Rounded(splat.opacity), Vec2<Rounded>{origin.x, origin.y}),
                        F::terms(splat.shape, splat.opacity, origin), F::mean_map(shape), id, row});
    }
    const auto for_each_pixel = [&](auto&& visit) {
      for (int y = 0; y < kSide && y0 + y < kHeight; ++y) {
        for (int x = 0; x < kSide && x0 + x < kWidth; ++x) visit(x, y, (y0 + y) * kWidth + x0 + x);
      }
    };
    int tile_last = 0;
    for_each_pixel([&](int, int, int i) {
      for (int s = 0; s < kAll; ++s) tile_last = std::max(tile_last, scene.last[s * kPixels + i]);
    });
    const bool final = tile_last <= end;  // nothing of a later chunk was composited
    for_each_pixel([&](int x, int y, int i) {
      const Rounded scale = 1.0 / kAll;
      Rounded g[C], transmittance[kAll], behind[kAll];
      for (int c = 0; c < C; ++c) g[c] = scale * scene.dL_dimage[c * kPixels + i];
      for (int s = 0; s < kAll; ++s) {
        const int sample = sample_number<F>(s) * kTilePixels + lane_of_sample<F>(x, y, s);
        const float* checkpoint = &scene.checkpoints[size_t(plane) * kTilePixels + sample * (C + 1)];
        const Rounded at_end = scene.transmittance[s * kPixels + i];
        const float* colors = final ? scene.background.data() : checkpoint;
        transmittance[s] = final ? at_end : Rounded(checkpoint[C]);
        behind[s] = g[0] * colors[0];
        for (int c = 1; c < C; ++c) behind[s] = behind[s] + g[c] * colors[c];
        if (!final) behind[s] = behind[s] / transmittance[s];
        behind[s] = behind[s] - scale * scene.dL_dalpha[i] * (final ? Rounded(1) : at_end / transmittance[s]);
      }
      for (int k = std::min(end, tile_last) - 1; k >= begin; --k) {
        const ListedTerms<F>& listed_splat = listed[k - begin];
        const auto& terms = listed_splat.terms;
        Sum* const sums = &out[size_t(listed_splat.row) * kPairGradWidth];
        const auto color = [&](int c) { return Rounded(scene.channel(listed_splat.splat, c)); };
        Rounded g_color = madd(g[0], color(0), madd(g[1], color(1), g[2] * color(2)));
        if (C == 4) g_color = madd(g[C - 1], color(C - 1), g_color);
        ShapeGrad<Rounded> of_pixel = {};
        bool shown = false;
        for (int s = 0; s < kAll; ++s) {
          const int number = sample_number<F>(s);
          const Vec2<float> position = position_in_tile<F>(x, y, s);
          const float in_float = F::alpha(listed_splat.in_float, position, number);
          if (in_float < float(kAlphaMin) || k >= scene.last[s * kPixels + i]) continue;
          shown = true;
          const Vec2<Rounded> at = {double(position.x), double(position.y)};
          const Rounded raw = F::alpha(terms, at, number);
          const auto grad = blend_sample_vjp<Rounded>({true}, raw, g_color, transmittance[s], behind[s]);
          ShapeGrad<Rounded> of_sample = {};
          F::add_alpha_vjp(terms, at, number, grad.of_alpha, of_sample);
          F::add_alpha_vjp(terms, at, number, grad.of_alpha, of_pixel);
          const Rounded values[] = {of_sample.offset.x, of_sample.offset.y, of_sample.shape.xx,
                                    of_sample.shape.xy, of_sample.shape.yy, grad.of_alpha.weighted};
          const auto summed = [&](Rounded term) { return term.summed(kInLane).summed(kAcross); };
          for (int v = 0; v < kPairChannels; ++v) sums[v].add(summed(values[v]));
          for (int c = 0; c < C; ++c)
            sums[c == 3 ? kPairFourthChannel : kPairChannels + c].add(summed(grad.contribution * g[c]));
        }
        if (!shown || scene.params.mean_sums == MeanSums::kNone) continue;
        const Vec2<Rounded> means = mean_sums_of(scene.params.mean_sums, image_size,
                                                 transform_transposed(listed_splat.mean_map, of_pixel.offset));
        sums[kPairMeans].add(means.x.summed(kSubtiles + kAcross));
        sums[kPairMeans + 1].add(means.y.summed(kSubtiles + kAcross));
      }
    });
  }
  return out;
}

template <class F, int C> void expect_sums_of_pixels(MeanSums mean_sums) {
  SCOPED_TRACE(testing::Message() << "MeanSums " << int(mean_sums));
  const bool with_means = mean_sums != MeanSums::kNone;
  Scene<F, C> scene(mean_sums, false);
  std::vector<float> sums(size_t(scene.rows) * kPairGradWidth, NAN);
  const int end = int(scene.chunks.size());
  if (with_means) {
    scene.template run<true>(2, 0, end, sums);
  } else {
    scene.template run<false>(2, 0, end, sums);
  }
  const std::vector<Sum> expected = expected_sums(scene);
  int compared = 0;
  for (size_t i = 0; i < sums.size(); ++i) {
    const int column = int(i % kPairGradWidth);
    if (column >= kPairMeans && (column == kPairFourthChannel ? C < 4 : !with_means)) continue;
    // Which is 0 where no pixel shows the splat.
    ASSERT_LE(std::abs(sums[i] - expected[i].value), expected[i].error)
        << "column " << column << " of row " << i / kPairGradWidth << ": " << sums[i];
    compared += expected[i].error > 0;
  }
  // Few of a list reach a small tile.
  ASSERT_GT(compared, int(sums.size()) / (F::kLanes > 1 ? 25 : 10));
}

template <class F, int C> struct Kernel {
  using Pixels = F;
  static constexpr int kChannels = C;
};
template <class K> class BlendVjpSums : public testing::Test {};
/// What a lane has in registers (still/vjp_pixels.cuh) differs among them, and what it sums.
using Kernels =
    testing::Types<Kernel<GaussianPixels<1>, 3>, Kernel<GaussianPixels<1>, 4>, Kernel<GaussianPixels<4>, 3>,
                   Kernel<GaussianPixels<4>, 4>, Kernel<GaussianSample<4>, 3>, Kernel<GaussianSample<4>, 4>,
                   Kernel<GaussianSample<16>, 3>, Kernel<Cumulant, 3>, Kernel<Cumulant, 4>,
                   Kernel<Analytic<FrameGradient::kFrozen>, 3>, Kernel<Analytic<FrameGradient::kFrozen>, 4>>;
TYPED_TEST_SUITE(BlendVjpSums, Kernels);

TYPED_TEST(BlendVjpSums, AreThoseOfThePixels) {
  using F = typename TypeParam::Pixels;
  for (const MeanSums mean_sums : {MeanSums::kNone, MeanSums::kAbsolute, MeanSums::kNorm})
    expect_sums_of_pixels<F, TypeParam::kChannels>(mean_sums);
}

template <class F, int C> void expect_positions_of_blend() {
  for (int lane = 0; lane < 32; ++lane) {
    uint32_t visited = 0;
    visit_subtiles<F, C>(0xff, position_of<F>(0, lane), [&](int b, Vec2<float> p) {
      const Vec2<float> expected = position_of<F>(b, lane);
      EXPECT_EQ(p.x, expected.x) << b << " " << lane;
      EXPECT_EQ(p.y, expected.y) << b << " " << lane;
      visited |= 1u << b;
    });
    EXPECT_EQ(visited, 0xff);
  }
}
TEST(BlendVjpPositions, AreThoseOfBlendToTheBit) {
  expect_positions_of_blend<GaussianPixels<1>, 3>();
  expect_positions_of_blend<GaussianSample<4>, 3>();
  expect_positions_of_blend<GaussianSample<4>, 4>();
  expect_positions_of_blend<GaussianSample<16>, 3>();
  expect_positions_of_blend<GaussianSample<16>, 4>();
  // In one loop over the subtiles, where they have no code of their own.
  static_assert(!kUnrollsSubtiles<GaussianPixels<4>, 4> && !kUnrollsSubtiles<Cumulant, 4>);
  expect_positions_of_blend<GaussianPixels<4>, 4>();
  expect_positions_of_blend<Cumulant, 4>();
}

template <class F> class BlendVjpKernel : public testing::Test {};
using Gaussians = testing::Types<GaussianPixels<1>, GaussianPixels<4>, GaussianSample<16>>;
TYPED_TEST_SUITE(BlendVjpKernel, Gaussians);

TYPED_TEST(BlendVjpKernel, FewWarpsLeaveWhatAWarpForEachChunkLeaves) {
  for (const bool overflow : {false, true}) {
    expect_the_same_from_few_warps<TypeParam, false>(overflow);
    expect_the_same_from_few_warps<TypeParam, true>(overflow);
  }
}

}  // namespace
}  // namespace ar::cuda
