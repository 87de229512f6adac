// The ops `rasterize` and `rasterize_timed` (check, project, bin, blend), `rasterize_vjp` (blend_vjp, project_vjp) and
// `inspect`, which looks at lists of `bin`.
#include <ATen/ops/constant_pad_nd.h>
#include <ATen/ops/empty_like.h>
#include <ATen/ops/tensor.h>
#include <ATen/ops/zeros.h>

#include <vector>

#include "torch/check_tensors.h"
#include "torch/checks.h"
#include "torch/ops.h"
#include "torch/scene_grads.h"
#include "torch/snapshot.h"

namespace ar::ops {
namespace {

/// They walk lists in the order of centres.
constexpr const char* kSummaries = "median_depth, dominant_index and gaussian_stats";

/// Three colours alone lie in the splats; colours, features, depth and inverse depth in rows: `made` by the forward
/// pass, or new.
ChannelTensors channels_of(const RasterizeArguments& a, const Tensor& made) {
  const int64_t colors = a.bg.size(0), depths = int64_t(a.images[kDepth]) + int64_t(a.images[kInverseDepth]);
  const bool three = colors == 3;
  ChannelTensors out;
  out.by_gaussian = true;
  if (!three) out.given = *a.colors_precomp;
  if (a.features) out.given = *a.features;
  out.first_given = three ? 3 : 0;
  out.color_channels = colors + (a.features ? a.features->size(1) : 0);
  out.count = out.color_channels + depths;
  const int64_t extra = out.count - colors;
  out.background = extra > 0 ? at::constant_pad_nd(a.bg, {0, extra}) : a.bg;
  if (extra == 0) {
    out.rows = out.given;
    return out;
  }
  if (three) out.color = 0;
  if (a.images[kDepth]) out.depth = int(out.color_channels);
  if (a.images[kInverseDepth]) out.inverse_depth = int(out.count) - 1;
  out.rows = made;
  if (made.defined()) return out;
  out.rows = at::empty({a.count(), out.count}, a.means3D.options());
  if (out.given.defined()) out.rows.narrow(1, out.first_given, out.given.size(1)).copy_(out.given);
  return out;
}

MeanSums mean_sums_of(const RasterizeArguments& a) {
  if (a.means2D->size(1) == 4) return MeanSums::kAbsolute;
  return a.means2d_z == "sum_abs" ? MeanSums::kAbsolute : a.means2d_z == "sum_norm" ? MeanSums::kNorm : MeanSums::kNone;
}

struct Saved {
  ListTensors lists;
  BlendState state;
  Tensor channels;  ///< Rows that the projection made, or empty.

  explicit Saved(const std::vector<Tensor>& list) {
    TORCH_CHECK_VALUE(list.size() == ListTensors::kMembers + BlendState::kMembers + 1,
                      "saved must be what the forward pass saved with keep=True, got ", list.size(), " tensors");
    lists = from_list<ListTensors>(list, 0);
    state = from_list<BlendState>(list, ListTensors::kMembers);
    channels = list.back();
  }

