// The kernels for groups of channels, run on the host: they give what compositing pixel by pixel in float64 gives, in
// either direction, and the same in groups of 8 and of 32, for lists of tiles and for a list of all splats. Sums over
// the pairs of a splat.
#include "cuda_on_host.h"
// After it: kernels.
#include <gtest/gtest.h>

#include "cuda/channels/groups_vjp.cuh"
#include "cuda/project/project_vjp.cuh"
#include "random_splats.h"

namespace ar::cuda {

namespace {

constexpr int kWidth = 20, kHeight = 10, kPixels = kWidth * kHeight;

template <class F> struct Scene : ListedScene<F> {
  static constexpr TileGrid kGrid = grid_for<F>(kWidth, kHeight);

  /// `largest`: logarithm of the largest variance.
  Scene(int count, int channels, float most_opaque, float largest = 2) {
    std::mt19937 bits(7);
    this->splats = random_splats<F>(bits, count, kGrid, -1, largest, most_opaque, [](const Cov2d<float>& cov) {
      return GaussianFootprint<kPixelSamples<F>, true>::prepare_with(cov, 1 / 12.0f);
    });
    this->complete(bits, channels, kGrid);
  }
};

/// What a pass gives. Sums are those of splats: over their pairs.
struct Results {
  std::vector<float> image, alpha, transmittance;
  std::vector<int32_t> last;
  std::vector<std::vector<float>> shapes, channels;  ///< PairGrad and MeanSums, and channels, of every splat
};

struct Way {
  int width = kSmallGroup;  ///< of a group of no more than kSmallGroup channels
  MeanSums mean_sums = MeanSums::kNone;
  bool overflow = false;  ///< there is no room for a list of each tile
};

template <class F> struct Run {
  static constexpr TileGrid kGrid = Scene<F>::kGrid;

  const Scene<F>& scene;
  const Way way;
  const int tiles = int(kGrid.tiles()), count = int(scene.splats.size());
  Results out;
  BlendParams blend = {};
  BlendVjpParams vjp = {};
  PlanState state = {};
  std::vector<SlotPair> pairs = scene.pairs;
  std::vector<int64_t> offsets = scene.offsets;
  Counts counts = scene.counts;
  std::vector<int32_t> order;
  std::vector<TileChunk> chunks;
  std::vector<float> pair_grads, channel_sums;

  Run(const Scene<F>& scene, Way way) : scene(scene), way(way) {
    out.image.resize(scene.channels * kPixels);
    out.alpha.resize(kPixels);
    out.transmittance.resize(kPixelSamples<F> * kPixels);
    out.last.resize(kPixelSamples<F> * kPixels);
    out.shapes.assign(count, std::vector<float>(kShapeSums));
    out.channels.assign(count, std::vector<float>(scene.channels));
    for (int tile = 0; tile < tiles; ++tile) order.push_back(tile), chunks.push_back({tile, 0, 0});
    state.counts.chunks = tiles;
    blend.grid = vjp.grid = kGrid;
    blend.splats = vjp.splats = &scene.splats[0].mean.x;
    blend.channels = vjp.channels = {scene.rows.data(), scene.channels, nullptr, scene.channels};
    blend.background = vjp.background = scene.background.data();
    blend.image = {out.image.data(), scene.channels, {}};
    blend.alpha = out.alpha.data();
    blend.transmittance = out.transmittance.data();
    blend.last = out.last.data();
    if (way.overflow) share_lists(pairs, offsets, counts, kGrid);
    blend.lists = vjp.lists = lists_of(pairs, offsets, counts);
    blend.plan.tile_order = order.data();
    vjp.transmittance = blend.transmittance;
    vjp.last = blend.last;
    vjp.dL_dimage = {scene.dL_dimage.data(), scene.channels, {}};
    vjp.dL_dalpha = scene.dL_dalpha.data();
    vjp.plan = &state;
    vjp.chunk_order = chunks.data();
    vjp.mean_sums = way.mean_sums;
    forward();
    backward();
  }

  int width_of(int first) const {
    const int left = scene.channels - first;
    return left <= kSmallGroup && first == 0 ? way.width : group_width<F>(left);
  }
  /// Calls f(std::integral_constant<int, width>, first channel) for every group.
  template <class Function> void for_each_group(Function&& f) {
    for (int first = 0; first < scene.channels; first += width_of(first)) {
      if (width_of(first) == kSmallGroup) {
        f(std::integral_constant<int, kSmallGroup>(), first);
      } else {
        f(std::integral_constant<int, kChannelGroup>(), first);
      }
    }
  }

  void forward() {
    for_each_group([&](auto width, int first) {
      cuda_on_host::launch(tiles, kBlendThreads, [&] { blend_groups_kernel<F, width()>(blend, first); });
    });
  }

  template <int C, bool kWithShape> void backward(int first) {
    static_assert(sizeof(GroupVjpShared<F, C>) <= sizeof dynamic_memory);
    cuda_on_host::launch(tiles, kBlendThreads, [&] { blend_groups_vjp_kernel<F, C, kWithShape>(vjp, first); });
  }

  void backward() {
    const size_t rows = way.overflow ? count : scene.pairs.size();
    // With a row for each splat all tiles add to it; otherwise every row must be written.
    const float start = way.overflow ? 0 : NAN;
    pair_grads.assign(rows * kPairGradWidth, start);
    channel_sums.assign(rows * width_of(0), start);  // for the widest group, and for all of them
    vjp.channel_sums = channel_sums.data();
    vjp.pair_grads = pair_grads.data();
    for_each_group([&](auto width, int first) {
      if (way.overflow) channel_sums.assign(rows * width(), 0);
      if (way.mean_sums == MeanSums::kNone || first == 0) {
        backward<width(), true>(first);
      } else {
        backward<width(), false>(first);
      }
      for (size_t row = 0; row < rows; ++row) {
        const int c_end = std::min(scene.channels - first, int(width()));
        for (int c = 0; c < c_end; ++c) out.channels[row % count][first + c] += channel_sums[row * width() + c];
      }
    });
    const int widths = way.mean_sums == MeanSums::kNone ? kPairChannels : kShapeSums;
    for (size_t row = 0; row < rows; ++row) {
      for (int v = 0; v < widths; ++v) {
        const int column = v < kPairChannels ? v : kPairMeans + v - kPairChannels;
        out.shapes[row % count][v] += pair_grads[row * kPairGradWidth + column];
      }
    }
  }
};

/// Pixel by pixel, in float64, from the same lists of splats that reach a subtile.
template <class F> Results reference(const Scene<F>& scene, MeanSums mean_sums) {
  constexpr int S = kPixelSamples<F>;
  const int count = int(scene.splats.size());
  Results out;
  out.image.resize(scene.channels * kPixels);
  out.alpha.resize(kPixels);
  std::vector<std::vector<double>> shapes(count, std::vector<double>(kShapeSums));
  std::vector<std::vector<double>> channels(count, std::vector<double>(scene.channels));
  for (int i = 0; i < kPixels; ++i) {
    const Vec2<double> p = {double(i % kWidth), double(i / kWidth)};
    const auto shape_of = [&](int k) {
      const auto& w = scene.splats[k].shape.w;
      return GaussianShape<double>{{w.xx, w.yx, w.yy}, scene.splats[k].shape.amp, scene.splats[k].shape.x_given_y};
    };
    const auto terms_of = [&](int k) {
      const Splat<F, float>& splat = scene.splats[k];
      return F::terms(shape_of(k), double(splat.opacity), {-double(splat.mean.x), -double(splat.mean.y)});
    };
    double transmittance[S], through = 0, g_background = -scene.dL_dalpha[i] / double(S);
    std::vector<double> image(scene.channels);
    std::vector<std::array<bool, S>> hits(count);
    for (int s = 0; s < S; ++s) transmittance[s] = 1;
    for (int k = 0; k < count; ++k) {
      const auto terms = terms_of(k);
      for (int s = 0; s < S; ++s) {
        const Blended<double> b =
            blend_sample(F::alpha(terms, sample_position<F>(p, s), sample_number<F>(s)), transmittance[s]);
        hits[k][s] = b.mask;
        for (int c = 0; c < scene.channels; ++c) image[c] += b.contribution * scene.rows[k * scene.channels + c] / S;
      }
    }
    for (int s = 0; s < S; ++s) through += std::abs(transmittance[s]) / S;
    for (int c = 0; c < scene.channels; ++c) {
      out.image[c * kPixels + i] = float(image[c] + through * scene.background[c]);
      g_background += scene.dL_dimage[c * kPixels + i] / double(S) * scene.background[c];
    }
    out.alpha[i] = float(1 - through);
    double behind[S];
    for (int s = 0; s < S; ++s) transmittance[s] = std::abs(transmittance[s]), behind[s] = g_background;
    for (int k = count - 1; k >= 0; --k) {
      const auto terms = terms_of(k);
      double g_color = 0, contribution = 0, weighted = 0;
      for (int c = 0; c < scene.channels; ++c)
        g_color += scene.dL_dimage[c * kPixels + i] / double(S) * scene.rows[k * scene.channels + c];
      ShapeGrad<double> sums = {{0, 0}, {0, 0, 0}};
      for (int s = 0; s < S; ++s) {
        const double alpha = F::alpha(terms, sample_position<F>(p, s), sample_number<F>(s));
        const BlendGrad<double> grad = blend_sample_vjp(bool(hits[k][s]), alpha, g_color, transmittance[s], behind[s]);
        F::add_alpha_vjp(terms, sample_position<F>(p, s), sample_number<F>(s), grad.of_alpha, sums);
        contribution += grad.contribution;
        weighted += grad.of_alpha.weighted;
      }
      for (int c = 0; c < scene.channels; ++c) channels[k][c] += contribution * scene.dL_dimage[c * kPixels + i] / S;
      Vec2<double> means = {0, 0};
      if (mean_sums != MeanSums::kNone) {
        const Vec2<double> size = {kWidth, kHeight};
        means = mean_sums_of(mean_sums, size, transform_transposed(F::mean_map(shape_of(k)), sums.offset));
      }
      const double values[] = {sums.offset.x, sums.offset.y, sums.shape.xx, sums.shape.xy,
                               sums.shape.yy, weighted,      means.x,       means.y};
      for (int v = 0; v < kShapeSums; ++v) shapes[k][v] += values[v];
    }
  }
  for (int k = 0; k < count; ++k) {
    out.shapes.emplace_back(shapes[k].begin(), shapes[k].end());
    out.channels.emplace_back(channels[k].begin(), channels[k].end());
  }
  return out;
}

/// Sums of hundreds of terms of order 1, in other orders.
constexpr float kRounding = 500 * 1.2e-7f;

void expect_near(const std::vector<float>& a, const std::vector<float>& b, const char* what) {
  ASSERT_EQ(a.size(), b.size());
  for (size_t i = 0; i < a.size(); ++i) ASSERT_NEAR(a[i], b[i], kRounding * (1 + std::abs(b[i]))) << what << " " << i;
}
void expect_near(const Results& a, const Results& b) {
  expect_near(a.image, b.image, "image");
  expect_near(a.alpha, b.alpha, "alpha");
  for (size_t k = 0; k < a.shapes.size(); ++k) {
    expect_near(a.shapes[k], b.shapes[k], "shape");
    expect_near(a.channels[k], b.channels[k], "channels");
  }
}

template <class F> class GroupKernels : public testing::Test {};
using Gaussians = testing::Types<GaussianPixels<1>, GaussianPixels<4>, GaussianSample<4>, GaussianSample<16>>;
TYPED_TEST_SUITE(GroupKernels, Gaussians);

TYPED_TEST(GroupKernels, GiveWhatCompositingPixelByPixelGives) {
  using F = TypeParam;
  const std::pair<int, MeanSums> cases[] = {{5, MeanSums::kAbsolute}, {72, MeanSums::kNorm}, {100, MeanSums::kNone}};
  for (const auto& [channels, mean_sums] : cases) {
    SCOPED_TRACE(testing::Message() << channels << " channels, MeanSums " << int(mean_sums));
    const Scene<F> scene(25, channels, 0.95f);
    Way way;
    way.mean_sums = mean_sums;
    expect_near(Run<F>(scene, way).out, reference(scene, mean_sums));
  }
}

TYPED_TEST(GroupKernels, GiveTheSameBitsOfImagesInGroupsOf8AndOf32) {
  using F = TypeParam;
  const Scene<F> scene(20, 8, 0.95f);
  Way wide;
  wide.width = kChannelGroup;
  const Results of_8 = Run<F>(scene, {}).out, of_32 = Run<F>(scene, wide).out;
  EXPECT_EQ(of_8.image, of_32.image);
  EXPECT_EQ(of_8.alpha, of_32.alpha);
  EXPECT_EQ(of_8.last, of_32.last);
  expect_near(of_8, of_32);
}

TYPED_TEST(GroupKernels, GiveWhatCompositingGivesInSeveralBatches) {
  using F = TypeParam;
  const Scene<F> scene(262, F::kSamples > 1 ? 40 : 72, 0.05f, -0.8f);
  ASSERT_GT(scene.splats.size(), 2 * ChannelsPolicy::kBatch);
  Way way;
  if (F::kSamples > 1) way.mean_sums = MeanSums::kNorm;
  const Results results = Run<F>(scene, way).out;
  EXPECT_GT(*std::max_element(results.last.begin(), results.last.end()), 2 * ChannelsPolicy::kBatch);
  expect_near(results, reference(scene, way.mean_sums));
}

TYPED_TEST(GroupKernels, GiveTheSameWithARowForEverySplat) {
  using F = TypeParam;
  const Scene<F> scene(12, 72, 0.3f);
  Way overflow;
  overflow.overflow = true;
  expect_near(Run<F>(scene, overflow).out, Run<F>(scene, {}).out);
}

/// Whole numbers, whose sums are exact in any order. `stride`: channels of the tensor, of which the group has up to C.
template <int C> void sum_channels_of(const std::vector<int>& pairs_of_splats, int first, int stride, bool by_splat) {
  SCOPED_TRACE(testing::Message() << C << " channels from " << first << " of " << stride << ", by splat " << by_splat);
  const int64_t n = int64_t(pairs_of_splats.size());
  const int count = std::min(C, stride - first);
  std::vector<PairRange> ranges;
  int32_t pairs = 0;
  for (const int of_splat : pairs_of_splats) ranges.push_back({pairs, of_splat}), pairs += of_splat;
  const Counts counts = {pairs, 0};
  std::vector<float> rows(std::max<int64_t>(pairs, n) * C), out(n * stride, NAN), expected = out;
  for (size_t i = 0; i < rows.size(); ++i) rows[i] = float(int(i * 7919 % 101) - 50);
  for (int64_t i = 0; i < n; ++i) {
    const bool none = pairs_of_splats[i] == 0;
    const int64_t begin = by_splat ? i : ranges[i].first, end = none       ? begin
                                                                : by_splat ? i + 1
                                                                           : begin + ranges[i].count;
    for (int c = 0; c < count; ++c) {
      float& sum = expected[i * stride + first + c] = 0;
      for (int64_t row = begin; row < end; ++row) sum += rows[row * C + c];
    }
  }
  SumChannelsParams params = {};
  params.sums = {n, ranges.data(), &counts, pairs - by_splat, nullptr};
  params.channel_sums = rows.data();
  params.width = C, params.first = first, params.count = count;
  params.dL_dchannels = out.data();
  params.stride = stride;
  const int of_block = ProjectPolicy::kSumThreads / ProjectPolicy::kSumLanes;
  cuda_on_host::launch((int(n) + of_block - 1) / of_block, ProjectPolicy::kSumThreads,
                       [&] { sum_channels_kernel<C>(params); });
  for (size_t i = 0; i < out.size(); ++i) {
    if (std::isnan(expected[i])) {
      EXPECT_TRUE(std::isnan(out[i])) << i;
    } else {
      EXPECT_EQ(out[i], expected[i]) << i;
    }
  }
}

TEST(SumChannels, AddsThePairsOfEverySplat) {
  std::vector<int> pairs;
  for (int i = 0; i < 40; ++i) pairs.push_back(i * i % 23);
  pairs.insert(pairs.begin() + 3, {64, 65, 256, 257, 3000});
  pairs.push_back(1000);
  for (const bool by_splat : {false, true}) {
    sum_channels_of<8>(pairs, 0, 8, by_splat);
    sum_channels_of<8>(pairs, 32, 37, by_splat);
    sum_channels_of<32>(pairs, 0, 40, by_splat);
    sum_channels_of<32>(pairs, 32, 46, by_splat);
  }
}

}  // namespace
}  // namespace ar::cuda
