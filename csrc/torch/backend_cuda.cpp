// Backend for CUDA tensors of float32: launches the stages of csrc/cuda. The host waits only to count pairs
// (counting_of(), pair_guess.h), to time stages, for tiles_share_lists(), and with debug.
#include <ATen/Dispatch.h>
#include <ATen/ops/cat.h>
#include <ATen/ops/zeros.h>
#include <c10/cuda/CUDAException.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>

#include <algorithm>
#include <optional>
#include <tuple>

#include "torch/cuda_frames.h"
#include "torch/cuda_views.h"
#include "torch/side_streams.h"
#include "torch/views.h"

namespace ar::ops {
namespace {

class CudaBackend final : public Backend {
 public:
  explicit CudaBackend(const Tensor& like)
      : guard_(like.device()),
        stream_(c10::cuda::getCurrentCUDAStream()),
        floats_(like.options().requires_grad(std::nullopt)),
        ints_(floats_.dtype(at::kInt)),
        longs_(floats_.dtype(at::kLong)),
        bytes_(floats_.dtype(at::kByte)) {}

  bool writes(std::string_view output) const override {
    static constexpr std::string_view kOutputs[] = {"alpha",   "depth",   "inverse_depth", "median",   "dominant",
                                                    "touched", "largest", "total",         "in_front", "dominated"};
    return std::find(std::begin(kOutputs), std::end(kOutputs), output) != std::end(kOutputs);
  }

  SplatTensors project(const Inputs& in, const Pass& pass, const ChannelTensors& channels,
                       const Tensor& radii) override {
    SplatTensors out = make_splats(in.count());
    cuda::ProjectParams p = {};
    set_projection<float>(p, in, pass);
    p.radii = pointer<int32_t>(radii);
    set_channels<float>(p, channels);
    p.grid = pass.grid;
    p.splats = pointer<float>(out.splats);
    set_for_bin(p, out);
    cuda::project(p, stream_);
    check_stage("project", false);
    if (pass.footprint.along_rays()) {
      out.rays = at::empty({in.count(), ListTensors::kRayWidth}, floats_);
      cuda::RayDepthsParams rays = {p.camera, p.gaussians, p.ranges, pointer<RayDepth<float>>(out.rays)};
      cuda::ray_depths(rays, stream_);
      check_stage("ray_depths", false);
    }
    return out;
  }

  void project_rows(const Inputs& in, const Pass& pass, const RowRules<double>& rules,
                    const ProjectedTensors& rows) override {
    cuda::ProjectRowsParams p = {};
    set_projection<float>(p, in, pass);
    p.rules = row_rules_of<float>(rules);
    p.rows = row_outputs_of<float>(rows);
    p.flags = pointer<int32_t>(rows.flags);
    cuda::project_rows(p, stream_);
    check_stage("project_rows", false);
  }

  void pack_rows(const Inputs& in, const Pass& pass, const PackedTensors& packed) override {
    cuda::ProjectRowsParams p = {};
    set_projection<float>(p, in, pass);
    p.packed = packed_rows_of<float>(packed);
    if (!p.packed.rows) return;
    cuda::project_rows(p, stream_);
    check_stage("pack_rows", false);
  }

  SplatTensors shape_rows(const RowTensors& rows, const Pass& pass) override {
    SplatTensors out = make_splats(row_count(rows));
    cuda::ShapeRowsParams p = {};
    set_shape_rows<float>(p, rows, pass, out.splats);
    set_for_bin(p, out);
    cuda::shape_rows(p, stream_);
    check_stage("shape_rows", false);
    if (pass.footprint.along_rays()) out.rays = at::cat({rows.depths.unsqueeze(1), rows.slopes}, 1);
    return out;
  }

