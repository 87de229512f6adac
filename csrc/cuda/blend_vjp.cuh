// Kernels of blend_vjp for up to four channels.
#pragma once

#include <algorithm>

#include "cuda/composite.cuh"
#include "cuda/launch.cuh"

namespace ar::cuda {

/// What a kernel of blend_vjp sums: gradients, MeanSums, or both at once.
enum class Sums { kGrads, kMeans, kBoth };

/// Samples of a pixel that a warp of blend_vjp takes. More are shared out to the warps of a block: one warp would be
/// busy for long with their chunk. Only MeanSums need a pixel's sum at once.
template <class F, Sums kSums>
inline constexpr int kVjpSamples = F::kSamples <= 4 || kSums == Sums::kMeans ? F::kSamples : 4;

/// Whether each lane of blend_vjp holds its eight pixels of a tile in registers, where one sample and three channels
/// leave room for a splat, and not in shared memory. Then a visit of a subtile neither waits for shared memory nor has
/// instructions that read and write it, which is worth the warps that there are fewer of on an SM.
template <class F, int C>
inline constexpr bool kHoldsPixels = F::kSamples == 1 && C == 3 && sizeof(TileSplat<F, C>) <= 112;

/// Whether it holds what blending carries through those pixels, for all samples, in registers. Then each subtile has
/// code of its own, and there is room in shared memory to add up the sums of several pairs together. Not with two
/// samples, as then twice as many warps fit without.
template <class F, int C>
inline constexpr bool kHoldsSamples =
    kHoldsPixels<F, C> || (F::kSamples == 4 && C == 3 && sizeof(TileSplat<F, C>) <= 64);

/// Whether it takes two subtiles, one below the other, under one branch: 8x8 pixels. Then two pixels of a lane have
/// instructions that do not wait for each other, and there are half as many branches, each of which waits for a uniform
/// register. Where weights are expensive, subtiles that are visited in vain cost more than that gains.
template <class F, int C>
inline constexpr bool kTakesTwo = kHoldsPixels<F, C> && sizeof(typename F::template Terms<float>) <= 8 * sizeof(float);

/// Nine values of each lane for kPairs pairs in shared memory, which are added up over the lanes together. For a pair
/// that takes 17 instructions, where sum_values takes 60. Lanes are added in the order of sum_values, so that the sums
/// are the same to the bit.
struct PairSums {
  static constexpr int kPairs = 8, kValues = 9;
  struct Pair {
    /// The first eight values of every lane, in two groups of four. Two more places keep the groups, and eight[] and
    /// ninth[] together the pairs, apart in such a way that no reads meet in a bank.
    float4 eight[2][34];
    float4 ninth[8];  ///< the ninth value of lanes 0, 4, ... 28, then of lanes 1, 5, ...

    __device__ void put(const float (&values)[kValues]) {
      const int lane = lane_id();
#pragma unroll
      for (int group = 0; group < 2; ++group) {
        const float* v = values + 4 * group;
        eight[group][lane] = {v[0], v[1], v[2], v[3]};
      }
      reinterpret_cast<float*>(ninth)[lane % 4 * 8 + lane / 4] = values[8];
    }
    /// Of the lanes that differ from `lane` in `offset` or in twice it and so on up to 16, added in pairs, those that
    /// are 16 apart first.
    template <int offset> __device__ Values<4> sum_from(int group, int lane) const {
      if constexpr (offset == 32) {
        const float4 v = eight[group][lane];
        return {v.x, v.y, v.z, v.w};
      } else {
        Values<4> sum = sum_from<2 * offset>(group, lane);
        sum += sum_from<2 * offset>(group, lane + offset);
        return sum;
      }
    }
  };
  Pair pairs[kPairs];

