// The stages on CPU tensors, in float32 and float64.
//
// Arguments have been checked (checks.h). What is relied on here: tensors are contiguous, on the CPU and of one
// floating type; lists and state fit each other, the splats and the image; `count` of inspect exceeds every id. What
// lists contain is an earlier stage's own and is not looked at.
#include <ATen/Parallel.h>
#if defined(__unix__) || defined(__APPLE__)
#include <pthread.h>
#endif

#include <algorithm>
#include <chrono>
#include <utility>

#include "cpu/stages.h"
#include "torch/views.h"

namespace ar::ops {
namespace {

bool is_forked = false;
#if defined(__unix__) || defined(__APPLE__)
[[maybe_unused]] const int kWatchesForks = pthread_atfork(nullptr, nullptr, [] { is_forked = true; });
#endif

/// Threads of a loop: as many as torch's, but one in a forked child. fork() leaves the threads of OpenMP's pool
/// behind, and libgomp would wait for them forever.
int thread_count() { return is_forked ? 1 : at::get_num_threads(); }

template <class Element, typename T> const Element* elements_of(const Tensor& t) {
  return reinterpret_cast<const Element*>(const_data_or_null<T>(t));
}
template <class Element, typename T> Element* elements_of(Tensor& t) {
  return reinterpret_cast<Element*>(data_or_null<T>(t));
}

cpu::TileLists tile_lists_of(const ListTensors& lists) {
  cpu::TileLists out;
  out.pairs = const_data_or_null<int32_t>(lists.pairs);
  out.tile_offsets = lists.tile_offsets.const_data_ptr<int64_t>();
  out.tile_samples = const_data_or_null<int32_t>(lists.tile_samples);
  return out;
}

cpu::SplatPairs splat_pairs_of(const ListTensors& lists) {
  cpu::SplatPairs out;
  out.splats = lists.ids.numel();
  out.ids = const_data_or_null<int32_t>(lists.ids);
  out.splat_offsets = lists.splat_offsets.const_data_ptr<int64_t>();
  out.positions = const_data_or_null<int64_t>(lists.positions);
  return out;
}

template <typename T> Channels<T> channels_of(const ChannelTensors& channels, const ListTensors& lists) {
  Channels<T> out = {};
  out.count = int(channels.count);
  if (channels.rows.defined()) {
    out.data = const_data_or_null<T>(channels.rows);
    out.stride = channels.count;
    out.ids = channels.by_gaussian ? const_data_or_null<int32_t>(lists.ids) : nullptr;
  } else if (lists.splats.numel()) {
    out.data = lists.splats.const_data_ptr<T>() + kSplatColor;
    out.stride = kSplatWidth;
  }
  return out;
}

/// Tiles of an image of 268 million pixels: to write numbers for more of them takes a second or longer.
constexpr int64_t kManyTiles = int64_t(1) << 20;

/// Members that are undefined become null.
template <typename T> ProjectedRows<T> projected_rows_of(RowTensors rows) {
  ProjectedRows<T> out;
  out.means2d = elements_of<Vec2<T>, T>(rows.means2d);
  out.cov2d = elements_of<Sym2<T>, T>(rows.cov2d);
  out.dets = data_or_null<T>(rows.dets);
  out.opacities = data_or_null<T>(rows.opacities);
  out.depths = data_or_null<T>(rows.depths);
  out.colors = elements_of<Vec3<T>, T>(rows.colors);
  return out;
}

template <typename T> class CpuBackend final : public Backend {
 public:
  explicit CpuBackend(const at::TensorOptions& options)
      : floats_(options), ints_(options.dtype(at::kInt)), longs_(options.dtype(at::kLong)) {}

  SplatTensors project(const Inputs& in, const FootprintSpec& footprint, const ChannelTensors& channels,
                       ChannelColumns columns, Tensor& radii) override {
    const int64_t chunks = cpu::chunks_of(in.count());
    std::vector<int64_t> offsets(chunks + 1, 0);
    std::vector<uint8_t> candidates(in.count());
    radii = at::empty({in.count()}, ints_);
    cpu::ProjectParams<T> p = {};
    set_projection(p, in, footprint, radii);
    p.channels = channel_rows<T>(channels, columns);
    p.candidates = candidates.data();
    p.chunk_offsets = offsets.data();
    const cpu::CameraStages<T>& stages = stages_of(footprint).of(p.camera);
    stages.count_candidates(p);
    int64_t count = 0;
    for (int64_t& offset : offsets) count += std::exchange(offset, count);
    SplatTensors out;
    out.splats = at::empty({count, kSplatWidth}, floats_);
    out.ids = at::empty({count}, ints_);
    out.depths = at::empty({count}, floats_);
    p.splats = data_or_null<T>(out.splats);
    p.ids = data_or_null<int32_t>(out.ids);
    p.depths = data_or_null<T>(out.depths);
    stages.project(p);
    return out;
  }

  RowTensors project_rows(const Inputs& in, const FootprintSpec& footprint, Tensor& radii) override {
    const int64_t n = in.count();
    radii = at::empty({n}, ints_);
    RowTensors out;
    out.means2d = at::empty({n, 2}, floats_);
    out.cov2d = at::empty({n, 3}, floats_);
    out.dets = at::empty({n}, floats_);
    out.opacities = at::empty({n}, floats_);
    out.depths = at::empty({n}, floats_);
    cpu::ProjectRowsParams<T> p = {};
    set_projection(p, in, footprint, radii);
    if (in.shs || in.colors_precomp) out.colors = at::empty({n, 3}, floats_);
    p.rows = projected_rows_of<T>(out);
    stages_of(footprint).of(p.camera).project_rows(p);
    return out;
  }

  SplatTensors shape_rows(const RowTensors& rows, const FootprintSpec& footprint, TileGrid grid) override {
    const int64_t n = rows.means2d.size(0);
    SplatTensors out;
    out.splats = at::empty({n, kSplatWidth}, floats_);
    out.ids = at::arange(n, ints_);
    out.depths = rows.depths;
    cpu::ShapeRowsParams<T> p = {};
    p.n = n;
    p.rows = projected_rows_of<T>(rows);
    p.footprint = footprint.choice;
    p.grid = grid;
    p.threads = thread_count();
    p.splats = data_or_null<T>(out.splats);
    stages_of(footprint).shape_rows(p);
    return out;
  }

  ListTensors bin(const SplatTensors& splats, const FootprintSpec& footprint, TileGrid grid, const Tensor& background,
                  PassOptions options) override {
    // An image that cannot be made raises here, before numbers are written for every one of its tiles.
    if (grid.tiles() > kManyTiles) at::empty({background.numel(), grid.height, grid.width}, floats_);
    const int64_t n = splats.ids.size(0);
    const cpu::Stages<T>& stages = stages_of(footprint);
    ListTensors out;
    out.splats = splats.splats;
    out.ids = splats.ids;
    out.tile_offsets = at::empty({grid.tiles() + 1}, longs_);
    out.splat_offsets = options.keep ? at::zeros({n + 1}, longs_) : at::empty({0}, longs_);
    cpu::BinParams<T> p = {};
    p.splats = const_data_or_null<T>(splats.splats);
    p.depths = const_data_or_null<T>(splats.depths);
    p.n = n;
    p.footprint = footprint.choice.index;
    p.grid = grid;
    p.threads = thread_count();
    p.tile_offsets = out.tile_offsets.template data_ptr<int64_t>();
    p.splat_offsets = data_or_null<int64_t>(out.splat_offsets);
    stages.count_pairs(p);
    const int64_t pairs = p.tile_offsets[grid.tiles()];
    out.pairs = at::empty({pairs}, ints_);
    out.positions = at::empty({options.keep ? pairs : 0}, longs_);
    p.pairs = data_or_null<int32_t>(out.pairs);
    p.positions = data_or_null<int64_t>(out.positions);
    stages.scatter_pairs(p);
    out.counts = at::empty({0}, longs_);
    out.tile_samples = at::empty({footprint.chosen ? grid.tiles() : 0}, ints_);
    if (footprint.chosen) {
      cpu::ChooseSamplesParams<T> choice = {};
      choice.splats = p.splats;
      choice.lists = tile_lists_of(out);
      choice.grid = grid;
      choice.threads = p.threads;
      choice.background = background.const_data_ptr<T>();
      choice.background_count = int(background.numel());
      choice.tolerance = footprint.choice.options.number;
      choice.tile_samples = out.tile_samples.template data_ptr<int32_t>();
      stages.choose_samples(choice);
    }
    return out;
  }

  ImageTensors blend(const ListTensors& lists, const FootprintSpec& footprint, TileGrid grid,
                     const ChannelTensors& channels, int64_t color_channels, const Tensor& background,
                     PassOptions options, BlendState& state) override {
    ImageTensors out;
    out.color_channels = color_channels;
    out.color = at::empty({color_channels, grid.height, grid.width}, floats_);
    for (int64_t c = color_channels; c < channels.count; ++c)
      out.extra.push_back(at::empty({grid.height, grid.width}, floats_));
    if (options.alpha) out.alpha = at::empty({grid.height, grid.width}, floats_);
    const std::vector<int64_t> planes = {options.keep ? footprint.samples : 0, grid.height, grid.width};
    // Where samples are chosen not every tile writes all planes.
    const auto make = [&](const at::TensorOptions& o) {
      return footprint.chosen ? at::zeros(planes, o) : at::empty(planes, o);
    };
    state.transmittance = make(floats_);
    state.last = make(ints_);
    state.checkpoints = at::empty({0}, floats_);
    state.chunks = at::empty({0}, ints_);
    cpu::BlendParams<T> p = {};
    p.grid = grid;
    p.splats = const_data_or_null<T>(lists.splats);
    p.channels = channels_of<T>(channels, lists);
    p.background = background.const_data_ptr<T>();
    p.image = planes_of<T>(out);
    p.alpha = data_or_null<T>(out.alpha);
    p.transmittance = data_or_null<T>(state.transmittance);
    p.last = data_or_null<int32_t>(state.last);
    p.lists = tile_lists_of(lists);
    p.threads = thread_count();
    const Tensor scratch = make_scratch(p.threads, channels.count);
    p.scratch = scratch.data_ptr<T>();
    stages_of(footprint).blend(p);
    return out;
  }

  std::vector<Tensor> inspect(const ListTensors& lists, const FootprintSpec& footprint, TileGrid grid,
                              int64_t count) override {
    const Tensor median = at::empty({grid.height, grid.width}, ints_), dominant = at::empty_like(median),
                 touched = at::zeros({count}, ints_), largest = at::zeros({count}, ints_),
                 total = at::zeros({count}, longs_);
    cpu::InspectParams<T> p = {};
    p.splats = const_data_or_null<T>(lists.splats);
    p.ids = const_data_or_null<int32_t>(lists.ids);
    p.lists = tile_lists_of(lists);
    p.grid = grid;
    p.threads = thread_count();
    p.median = median.data_ptr<int32_t>();
    p.dominant = dominant.data_ptr<int32_t>();
    p.touched = data_or_null<int32_t>(touched);
    p.largest = data_or_null<int32_t>(largest);
    p.units = data_or_null<int64_t>(total);
    stages_of(footprint).inspect(p);
    return {median, dominant, touched, largest.view(at::kFloat), total};
  }

  PairSums blend_vjp(const ListTensors& lists, const BlendState& state, const FootprintSpec& footprint, TileGrid grid,
                     const ChannelTensors& channels, const Tensor& background, const ImageTensors& dL_dimage,
                     MeanSums mean_sums, bool) override {
    const int64_t pairs = lists.pairs.numel(), count = channels.count;
    const bool own = !channels.rows.defined();  // the colours in the splats, whose sums stay with the pairs
    PairSums out;
    out.pairs = at::empty({pairs, cpu::kPairNumbers + (own ? 3 : 0)}, floats_);
    if (mean_sums != MeanSums::kNone) out.means = at::empty({pairs, 2}, floats_);
    cpu::BlendVjpParams<T> p = {};
    p.grid = grid;
    p.splats = const_data_or_null<T>(lists.splats);
    p.channels = channels_of<T>(channels, lists);
    p.background = background.const_data_ptr<T>();
    p.transmittance = state.transmittance.const_data_ptr<T>();
    p.last = state.last.const_data_ptr<int32_t>();
    p.dL_dimage = planes_of<const T>(dL_dimage);
    p.dL_dalpha = const_data_or_null<T>(dL_dimage.alpha);
    p.lists = tile_lists_of(lists);
    p.threads = thread_count();
    const Tensor scratch = make_scratch(p.threads, count);
    p.scratch = scratch.data_ptr<T>();
    p.pair_grads = data_or_null<T>(out.pairs);
    p.pair_stride = out.pairs.size(1);
    p.mean_sums = mean_sums;
    p.pair_means = elements_of<Vec2<T>, T>(out.means);
    const cpu::Stages<T>& stages = stages_of(footprint);
    const Tensor replay = at::empty({stages.moves ? p.threads : 0, cpu::kReplayNumbers}, floats_);
    p.replay = data_or_null<T>(replay);
    if (own) {
      p.count = 3;
      p.channel_sums = pairs ? p.pair_grads + cpu::kPairNumbers : nullptr;
      p.channel_stride = p.pair_stride;
      stages.blend_vjp(p);
      return out;
    }
    out.dL_dchannels = at::zeros_like(channels.rows);
    const Tensor channel_sums = at::empty({pairs, std::min<int64_t>(count, cpu::kWindow)}, floats_);
    p.channel_sums = data_or_null<T>(channel_sums);
    p.channel_stride = channel_sums.size(1);
    cpu::SumChannelsParams<T> sum = {};
    sum.pairs = splat_pairs_of(lists);
    sum.threads = p.threads;
    sum.channel_sums = p.channel_sums;
    sum.channel_stride = p.channel_stride;
    sum.by_gaussian = channels.by_gaussian;
    sum.dL_dchannels = data_or_null<T>(out.dL_dchannels);
    sum.stride = count;
    for (int first = 0; first < count; first += cpu::kWindow) {
      p.first = sum.first = first;
      p.count = sum.count = std::min(int(count) - first, cpu::kWindow);
      stages.blend_vjp(p);
      stages.sum_channels(sum);
      p.pair_grads = nullptr;
    }
    return out;
  }

  Tensor project_vjp(const Inputs& in, const ListTensors& lists, const FootprintSpec& footprint, const PairSums& sums,
                     ChannelColumns columns, const Grads& grads, bool with_camera, bool) override {
    cpu::ProjectVjpParams<T> p = {};
    const Tensor camera_grads = set_projection_vjp(p, in, footprint, grads, with_camera);
    p.pairs = splat_pairs_of(lists);
    p.pair_grads = const_data_or_null<T>(sums.pairs);
    p.pair_stride = sums.pairs.size(1);
    p.pair_colors = p.pair_stride > cpu::kPairNumbers;
    p.pair_means = elements_of<Vec2<T>, T>(sums.means);
    if (columns.color >= 0 || columns.depth >= 0 || columns.inverse_depth >= 0) {
      p.dL_dchannels.data = const_data_or_null<T>(sums.dL_dchannels);
      p.dL_dchannels.stride = sums.dL_dchannels.size(1);
      p.dL_dchannels.color = columns.color;
      p.dL_dchannels.depth = columns.depth;
      p.dL_dchannels.inverse_depth = columns.inverse_depth;
    }
    stages_of(footprint).of(p.camera).project_vjp(p);
    return camera_grads;
  }

  Tensor project_rows_vjp(const Inputs& in, const Tensor& rows, const RowTensors& dL_drows, const Grads& grads,
                          bool with_camera) override {
    cpu::ProjectRowsVjpParams<T> p = {};
    const FootprintSpec any = {};  // the gradient of rows is the same whatever the footprint
    const Tensor camera_grads = set_projection_vjp(p, in, any, grads, with_camera);
    p.rows.rows = const_data_or_null<int32_t>(rows);
    p.rows.means2d = elements_of<Vec2<T>, T>(dL_drows.means2d);
    p.rows.cov2d = elements_of<Sym2<T>, T>(dL_drows.cov2d);
    p.rows.opacities = const_data_or_null<T>(dL_drows.opacities);
    p.rows.depths = const_data_or_null<T>(dL_drows.depths);
    p.rows.colors = elements_of<Vec3<T>, T>(dL_drows.colors);
    stages_of(any).of(p.camera).project_rows_vjp(p);
    return camera_grads;
  }

  RowTensors row_grads(const RowTensors& rows, const ListTensors& lists, const FootprintSpec& footprint,
                       const PairSums& sums) override {
    const int64_t n = rows.means2d.size(0);
    RowTensors out;
    out.means2d = at::empty({n, 2}, floats_);
    out.cov2d = at::empty({n, 3}, floats_);
    out.opacities = at::empty({n}, floats_);
    if (sums.means.defined()) out.absolute = at::empty({n, 2}, floats_);
    cpu::RowGradsParams<T> p = {};
    p.pairs = splat_pairs_of(lists);
    p.n = n;
    p.footprint = footprint.choice;
    p.threads = thread_count();
    p.rows = projected_rows_of<T>(rows);
    p.pair_grads = const_data_or_null<T>(sums.pairs);
    p.pair_stride = sums.pairs.size(1);
    p.pair_means = elements_of<Vec2<T>, T>(sums.means);
    p.dL_dmeans2d = elements_of<Vec2<T>, T>(out.means2d);
    p.dL_dcov2d = elements_of<Sym2<T>, T>(out.cov2d);
    p.dL_dopacities = data_or_null<T>(out.opacities);
    p.absolute = elements_of<Vec2<T>, T>(out.absolute);
    stages_of(footprint).row_grads(p);
    return out;
  }

  Tensor weight(const Tensor& offset, const Tensor& cov2d, const FootprintSpec& footprint) override {
    const Tensor out = at::empty(offset.sizes().slice(0, offset.dim() - 1), floats_);
    auto p = weight_params<cpu::WeightParams<T>, T>(offset, cov2d, footprint);
    p.threads = thread_count();
    p.weights = data_or_null<T>(out);
    stages_of(footprint).weight(p);
    return out;
  }

  std::tuple<Tensor, Tensor> weight_vjp(const Tensor& dL_dweight, const Tensor& offset, const Tensor& cov2d,
                                        const FootprintSpec& footprint) override {
    Tensor dL_doffset = at::empty(offset.sizes(), floats_), dL_dcov = at::empty(cov2d.sizes(), floats_);
    auto p = weight_params<cpu::WeightParams<T>, T>(offset, cov2d, footprint);
    p.threads = thread_count();
    p.dL_dweights = const_data_or_null<T>(dL_dweight);
    p.dL_doffsets = elements_of<Vec2<T>, T>(dL_doffset);
    p.dL_dcovs = elements_of<Sym2<T>, T>(dL_dcov);
    stages_of(footprint).weight_vjp(p);
    return {dL_doffset, dL_dcov};
  }

  double lap() override {
    const auto now = Clock::now();
    return std::chrono::duration<double>(now - std::exchange(last_lap_, now)).count();
  }

 private:
  using Clock = std::chrono::steady_clock;

  static const cpu::Stages<T>& stages_of(const FootprintSpec& footprint) {
    return cpu::stages_of<T>(footprint.choice.index);
  }

  /// What project and project_rows have in common.
  template <class Params>
  static void set_projection(Params& p, const Inputs& in, const FootprintSpec& footprint, const Tensor& radii) {
    p.camera = camera_of<T>(in);
    p.gaussians = gaussians_of<T>(in);
    p.footprint = footprint.choice;
    p.bounds = cull_bounds<T>(footprint.choice);
    p.radii = data_or_null<int32_t>(radii);
    if (in.colors_precomp && !p.gaussians.colors) {
      p.given.data = const_data_or_null<T>(*in.colors_precomp);
      p.given.stride = in.colors_precomp->size(1);
      p.given.count = int(p.given.stride);
    }
    p.threads = thread_count();
  }

  /// What project_vjp and project_rows_vjp have in common. Returns room for the camera's gradient, zero.
  template <class Params>
  Tensor set_projection_vjp(Params& p, const Inputs& in, const FootprintSpec& footprint, const Grads& grads,
                            bool with_camera) const {
    p.camera = camera_of<T>(in);
    p.gaussians = gaussians_of<T>(in);
    p.footprint = footprint.choice;
    p.grads = grads_of<T>(in, grads);
    p.threads = thread_count();
    if (!with_camera) return Tensor();
    Tensor camera_grads = at::zeros({cpu::chunks_of(in.count()), kCameraGradWidth}, floats_);
    p.camera_grads = elements_of<CameraGrad<T>, T>(camera_grads);
    return camera_grads;
  }

  Tensor make_scratch(int threads, int64_t channels) const {
    return at::empty({threads, channels * kTile * kTile}, floats_);
  }

  at::TensorOptions floats_, ints_, longs_;
  Clock::time_point last_lap_ = Clock::now();
};

}  // namespace

std::unique_ptr<Backend> make_cpu_backend(const Tensor& like) {
  const at::TensorOptions options = like.options().requires_grad(std::nullopt);
  if (like.scalar_type() == at::kDouble) return std::make_unique<CpuBackend<double>>(options);
  return std::make_unique<CpuBackend<float>>(options);
}

}  // namespace ar::ops