  ListTensors bin(const SplatTensors& splats, const Pass& pass) override {
    const TileGrid grid = pass.grid;
    const FootprintSpec& footprint = pass.footprint;
    if (pass.debug) check_stage("project", true);
    const int64_t n = splats.splats.size(0);
    TORCH_CHECK_VALUE(grid.tiles() < std::numeric_limits<int32_t>::max(),
                      "the image has too many tiles: ", grid.tiles());
    const cuda::Counting counting = counting_of(pass, n, stream_);
    const int64_t most = std::clamp<int64_t>(n, 1, cuda::max_items() / grid.tiles() + 1) * grid.tiles();
    auto& guesses = SharedGuesses::instance();
    const auto frame = guesses.use([&](cuda::PairGuesses& g) {
      return g.begin(floats_.device().index(), grid, n, std::min(most, cuda::max_items()), counting);
    });
    int64_t capacity = frame.capacity;
    TORCH_CHECK(capacity > 0 || !is_capturing(stream_),
                "a frame of this size must have been rendered before it is captured in a CUDA graph, without "
                "torch.use_deterministic_algorithms");
    const auto make_pair_memory = [&] { return make_memory<PairMemory>(bytes_, capacity, grid, pass.keep); };
    auto [pair_memory, pairs] = make_pair_memory();
    const SplatMemory memory(splats.memory, n);

    ListTensors out;
    out.splats = splats.splats;
    out.splat_offsets = splats.ranges;
    out.ids = at::empty({n}, ints_);
    out.positions = at::empty({0}, longs_);
    out.counts = splats.counts;
    out.rays = splats.rays.defined() ? splats.rays : at::empty({0}, floats_);
    auto* counts = reinterpret_cast<cuda::Counts*>(pointer<int64_t>(out.counts));
    cuda::DepthSort by_depth = {};
    by_depth.n = n;
    by_depth.keys[0] = memory.keys[0];
    by_depth.keys[1] = memory.keys[1];
    by_depth.order[0] = pointer<int32_t>(out.ids);
    by_depth.order[1] = memory.order;
    by_depth.ranges = structs_of<cuda::PairRange>(splats.ranges);
    by_depth.with_slots = pass.keep;
    by_depth.counts = counts;
    cuda::count_depths(by_depth, memory.depth_scratch, memory.to_clear, pairs.scratch, stream_);
    check_stage("count_depths", pass.debug);
    if (capacity == 0) {
      const int64_t counted = out.counts[0].item<int64_t>();
      guesses.use([&](cuda::PairGuesses& g) { g.counted(frame, n, counted); });
      capacity = std::clamp<int64_t>(counted, 1, cuda::max_items());
      std::tie(pair_memory, pairs) = make_pair_memory();
      C10_CUDA_CHECK(cudaMemsetAsync(pairs.scratch.data, 0, size_t(pairs.scratch.bytes), stream_));
    }
    cuda::sort_by_depth(by_depth, memory.depth_scratch, stream_);
    check_stage("sort_by_depth", pass.debug);

    cuda::EmitParams emit = {};
    emit.splats = const_pointer<float>(splats.splats);
    emit.n = n;
    emit.footprint = footprint.choice.index;
    emit.grid = grid;
    emit.capacity = capacity;
    emit.counts = counts;
    emit.order = by_depth.order[0];
    emit.ranges = by_depth.ranges;
    emit.splat_tiles = memory.tiles;
    emit.long_splats = reinterpret_cast<int32_t*>(memory.keys[0]);  // Keys are not needed any more.
    emit.long_places = reinterpret_cast<int32_t*>(memory.keys[1]);
    emit.status = reinterpret_cast<uint32_t*>(memory.emit_scratch);
    out.tile_offsets = at::empty({grid.tiles() + 1}, longs_);
    if (pass.keep) {
      make_pairs<cuda::SlotPair>(emit, &cuda::EmitParams::slot_pairs, {frame.word, frame.number}, pairs, out,
                                 pass.debug);
    } else {
      make_pairs<int32_t>(emit, &cuda::EmitParams::splat_pairs, {frame.word, frame.number}, pairs, out, pass.debug);
    }
    return out;
  }

  bool tiles_share_lists(const ListTensors& lists) override {
    return lists.counts[0].item<int64_t>() > lists.pairs.size(0);
  }

  void blend(const ListTensors& lists, const Pass& pass, const ChannelTensors& channels, const ImageTensors& image,
             BlendState& state) override {
    check_counts(lists);
    cuda::BlendParams p = {};
    p.order = ray_order_of<float>(lists, pass, channels.count);
    set_blend<float>(p, lists, pass, channels, image, state);
    p.channels = channels_of(channels);
    p.lists = tile_lists_of(lists);
    p.layout = {cuda::compiled_channels(!channels.rows.defined()), pass.keep};
    const cuda::Route route = route_of(lists, pass, channels.count);
    p.cut = route.cut;
    const Tensor plan = make_plan(p, pass, route, state);
    Tensor reach;
    const int64_t reach_words = cuda::max_reach_words(p.cut, pass.grid);
    if (reach_words > 0) reach = at::empty({reach_words}, ints_);
    p.reach_words = structs_of<uint32_t>(reach);
    cuda::blend(pass.footprint.choice.index, p, stream_);
    check_stage("blend", pass.debug);
  }

