#include "torch/recipe.h"

#include <torch/csrc/jit/serialization/pickle.h>

#include <algorithm>
#include <cstdio>

#include "core/camera.h"
#include "torch/checks.h"

namespace ar::ops {
namespace {

std::unique_ptr<Backend> make_backend(const Tensor& like) {
#if defined(AR_WITH_CUDA)
  if (like.is_cuda()) return make_cuda_backend(like);
#endif
  return make_cpu_backend(like);
}

TileGrid grid_of(int64_t height, int64_t width) { return {int(width), int(height)}; }

/// Copies the arguments of an op before it runs, if it is being debugged, and writes them to a file if it fails: after
/// an error the device may give nothing back.
class Snapshot {
 public:
  template <class Arguments> Snapshot(Arguments& arguments, bool debug, const char* path) : path_(path) {
    if (!debug) return;
    copy_.emplace(c10::StringType::get(), c10::AnyType::get());
    arguments.each([&](const char* declaration, auto& value) {
      const std::string text = declaration;
      const size_t first = text.find(' ') + 1;
      copy_->insert(text.substr(first, text.find('=') - first), copy_of(value));
    });
  }
  /// Runs `work`; where it throws, writes the file first.
  template <class Work> auto guard(const Work& work) const {
    try {
      return work();
    } catch (...) {
      if (copy_) write();
      throw;
    }
  }

 private:
  static IValue copy_of(const Tensor& t) { return t.defined() ? IValue(t.detach().cpu()) : IValue(); }
  static IValue copy_of(const OptionalTensor& t) { return t ? copy_of(*t) : IValue(); }
  static IValue copy_of(const std::vector<Tensor>& list) {
    c10::List<Tensor> copies;
    for (const Tensor& t : list) copies.push_back(t.detach().cpu());
    return copies;
  }
  static IValue copy_of(const std::vector<OptionalTensor>& list) {
    c10::List<OptionalTensor> copies;
    for (const OptionalTensor& t : list) copies.push_back(t ? OptionalTensor(t->detach().cpu()) : std::nullopt);
    return copies;
  }
  static IValue copy_of(const std::vector<bool>& list) {
    c10::List<bool> copies;
    for (const bool b : list) copies.push_back(b);
    return copies;
  }
  template <class Value> static IValue copy_of(const Value& value) { return IValue(value); }

  void write() const {
    const std::vector<char> bytes = torch::jit::pickle_save(IValue(*copy_));
    if (std::FILE* file = std::fopen(path_, "wb")) {
      std::fwrite(bytes.data(), 1, bytes.size(), file);
      std::fclose(file);
    }
  }

  const char* path_;
  std::optional<c10::impl::GenericDict> copy_;
};

/// Which channels are blended: the colours, then depth and inverse depth, if they are asked for.
struct ChannelPlan {
  int64_t color_channels;
  ChannelTensors channels;
  ChannelColumns columns;
  Tensor background;

  /// `made`: the rows as the forward pass saved them, or undefined: make room for them.
  ChannelPlan(const RasterizeArguments& a, Tensor made) {
    const int64_t count = a.count(), extra = int64_t(a.depth) + int64_t(a.inverse_depth);
    color_channels = a.bg.size(0);
    channels.count = color_channels + extra;
    channels.by_gaussian = true;
    background = a.bg;
    if (extra > 0) background = at::constant_pad_nd(a.bg, {0, extra});
    if (color_channels == 3 && extra == 0) return;
    if (extra == 0) {
      channels.rows = *a.colors_precomp;
      return;
    }
    channels.rows = made;
    if (color_channels == 3) columns.color = 0;
    channels.all_made = columns.color == 0;
    if (a.depth) columns.depth = int(color_channels);
    if (a.inverse_depth) columns.inverse_depth = int(channels.count) - 1;
    if (made.defined()) return;
    channels.rows = at::empty({count, channels.count}, a.means3D.options());
    if (color_channels != 3) channels.rows.narrow(1, 0, color_channels).copy_(*a.colors_precomp);
  }
  bool makes_rows() const { return columns.color >= 0 || columns.depth >= 0 || columns.inverse_depth >= 0; }
};

/// Everything that the adjoint of a rasterization needs.
struct Saved {
  ListTensors lists;
  BlendState state;
  Tensor channels;  ///< the rows of ChannelPlan that the projection made, or empty

