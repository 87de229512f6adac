// Kernel blend_rays: the forward pass in the order along rays, for up to four channels. A block, one warp, per half
// tile.
#pragma once

#include "cuda/rays/walk.cuh"
#include "cuda/still/output.cuh"

namespace ar::cuda {

/// C: 3 channels in the splats, or up to 4 in rows. `last` is zero: the backward pass composites again.
template <class F, int C>
__global__ void __launch_bounds__(32, RayPolicy::kBlocks) blend_rays_kernel(const BlendParams params) {
  wait_for_earlier_kernels();
  constexpr int S = F::kSamples, kAtOnce = RayPolicy::kAtOnce<F>;
  auto& stage = *reinterpret_cast<RayStage<F>*>(dynamic_shared());
  const TileList list = list_of(params.lists, params.grid, params.plan.tile_order[blockIdx.x / kRayHalves]);
  const int half = blockIdx.x % kRayHalves;
  const Vec2<float> p = ray_pixel(half);
  const Pixel pixel(list, params.grid, p);
  RaySamples<F> samples(pixel.inside);
  Values<C> sums = {};
  walk_rays<F>(
      params, list, stage, reinterpret_cast<RayEntry*>(&stage + 1), half, pixel.inside,
      [](int, int32_t id) { return id; },
      [&](const RayEntry(&entries)[kAtOnce]) {
        Values<C> channels[kAtOnce];
        LeavingSplat<F> leaving[kAtOnce] = {};
        AR_UNROLL for (int i = 0; i < kAtOnce; ++i) {
          const int32_t id = max(entries[i].payload, 0);  // any splat, for lanes that have none
          const Splat<F, float> splat = load_splat<F>(params.splats, id);
          channels[i] = channels_of<C>(params.channels, splat, id);
          leaving[i].set(splat, list, p);
        }
        AR_UNROLL for (int i = 0; i < kAtOnce; ++i) {
          add_samples<S>(sums, channels[i], [&](int s) {
            float raw;
            return blend_leaving(leaving[i], entries[i], p, s, samples, raw);
          });
        }
        return samples.open();
      });
  AR_UNROLL for (int s = 0; s < S; ++s) {
    if (params.last && pixel.inside) params.last[s * pixel.image + pixel.index] = 0;
  }
  store_pixel<LaneSamples<S, 1>>(params, pixel, sums, samples.transmittance);
}

}  // namespace ar::cuda