  void inspect(const ListTensors& lists, const Pass& pass, const Tensor& depths, const Inputs* in,
               const SummaryTensors& summary) override {
    check_counts(lists);
    cuda::InspectParams p = {};
    set_inspect<float>(p, lists, pass, depths, summary);
    p.lists = tile_lists_of(lists);
    if (in) {
      p.camera = camera_of<float>(*in);
      p.means = const_pointer<Vec3<float>>(in->means3D);
    }
    cuda::inspect(pass.footprint.choice.index, p, stream_);
    check_stage("inspect", pass.debug);
  }

  void zero_culled_grads(const Inputs& in, const ListTensors& lists, const Pass& pass, const Grads& grads) override {
    cuda::ZeroGradsParams p = {};
    p.gaussians = gaussians_of<float>(in);
    p.grads = grads_of<float>(in, grads);
    p.ranges = const_structs_of<cuda::PairRange>(lists.splat_offsets);
    if (p.gaussians.n == 0) return;
    side_.emplace(stream_);
    // Blocks of blend_vjp must start later: they stay until no work is left. In a graph only a kernel can wait for
    // that; the next node may be none.
    const bool ordered = !is_capturing(stream_);
    cuda::zero_culled_grads(p, side_->stream(), ordered ? side_->begun() : nullptr);
    if (ordered) side_->wait_until_begun();
    if (pass.debug) join();
    check_stage("zero_culled_grads", pass.debug);
  }

  PairSums blend_vjp(const ListTensors& lists, const BlendState& state, const Pass& pass,
                     const ChannelTensors& channels, const ImageTensors& dL_dimage, MeanSums mean_sums) override {
    check_counts(lists);
    const RayOrder<float> order = ray_order_of<float>(lists, pass, channels.count);
    const cuda::ListCut cut = route_of(lists, pass, channels.count).cut;
    check_plan(state, cut, pass.grid);
    const int64_t n = lists.ids.numel(), rows = std::max(lists.pairs.size(0), n);
    const int count = int(channels.count);
    PairSums out;
    out.pairs = at::empty({rows, cuda::kPairGradWidth}, floats_);
    if (mean_sums != MeanSums::kNone) out.means = out.pairs.narrow(1, cuda::kPairMeans, 2);
    ImageTensors gradient = dL_dimage;
    if (!channels.rows.defined() && !gradient.color.defined())  // Here kernels take no null.
      gradient.color = at::zeros({3, pass.grid.height, pass.grid.width}, floats_);
    cuda::BlendVjpParams p = {};
    set_blend<float>(p, lists, pass, channels, gradient, state);
    p.channels = channels_of(channels);
    p.lists = tile_lists_of(lists);
    p.cut = cut;
    set_plan(p, state.chunks, cut);
    const Tensor chunks_taken = at::empty({1}, ints_);
    p.chunks_taken = pointer<int32_t>(chunks_taken);
    p.checkpoints = pointer<float>(state.checkpoints);
    p.pair_grads = pointer<float>(out.pairs);
    p.mean_sums = mean_sums;
    Tensor maps;
    const int64_t numbers = cuda::max_adjoint_maps(pass.footprint.samples, cut, pass.grid);
    if (numbers > 0) maps = at::empty({numbers}, floats_);
    p.adjoint_maps = pointer<float>(maps);
    Tensor group_sums;
    const int64_t sums = cuda::max_group_sums(pass.footprint.choice.index, p.channels, cut, pass.grid);
    if (sums > 0) group_sums = at::empty({sums}, floats_);
    p.group_sums = pointer<float>(group_sums);
    p.order = order;
    Tensor ray_log;
    if (pass.footprint.along_rays()) {
      int64_t words = 0;
      p.ray_log = cuda::ray_log(pass.footprint.choice.index, pass.grid, words);
      ray_log = at::empty({words}, ints_);
      p.ray_log.words = structs_of<uint32_t>(ray_log);
    }

    cuda::SumChannelsParams sum = {};
    sum.sums = pair_sums_of(lists, out.pairs);
    const bool few = count <= cuda::kFewChannels;
    const bool with_sums = channels.rows.defined() && !(few && channels.only_made_by_projection());
    if (with_sums) {
      out.dL_dchannels = at::empty({n, count}, floats_);
      sum.dL_dchannels = pointer<float>(out.dL_dchannels);
      sum.stride = count;
    }
    const auto width_of = [&](int first) {
      return few ? cuda::kFewChannels : cuda::channel_group(pass.footprint.choice.index, count - first);
    };
    Tensor channel_sums;
    if (!few) {
      channel_sums = at::empty({rows, width_of(0)}, floats_);  // No later group is wider.
      sum.channel_sums = p.channel_sums = pointer<float>(channel_sums);
    }
    for (; sum.first < count; sum.first += sum.width) {
      sum.width = width_of(sum.first);
      sum.count = std::min(count - sum.first, sum.width);
      cuda::blend_vjp(pass.footprint.choice.index, p, sum.first, stream_);
      check_stage("blend_vjp", pass.debug);
      if (with_sums) cuda::sum_channels(sum, stream_);
      check_stage("sum_channels", pass.debug);
    }
    return out;
  }