  /// The sums of pair lane / 4: `four` of a group, that of number lane / 2 % 2, and that of the ninth value.
  __device__ void sum(float (&four)[4], float& ninth) const {
    const int lane = lane_id(), odd = lane / 4 % 2;
    const Pair& pair = pairs[lane / 4];
    const Values<4> half = pair.sum_from<2>(lane / 2 % 2, lane % 2);
#pragma unroll
    for (int v = 0; v < 4; ++v) four[v] = half.v[v] + __shfl_xor_sync(kAllLanes, half.v[v], 1);
    // The four numbers of lanes below 16 and the four of the others, in either order.
    const float4 a = pair.ninth[lane % 4 * 2 + odd], b = pair.ninth[lane % 4 * 2 + 1 - odd];
    ninth = ((a.x + b.x) + (a.z + b.z)) + ((a.y + b.y) + (a.w + b.w));
#pragma unroll
    for (int offset = 2; offset > 0; offset /= 2) ninth += __shfl_xor_sync(kAllLanes, ninth, offset);
  }
};

/// A splat of a batch of 32 that reaches pixels of its tile.
template <class F, int C> struct alignas(16) ListedSplat {
  typename F::template Terms<float> terms;
  Values<C> channels;
  uint32_t reach_and_place;  ///< bits 0 to 7: the subtiles; from bit 27 on: its place in the batch
  int32_t row;               ///< of its sums
};
/// In use: copied to registers, unless it has too many numbers.
template <class F, int C>
using ListedSplatRef =
    std::conditional_t<sizeof(TileSplat<F, C>) <= 112, const ListedSplat<F, C>, const ListedSplat<F, C>&>;

/// Those splats of a batch in blend_vjp, back to front, and what each of the warps that share them sums.
template <class F, int C, int kGroup> struct VjpGroup {
  struct Nothing {};
  alignas(16) int subtile_last[kSubtiles];  ///< behind the last pair that was composited into a pixel of each subtile
  ListedSplat<F, C> splats[32];
  std::conditional_t<kHoldsSamples<F, C>, PairSums, Nothing> pair_sums;
  float sums[kGroup > 1 ? kGroup : 1][kGroup > 1 ? 32 : 1][6 + C];
};

/// kCount pixels in blend_vjp, S samples of each: those of a warp in shared memory, or those that a lane holds.
template <int S, int C, int kCount> struct VjpPixels {
  static constexpr bool kPacked = C == 3;  // the fourth number of g is sample 0's `last`, as bits
  static constexpr int kLasts = kPacked ? S - 1 : S;
  float4 g[kCount];  // gradient with respect to one sample's channels
  int last[kLasts > 0 ? kLasts : 1][kLasts > 0 ? kCount : 1];

  __device__ int last_of(int s, int pixel, const float4& g_pixel) const {
    if (kPacked) return s == 0 ? __float_as_int(g_pixel.w) : last[s > 0 ? s - 1 : 0][pixel];
    return last[kPacked ? 0 : s][pixel];
  }
  __device__ void set(int pixel, const Values<C>& values) {
    g[pixel] = {values.v[0], values.v[1], values.v[2], kPacked ? 0 : values.v[C - 1]};
  }
  __device__ void set_last(int s, int pixel, int value) {
    if (!kPacked) {
      last[kPacked ? 0 : s][pixel] = value;
    } else if (s == 0) {
      g[pixel].w = __int_as_float(value);
    } else {
      last[s > 0 ? s - 1 : 0][pixel] = value;
    }
  }
};

/// What blending carries through them from splat to splat.
template <int S, int kCount> struct VjpSamples {
  struct Sample {
    float transmittance, behind;
  };
  Sample of[S][kCount];
};

template <int C> __device__ float dot(const Values<C>& a, const Values<C>& b) {
  float sum = a.v[0] * b.v[0];
#pragma unroll
  for (int c = 1; c < C; ++c) sum = sum + a.v[c] * b.v[c];
  return sum;
}

/// Blocks of blend_vjp that an SM should hold: bounds the registers.
template <class F, int C>
inline constexpr int kVjpBlocks = F::kSamples > 1                 ? (kHoldsSamples<F, C> ? 11 : 1)
                                  : sizeof(TileSplat<F, C>) <= 48 ? (kHoldsPixels<F, C> ? 5 : 6)
                                                                  : (kHoldsPixels<F, C> ? 4 : 5);

/// Warps of a block of blend_vjp: as many as leave room for a few blocks in shared memory.
template <class F, Sums kSums>
inline constexpr int kVjpWarps = F::kSamples > kVjpSamples<F, kSums> ? F::kSamples / kVjpSamples<F, kSums>
                                 : F::kSamples <= 2                  ? 4
                                 : F::kSamples == 8                  ? 2
                                                                     : 1;

/// What of a warp's pixels is in shared memory.
template <class F, int C, Sums kSums> struct SharedPixels {
  static constexpr int kOwn = kVjpSamples<F, kSums>;
  VjpPixels<kOwn, C, kHoldsPixels<F, C> ? 1 : kTilePixels> pixels;
  VjpSamples<kOwn, kHoldsSamples<F, C> ? 1 : kTilePixels> samples;
};

/// A warp's share of a chunk, back to front over all pixels of the tile: every pair is summed in one place, so the sums
/// need no atomics, whose order would change from run to run. `first`: the first of the samples that the warp takes.
template <class F, int C, Sums kSums>
__device__ __forceinline__ void blend_chunk_vjp(const BlendVjpParams& params, int64_t item, int first,
                                                SharedPixels<F, C, kSums>& shared,
                                                VjpGroup<F, C, F::kSamples / kVjpSamples<F, kSums>>& group) {
  constexpr int S = F::kSamples, kLength = chunk_length(S), kSumCount = 6 + C;
  constexpr int kOwn = kVjpSamples<F, kSums>, kGroup = S / kOwn;  // samples of a warp, warps of a chunk
  // Where the code for a subtile is short, or pixels are in registers, each has its own: of 58 instructions 11 would
  // work out where its pixels are.
  constexpr bool kUnroll = kHoldsSamples<F, C> || (S == 1 && sizeof(TileSplat<F, C>) <= 48);
  constexpr bool kGrads = kSums != Sums::kMeans, kMeans = kSums != Sums::kGrads;
  // A shared-out sample's number is not known when the code is compiled: keep its node indexable.
  using VjpSplat = std::conditional_t<kGroup == 1, ListedSplatRef<F, C>, const ListedSplat<F, C>&>;
  constexpr bool kHolds = kHoldsPixels<F, C>, kHoldsState = kHoldsSamples<F, C>;
  static_assert(kGrads || !kHoldsState);  // or there would be no sums to add up in shared memory
  const int lane = lane_id(), warp = threadIdx.x / 32;
  std::conditional_t<kHolds, VjpPixels<kOwn, C, kSubtiles>, int> held_pixels;
  std::conditional_t<kHoldsState, VjpSamples<kOwn, kSubtiles>, int> held_samples;
  auto& pixels = *[&] {
    if constexpr (kHolds) {
      return &held_pixels;
    } else {
      return &shared.pixels;
    }
  }();
  auto& samples = *[&] {
    if constexpr (kHoldsState) {
      return &held_samples;
    } else {
      return &shared.samples;
    }
  }();
  const auto place_of = [&](int b) { return kHolds ? b : b * 32 + lane; };           // in `pixels`
  const auto sample_place = [&](int b) { return kHoldsState ? b : b * 32 + lane; };  // in `samples`
  const auto group_sync = [] {
    if constexpr (kGroup > 1) {
      __syncthreads();
    } else {
      __syncwarp();
    }
  };
  const auto [tile, chunk, plane] = params.chunk_order[item];
  const TileList list = list_of(params.lists, params.grid, tile);
  const int begin = chunk * kLength, end = list.overflow ? list.count : min(list.count, begin + kLength);
  const int64_t image = int64_t(params.grid.width) * params.grid.height;
  const Vec2<float> size = {float(params.grid.width), float(params.grid.height)};
  const auto pixel_index = [&](int b) {  // in the image; -1 outside
    const Vec2<float> p = pixel_of(b, lane);
    const int x = list.x0 + int(p.x), y = list.y0 + int(p.y);
    return x < params.grid.width && y < params.grid.height ? int64_t(y) * params.grid.width + x : int64_t(-1);
  };

  int tile_last = 0;
#pragma unroll
  for (int b = 0; b < kSubtiles; ++b) {
    const int64_t i = pixel_index(b);
    int last = 0;
#pragma unroll
    for (int s = 0; s < S; ++s) last = max(last, i < 0 ? 0 : params.last[s * image + i]);
    last = warp_max(last);
    if (lane == 0 && first == 0) group.subtile_last[b] = last;  // is read behind group_sync()
    tile_last = max(tile_last, last);
  }
  const auto clear_row = [&](int32_t row) {  // of a pair that reaches nothing
    auto* numbers = reinterpret_cast<float4*>(params.pair_grads + int64_t(row) * kPairGradWidth);
#pragma unroll
    for (int q = 0; q < kPairGradWidth / 4; ++q) numbers[q] = {0, 0, 0, 0};
  };
  if (kGrads && !list.overflow) {
    for (int k = max(begin, min(tile_last, end)) + lane; k < end; k += 32) clear_row(list.slot(k));
  }
  if (begin >= tile_last) return;

  const bool final = tile_last <= end;
  const auto* checkpoints = reinterpret_cast<const Checkpoint<C>*>(params.checkpoints + int64_t(plane) * kTilePixels);
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const Vec2<float> p0 = pixel_of(0, lane);
  constexpr int kTwo23 = 0x4b000000;
  const uint32_t subtile_bit = lane < kSubtiles ? 1u << lane : 0;
  const int value = summed_value<kSumCount>(lane);  // that sum_values leaves here
  float* const sums = params.pair_grads + (value == 9 ? kPairFourthChannel : value);
  const float* dL_dplanes[C];  // of three channels all are there
  Values<C> background;
#pragma unroll
  for (int c = 0; c < C; ++c) {
    const bool used = C == 3 || c < params.channels.count;
    dL_dplanes[c] = C == 3 ? params.dL_dimage.first + c * image : used ? params.dL_dimage.plane(c, image) : nullptr;
    background.v[c] = used ? params.background[c] : 0;
  }
#pragma unroll
  for (int b = 0; b < kSubtiles; ++b) {
    const int64_t i = pixel_index(b);
    const int q = place_of(b);
    const float scale = i < 0 ? 0 : 1.0f / S;
    Values<C> g;
#pragma unroll
    for (int c = 0; c < C; ++c) g.v[c] = i >= 0 && (C == 3 || dL_dplanes[c]) ? scale * dL_dplanes[c][i] : 0;
    pixels.set(q, g);
#pragma unroll
    for (int s = 0; s < kOwn; ++s) {
      const int last = i < 0 ? 0 : params.last[(first + s) * image + i];
      float transmittance = 1, behind = 0;
      if (final) {
        transmittance = i < 0 ? 1.0f : params.transmittance[(first + s) * image + i];
        behind = dot(g, background);
      } else {
        const Checkpoint<C> c = checkpoints[(first + s) * kTilePixels + b * 32 + lane];
        transmittance = abs(c.transmittance);
        behind = dot(g, c.channels) / transmittance;
      }
      // Alpha is 1 - transmittance: its gradient acts like one more channel whose background is -1.
      if (params.dL_dalpha && i >= 0) {
        const float open = final ? 1 : params.transmittance[(first + s) * image + i] / transmittance;
        behind -= scale * params.dL_dalpha[i] * open;
      }
      samples.of[s][sample_place(b)] = {transmittance, behind};
      pixels.set_last(s, q, last);
    }
  }

  const auto put = [&](int32_t row, int column, float x) {
    put_sum(params.pair_grads, kPairGradWidth, list.overflow, row, column, x);
  };
  // Adds up the values of `count` listed splats, from number `from` on.
  [[maybe_unused]] const auto sum_pairs = [&](int from, int count) {
    if constexpr (kHoldsState) {
      __syncwarp();
      float four[4], ninth;
      group.pair_sums.sum(four, ninth);
      __syncwarp();
      if (lane / 4 >= count) return;
      float* const row = params.pair_grads + int64_t(group.splats[from + lane / 4].row) * kPairGradWidth;
      float* const place = row + lane / 2 % 2 * 4;
      if (!list.overflow) {
        *reinterpret_cast<float4*>(place) = {four[0], four[1], four[2], four[3]};
        if (lane % 4 == 0) row[8] = ninth;
      } else if (lane % 2 == 0) {
#pragma unroll
        for (int v = 0; v < 4; ++v) atomicAdd(place + v, four[v]);
        if (lane % 4 == 0) atomicAdd(row + 8, ninth);
      }
    }
  };
  static_assert(kLength % 32 == 0);  // no batch begins before `begin`
  for (int k1 = min(end, tile_last); k1 > begin; k1 = (k1 - 1) / 32 * 32) {
    const int k0 = (k1 - 1) / 32 * 32, k = k0 + lane;
    uint32_t reach = 0;
    Mat2<float> mean_map = {0, 0, 0, 0};
    group_sync();
    Splat<F, float> own;
    int32_t id = 0, row_index = 0;
    if (k < k1) {
      id = list.splat(k);
      row_index = list.overflow ? id : list.slot(k);
      own = splats[id];
      reach = subtile_reach<F>(own, list.x0, list.y0);
#pragma unroll
      for (int b = 0; b < kSubtiles; ++b) reach &= ~(uint32_t(k >= group.subtile_last[b]) << b);
      if (kMeans) mean_map = F::mean_map(own.shape);
      if (kGrads && reach == 0 && first == 0 && !list.overflow) clear_row(row_index);
    }
    const uint32_t reaching = __ballot_sync(kAllLanes, reach != 0);
    if (reach && first == 0) {
      group.splats[__popc(reaching >> lane >> 1)] = {tile_terms(own, list), channels_of<C>(params.channels, own, id),
                                                     reach | uint32_t(lane) << 27, row_index};
    }
    const int listed = __popc(reaching);
    group_sync();
    // `to` is where values for its sums go, or its number in the list; `kind` which MeanSums, known to the compiler,
    // since pixels must not branch on it.
    const auto walk = [&](const ListedSplat<F, C>& listed_splat, auto&& to, auto kind) {
      VjpSplat splat = listed_splat;
      // By a ballot, so that the compiler knows that all lanes branch alike.
      const uint32_t reached = __ballot_sync(kAllLanes, splat.reach_and_place & subtile_bit);
      const int j = int(splat.reach_and_place >> 27), at = k0 + j;
      const Mat2<float> m =
          !kMeans ? mean_map
                  : Mat2<float>{__shfl_sync(kAllLanes, mean_map.xx, j), __shfl_sync(kAllLanes, mean_map.xy, j),
                                __shfl_sync(kAllLanes, mean_map.yx, j), __shfl_sync(kAllLanes, mean_map.yy, j)};
      ShapeGrad<float> shape = {{0, 0}, {0, 0, 0}};
      float weighted = 0;
      Values<C> channels = {};
      Vec2<float> mean_sums = {0, 0};
      const auto visit = [&](int b, Vec2<float> p) {
        const int q = place_of(b);
        const float4 g = pixels.g[q];
        const Values<4> of_pixel_g = {{g.x, g.y, g.z, g.w}};
        float g_color = madd(g.x, splat.channels.v[0], madd(g.y, splat.channels.v[1], g.z * splat.channels.v[2]));
        if (C > 3) g_color = madd(g.w, splat.channels.v[C - 1], g_color);
        float contribution = 0;
        ShapeGrad<float> of_pixel = {{0, 0}, {0, 0, 0}};
#pragma unroll
        for (int s = 0; s < kOwn; ++s) {
          const int node = kGroup == 1 ? s : first + s;
          const float alpha = F::alpha(splat.terms, p, node);
          // Both are worked out: to read the second only after the first would be to wait for it.
          const bool mask = (alpha >= float(kAlphaMin)) & (at < pixels.last_of(s, q, g));
          if (s == 0 && S == 1 && !kTakesTwo<F, C> && !__any_sync(kAllLanes, mask)) break;
          auto sample = samples.of[s][sample_place(b)];
          const BlendGrad<float> grad = blend_sample_vjp(mask, alpha, g_color, sample.transmittance, sample.behind);
          samples.of[s][sample_place(b)] = sample;
          if (kGrads) F::add_alpha_vjp(splat.terms, p, node, alpha, grad.dL_dalpha, shape);
          // Again for the pixel alone: to ask for it must not change the other sums by a bit.
          if (kMeans) F::add_alpha_vjp(splat.terms, p, node, alpha, grad.dL_dalpha, of_pixel);
          contribution = s == 0 ? grad.contribution : contribution + grad.contribution;
          weighted += grad.dL_dalpha * alpha;
        }
#pragma unroll
        for (int c = 0; c < C; ++c) channels.v[c] = madd(contribution, of_pixel_g.v[c], channels.v[c]);
        if (kMeans) {
          const Vec2<float> dL_dmean = transform_transposed(m, of_pixel.offset);
          mean_sums = mean_sums + mean_sums_of(decltype(kind)::value, size, dL_dmean);
        }
      };
      if constexpr (kTakesTwo<F, C>) {
#pragma unroll
        for (int q = 0; q < kSubtiles / 2; ++q) {
          const int upper = q % 2 + q / 2 * 4, lower = upper + 2;
          if (!(reached & (1u << upper | 1u << lower))) continue;
          const Vec2<float> p = {p0.x + float(q % 2 * 8), p0.y + float(q / 2 * 8)};
          visit(upper, p);
          visit(lower, {p.x, p.y + 4});
        }
      } else if constexpr (kUnroll) {
#pragma unroll
        for (int b = 0; b < kSubtiles; ++b) {
          if (reached >> b & 1) visit(b, {p0.x + float(8 * (b & 1)), p0.y + float(4 * (b >> 1))});
        }
      } else {
        for (uint32_t hit = reached; hit != 0; hit &= hit - 1) {
          const int b = __ffs(hit) - 1;
          // pixel_of(b, lane); an integer below 2^23 set into the mantissa of 2^23 is that float, plus 2^23
          const float column = __int_as_float(kTwo23 | (b & 1)) - 8388608.0f;
          const float band = __int_as_float(kTwo23 | (b >> 1)) - 8388608.0f;
          visit(b, {madd(8.0f, column, p0.x), madd(4.0f, band, p0.y)});
        }
      }
      const int32_t row = splat.row;
      if (kGrads) {
        shape = F::collect(splat.terms, shape, weighted);
        float values[kSumCount] = {shape.offset.x, shape.offset.y, shape.shape.xx,
                                   shape.shape.xy, shape.shape.yy, weighted};
#pragma unroll
        for (int c = 0; c < C; ++c) values[6 + c] = channels.v[c];
        if constexpr (kHoldsState) {
          to.put(values);
        } else if constexpr (kGroup > 1) {
          const float sum = sum_values(values);
          if (has_value_first<kSumCount>(lane)) group.sums[warp][to][value] = sum;
        } else {
          const float sum = sum_values(values);
          if (!list.overflow) {
            sums[int64_t(row) * kPairGradWidth] = sum;  // of all lanes: to find the first ones takes longer
          } else if (has_value_first<kSumCount>(lane)) {
            atomicAdd(&sums[int64_t(row) * kPairGradWidth], sum);
          }
        }
      }
      if (kMeans) {
        const float total = warp_sum_of_two(mean_sums.x, mean_sums.y);
        if (lane % 16 == 0) put(row, kPairMeans + lane / 16, total);
      }
    };
    const auto walk_listed = [&](auto kind) {
      if constexpr (kHoldsState) {
        for (int n = 0; n < listed; n += PairSums::kPairs) {
          const int count = min(listed - n, PairSums::kPairs);
          const auto* splat = group.splats + n;
          PairSums::Pair* pair = group.pair_sums.pairs;
          for (int left = count; left > 0; --left) walk(*splat++, *pair++, kind);
          sum_pairs(n, count);
        }
      } else {
        for (int n = 0; n < listed; ++n) walk(group.splats[n], n, kind);
      }
    };
    if constexpr (!kMeans) {
      walk_listed(std::integral_constant<MeanSums, MeanSums::kNone>());
    } else if (params.mean_sums == MeanSums::kNorm) {
      walk_listed(std::integral_constant<MeanSums, MeanSums::kNorm>());
    } else {
      walk_listed(std::integral_constant<MeanSums, MeanSums::kAbsolute>());
    }
    if constexpr (kGroup > 1 && kGrads) {
      __syncthreads();
      for (int t = threadIdx.x; t < kSumCount * listed; t += 32 * kGroup) {
        const int n = t / kSumCount, v = t % kSumCount;
        float sum = group.sums[0][n][v];
#pragma unroll
        for (int w = 1; w < kGroup; ++w) sum += group.sums[w][n][v];
        put(group.splats[n].row, v == 9 ? kPairFourthChannel : v, sum);
      }
    }
  }
}

/// Whether a warp has a chunk for itself. Then it takes the next one when it is done, and need not wait for the others
/// of its block, which have other chunks. Warps that share a chunk end with their block.
template <class F, Sums kSums> inline constexpr bool kTakesChunks = kVjpSamples<F, kSums> == F::kSamples;

template <class F, int C, Sums kSums>
__global__ void __launch_bounds__(32 * kVjpWarps<F, kSums>, kVjpBlocks<F, C>)
    blend_vjp_kernel(const BlendVjpParams params) {
  constexpr int kWarps = kVjpWarps<F, kSums>, kOwn = kVjpSamples<F, kSums>, kGroup = F::kSamples / kOwn;
  auto* pixels = reinterpret_cast<SharedPixels<F, C, kSums>*>(dynamic_shared());
  auto* groups = reinterpret_cast<VjpGroup<F, C, kGroup>*>(pixels + kWarps);
  const int warp = threadIdx.x / 32, first = warp % kGroup * kOwn;
  const int32_t* firsts = params.plan->counts.chunks.first + sample_class(F::kSamples);
  const int begin = firsts[0], end = firsts[1];
  if constexpr (kTakesChunks<F, kSums>) {
    for (;;) {
      int taken = 0;
      if (lane_id() == 0) taken = atomicAdd(&params.chunks_taken[sample_class(F::kSamples)], 1);
      const int item = begin + shuffle(taken, 0);
      if (item >= end) return;
      blend_chunk_vjp<F, C, kSums>(params, item, first, pixels[warp], groups[warp]);
    }
  } else {
    const int64_t item = begin + (int64_t(blockIdx.x) * kWarps + warp) / kGroup;
    if (item < end) blend_chunk_vjp<F, C, kSums>(params, item, first, pixels[warp], groups[warp / kGroup]);
  }
}

/// Eight blocks for each of the 132 multiprocessors of an H200.
inline constexpr int kClearBlocks = 132 * 8;
/// As many blocks as any device holds: more would only find that no chunk is left.
inline constexpr unsigned kTakingBlocks = 256 * 8;

template <class F, int C, Sums kSums> void launch_blend_vjp(const BlendVjpParams& p, cudaStream_t stream) {
  constexpr int kOwn = kVjpSamples<F, kSums>, kWarps = kVjpWarps<F, kSums>, kGroup = F::kSamples / kOwn;
  const size_t bytes = kWarps * sizeof(SharedPixels<F, C, kSums>) + kWarps / kGroup * sizeof(VjpGroup<F, C, kGroup>);
  unsigned blocks = blocks_of(p.max_chunks, kWarps / kGroup);
  if (kTakesChunks<F, kSums>) blocks = std::min(blocks, kTakingBlocks);
  launch(blend_vjp_kernel<F, C, kSums>, {blocks, 32 * kWarps, bytes}, stream, p);
}
template <class F, int C> void blend_vjp_few(const BlendVjpParams& p, cudaStream_t stream) {
  constexpr bool kAtOnce = kVjpSamples<F, Sums::kGrads> == F::kSamples;
  if (!kAtOnce || p.mean_sums == MeanSums::kNone) launch_blend_vjp<F, C, Sums::kGrads>(p, stream);
  if (p.mean_sums != MeanSums::kNone) launch_blend_vjp<F, C, kAtOnce ? Sums::kBoth : Sums::kMeans>(p, stream);
}

}  // namespace ar::cuda
