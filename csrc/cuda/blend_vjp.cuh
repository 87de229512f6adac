// Kernels of blend_vjp for up to four channels.
#pragma once

#include <algorithm>

#include "cuda/blend_vjp_pixels.cuh"
#include "cuda/blend_vjp_sums.cuh"
#include "cuda/launch.cuh"

namespace ar::cuda {

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