  Tensor project_vjp(const Inputs& in, const ListTensors& lists, const Pass& pass, const PairSums& sums,
                     const ChannelTensors& channels, const Grads& grads) override {
    cuda::ProjectVjpParams p = {};
    set_projection_vjp<float>(p, in, grads);
    p.footprint = pass.footprint.choice;
    p.dL_dchannels = channel_rows<const float>(sums.dL_dchannels, channels);
    p.channels_in_pairs = channels.made_by_projection() && !sums.dL_dchannels.defined();
    p.sums = pair_sums_of(lists, sums.pairs);
    const Tensor camera_grads = make_camera_grads(p, grads);
    cuda::project_vjp(p, stream_);
    join();
    check_stage("project_vjp", pass.debug);
    return camera_grads;
  }

  Tensor project_rows_vjp(const Inputs& in, const ProjectedGrads& dL_drows, const Grads& grads) override {
    cuda::ProjectRowsVjpParams p = {};
    set_projection_vjp<float>(p, in, grads);
    p.rows = projected_row_grads_of<float>(dL_drows);
    p.add = grads.add;
    const Tensor camera_grads = make_camera_grads(p, grads);
    cuda::project_rows_vjp(p, stream_);
    check_stage("project_rows_vjp", false);
    return camera_grads;
  }

  void sum_camera_grads(const Tensor& parts, const Grads& grads) override {
    cuda::sum_camera_grads(camera_sums_of<float>(parts, grads), stream_);
    check_stage("sum_camera_grads", false);
  }

  void row_grads(const RowTensors& rows, const ListTensors& lists, const Pass& pass, const PairSums& sums,
                 const RowTensors& dL_drows) override {
    cuda::RowGradsParams p = {};
    set_row_grads<float>(p, rows, pass, dL_drows);
    p.sums = pair_sums_of(lists, sums.pairs);
    cuda::row_grads(p, stream_);
    check_stage("row_grads", false);
  }

  void weight(const WeightTensors& tensors, const FootprintSpec& footprint) override {
    AT_DISPATCH_FLOATING_TYPES(tensors.offset.scalar_type(), "footprint_weight", [&] {
      WeightParams<scalar_t> p = {};
      set_weight(p, tensors, footprint);
      if (tensors.dL_dweight.defined()) {
        cuda::weight_vjp(footprint.choice.index, p, stream_);
      } else {
        cuda::weight(footprint.choice.index, p, stream_);
      }
    });
    check_stage("footprint_weight", false);
  }

  double lap() override { return laps_.next(stream_); }

 private:
  void join() { side_.reset(); }

  /// Raises errors of launches or, with `wait`, of the stage.
  void check_stage(const char* stage, bool wait) const {
    cudaError_t error = cudaGetLastError();
    if (wait && error == cudaSuccess) error = cudaStreamSynchronize(stream_);
    TORCH_CHECK(error == cudaSuccess, "CUDA error in ", stage, ": ", cudaGetErrorString(error));
  }