  explicit Saved(const std::vector<Tensor>& list) {
    TORCH_CHECK_VALUE(list.size() == ListTensors::kMembers + BlendState::kMembers + 1,
                      "saved must be what the forward pass saved with keep=True, got ", list.size(), " tensors");
    lists = from_list<ListTensors>(list, 0);
    state = from_list<BlendState>(list, ListTensors::kMembers);
    channels = list.back();
  }
};

bool any_of(const std::vector<bool>& needs, size_t first, size_t count) {
  return std::find(needs.begin() + first, needs.begin() + first + count, true) != needs.begin() + first + count;
}

void check_needs(const std::vector<bool>& needs, size_t count) {
  TORCH_CHECK_VALUE(needs.size() == count, "needs must have ", count, " members, got ", needs.size());
}
/// Without a lens there are no gradients with respect to the four tensors of the camera, which begin at `first`.
void check_camera_needs(const std::vector<bool>& needs, size_t first, const OptionalTensor& lens) {
  TORCH_CHECK_VALUE(lens || !any_of(needs, first, 4),
                    "lens must be given where viewmatrix, projmatrix or campos requires a gradient, got None");
}

/// The tensors of Inputs, in the order of Grads.
constexpr size_t kGaussianTensors = 8, kCameraTensors = 4, kInputTensors = kGaussianTensors + kCameraTensors;

/// Room for the gradients with respect to the Gaussians.
Grads make_grads(const Inputs& in, const std::vector<bool>& needs) {
  Grads grads;
  const auto make = [&](Tensor& grad, const OptionalTensor& like, bool needed) {
    if (needed && like) grad = at::empty_like(*like, at::MemoryFormat::Contiguous);
  };
  make(grads.means3D, in.means3D, needs[0]);
  make(grads.means2D, in.means2D, needs[1]);
  make(grads.opacities, in.opacities, needs[2]);
  make(grads.shs, in.shs, needs[3]);
  if (in.colors_precomp && in.colors_precomp->size(1) == 3) make(grads.colors_precomp, in.colors_precomp, needs[4]);
  make(grads.scales, in.scales, needs[5]);
  make(grads.rotations, in.rotations, needs[6]);
  make(grads.cov3D_precomp, in.cov3D_precomp, needs[7]);
  return grads;
}

/// What the gradient with respect to means2D holds besides itself.
MeanSums mean_sums_of(const RasterizeArguments& a) {
  if (a.means2D->size(1) == 4) return MeanSums::kAbsolute;
  return a.means2d_z == "sum_abs" ? MeanSums::kAbsolute : a.means2d_z == "sum_norm" ? MeanSums::kNorm : MeanSums::kNone;
}

/// Adds up parts of CameraGrad, in double and always in the same order, and writes what is wanted.
void set_camera_grads(const Tensor& parts, const std::vector<bool>& needs, Grads& grads) {
  const Tensor sum = parts.sum(0, false, at::kDouble).to(parts.scalar_type());
  const auto rows = [&](int64_t first, int64_t count) { return sum.narrow(0, first, 4 * count).view({count, 4}); };
  const auto matrix = [&](Tensor first, Tensor last) {  // with a row of zeros between
    return at::cat({first, at::zeros({4 - first.size(0) - last.size(0), 4}, sum.options()), last}).t().contiguous();
  };
  if (needs[8]) grads.viewmatrix = matrix(rows(0, 3), rows(12, 0));
  if (needs[9]) grads.projmatrix = matrix(rows(12, 2), rows(20, 1));
  if (needs[10]) grads.campos = sum.narrow(0, 24, 3).clone();
  if (needs[11]) grads.lens = sum.narrow(0, 27, kLensWidth).clone();
}

/// As a list: an empty tensor stands for one that is not wanted.
std::vector<Tensor> list_of(Grads grads, const Tensor& like) {
  std::vector<Tensor> list;
  grads.each([&](Tensor& t) { list.push_back(t.defined() ? t : at::empty({0}, like.options())); });
  return list;
}

/// Mean transmittance of every pixel's samples, (H, W). A tile of `adaptive` uses the first of them only.
Tensor mean_transmittance(const BlendState& state, const ListTensors& lists, TileGrid grid) {
  if (lists.tile_samples.numel() == 0) return state.transmittance.mean(0);
  const Tensor samples = lists.tile_samples.view({grid.rows(), grid.columns()})
                             .repeat_interleave(kTile, 0)
                             .repeat_interleave(kTile, 1)
                             .slice(0, 0, grid.height)
                             .slice(1, 0, grid.width);
  const Tensor number = at::arange(state.transmittance.size(0), samples.options()).view({-1, 1, 1});
  return at::where(number.lt(samples), state.transmittance, at::zeros({}, state.transmittance.options())).sum(0) /
         samples;
}

/// Gradient with respect to a background: it shows through what no splat covers.
Tensor background_grad(const Tensor& dL_dcolor, const BlendState& state, const ListTensors& lists, TileGrid grid) {
  return (dL_dcolor * mean_transmittance(state, lists, grid)).sum(at::IntArrayRef({1, 2}));
}

/// The gradient with respect to a differentiable output, if there is one.
Tensor given(const std::vector<OptionalTensor>& gradients, size_t place) {
  return place < gradients.size() && gradients[place] ? *gradients[place] : Tensor();
}

}  // namespace

Rasterized rasterize(RasterizeArguments a, std::vector<double>* seconds) {
  const Snapshot snapshot(a, a.debug, "snapshot_fw.dump");
  return snapshot.guard([&] {
    const FootprintSpec footprint = find_footprint(a.footprint, a.option);
    check(a);
    check_values(a);
    const TileGrid grid = grid_of(a.image_height, a.image_width);
    const PassOptions options = {a.keep, a.alpha, a.debug, at::globalContext().deterministicAlgorithms()};
    const std::unique_ptr<Backend> backend = make_backend(a.means3D);
    const ChannelPlan plan(a, Tensor());
    const auto lap = [&] {
      if (seconds) seconds->push_back(backend->lap());
    };
    Rasterized out;
    lap();
    const SplatTensors splats = backend->project(a, footprint, plan.channels, plan.columns, out.radii);
    lap();
    const ListTensors lists = backend->bin(splats, footprint, grid, plan.background, options);
    lap();
    BlendState state;
    const ImageTensors image =
        backend->blend(lists, footprint, grid, plan.channels, plan.color_channels, plan.background, options, state);
    lap();
    out.color = image.color;
    if (a.alpha) out.images.push_back(image.alpha);
    out.images.insert(out.images.end(), image.extra.begin(), image.extra.end());
    if (a.keep) {
      append_to(out.saved, lists);
      append_to(out.saved, state);
      out.saved.push_back(plan.makes_rows() ? plan.channels.rows : at::empty({0}, a.means3D.options()));
    } else if (seconds) {
      append_to(out.saved, lists);
    }
    return out;
  });
}

std::vector<Tensor> rasterize_vjp(VjpArguments<RasterizeArguments> arguments) {
  RasterizeArguments& a = arguments.of_op;
  const Snapshot snapshot(arguments, a.debug, "snapshot_bw.dump");
  return snapshot.guard([&] {
    const FootprintSpec footprint = find_footprint(a.footprint, a.option);
    check(a);
    const std::vector<bool>& needs = arguments.needs;
    check_needs(needs, kInputTensors + 1);
    check_camera_needs(needs, kGaussianTensors, a.lens);
    const Saved saved(arguments.saved);
    const TileGrid grid = grid_of(a.image_height, a.image_width);
    check_saved(saved.lists, saved.state, a.means3D, footprint, grid);
    const ChannelPlan plan(a, saved.channels);

    ImageTensors dL_dimage;
    dL_dimage.color_channels = plan.color_channels;
    size_t place = 0;
    const auto next = [&](const char* name, std::initializer_list<int64_t> sizes) {
      Tensor gradient = given(arguments.dL_doutputs, place++);
      if (gradient.defined()) check_gradient(gradient, name, a.means3D, sizes);
      return gradient;
    };
    dL_dimage.color = next("dL_dcolor", {plan.color_channels, a.image_height, a.image_width});
    if (a.alpha) dL_dimage.alpha = next("dL_dalpha", {a.image_height, a.image_width});
    if (a.depth) dL_dimage.extra.push_back(next("dL_ddepth", {a.image_height, a.image_width}));
    if (a.inverse_depth) dL_dimage.extra.push_back(next("dL_dinverse_depth", {a.image_height, a.image_width}));

    const std::unique_ptr<Backend> backend = make_backend(a.means3D);
    Grads grads = make_grads(a, needs);
    if (grads.means2D.defined()) grads.mean_sums = mean_sums_of(a);
    const bool with_camera = a.lens && any_of(needs, kGaussianTensors, kCameraTensors);
    const PairSums sums = backend->blend_vjp(saved.lists, saved.state, footprint, grid, plan.channels, plan.background,
                                             dL_dimage, grads.mean_sums, a.debug);
    const Tensor camera =
        backend->project_vjp(a, saved.lists, footprint, sums, plan.columns, grads, with_camera, a.debug);
    if (with_camera) set_camera_grads(camera, needs, grads);
    if (needs[4] && plan.color_channels != 3) {
      const Tensor& all = sums.dL_dchannels;
      grads.colors_precomp =
          all.size(1) == plan.color_channels ? all : all.narrow(1, 0, plan.color_channels).contiguous();
    }
    std::vector<Tensor> list = list_of(grads, a.means3D);
    list.push_back(!needs[kInputTensors]       ? at::empty({0}, a.means3D.options())
                   : dL_dimage.color.defined() ? background_grad(dL_dimage.color, saved.state, saved.lists, grid)
                                               : at::zeros_like(a.bg));
    return list;
  });
}

Projected project(ProjectArguments a) {
  const FootprintSpec footprint = find_footprint(a.footprint, a.option);
  const int64_t cameras = check_cameras(a);
  Projected out;
  std::vector<Tensor> means2d, cov2d, opacities, depths, colors, dets, radii, ids, camera_ids;
  out.row_splits = at::zeros({cameras + 1}, at::kLong);
  const bool with_colors = a.shs || a.colors_precomp;
  for (int64_t c = 0; c < cameras; ++c) {
    Inputs in = inputs_of(a, c);
    check(in);
    check_values(in, false);
    const std::unique_ptr<Backend> backend = make_backend(in.means3D);
    Tensor all_radii;
    const RowTensors rows = backend->project_rows(in, footprint, all_radii);
    const Tensor kept = all_radii.gt(0).nonzero().select(1, 0);
    const auto pick = [&](std::vector<Tensor>& to, const Tensor& of_all) {
      to.push_back(of_all.index_select(0, kept));
    };
    pick(means2d, rows.means2d);
    pick(cov2d, rows.cov2d);
    pick(dets, rows.dets);
    pick(opacities, rows.opacities);
    pick(depths, rows.depths);
    if (with_colors) pick(colors, rows.colors);
    pick(radii, all_radii);
    ids.push_back(kept.to(at::kInt));
    camera_ids.push_back(at::full_like(ids.back(), c));
    int64_t* splits = out.row_splits.data_ptr<int64_t>();
    splits[c + 1] = splits[c] + kept.size(0);
  }
  const auto join = [&](const std::vector<Tensor>& parts, std::initializer_list<int64_t> rest, at::ScalarType dtype) {
    std::vector<int64_t> sizes = {0};
    sizes.insert(sizes.end(), rest);
    return parts.empty()       ? at::empty(sizes, a.means3D.options().dtype(dtype))
           : parts.size() == 1 ? parts[0]
                               : at::cat(parts);
  };
  const at::ScalarType floats = a.means3D.scalar_type();
  out.means2d = join(means2d, {2}, floats);
  out.cov2d = join(cov2d, {3}, floats);
  out.opacities = join(opacities, {}, floats);
  out.depths = join(depths, {}, floats);
  out.colors = join(colors, {3}, floats);
  out.radii = join(radii, {}, at::kInt);
  out.gaussian_ids = join(ids, {}, at::kInt);
  out.camera_ids = join(camera_ids, {}, at::kInt);
  // The ids again for the adjoint, which takes what was saved.
  out.saved = {join(dets, {}, floats), out.gaussian_ids.clone(), out.row_splits.clone()};
  return out;
}

std::vector<Tensor> project_vjp(VjpArguments<ProjectArguments> arguments) {
  const ProjectArguments& a = arguments.of_op;
  const int64_t cameras = check_cameras(a);
  const std::vector<bool>& needs = arguments.needs;
  check_needs(needs, 11);
  check_camera_needs(needs, 7, a.lens);
  TORCH_CHECK_VALUE(arguments.saved.size() == 3, "saved must be what project saved, got ", arguments.saved.size(),
                    " tensors");
  const Tensor ids = arguments.saved[1], splits = arguments.saved[2];
  const int64_t n = ids.numel(), count = a.means3D.size(0);
  TORCH_CHECK_VALUE(splits.numel() == cameras + 1 && splits.device().is_cpu() && splits.scalar_type() == at::kLong &&
                        ids.scalar_type() == at::kInt && splits[-1].item<int64_t>() == n &&
                        (n == 0 || (ids.min().item<int64_t>() >= 0 && ids.max().item<int64_t>() < count)),
                    "saved must be what project saved for the same arguments");
  const auto options = a.means3D.options();
  const auto gradient = [&](size_t place, const char* name, std::vector<int64_t> sizes) {
    Tensor t = given(arguments.dL_doutputs, place);
    if (!t.defined()) return at::zeros(sizes, options);
    check_gradient(t, name, a.means3D, sizes);
    return t;
  };
  const bool with_colors = a.shs || a.colors_precomp;
  RowTensors dL_drows;
  dL_drows.means2d = gradient(0, "dL_dmeans2d", {n, 2});
  dL_drows.cov2d = gradient(1, "dL_dcov2d", {n, 3});
  dL_drows.opacities = gradient(2, "dL_dopacities", {n});
  dL_drows.depths = gradient(3, "dL_ddepths", {n});
  if (with_colors) dL_drows.colors = gradient(4, "dL_dcolors", {n, 3});
  // Needs in the order of Inputs: without means2D.
  std::vector<bool> of_inputs = {needs[0], false};
  of_inputs.insert(of_inputs.end(), needs.begin() + 1, needs.end());
  std::vector<Tensor> total;
  std::vector<std::vector<Tensor>> of_cameras(kCameraTensors);
  for (int64_t c = 0; c < cameras; ++c) {
    Inputs in = inputs_of(a, c);
    check(in);
    const std::unique_ptr<Backend> backend = make_backend(in.means3D);
    const int64_t first = splits[c].item<int64_t>(), last = splits[c + 1].item<int64_t>();
    const Tensor rows = at::full({count}, -1, ids.options());
    rows.index_put_({ids.slice(0, first, last).to(at::kLong)}, at::arange(first, last, ids.options()));
    Grads grads = make_grads(in, of_inputs);
    const bool with_camera = in.lens && any_of(of_inputs, kGaussianTensors, kCameraTensors);
    const Tensor camera = backend->project_rows_vjp(in, rows, dL_drows, grads, with_camera);
    if (with_camera) set_camera_grads(camera, of_inputs, grads);
    const std::vector<Tensor> list = list_of(grads, in.means3D);
    for (size_t k = 0; k < kCameraTensors; ++k) of_cameras[k].push_back(list[kGaussianTensors + k]);
    if (c == 0) {
      total = list;
    } else {
      for (size_t k = 0; k < kGaussianTensors; ++k) total[k].add_(list[k]);
    }
  }
  std::vector<Tensor> out;
  const OptionalTensor inputs[] = {a.means3D, a.opacities, a.shs,          a.colors_precomp,
                                   a.scales,  a.rotations, a.cov3D_precomp};
  const size_t places[] = {0, 2, 3, 4, 5, 6, 7};
  for (size_t k = 0; k < 7; ++k) {
    const bool wanted = needs[k] && inputs[k];
    out.push_back(!wanted        ? at::empty({0}, options)
                  : cameras == 0 ? at::zeros_like(*inputs[k])
                                 : total[places[k]].view_as(*inputs[k]));
  }
  const Tensor matrices[] = {a.viewmatrix, a.projmatrix, a.campos, a.lens ? *a.lens : Tensor()};
  for (size_t k = 0; k < kCameraTensors; ++k) {
    const bool wanted = needs[7 + k] && a.lens;
    out.push_back(!wanted        ? at::empty({0}, options)
                  : cameras == 0 ? at::zeros_like(matrices[k])
                                 : at::stack(of_cameras[k]));
  }
  return out;
}

std::vector<Tensor> bin(BinArguments a) {
  const FootprintSpec footprint = find_footprint(a.footprint, a.option);
  check(a);
  TORCH_CHECK_VALUE(!footprint.chosen || a.colors,
                    "colors must be given for the footprint adaptive, which chooses samples by them, got None");
  const TileGrid grid = grid_of(a.image_height, a.image_width);
  const int64_t* splits = a.row_splits.const_data_ptr<int64_t>();
  std::vector<Tensor> out;
  for (int64_t c = 0; c + 1 < a.row_splits.size(0); ++c) {
    const std::unique_ptr<Backend> backend = make_backend(a.means2d);
    const auto part = [&](const Tensor& t) { return t.slice(0, splits[c], splits[c + 1]); };
    RowTensors rows;
    rows.means2d = part(a.means2d);
    rows.cov2d = part(a.cov2d);
    rows.dets = part(a.dets);
    rows.opacities = part(a.opacities);
    rows.depths = part(a.depths);
    if (a.colors) rows.colors = part(*a.colors);
    PassOptions options = {};
    options.keep = a.keep;
    options.exact = at::globalContext().deterministicAlgorithms();
    append_to(out, backend->bin(backend->shape_rows(rows, footprint, grid), footprint, grid, *a.background, options));
  }
  return out;
}

namespace {

/// The part of a blending that one camera has.
struct CameraPart {
  ListTensors lists;
  RowTensors rows;
  ChannelTensors channels;
  Tensor background;

