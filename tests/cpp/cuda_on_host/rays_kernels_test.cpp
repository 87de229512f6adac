// The kernels for the order along rays, run on the host: they give what a window per pixel gives that is written down
// plainly, in either direction, and the same bits with a log of any length.
#include "cuda_on_host.h"
// After it: kernels.
#include <gtest/gtest.h>

#include <limits>

#include "cuda/dispatch.h"
#include "cuda/rays/blend.cuh"
#include "cuda/rays/vjp.cuh"
#include "random_splats.h"

namespace ar::cuda {

namespace {

constexpr int kWidth = 21, kHeight = 13, kPixels = kWidth * kHeight;

template <class F> struct Scene : ListedScene<F> {
  static constexpr TileGrid kGrid = {kWidth, kHeight, kRayTileBits};
  std::vector<RayDepth<float>> depths;

  Scene(int count, int channels, float most_opaque) {
    std::mt19937 bits(7);
    this->splats = random_splats<F>(bits, count, kGrid, -1, 3, most_opaque, [](const Cov2d<float>& cov) {
      if constexpr (std::is_same_v<F, Analytic<FrameGradient::kFrozen>> || F::kMoves) {
        return F::prepare(cov, FootprintOptions{0});
      } else {
        return GaussianFootprint<F::kSamples, true>::prepare_with(cov, 1 / 12.0f);
      }
    });
    // Some depths are equal.
    for (int k = 0; k < count; ++k)
      depths.push_back(k % 5 == 1 ? depths.back()
                                  : RayDepth<float>{0.05f * float(k) + uniform(bits, 0, 1),
                                                    {uniform(bits, -0.1f, 0.1f), uniform(bits, -0.1f, 0.1f)}});
    this->complete(bits, channels, kGrid);
  }
  const float* row(int splat) const {
    return this->channels == 3 ? &this->splats[splat].color.x : this->rows.data() + splat * this->channels;
  }
};

/// Sums are those of splats: over their pairs.
struct Results {
  std::vector<float> image, alpha, transmittance;
  std::vector<std::vector<float>> sums;  ///< PairGrad, three channels, MeanSums, the fourth channel
};

struct Way {
  int window = 24;
  int log_rows = 1024;
  bool overflow = false;  ///< there is no room for a list of each tile
};

template <class F, int C> Results run(const Scene<F>& scene, Way way) {
  constexpr TileGrid kGrid = Scene<F>::kGrid;
  constexpr int kBlocks = 2;
  const int tiles = int(kGrid.tiles()), count = int(scene.splats.size());
  Results out;
  out.image.resize(scene.channels * kPixels);
  out.alpha.resize(kPixels);
  out.transmittance.resize(F::kSamples * kPixels);
  std::vector<int32_t> last(F::kSamples * kPixels), order;
  std::vector<SlotPair> pairs = scene.pairs;
  std::vector<int64_t> offsets = scene.offsets;
  Counts counts = scene.counts;
  if (way.overflow) share_lists(pairs, offsets, counts, kGrid);
  PlanState state = {};
  std::vector<TileChunk> chunks;
  for (int tile = 0; tile < tiles; ++tile) order.push_back(tile), chunks.push_back({tile, 0, 0});
  state.counts.chunks = tiles;

  BlendParams blend = {};
  blend.grid = kGrid;
  blend.splats = &scene.splats[0].mean.x;
  if (C != 3) blend.channels.data = scene.rows.data(), blend.channels.stride = scene.channels;
  blend.channels.count = scene.channels;
  blend.background = scene.background.data();
  blend.image = {out.image.data(), scene.channels, {}};
  blend.alpha = out.alpha.data();
  blend.transmittance = out.transmittance.data();
  blend.last = last.data();
  blend.lists = lists_of(pairs, offsets, counts);
  blend.plan.tile_order = order.data();
  blend.order = {scene.depths.data(), way.window};
  EXPECT_LE(int64_t(sizeof(RayStage<F>)) + RayWindow::bytes(way.window), int64_t(sizeof dynamic_memory));
  cuda_on_host::launch(tiles * kRayHalves, 32, [&] { blend_rays_kernel<F, C>(blend); });

  BlendVjpParams vjp = {};
  vjp.grid = kGrid;
  vjp.splats = blend.splats;
  vjp.channels = blend.channels;
  vjp.background = blend.background;
  vjp.lists = blend.lists;
  vjp.dL_dimage = {scene.dL_dimage.data(), scene.channels, {}};
  vjp.dL_dalpha = scene.dL_dalpha.data();
  vjp.plan = &state;
  vjp.chunk_order = chunks.data();
  int32_t chunks_taken = 0;
  vjp.chunks_taken = &chunks_taken;
  vjp.mean_sums = MeanSums::kAbsolute;
  vjp.order = blend.order;
  std::vector<uint32_t> words(size_t(kBlocks * way.log_rows * 32 * kLogWords<F>), 0x7fc00000);
  vjp.ray_log = {words.data(), kBlocks, way.log_rows};
  const size_t rows = way.overflow ? count : pairs.size();
  std::vector<float> pair_grads(rows * kPairGradWidth, way.overflow ? 0 : NAN);
  vjp.pair_grads = pair_grads.data();
  cuda_on_host::launch(kBlocks, 32, [&] { blend_rays_vjp_kernel<F, C>(vjp); });
  out.sums.assign(count, std::vector<float>(kPairGradWidth));
  for (size_t row = 0; row < rows; ++row) {
    for (int k = 0; k < kPairGradWidth; ++k) out.sums[row % count][k] += pair_grads[row * kPairGradWidth + k];
  }
  return out;
}

/// Pixel by pixel, by exchange_nearest() of core/order.h.
template <class F> Results reference(const Scene<F>& scene, int window) {
  constexpr int S = F::kSamples;
  constexpr int side = 1 << kRayTileBits;
  const int count = int(scene.splats.size()), channels = scene.channels;
  Results out;
  out.image.assign(channels * kPixels, 0);
  out.alpha.assign(kPixels, 0);
  out.transmittance.assign(S * kPixels, 0);
  out.sums.assign(count, std::vector<float>(kPairGradWidth));
  struct Event {
    int splat;
    float raw[S];
    Vec2<float> before[S];
  };
  for (int i = 0; i < kPixels; ++i) {
    const int x = i % kWidth, y = i / kWidth;
    const Vec2<float> p = {float(x % side), float(y % side)};
    const auto terms_of = [&](int k) {
      const Splat<F, float>& splat = scene.splats[k];
      return F::terms(splat.shape, splat.opacity,
                      {float(x / side * side) - splat.mean.x, float(y / side * side) - splat.mean.y});
    };
    float transmittance[S], color[kMaxRayChannels] = {};
    Vec2<float> places[S] = {};
    for (int s = 0; s < S; ++s) {
      transmittance[s] = 1;
      if constexpr (F::kMoves) places[s] = F::template node<float>(s);
    }
    std::vector<Event> events;
    const auto composite = [&](int k) {
      const auto terms = terms_of(k);
      Event event = {k, {}, {}};
      bool any = false;
      for (int s = 0; s < S; ++s) {
        event.before[s] = places[s];
        Blended<float> b;
        float raw;
        if constexpr (F::kMoves) {
          const Vec2<float> z = F::whitened_node(terms, F::whitened(terms, p, 0), places[s]);
          raw = exp2(F::log_alpha(terms, z));
          b = blend_placed_sample<F>(terms, z, raw, F::template cell<float>(s), transmittance[s], places[s]);
        } else {
          raw = F::alpha(terms, p, s);
          b = blend_sample(raw, transmittance[s]);
        }
        if (b.mask) event.raw[s] = raw, any = true;
        for (int c = 0; c < channels; ++c) color[c] += b.contribution * scene.row(k)[c];
      }
      if (any) events.push_back(event);
    };
    using Entry = WindowEntry<float, 0>;
    const float none = -std::numeric_limits<float>::infinity();
    std::vector<Entry> slots(window, Entry::nothing(none));
    for (int k = 0; k < count + window; ++k) {
      Entry nearest;
      if (k < count) {
        const Splat<F, float>& splat = scene.splats[k];
        const Vec2<float> d = {float(x) - splat.mean.x, float(y) - splat.mean.y};
        bool shows = false;
        if constexpr (F::kMoves) {
          shows = PixelReach<F, float>::of(splat).reaches(d);
        } else {
          for (int s = 0; s < S; ++s) shows |= F::alpha(terms_of(k), p, s) >= float(kAlphaMin);
        }
        if (!shows) continue;
        Entry next;
        next.depth = depth_in_pixel(scene.depths[k], d);
        next.place = k;
        nearest = exchange_nearest(slots.data(), window, next);
      } else {
        nearest = slots[k - count];
      }
      if (nearest.place >= 0) composite(nearest.place);
    }
    float through = 0, behind[S], g_background = 0;
    for (int s = 0; s < S; ++s) {
      transmittance[s] = abs(transmittance[s]);
      out.transmittance[s * kPixels + i] = transmittance[s];
      through += transmittance[s] / S;
    }
    float g[kMaxRayChannels] = {};
    for (int c = 0; c < channels; ++c) {
      out.image[c * kPixels + i] = color[c] / S + through * scene.background[c];
      g[c] = scene.dL_dimage[c * kPixels + i] / S;
      g_background += g[c] * scene.background[c];
    }
    out.alpha[i] = 1 - through;
    Vec2<float> dL_dplace[S] = {};
    for (int s = 0; s < S; ++s) behind[s] = g_background - scene.dL_dalpha[i] / S;
    for (size_t e = events.size(); e-- > 0;) {
      const Event& event = events[e];
      const auto terms = terms_of(event.splat);
      float g_color = 0, contribution = 0, weighted = 0;
      ShapeGrad<float> shape = {{0, 0}, {0, 0, 0}};
      for (int c = 0; c < channels; ++c) g_color += g[c] * scene.row(event.splat)[c];
      for (int s = 0; s < S; ++s) {
        const float raw = event.raw[s];
        if constexpr (F::kMoves) {
          MovingBlendGrad<float> grad = no_moving_blend_grad<float>();
          const Vec2<float> z = F::whitened_node(terms, F::whitened(terms, p, 0), event.before[s]);
          add_placed_sample_vjp<F>(terms, z, raw, F::template cell<float>(s), g_color, event.before[s],
                                   transmittance[s], behind[s], dL_dplace[s], grad);
          shape = shape + grad.of_splat.sums;
          weighted += grad.of_splat.weighted;
          contribution += grad.contribution;
        } else {
          const BlendGrad<float> grad = blend_sample_vjp(raw > 0, raw, g_color, transmittance[s], behind[s]);
          F::add_alpha_vjp(terms, p, s, grad.of_alpha, shape);
          weighted += grad.of_alpha.weighted;
          contribution += grad.contribution;
        }
      }
      const Vec2<float> mean =
          mean_sums_of(MeanSums::kAbsolute, Vec2<float>{kWidth, kHeight},
                       transform_transposed(F::mean_map(scene.splats[event.splat].shape), shape.offset));
      const float numbers[kPairGradWidth] = {
          shape.offset.x, shape.offset.y,      shape.shape.xx,      shape.shape.xy,      shape.shape.yy,
          weighted,       contribution * g[0], contribution * g[1], contribution * g[2], mean.x,
          mean.y,         contribution * g[3]};
      for (int k = 0; k < kPairGradWidth; ++k) out.sums[event.splat][k] += numbers[k];
    }
  }
  return out;
}

/// Sums of some hundred terms in different orders.
constexpr float kRounding = 300 * 1.2e-7f;

void expect_near(const Results& a, const Results& b) {
  EXPECT_EQ(a.transmittance, b.transmittance);
  for (size_t i = 0; i < a.image.size(); ++i) ASSERT_NEAR(a.image[i], b.image[i], kRounding) << i;
  for (size_t i = 0; i < a.alpha.size(); ++i) ASSERT_NEAR(a.alpha[i], b.alpha[i], kRounding) << i;
  float largest = 0;
  for (const auto& sums : b.sums) {
    for (const float x : sums) largest = std::max(largest, std::abs(x));
  }
  EXPECT_GT(largest, 0.1f);
  for (size_t k = 0; k < a.sums.size(); ++k) {
    for (int v = 0; v < kPairGradWidth; ++v)
      ASSERT_NEAR(a.sums[k][v], b.sums[k][v], kRounding * largest) << k << ' ' << v;
  }
}
void expect_equal(const Results& a, const Results& b) {
  EXPECT_EQ(a.image, b.image);
  EXPECT_EQ(a.sums, b.sums);
}

template <class F> class RaysKernels : public testing::Test {};
using AlongRays =
    testing::Types<GaussianPixels<1>, GaussianPixels<4>, Analytic<FrameGradient::kFrozen>, Moment<1>, Moment<4>>;
TYPED_TEST_SUITE(RaysKernels, AlongRays);

TYPED_TEST(RaysKernels, AreWindowsOfPixels) {
  using F = TypeParam;
  const Scene<F> scene(150, 3, 0.5f), rows(150, 4, 0.95f), one(70, 1, 0.95f);
  for (const int window : {1, 3, 24, 64}) {
    SCOPED_TRACE(window);
    expect_near(run<F, 3>(scene, {window}), reference(scene, window));
  }
  expect_near(run<F, 4>(rows, {24}), reference(rows, 24));
  expect_near(run<F, 4>(one, {24}), reference(one, 24));
}

TYPED_TEST(RaysKernels, LogAnyNumberOfRowsAtOnce) {
  using F = TypeParam;
  const Scene<F> scene(150, 3, 0.3f);
  const Results whole = run<F, 3>(scene, {24, 1024});
  for (const int rows : {1, 8, 64}) expect_equal(run<F, 3>(scene, {24, rows}), whole);
}

TYPED_TEST(RaysKernels, ShareLists) {
  using F = TypeParam;
  const Scene<F> scene(70, 3, 0.5f);
  expect_near(run<F, 3>(scene, {24, 16, true}), run<F, 3>(scene, {24}));
}

/// Windows depend on no tiles: where a splat enters one, lists of every pixel alone would have it. It enters wherever a
/// node can see it.
TYPED_TEST(RaysKernels, HaveWhatPixelsList) {
  using F = TypeParam;
  if constexpr (F::kMoves) {
    constexpr TileGrid kOfPixels = {kWidth, kHeight, 0};
    std::mt19937 bits(3);
    const auto prepare = [](const Cov2d<float>& cov) { return F::prepare(cov, FootprintOptions{0}); };
    int entered = 0;
    for (const auto& splat : random_splats<F>(bits, 400, kOfPixels, -6, 6, 0.95f, prepare, 20)) {
      std::vector<bool> listed(kPixels);
      if (splat.level > 0) for_each_tile(support_of<F>(splat), kOfPixels, [&](int64_t pixel) { listed[pixel] = true; });
      const auto reach = PixelReach<F, float>::of(splat);
      for (int i = 0; i < kPixels && splat.level > 0; ++i) {
        const Vec2<float> d = {float(i % kWidth) - splat.mean.x, float(i / kWidth) - splat.mean.y};
        const bool enters = reach.reaches(d);
        entered += enters;
        ASSERT_TRUE(listed[i] || !enters) << i;
        for (int k = 0; k < 25; ++k) {
          const Vec2<float> z =
              transform(F::ellipse(splat.shape), Vec2<float>{d.x + 0.25f * (k % 5 - 2), d.y + 0.25f * (k / 5 - 2)});
          ASSERT_TRUE(enters || z.x * z.x + z.y * z.y > splat.level) << i << ' ' << k;
        }
      }
    }
    EXPECT_GT(entered, kPixels);
  }
}

/// A device of 7.5 has 64 KiB.
TYPED_TEST(RaysKernels, FitIntoSharedMemory) {
  using F = TypeParam;
  EXPECT_LE(int64_t(sizeof(RayStage<F>)) + RayWindow::bytes(kMaxRayWindow), 64 * 1024);
}

}  // namespace
}  // namespace ar::cuda