  /// Raises unless this was saved for these Gaussians and channels.
  void check_scene(const RasterizeArguments& a, const ChannelTensors& needed) const {
    const Tensor& ids = lists.ids;
    const int64_t p = a.count();
    const int32_t* numbers = ids.is_cpu() ? const_pointer<int32_t>(ids) : nullptr;
    // Ids ascend on the CPU. On CUDA, where reading waits, every Gaussian has a splat.
    const bool same_gaussians =
        ids.is_cuda() ? ids.numel() == p : !numbers || (numbers[0] >= 0 && numbers[ids.numel() - 1] < p);
    TORCH_CHECK_VALUE(same_gaussians, "saved must be what the forward pass saved for the same ", p, " Gaussians");
    if (!needed.made_by_projection()) return;
    const std::vector<int64_t> sizes = {p, needed.count};
    TORCH_CHECK_VALUE(channels.sizes() == at::IntArrayRef(sizes) && channels.is_contiguous() &&
                          channels.scalar_type() == a.means3D.scalar_type() && channels.device() == a.means3D.device(),
                      "saved must end with the channels of the forward pass for the same arguments, of shape ",
                      text_of(sizes), ", got ", shape_of(channels));
  }
};

/// Memory for what `inspect` writes of `count` Gaussians or rows.
SummaryTensors make_summary(const Backend& backend, const SummarySwitches& wanted, TileGrid grid, int64_t count,
                            const Tensor& like) {
  const at::TensorOptions options = like.options(), ints = options.dtype(at::kInt);
  const std::vector<int64_t> image = {1, grid.height, grid.width};
  SummaryTensors out;
  if (wanted[kMedianDepth]) out.median = at::empty(image, options);
  if (wanted[kDominantIndex]) out.dominant = at::empty(image, ints);
  if (wanted[kGaussianStats]) {
    for (Tensor* t : {&out.touched, &out.in_front, &out.dominated}) *t = at::zeros({count}, ints);
    out.largest = at::zeros({count}, options.dtype(at::kFloat));
    out.total = at::zeros({count}, options.dtype(at::kLong));
  }
  out.each([&](const char* name, const Tensor& t) {
    if (t.defined()) check_output(backend, name, like);
  });
  return out;
}

std::vector<Tensor> results_of(SummaryTensors summary, at::ScalarType type) {
  if (summary.total.defined()) summary.total = summary.total.to(at::kDouble).mul_(kWeightUnit).to(type);
  std::vector<Tensor> out;
  summary.each([&](const char*, const Tensor& t) {
    if (t.defined()) out.push_back(t);
  });
  return out;
}

/// Appends four times to `seconds`, if given: before project, and of project, bin and blend.
Results run(RasterizeArguments a, std::vector<double>* seconds, bool exact = false) {
  const Snapshot snapshot(a, a.debug, "snapshot_fw.dump");
  return snapshot.guard([&] {
    Pass pass(a, a.means3D);
    pass.keep = a.keep;
    pass.debug = a.debug;
    pass.exact |= exact;
    check(a);
    check_values(a);
    if (any_of(a.summary)) refuse_rays(pass, kSummaries);
    const std::unique_ptr<Backend> backend = make_backend(a.means3D);
    const auto lap = [&] {
      if (seconds) seconds->push_back(backend->lap());
    };
    const ChannelTensors channels = channels_of(a, Tensor());
    const Tensor radii = at::empty({a.count()}, a.means3D.options().dtype(at::kInt));
    lap();
    const SplatTensors splats = backend->project(a, pass, channels, radii);
    lap();
    const ListTensors lists = backend->bin(splats, pass);
    lap();
    const ImageTensors image = make_images(*backend, channels, a.images, pass.grid);
    const SummaryTensors summary = make_summary(*backend, a.summary, pass.grid, a.count(), a.means3D);
    BlendState state = make_state(pass, a.means3D);
    backend->blend(lists, pass, channels, image, state);
    lap();
    if (seconds && !pass.exact && backend->tiles_share_lists(lists)) {  // The caller wants a list for each tile.
      seconds->clear();
      return run(a, seconds, true);
    }
    if (any_of(a.summary)) backend->inspect(lists, pass, splats.depths, &a, summary);
    std::vector<Tensor> images, saved;
    for (const Tensor& other : image.others) {
      if (other.defined()) images.push_back(other);
    }
    if (a.keep || seconds) append_to(saved, lists);
    if (a.keep) {
      append_to(saved, state);
      saved.push_back(or_empty(channels.made_by_projection() ? channels.rows : Tensor(), a.means3D));
    }
    return Results{image.color, images, radii, results_of(summary, a.means3D.scalar_type()), saved};
  });
}

}  // namespace

Results rasterize(RasterizeArguments a) { return run(std::move(a), nullptr); }

Results rasterize_timed(RasterizeArguments a) {
  std::vector<double> seconds;
  Results results = run(std::move(a), &seconds);
  results.push_back(at::tensor({seconds[1], seconds[2], seconds[3]}, at::kDouble));
  return results;
}

Results rasterize_vjp(VjpArguments<RasterizeArguments> arguments) {
  RasterizeArguments& a = arguments.of_op;
  const Snapshot snapshot(arguments, a.debug, "snapshot_bw.dump");
  return snapshot.guard([&] {
    Pass pass(a, a.means3D);
    pass.debug = a.debug;
    check(a);
    const std::vector<bool>& needs = arguments.needs;
    check_needs(needs, kSceneTensors + 2);
    check_camera_needs(needs, a.lens);
    const Saved saved(arguments.saved);
    check_saved(saved.lists, saved.state, a.means3D, pass);
    const ChannelTensors channels = channels_of(a, saved.channels);
    saved.check_scene(a, channels);
    const int64_t height = a.image_height, width = a.image_width;
    ImageTensors dL_dimage;
    dL_dimage.color =
        gradient_of(arguments.dL_doutputs, 0, "dL_dcolor", a.means3D, {channels.color_channels, height, width});
    size_t output = 1;
    for (size_t k = 0; k < kImageCount; ++k) {
      const std::string name = "dL_d" + std::string(name_of(kImageSwitches[k]));
      if (a.images[k])
        dL_dimage.others[k] = gradient_of(arguments.dL_doutputs, output++, name.c_str(), a.means3D, {height, width});
    }

    const MeanSums mean_sums = needs[1] && a.means2D ? mean_sums_of(a) : MeanSums::kNone;
    // Before blend_vjp, beside which zero_culled_grads writes them: the device still uses what it frees. And before the
    // backend, whose destructor waits.
    Grads grads = make_grads(a, needs);
    grads.mean_sums = mean_sums;
    const std::unique_ptr<Backend> backend = make_backend(a.means3D);
    backend->zero_culled_grads(a, saved.lists, pass, grads);
    const PairSums sums = backend->blend_vjp(saved.lists, saved.state, pass, channels, dL_dimage, mean_sums);
    const Tensor camera = backend->project_vjp(a, saved.lists, pass, sums, channels, grads);
    if (grads.with_camera) set_camera_grads(*backend, camera, needs, grads);
    Tensor background, features;
    if (channels.given.defined() && needs[a.features ? kSceneTensors + 1 : 4]) {
      Tensor& grad = a.features ? features : grads.colors_precomp;
      grad = sums.dL_dchannels.narrow(1, channels.first_given, channels.given.size(1)).contiguous();
    }
    if (needs[kSceneTensors]) background = background_grad(dL_dimage.color, a.bg, saved.state, pass.grid);
    std::vector<Tensor> list = list_of(grads, a.means3D);
    list.push_back(or_empty(background, a.means3D));
    list.push_back(or_empty(features, a.means3D));
    return Results{list};
  });
}

Results inspect(InspectArguments a) {
  TORCH_CHECK_VALUE(a.lists.size() == ListTensors::kMembers,
                    "lists must be the output of list_tiles for one camera, got ", a.lists.size(), " tensors");
  const ListTensors lists = from_list<ListTensors>(a.lists, 0);
  const Pass pass(a, lists.splats);
  refuse_rays(pass, kSummaries);
  check(a, lists, pass);
  const std::unique_ptr<Backend> backend = make_backend(lists.splats);
  const SummaryTensors summary = make_summary(*backend, a.summary, pass.grid, a.count(), lists.splats);
  const Tensor depths = lists.splats.is_cuda() ? a.depths : a.depths.index_select(0, lists.ids);
  if (any_of(a.summary)) backend->inspect(lists, pass, depths, nullptr, summary);
  return {results_of(summary, lists.splats.scalar_type())};
}

}  // namespace ar::ops