  CameraPart(const BlendArguments& a, int64_t c) {
    const int64_t* splits = a.row_splits.const_data_ptr<int64_t>();
    const int64_t first = splits[c], last = splits[c + 1];
    lists = from_list<ListTensors>(a.lists, size_t(c) * ListTensors::kMembers);
    rows.means2d = a.means2d.slice(0, first, last);
    rows.cov2d = a.cov2d.slice(0, first, last);
    rows.dets = a.dets.slice(0, first, last);
    rows.opacities = a.opacities.slice(0, first, last);
    channels.rows = a.features.slice(0, first, last);
    channels.by_gaussian = false;
    channels.count = a.features.size(1);
    background = a.background[c];
  }
};

}  // namespace

Blended blend(BlendArguments a) {
  const FootprintSpec footprint = find_footprint(a.footprint, a.option);
  check(a, footprint);
  const TileGrid grid = grid_of(a.image_height, a.image_width);
  const int64_t cameras = a.row_splits.size(0) - 1, channels = a.features.size(1);
  std::vector<Tensor> images, alphas;
  Blended out;
  for (int64_t c = 0; c < cameras; ++c) {
    const std::unique_ptr<Backend> backend = make_backend(a.means2d);
    const CameraPart part(a, c);
    PassOptions options = {};
    options.keep = a.keep;
    options.alpha = true;
    BlendState state;
    const ImageTensors image =
        backend->blend(part.lists, footprint, grid, part.channels, channels, part.background, options, state);
    images.push_back(image.color);
    alphas.push_back(image.alpha);
    if (a.keep) append_to(out.saved, state);
  }
  const auto options = a.means2d.options();
  out.image = cameras ? at::stack(images) : at::empty({0, channels, a.image_height, a.image_width}, options);
  out.alpha = cameras ? at::stack(alphas) : at::empty({0, a.image_height, a.image_width}, options);
  return out;
}

std::vector<Tensor> blend_vjp(VjpArguments<BlendArguments> arguments) {
  BlendArguments& a = arguments.of_op;
  const FootprintSpec footprint = find_footprint(a.footprint, a.option);
  check(a, footprint);
  const std::vector<bool>& needs = arguments.needs;
  check_needs(needs, 8);
  const TileGrid grid = grid_of(a.image_height, a.image_width);
  const int64_t cameras = a.row_splits.size(0) - 1, channels = a.features.size(1);
  TORCH_CHECK_VALUE(int64_t(arguments.saved.size()) == cameras * int64_t(BlendState::kMembers),
                    "saved must be what blend saved with keep=True, got ", arguments.saved.size(), " tensors");
  Tensor dL_dimage = given(arguments.dL_doutputs, 0), dL_dalpha = given(arguments.dL_doutputs, 1);
  const int64_t height = a.image_height, width = a.image_width;
  if (dL_dimage.defined()) check_gradient(dL_dimage, "dL_dimage", a.means2d, {cameras, channels, height, width});
  if (dL_dalpha.defined()) check_gradient(dL_dalpha, "dL_dalpha", a.means2d, {cameras, height, width});
  const auto options = a.means2d.options();
  const bool absolute = needs[5] && a.means2d_abs;
  std::vector<Tensor> means2d, cov2d, opacities, features, backgrounds, sums_abs;
  for (int64_t c = 0; c < cameras; ++c) {
    const std::unique_ptr<Backend> backend = make_backend(a.means2d);
    const CameraPart part(a, c);
    const auto state = from_list<BlendState>(arguments.saved, size_t(c) * BlendState::kMembers);
    check_saved(part.lists, state, a.means2d, footprint, grid);
    ImageTensors gradient;
    gradient.color_channels = channels;
    if (dL_dimage.defined()) gradient.color = dL_dimage[c];
    if (dL_dalpha.defined()) gradient.alpha = dL_dalpha[c];
    const PairSums sums = backend->blend_vjp(part.lists, state, footprint, grid, part.channels, part.background,
                                             gradient, absolute ? MeanSums::kAbsolute : MeanSums::kNone, false);
    const RowTensors rows = backend->row_grads(part.rows, part.lists, footprint, sums);
    means2d.push_back(rows.means2d);
    cov2d.push_back(rows.cov2d);
    opacities.push_back(rows.opacities);
    if (absolute) sums_abs.push_back(rows.absolute);
    features.push_back(sums.dL_dchannels);
    if (needs[4]) {
      backgrounds.push_back(dL_dimage.defined() ? background_grad(gradient.color, state, part.lists, grid)
                                                : at::zeros({channels}, options));
    }
  }
  const auto join = [&](bool wanted, const std::vector<Tensor>& parts, const Tensor& like) {
    return !wanted ? at::empty({0}, options) : parts.empty() ? at::zeros_like(like) : at::cat(parts);
  };
  const Tensor none = at::empty({0}, options);
  return {join(needs[0], means2d, a.means2d),
          join(needs[1], cov2d, a.cov2d),
          join(needs[2], opacities, a.opacities),
          join(needs[3], features, a.features),
          !needs[4]      ? none
          : cameras == 0 ? at::zeros_like(a.background)
                         : at::stack(backgrounds),
          join(absolute, sums_abs, a.means2d),
          needs[6] ? at::zeros_like(a.dets) : none.clone(),  // what depends on dets is in cov2d's
          none.clone()};
}

std::vector<Tensor> inspect(InspectArguments a) {
  const FootprintSpec footprint = find_footprint(a.footprint, a.option);
  const ListTensors lists = Saved(a.saved).lists;
  check(a, lists, footprint);
  return make_backend(lists.splats)->inspect(lists, footprint, grid_of(a.image_height, a.image_width), a.count);
}

Tensor footprint_weight(WeightArguments a) {
  const FootprintSpec footprint = find_footprint(a.footprint, a.option);
  check(a);
  return make_backend(a.offset)->weight(a.offset, a.cov2d, footprint);
}

std::vector<Tensor> footprint_weight_vjp(VjpArguments<WeightArguments> arguments) {
  WeightArguments& a = arguments.of_op;
  const FootprintSpec footprint = find_footprint(a.footprint, a.option);
  check(a);
  check_needs(arguments.needs, 2);
  Tensor dL_dweight = given(arguments.dL_doutputs, 0);
  TORCH_CHECK_VALUE(dL_dweight.defined(), "dL_doutputs must hold the gradient with respect to the weight, got none");
  check_gradient(dL_dweight, "dL_dweight", a.offset, a.offset.sizes().slice(0, a.offset.dim() - 1));
  const auto [dL_doffset, dL_dcov] = make_backend(a.offset)->weight_vjp(dL_dweight, a.offset, a.cov2d, footprint);
  return {dL_doffset, dL_dcov};
}

}  // namespace ar::ops