  /// Returns memory that must live until blend is launched.
  Tensor make_plan(cuda::BlendParams& p, const Pass& pass, const cuda::Route& route, BlendState& state) const {
    const cuda::ListCut& cut = route.cut;
    const int64_t tiles = pass.grid.tiles(), capacity = p.lists.capacity;
    const int samples = route.samples_of_lane;
    p.plan.blocks_at_once = cuda::kBlocksPerSm * cuda::multiprocessors_of_device();
    const int64_t chunks = cut.whole ? cut.max_segments : capacity / cuda::kChunkLength;
    const int64_t max_planes = !cut.whole ? p.layout.max_planes(pass.grid, samples, capacity, p.plan.blocks_at_once)
                               : pass.keep && route.family == cuda::Family::kMoment
                                   ? capacity / cuda::kStateChunk * cuda::state_planes(samples)
                                   : 0;
    const int side = cut.whole ? pass.grid.side() : kTile;  // Of chunks a plane has a number per lane of 256.
    state.checkpoints = at::empty({max_planes * side * side}, floats_);
    state.chunks = at::empty({kPlanRows + chunks + tiles + cut.max_lists, kChunkWidth}, ints_);
    const auto [memory, parts] = make_memory<PlanMemory>(bytes_, tiles, cut.whole ? 0 : chunks);
    parts.set(p);
    set_plan(p, state.chunks, cut);
    p.checkpoints = pointer<float>(state.checkpoints);
    cuda::plan_chunks(p.lists, pass.grid, samples, cut, p.layout, p.plan, stream_);
    check_stage("plan_chunks", pass.debug);
    return memory;
  }

  SplatTensors make_splats(int64_t n) const {
    TORCH_CHECK_VALUE(n <= cuda::max_items(), "CUDA takes at most ", cuda::max_items(), " Gaussians, got ", n);
    SplatTensors out;
    out.splats = at::empty({n, kSplatWidth}, floats_);
    out.ranges = at::empty({n, 2}, ints_);
    out.memory = at::empty({SplatMemory(Tensor(), n).bytes}, bytes_);
    // A kernel clears them, if there is one.
    out.counts = n > 0 ? at::empty({kCountsWidth}, longs_) : at::zeros({kCountsWidth}, longs_);
    return out;
  }
  template <class Params> static void set_for_bin(Params& p, const SplatTensors& splats) {
    const SplatMemory memory(splats.memory, splats.splats.size(0));
    p.keys = memory.keys[0];
    p.tiles = memory.tiles;
    p.ranges = structs_of<cuda::PairRange>(splats.ranges);
    p.counts = reinterpret_cast<cuda::Counts*>(pointer<int64_t>(splats.counts));
    p.depth_histograms = reinterpret_cast<uint32_t*>(memory.depth_scratch);
  }

  template <class Params> Tensor make_camera_grads(Params& p, const Grads& grads) const {
    if (!grads.with_camera) return Tensor();
    const Tensor camera_grads = at::empty({cuda::warps_of(p.gaussians.n), kCameraGradWidth}, floats_);
    p.camera_grads = pointer<float>(camera_grads);
    return camera_grads;
  }

  /// Value: SlotPair or int32_t.
  template <class Value>
  void make_pairs(cuda::EmitParams emit, Value* cuda::EmitParams::* to, cuda::PairFeedback feedback,
                  const PairMemory& memory, ListTensors& out, bool debug) const {
    constexpr int64_t kStride = sizeof(Value) / sizeof(int32_t);
    out.pairs = at::empty({emit.capacity, kStride}, ints_);
    const int result = cuda::tile_sort_result(emit.grid);
    cuda::TileSort<Value> sort = {};
    sort.capacity = emit.capacity;
    sort.counts = emit.counts;
    sort.tile_offsets = pointer<int64_t>(out.tile_offsets);
    sort.feedback = feedback;
    for (int k = 0; k < 2; ++k) sort.tiles[k] = memory.tiles[k];
    sort.values[result] = structs_of<Value>(out.pairs);
    sort.values[1 - result] = reinterpret_cast<Value*>(memory.values);
    emit.tile_counts = static_cast<uint32_t*>(memory.scratch.data);
    emit.tiles = sort.tiles[0];
    emit.*to = sort.values[0];
    cuda::emit_pairs(emit, stream_);
    check_stage("emit_pairs", debug);
    cuda::sort_by_tile(sort, emit.grid, memory.scratch.data, stream_);
    check_stage("sort_by_tile", debug);
  }

  c10::cuda::CUDAGuard guard_;
  c10::cuda::CUDAStream stream_;
  at::TensorOptions floats_, ints_, longs_, bytes_;
  Laps laps_;
  std::optional<cuda::SideStream> side_;
};

}  // namespace

std::unique_ptr<Backend> make_cuda_backend(const Tensor& like) { return std::make_unique<CudaBackend>(like); }

/// For tests: room for this many pairs, at least one per Gaussian; 0: guess anew.
void force_pair_capacity(int64_t capacity) {
  SharedGuesses::instance().use([&](cuda::PairGuesses& g) { g.force(capacity); });
}

}  // namespace ar::ops
