// The ops on CPU tensors: check, sizes, allocate, launch.
#include <ATen/Parallel.h>
#include <torch/library.h>
#if defined(__unix__) || defined(__APPLE__)
#include <pthread.h>
#endif

#include <array>
#include <chrono>
#include <tuple>

#include "cpu/tasks.h"
#include "torch/checks.h"
#include "torch/views.h"

namespace ar::ops {
namespace {

using cpu::Stages;

bool is_forked = false;
#if defined(__unix__) || defined(__APPLE__)
[[maybe_unused]] const int kWatchesForks = pthread_atfork(nullptr, nullptr, [] { is_forked = true; });
#endif

/// Threads of a loop: as many as torch's, but one in a forked child. fork() leaves the threads of OpenMP's pool
/// behind, and libgomp would wait for them forever.
int thread_count() { return is_forked ? 1 : at::get_num_threads(); }

template <typename T> const Stages<T>& stages_of(const std::string& footprint) {
  return found(cpu::find_stages<T>(footprint), footprint);
}

struct Projected {
  Tensor splats, ids, depths, radii;
};

template <typename T> Projected project(const Inputs& in, const Stages<T>& stages) {
  const auto options = in.means3D.options();
  const int64_t chunks = cpu::chunks_of(in.count());
  std::vector<int64_t> offsets(chunks + 1, 0);
  std::vector<uint8_t> flags(in.count());
  cpu::ProjectTask<T> task{camera_of<T>(in),
                           gaussians_of<T>(in),
                           footprint_options(in.option),
                           thread_count(),
                           flags.data(),
                           offsets.data(),
                           {},
                           {},
                           {},
                           {}};
  const cpu::CameraStages<T>& of_camera = stages.of(task.camera);
  of_camera.count_candidates(task);
  int64_t candidates = 0;
  for (int64_t& offset : offsets) candidates += std::exchange(offset, candidates);
  Projected out{at::empty({candidates, kSplatWidth}, options), at::empty({candidates}, options.dtype(at::kInt)),
                at::empty({candidates}, options), at::empty({in.count()}, options.dtype(at::kInt))};
  task.splats = out.splats.data_ptr<T>();
  task.ids = out.ids.data_ptr<int32_t>();
  task.depths = out.depths.data_ptr<T>();
  task.radii = out.radii.data_ptr<int32_t>();
  of_camera.project(task);
  return out;
}

struct Binned {
  Tensor pairs, tile_offsets, splat_offsets, positions;
};

template <typename T> Binned bin(const Inputs& in, const Projected& projected, const Stages<T>& stages, bool keep) {
  const auto longs = projected.ids.options().dtype(at::kLong);
  const int64_t n = projected.ids.size(0);
  const TileGrid grid = grid_of(in);
  Binned out;
  out.tile_offsets = at::empty({grid.tiles() + 1}, longs);
  out.splat_offsets = keep ? at::zeros({n + 1}, longs) : at::empty({0}, longs);
  cpu::BinTask<T> task{};
  task.splats = projected.splats.template const_data_ptr<T>();
  task.depths = projected.depths.template const_data_ptr<T>();
  task.n = n;
  task.grid = grid;
  task.threads = thread_count();
  task.tile_offsets = out.tile_offsets.template data_ptr<int64_t>();
  task.splat_offsets = keep ? out.splat_offsets.template data_ptr<int64_t>() : nullptr;
  stages.count_pairs(task);
  const int64_t pairs = task.tile_offsets[grid.tiles()];
  out.pairs = at::empty({pairs}, projected.ids.options());
  out.positions = at::empty({keep ? pairs : 0}, longs);
  task.pairs = out.pairs.template data_ptr<int32_t>();
  task.positions = keep ? out.positions.template data_ptr<int64_t>() : nullptr;
  stages.scatter_pairs(task);
  return out;
}

/// Samples of every tile; empty where all have the same.
template <typename T>
Tensor choose(const Inputs& in, const Projected& projected, const Binned& binned, const Stages<T>& stages) {
  const TileGrid grid = grid_of(in);
  const Tensor out = at::empty({stages.choose ? grid.tiles() : 0}, binned.pairs.options());
  if (stages.choose) {
    stages.choose({projected.splats.template const_data_ptr<T>(), binned.pairs.const_data_ptr<int32_t>(),
                   binned.tile_offsets.const_data_ptr<int64_t>(), grid, thread_count(),
                   in.background.const_data_ptr<T>(), footprint_options(in.option), out.data_ptr<int32_t>()});
  }
  return out;
}
const int32_t* samples_or_null(const Tensor& tile_samples) {
  return tile_samples.numel() ? tile_samples.const_data_ptr<int32_t>() : nullptr;
}

struct BlendedImage {
  Tensor color, transmittance, last;
  std::vector<Tensor> alpha;  ///< one, if asked for
};

template <typename T>
BlendedImage blend(const Inputs& in, const Projected& projected, const Binned& binned, const Tensor& tile_samples,
                   const Stages<T>& stages, bool keep, bool with_alpha) {
  const auto options = in.means3D.options();
  const int64_t samples = keep ? stages.samples : 0;
  const std::vector<int64_t> planes = {samples, in.image_height, in.image_width};
  // Where samples are chosen not every tile writes all planes.
  const auto make = [&](const at::TensorOptions& o) {
    return stages.choose ? at::zeros(planes, o) : at::empty(planes, o);
  };
  BlendedImage out{
      at::empty({3, in.image_height, in.image_width}, options), make(options), make(options.dtype(at::kInt)), {}};
  if (with_alpha) out.alpha.push_back(at::empty({in.image_height, in.image_width}, options));
  stages.blend({projected.splats.template const_data_ptr<T>(), binned.pairs.const_data_ptr<int32_t>(),
                binned.tile_offsets.const_data_ptr<int64_t>(), grid_of(in), thread_count(),
                samples_or_null(tile_samples), in.background.const_data_ptr<T>(), out.color.template data_ptr<T>(),
                keep ? out.transmittance.template data_ptr<T>() : nullptr,
                keep ? out.last.template data_ptr<int32_t>() : nullptr,
                with_alpha ? out.alpha[0].template data_ptr<T>() : nullptr});
  return out;
}

RasterizeOutput rasterize_cpu(const Tensor& means3D, const OptionalTensor& means2D, const Tensor& opacities,
                              const OptionalTensor& shs, const OptionalTensor& colors_precomp,
                              const OptionalTensor& scales, const OptionalTensor& rotations,
                              const OptionalTensor& cov3D_precomp, const Tensor& bg, const Tensor& viewmatrix,
                              const Tensor& projmatrix, const Tensor& campos, const OptionalTensor& lens,
                              int64_t image_height, int64_t image_width, double tanfovx, double tanfovy,
                              double scale_modifier, int64_t sh_degree, std::string footprint, double option, bool keep,
                              bool with_alpha, bool) {
  Inputs in{means3D, opacities,      means2D,    shs,       colors_precomp, scales,       rotations,   cov3D_precomp,
            bg,      viewmatrix,     projmatrix, campos,    lens,           image_height, image_width, tanfovx,
            tanfovy, scale_modifier, sh_degree,  footprint, option};
  in.check();
  in.check_camera();
  RasterizeOutput out;
  AT_DISPATCH_FLOATING_TYPES(in.means3D.scalar_type(), "rasterize", [&] {
    const Stages<scalar_t>& stages = stages_of<scalar_t>(footprint);
    const Projected projected = project(in, stages);
    const Binned binned = bin(in, projected, stages, keep);
    const Tensor tile_samples = choose(in, projected, binned, stages);
    const BlendedImage image = blend(in, projected, binned, tile_samples, stages, keep, with_alpha);
    out = {image.color,
           projected.radii,
           projected.splats,
           projected.ids,
           binned.pairs,
           binned.tile_offsets,
           binned.splat_offsets,
           binned.positions,
           image.transmittance,
           image.last,
           at::empty({0}, in.means3D.options()),
           at::empty({0}, binned.pairs.options()),
           at::empty({0}, binned.tile_offsets.options()),
           tile_samples,
           image.alpha};
  });
  return out;
}

StagesOutput rasterize_stages_cpu(const Tensor& means3D, const Tensor& opacities, const OptionalTensor& shs,
                                  const OptionalTensor& colors_precomp, const OptionalTensor& scales,
                                  const OptionalTensor& rotations, const OptionalTensor& cov3D_precomp,
                                  const Tensor& bg, const Tensor& viewmatrix, const Tensor& projmatrix,
                                  const Tensor& campos, const OptionalTensor& lens, int64_t image_height,
                                  int64_t image_width, double tanfovx, double tanfovy, double scale_modifier,
                                  int64_t sh_degree, std::string footprint, double option) {
  Inputs in{means3D, opacities,      std::nullopt, shs,       colors_precomp, scales,       rotations,   cov3D_precomp,
            bg,      viewmatrix,     projmatrix,   campos,    lens,           image_height, image_width, tanfovx,
            tanfovy, scale_modifier, sh_degree,    footprint, option};
  in.check();
  in.check_camera();
  StagesOutput out;
  AT_DISPATCH_FLOATING_TYPES(in.means3D.scalar_type(), "rasterize_stages", [&] {
    using Clock = std::chrono::steady_clock;
    const Stages<scalar_t>& stages = stages_of<scalar_t>(footprint);
    const auto t0 = Clock::now();
    const Projected projected = project(in, stages);
    const auto t1 = Clock::now();
    const Binned binned = bin(in, projected, stages, false);
    const auto t2 = Clock::now();
    const BlendedImage image =
        blend(in, projected, binned, choose(in, projected, binned, stages), stages, false, false);
    const auto t3 = Clock::now();
    const Tensor seconds = at::empty({3}, at::kDouble);
    const auto elapsed = [](auto from, auto to) { return std::chrono::duration<double>(to - from).count(); };
    const double values[3] = {elapsed(t0, t1), elapsed(t1, t2), elapsed(t2, t3)};
    std::copy(values, values + 3, seconds.data_ptr<double>());
    // A splat begins with its mean.
    out = {image.color,  projected.radii,     projected.ids, projected.depths, projected.splats.narrow(1, 0, 2).clone(),
           binned.pairs, binned.tile_offsets, seconds};
  });
  return out;
}

/// The tensors that rasterize hands to its vjp must fit each other. Their contents are rasterize's own.
void check_saved(const Inputs& in, const Tensor& splats, const Tensor& ids, const Tensor& pairs,
                 const Tensor& tile_offsets, const Tensor& splat_offsets, const Tensor& positions,
                 const Tensor& transmittance, const Tensor& last, const Tensor& tile_samples, int64_t width,
                 int64_t samples, bool chosen) {
  const int64_t v = ids.numel(), n = pairs.numel();
  const std::vector<int64_t> image = {samples, in.image_height, in.image_width};
  TORCH_CHECK_VALUE(
      splats.dim() == 2 && splats.size(0) == v && splats.size(1) == width && splat_offsets.numel() == v + 1 &&
          positions.numel() == n && tile_offsets.numel() == grid_of(in).tiles() + 1 && transmittance.sizes() == image &&
          last.sizes() == image && tile_samples.numel() == (chosen ? grid_of(in).tiles() : 0),
      "splats ... last must be the outputs of rasterize with keep=True for the same arguments, got splats of shape ",
      shape_of(splats), " and transmittance of shape ", shape_of(transmittance));
  TORCH_CHECK_VALUE(
      splats.is_contiguous() && transmittance.is_contiguous() && last.is_contiguous() && tile_samples.is_contiguous(),
      "splats, transmittance, last and tile_samples must be contiguous, got strided ones");
}

Grads rasterize_vjp_cpu(const Tensor& dL_dcolor, const OptionalTensor& dL_dalpha, const Tensor& means3D,
                        const OptionalTensor& means2D, const Tensor& opacities, const OptionalTensor& shs,
                        const OptionalTensor& colors_precomp, const OptionalTensor& scales,
                        const OptionalTensor& rotations, const OptionalTensor& cov3D_precomp, const Tensor& bg,
                        const Tensor& viewmatrix, const Tensor& projmatrix, const Tensor& campos,
                        const OptionalTensor& lens, int64_t image_height, int64_t image_width, double tanfovx,
                        double tanfovy, double scale_modifier, int64_t sh_degree, std::string footprint, double option,
                        const Tensor& splats, const Tensor& ids, const Tensor& pairs, const Tensor& tile_offsets,
                        const Tensor& splat_offsets, const Tensor& positions, const Tensor& transmittance,
                        const Tensor& last, const Tensor&, const Tensor&, const Tensor&, const Tensor& tile_samples,
                        Needs needs, bool) {
  Inputs in{means3D, opacities,      means2D,    shs,       colors_precomp, scales,       rotations,   cov3D_precomp,
            bg,      viewmatrix,     projmatrix, campos,    lens,           image_height, image_width, tanfovx,
            tanfovy, scale_modifier, sh_degree,  footprint, option};
  in.check();
  in.check_gradient(dL_dcolor, dL_dalpha);
  Grads out = make_grads(in, needs);
  AT_DISPATCH_FLOATING_TYPES(means3D.scalar_type(), "rasterize_vjp", [&] {
    using T = scalar_t;
    const Stages<T>& stages = stages_of<T>(footprint);
    check_saved(in, splats, ids, pairs, tile_offsets, splat_offsets, positions, transmittance, last, tile_samples,
                kSplatWidth, stages.samples, stages.choose != nullptr);
    const GaussianGrads<T> grads = grads_of<T>(in, out);
    const int64_t n = pairs.size(0);
    const Tensor pair_grads = at::empty({n, int64_t(sizeof(PairGrad<T>) / sizeof(T))}, means3D.options());
    const bool absolute = grads.means2d && grads.means2d_stride == 4;
    const Tensor pair_abs = at::empty({absolute ? n : 0, 2}, means3D.options());
    auto* sums = reinterpret_cast<PairGrad<T>*>(pair_grads.data_ptr<T>());
    auto* abs2d = absolute ? reinterpret_cast<Vec2<T>*>(pair_abs.data_ptr<T>()) : nullptr;
    const Tensor g = dL_dcolor.contiguous(), g_alpha = dL_dalpha ? dL_dalpha->contiguous() : Tensor();
    const int threads = thread_count();
    stages.blend_vjp({splats.const_data_ptr<T>(), pairs.const_data_ptr<int32_t>(),
                      tile_offsets.const_data_ptr<int64_t>(), grid_of(in), threads, samples_or_null(tile_samples),
                      in.background.const_data_ptr<T>(), transmittance.const_data_ptr<T>(),
                      last.const_data_ptr<int32_t>(), g.const_data_ptr<T>(), const_data_or_null<T>(g_alpha), sums,
                      abs2d});
    const CameraView<T> camera = camera_of<T>(in);
    const Tensor camera_grads = make_camera_grads(in, needs, cpu::chunks_of(in.count()));
    stages.of(camera).project_vjp({camera, gaussians_of<T>(in), footprint_options(option), threads,
                                   ids.const_data_ptr<int32_t>(), ids.size(0), splat_offsets.const_data_ptr<int64_t>(),
                                   positions.const_data_ptr<int64_t>(), sums, abs2d, grads,
                                   reinterpret_cast<CameraGrad<T>*>(data_or_null<T>(camera_grads))});
    set_camera_grads(in, needs, camera_grads, out);
  });
  return out;
}

/// The lists of rasterize must fit each other and the image size.
void check_fit(const Tensor& splats, const Tensor& ids, const Tensor& tile_offsets, const Tensor& tile_samples,
               TileGrid grid, bool chosen) {
  TORCH_CHECK_VALUE(ids.numel() == splats.size(0) && tile_offsets.numel() == grid.tiles() + 1 &&
                        tile_samples.numel() == (chosen ? grid.tiles() : 0),
                    "ids, tile_offsets and tile_samples must be outputs of rasterize for these splats and this image "
                    "size, got ids of shape ",
                    shape_of(ids), " and tile_offsets of shape ", shape_of(tile_offsets));
}

ChannelsOutput rasterize_channels_cpu(const Tensor& colors, const Tensor& bg, int64_t image_height, int64_t image_width,
                                      std::string footprint, double, const Tensor& splats, const Tensor& ids,
                                      const Tensor& pairs, const Tensor& tile_offsets, const Tensor& counts,
                                      const Tensor& tile_samples, bool, bool) {
  check_lists(splats, {ids, pairs, tile_offsets, tile_samples});
  check_channels(colors, bg, splats);
  check_image_size(image_height, image_width);
  const TileGrid grid = {int(image_width), int(image_height)};
  Tensor own = splats.clone();
  const Tensor background = bg.contiguous(), image = at::empty({3, image_height, image_width}, colors.options());
  AT_DISPATCH_FLOATING_TYPES(colors.scalar_type(), "rasterize_channels", [&] {
    const Stages<scalar_t>& stages = stages_of<scalar_t>(footprint);
    check_fit(splats, ids, tile_offsets, tile_samples, grid, stages.choose != nullptr);
    own.narrow(1, kSplatColor, 3).copy_(colors.index_select(0, ids));
    stages.blend({own.const_data_ptr<scalar_t>(), pairs.const_data_ptr<int32_t>(),
                  tile_offsets.const_data_ptr<int64_t>(), grid, thread_count(), samples_or_null(tile_samples),
                  background.const_data_ptr<scalar_t>(), image.data_ptr<scalar_t>(), nullptr, nullptr, nullptr});
  });
  const auto none = [](const Tensor& like) { return at::empty({0}, like.options()); };
  return {image, none(colors), none(pairs), none(tile_offsets)};
}

InspectOutput inspect_cpu(const Tensor& splats, const Tensor& ids, const Tensor& pairs, const Tensor& tile_offsets,
                          const Tensor&, const Tensor& tile_samples, int64_t count, int64_t image_height,
                          int64_t image_width, std::string footprint) {
  check_lists(splats, {ids, pairs, tile_offsets, tile_samples});
  check_image_size(image_height, image_width);
  const TileGrid grid = {int(image_width), int(image_height)};
  const auto ints = ids.options();
  const Tensor median = at::empty({image_height, image_width}, ints), dominant = at::empty_like(median),
               touched = at::zeros({count}, ints), largest = at::zeros({count}, ints),
               total = at::zeros({count}, ints.dtype(at::kLong));
  AT_DISPATCH_FLOATING_TYPES(splats.scalar_type(), "inspect", [&] {
    const Stages<scalar_t>& stages = stages_of<scalar_t>(footprint);
    check_fit(splats, ids, tile_offsets, tile_samples, grid, stages.choose != nullptr);
    stages.inspect({splats.const_data_ptr<scalar_t>(), ids.const_data_ptr<int32_t>(), pairs.const_data_ptr<int32_t>(),
                    tile_offsets.const_data_ptr<int64_t>(), grid, thread_count(), samples_or_null(tile_samples),
                    median.data_ptr<int32_t>(), dominant.data_ptr<int32_t>(), touched.data_ptr<int32_t>(),
                    largest.data_ptr<int32_t>(), total.data_ptr<int64_t>()});
  });
  return {median, dominant, touched, largest.view(at::kFloat), total};
}

Tensor footprint_weight_cpu(const Tensor& offset, const Tensor& cov2d, std::string footprint, double option) {
  check_weight_arguments(offset, cov2d, option);
  const Tensor d = offset.contiguous(), c = cov2d.contiguous();
  const Tensor out = at::empty(offset.sizes().slice(0, offset.dim() - 1), offset.options());
  AT_DISPATCH_FLOATING_TYPES(offset.scalar_type(), "footprint_weight", [&] {
    auto task = weight_task<cpu::WeightTask<scalar_t>, scalar_t>(d, c, option);
    task.threads = thread_count();
    task.weights = out.data_ptr<scalar_t>();
    stages_of<scalar_t>(footprint).weight(task);
  });
  return out;
}

std::tuple<Tensor, Tensor> footprint_weight_vjp_cpu(const Tensor& dL_dweight, const Tensor& offset, const Tensor& cov2d,
                                                    std::string footprint, double option) {
  check_weight_arguments(offset, cov2d, option);
  check_weight_gradient(dL_dweight, offset);
  const Tensor g = dL_dweight.contiguous(), d = offset.contiguous(), c = cov2d.contiguous();
  const Tensor dL_doffset = at::empty(offset.sizes(), offset.options()),
               dL_dcov = at::empty(cov2d.sizes(), cov2d.options());
  AT_DISPATCH_FLOATING_TYPES(offset.scalar_type(), "footprint_weight_vjp", [&] {
    auto task = weight_task<cpu::WeightTask<scalar_t>, scalar_t>(d, c, option);
    task.threads = thread_count();
    task.dL_dweights = g.const_data_ptr<scalar_t>();
    task.dL_doffsets = reinterpret_cast<Vec2<scalar_t>*>(dL_doffset.data_ptr<scalar_t>());
    task.dL_dcovs = reinterpret_cast<Sym2<scalar_t>*>(dL_dcov.data_ptr<scalar_t>());
    stages_of<scalar_t>(footprint).weight_vjp(task);
  });
  return {dL_doffset, dL_dcov};
}

TORCH_LIBRARY_IMPL(analytic_rasterizer, CPU, m) {
  m.impl("rasterize", rasterize_cpu);
  m.impl("rasterize_vjp", rasterize_vjp_cpu);
  m.impl("rasterize_stages", rasterize_stages_cpu);
  m.impl("rasterize_channels", rasterize_channels_cpu);
  m.impl("inspect", inspect_cpu);
  m.impl("footprint_weight", footprint_weight_cpu);
  m.impl("footprint_weight_vjp", footprint_weight_vjp_cpu);
}

}  // namespace
}  // namespace ar::ops
