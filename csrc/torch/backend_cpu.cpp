// Backend for CPU tensors of float32 or float64: calls the stages of csrc/cpu. Contents of lists are trusted.
#include <ATen/ops/arange.h>
#include <ATen/ops/cat.h>
#include <ATen/ops/empty_like.h>
#include <ATen/ops/zeros.h>
#include <ATen/Parallel.h>
#if defined(__linux__)
#include <sys/mman.h>
#endif

#include <algorithm>
#include <chrono>
#include <utility>

#include "cpu/parallel.h"
#include "cpu/quota.h"
#include "cpu/stages.h"
#include "torch/views.h"

namespace ar::ops {
namespace {

/// at::empty in huge pages, for what is visited in random order.
Tensor make_buffer(at::IntArrayRef sizes, const at::TensorOptions& options) {
  const Tensor buffer = at::empty(sizes, options);
#if defined(__linux__)
  constexpr uintptr_t kHugePage = uintptr_t(1) << 21;
  const uintptr_t begin = reinterpret_cast<uintptr_t>(buffer.data_ptr()), end = begin + buffer.nbytes();
  const uintptr_t first = (begin + kHugePage - 1) & ~(kHugePage - 1), last = end & ~(kHugePage - 1);
  // Only pages that the buffer fills. May fail.
  if (first < last) madvise(reinterpret_cast<void*>(first), last - first, MADV_HUGEPAGE);
#endif
  return buffer;
}

cpu::TileLists tile_lists_of(const ListTensors& lists) {
  cpu::TileLists out;
  out.pairs = const_pointer<int32_t>(lists.pairs);
  out.tile_offsets = const_pointer<int64_t>(lists.tile_offsets);
  return out;
}

cpu::SplatPairs splat_pairs_of(const ListTensors& lists) {
  cpu::SplatPairs out;
  out.splats = lists.ids.numel();
  out.ids = const_pointer<int32_t>(lists.ids);
  out.splat_offsets = const_pointer<int64_t>(lists.splat_offsets);
  out.positions = const_pointer<int64_t>(lists.positions);
  return out;
}

template <typename T> Channels<T> channels_of(const ChannelTensors& channels, const ListTensors& lists) {
  Channels<T> out = {};
  out.count = int(channels.count);
  if (channels.rows.defined()) {
    out.data = const_pointer<T>(channels.rows);
    out.stride = channels.count;
    out.ids = channels.by_gaussian ? const_pointer<int32_t>(lists.ids) : nullptr;
  } else if (lists.splats.numel()) {
    out.data = const_pointer<T>(lists.splats) + kSplatColor;
    out.stride = kSplatWidth;
  }
  return out;
}

/// To number more takes a second.
constexpr int64_t kManyTiles = int64_t(1) << 20;

template <typename T> class CpuBackend final : public Backend {
 public:
  explicit CpuBackend(const at::TensorOptions& options)
      : floats_(options), ints_(options.dtype(at::kInt)), longs_(options.dtype(at::kLong)) {}

  bool writes(std::string_view output) const override {
    static constexpr std::string_view kOutputs[] = {"alpha",   "depth",   "inverse_depth", "median",   "dominant",
                                                    "touched", "largest", "total",         "in_front", "dominated"};
    return std::find(std::begin(kOutputs), std::end(kOutputs), output) != std::end(kOutputs);
  }

  SplatTensors project(const Inputs& in, const Pass& pass, const ChannelTensors& channels,
                       const Tensor& radii) override {
    std::vector<int64_t> offsets(cpu::chunks_of(in.count()) + 1, 0);
    std::vector<uint8_t> candidates(in.count());
    cpu::ProjectParams<T> p = {};
    set_projection<T>(p, in, pass);
    p.radii = pointer<int32_t>(radii);
    set_channels<T>(p, channels);
    p.threads = thread_count();
    p.candidates = candidates.data();
    p.chunk_offsets = offsets.data();
    const int64_t count = cpu::count_candidates(p);
    SplatTensors out;
    out.splats = make_buffer({count, kSplatWidth}, floats_);
    out.ids = at::empty({count}, ints_);
    out.depths = at::empty({count}, floats_);
    if (pass.footprint.along_rays()) out.slopes = at::zeros({count, 2}, floats_);
    p.splats = pointer<T>(out.splats);
    p.ids = pointer<int32_t>(out.ids);
    p.depths = pointer<T>(out.depths);
    p.slopes = pointer<Vec2<T>>(out.slopes);
    cpu::project(p);
    return out;
  }

  void project_rows(const Inputs& in, const Pass& pass, const RowRules<double>& rules,
                    const ProjectedTensors& rows) override {
    cpu::ProjectRowsParams<T> p = {};
    set_projection<T>(p, in, pass);
    p.threads = thread_count();
    p.rules = row_rules_of<T>(rules);
    p.rows = row_outputs_of<T>(rows);
    p.flags = pointer<int32_t>(rows.flags);
    cpu::project_rows(p);
  }

  void pack_rows(const Inputs& in, const Pass& pass, const PackedTensors& packed) override {
    cpu::ProjectRowsParams<T> p = {};
    set_projection<T>(p, in, pass);
    p.threads = thread_count();
    p.packed = packed_rows_of<T>(packed);
    if (p.packed.rows) cpu::project_rows(p);
  }

  SplatTensors shape_rows(const RowTensors& rows, const Pass& pass) override {
    const int64_t n = row_count(rows);
    SplatTensors out;
    out.splats = at::empty({n, kSplatWidth}, floats_);
    out.ids = at::arange(n, ints_);
    out.depths = rows.packed.defined() ? rows.packed.select(1, kPackedDepth).contiguous() : rows.depths;
    out.slopes = rows.slopes;
    cpu::ShapeRowsParams<T> p = {};
    set_shape_rows<T>(p, rows, pass, out.splats);
    p.threads = thread_count();
    cpu::shape_rows(p);
    return out;
  }

  ListTensors bin(const SplatTensors& splats, const Pass& pass) override {
    const TileGrid grid = pass.grid;
    // Without memory for the image, raise before tiles are numbered.
    if (grid.tiles() > kManyTiles) at::empty({grid.height, grid.width}, floats_);
    const int64_t n = splats.ids.size(0);
    ListTensors out;
    out.splats = splats.splats;
    out.ids = splats.ids;
    out.tile_offsets = at::empty({grid.tiles() + 1}, longs_);
    out.splat_offsets = at::empty({pass.keep ? n + 1 : 0}, longs_);
    cpu::BinParams<T> p = {};
    p.splats = const_pointer<T>(splats.splats);
    p.depths = const_pointer<T>(splats.depths);
    p.n = n;
    p.footprint = pass.footprint.choice.index;
    p.grid = grid;
    p.threads = thread_count();
    p.tile_offsets = pointer<int64_t>(out.tile_offsets);
    p.splat_offsets = pointer<int64_t>(out.splat_offsets);
    const int64_t pairs = cpu::count_pairs(p);
    out.pairs = make_buffer({pairs}, ints_);
    out.positions = make_buffer({pass.keep ? pairs : 0}, longs_);
    p.pairs = pointer<int32_t>(out.pairs);
    p.positions = pointer<int64_t>(out.positions);
    cpu::scatter_pairs(p);
    out.counts = at::empty({0}, longs_);
    const bool along_rays = pass.footprint.along_rays();
    out.rays = along_rays ? at::cat({splats.depths.unsqueeze(1), splats.slopes}, 1) : at::empty({0}, floats_);
    return out;
  }

  void blend(const ListTensors& lists, const Pass& pass, const ChannelTensors& channels, const ImageTensors& image,
             BlendState& state) override {
    state.checkpoints = at::empty({0}, floats_);
    state.chunks = at::empty({0}, ints_);
    cpu::BlendParams<T> p = {};
    set_blend<T>(p, lists, pass, channels, image, state);
    p.channels = channels_of<T>(channels, lists);
    p.lists = tile_lists_of(lists);
    p.threads = thread_count();
    const Tensor scratch = make_scratch(p.threads, channels.count);
    p.scratch = pointer<T>(scratch);
    p.order = ray_order_of<T>(lists, pass, channels.count);
    cpu::blend(pass.footprint.choice.index, p);
  }

  void inspect(const ListTensors& lists, const Pass& pass, const Tensor& depths, const Inputs*,
               const SummaryTensors& summary) override {
    cpu::InspectParams<T> p = {};
    set_inspect<T>(p, lists, pass, depths, summary);
    p.ids = const_pointer<int32_t>(lists.ids);
    p.lists = tile_lists_of(lists);
    p.threads = thread_count();
    cpu::inspect(pass.footprint.choice.index, p);
  }

  PairSums blend_vjp(const ListTensors& lists, const BlendState& state, const Pass& pass,
                     const ChannelTensors& channels, const ImageTensors& dL_dimage, MeanSums mean_sums) override {
    const int64_t pairs = lists.pairs.numel(), count = channels.count;
    const bool own = !channels.rows.defined();  // Sums of the splats' colours stay with the pairs.
    PairSums out;
    out.pairs = make_buffer({pairs, cpu::kPairNumbers + (own ? 3 : 0)}, floats_);
    if (mean_sums != MeanSums::kNone) out.means = at::empty({pairs, 2}, floats_);
    cpu::BlendVjpParams<T> p = {};
    set_blend<T>(p, lists, pass, channels, dL_dimage, state);
    p.channels = channels_of<T>(channels, lists);
    p.lists = tile_lists_of(lists);
    p.threads = thread_count();
    const Tensor scratch = make_scratch(p.threads, count);
    p.scratch = pointer<T>(scratch);
    p.pair_grads = pointer<T>(out.pairs);
    p.pair_stride = out.pairs.size(1);
    p.mean_sums = mean_sums;
    p.pair_means = pointer<Vec2<T>>(out.means);
    const int footprint = pass.footprint.choice.index;
    p.order = ray_order_of<T>(lists, pass, channels.count);
    const bool replays = pass.footprint.moves && !pass.footprint.along_rays();
    const Tensor replay = at::empty({replays ? p.threads : 0, cpu::kReplayNumbers}, floats_);
    p.replay = pointer<T>(replay);
    if (own) {
      p.count = 3;
      p.channel_sums = pairs ? p.pair_grads + cpu::kPairNumbers : nullptr;
      p.channel_stride = p.pair_stride;
      cpu::blend_vjp(footprint, p);
      return out;
    }
    out.dL_dchannels = make_zeros_like(channels.rows);
    const Tensor channel_sums = make_buffer({pairs, std::min<int64_t>(count, cpu::kWindow)}, floats_);
    p.channel_sums = pointer<T>(channel_sums);
    p.channel_stride = channel_sums.size(1);
    cpu::SumChannelsParams<T> sum = {};
    sum.pairs = splat_pairs_of(lists);
    sum.threads = p.threads;
    sum.channel_sums = p.channel_sums;
    sum.channel_stride = p.channel_stride;
    sum.by_gaussian = channels.by_gaussian;
    sum.dL_dchannels = pointer<T>(out.dL_dchannels);
    sum.stride = count;
    for (int first = 0; first < count; first += cpu::kWindow) {
      p.first = sum.first = first;
      p.count = sum.count = std::min(int(count) - first, cpu::kWindow);
      cpu::blend_vjp(footprint, p);
      cpu::sum_channels(sum);
      p.pair_grads = nullptr;
    }
    return out;
  }

  Tensor project_vjp(const Inputs& in, const ListTensors& lists, const Pass& pass, const PairSums& sums,
                     const ChannelTensors& channels, const Grads& grads) override {
    cpu::ProjectVjpParams<T> p = {};
    set_projection_vjp<T>(p, in, grads);
    p.footprint = pass.footprint.choice;
    p.dL_dchannels = channel_rows<const T>(sums.dL_dchannels, channels);
    p.pair_colors = sums.pairs.size(1) > cpu::kPairNumbers;
    set_pair_sums(p, lists, sums);
    const Tensor camera_grads = make_camera_grads(p, grads);
    cpu::project_vjp(p);
    return camera_grads;
  }

  Tensor project_rows_vjp(const Inputs& in, const ProjectedGrads& dL_drows, const Grads& grads) override {
    cpu::ProjectRowsVjpParams<T> p = {};
    set_projection_vjp<T>(p, in, grads);
    p.rows = projected_row_grads_of<T>(dL_drows);
    p.add = grads.add;
    p.threads = thread_count();
    const Tensor camera_grads = make_camera_grads(p, grads);
    cpu::project_rows_vjp(p);
    return camera_grads;
  }

  void sum_camera_grads(const Tensor& parts, const Grads& grads) override {
    cpu::sum_camera_grads(camera_sums_of<T>(parts, grads));
  }

  void row_grads(const RowTensors& rows, const ListTensors& lists, const Pass& pass, const PairSums& sums,
                 const RowTensors& dL_drows) override {
    cpu::RowGradsParams<T> p = {};
    set_row_grads<T>(p, rows, pass, dL_drows);
    set_pair_sums(p, lists, sums);
    cpu::row_grads(p);
  }

  void weight(const WeightTensors& tensors, const FootprintSpec& footprint) override {
    cpu::WeightParams<T> p = {};
    set_weight<T>(p, tensors, footprint);
    p.threads = thread_count();
    const int index = footprint.choice.index;
    tensors.dL_dweight.defined() ? cpu::weight_vjp(index, p) : cpu::weight(index, p);
  }

  double lap() override {
    const auto now = Clock::now();
    return std::chrono::duration<double>(now - std::exchange(last_lap_, now)).count();
  }

 private:
  using Clock = std::chrono::steady_clock;

  template <class Params> static void set_pair_sums(Params& p, const ListTensors& lists, const PairSums& sums) {
    p.pairs = splat_pairs_of(lists);
    p.threads = thread_count();
    p.pair_grads = const_pointer<T>(sums.pairs);
    p.pair_stride = sums.pairs.size(1);
    p.pair_means = const_pointer<Vec2<T>>(sums.means);
  }

  template <class Params> Tensor make_camera_grads(Params& p, const Grads& grads) const {
    if (!grads.with_camera) return Tensor();
    const Tensor camera_grads = at::zeros({cpu::chunks_of(p.gaussians.n), kCameraGradWidth}, floats_);
    p.camera_grads = pointer<CameraGrad<T>>(camera_grads);
    return camera_grads;
  }

  /// Not by torch, whose threads spin while waiting.
  static Tensor make_zeros_like(const Tensor& contiguous) {
    const Tensor out = at::empty_like(contiguous);
    T* const numbers = pointer<T>(out);
    const int64_t n = out.numel(), parts = cpu::chunks_of(n);
    cpu::parallel_for(parts, thread_count(), [&](int64_t p) {
      const cpu::Part part = cpu::part_of(n, parts, p);
      std::fill(numbers + part.begin, numbers + part.end, T(0));
    });
    return out;
  }

  Tensor make_scratch(int threads, int64_t channels) const {
    return at::empty({threads, channels * kTile * kTile}, floats_);
  }

  at::TensorOptions floats_, ints_, longs_;
  Clock::time_point last_lap_ = Clock::now();
};

}  // namespace

int thread_count() {
  static const int quota = cpu::cpu_quota();
  return std::min(at::get_num_threads(), quota);
}

std::unique_ptr<Backend> make_cpu_backend(const Tensor& like) {
  const at::TensorOptions options = like.options().requires_grad(std::nullopt);
  if (like.scalar_type() == at::kDouble) return std::make_unique<CpuBackend<double>>(options);
  return std::make_unique<CpuBackend<float>>(options);
}

}  // namespace ar::ops
