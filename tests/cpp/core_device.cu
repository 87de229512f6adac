// Instantiates everything in core/ for devices, for every footprint, float and double. Compiled,
// never run: it shows that the CPU's formulas are formulas for CUDA too.
#include "core/bin.h"
#include "core/blend.h"
#include "core/footprint/registry.h"
#include "core/project.h"

namespace ar {

template <typename T> struct Buffers {
  CameraView<T> camera;
  Gaussians<T> gaussians;
  GaussianGrads<T> grads;
  FootprintOptions options;
  PairGrad<T>* sums;
  Vec2<T>* pixels;
  T* alphas;
  int* flags;
};

template <class F, typename T> __global__ void run_core(Buffers<T> b, Splat<F, T>* splats) {
  const int64_t i = blockIdx.x * blockDim.x + threadIdx.x;
  const Camera<T> camera = load_camera(b.camera);
  if (!may_be_visible(camera, b.gaussians, i, T(1))) {
    zero_grads(b.gaussians, i, b.grads);
    return;
  }
  T depth;
  b.flags[i] = project(camera, b.gaussians, i, b.options, splats[i], depth);
  for_each_tile(support_of(splats[i]), camera.grid, [&](int64_t tile) { ++b.flags[tile]; });

  const auto terms = F::terms(splats[i].shape, splats[i].opacity);
  const Vec2<T> d = b.pixels[i];
  const Span<T> chord = chord_of(support_of(splats[i]), d.y);
  if (d.x < chord.lo || d.x > chord.hi) return;
  T transmittance = T(1), behind = depth;
  PairGrad<T> sums = b.sums[i];
  for (int s = 0; s < F::kSamples; ++s) {
    const T alpha = F::alpha(terms, d, s);
    const Blended<T> blended = blend_sample(alpha, transmittance);
    const BlendGrad<T> grad = blend_sample_vjp(blended.mask, alpha, splats[i].color.x, transmittance, behind);
    F::add_alpha_vjp(terms, d, s, alpha, grad.dL_dalpha, sums.shape);
    sums.weighted += grad.contribution;
  }
  b.pixels[i] = transform_transposed(F::mean_map(splats[i].shape), sums.shape.offset);
  project_vjp<F>(camera, b.gaussians, i, b.options, sums, b.gaussians.shs, b.grads.shs, b.grads);
}

template <typename T> void launch(const char* footprint, const Buffers<T>& b) {
  visit_footprint(footprint, Footprints{}, [&](auto f) {
    using F = decltype(f);
    run_core<F, T><<<1, 1>>>(b, static_cast<Splat<F, T>*>(nullptr));
  });
}
template void launch(const char*, const Buffers<float>&);
template void launch(const char*, const Buffers<double>&);

}  // namespace ar
