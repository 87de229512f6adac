// The stages on CUDA tensors, in float32. Nothing here waits for the device, except where there is no earlier frame to
// guess the number of pairs from, in deterministic mode, with debug, and in lap().
//
// Arguments have been checked (checks.h). What is relied on here: tensors are contiguous and on one device; lists and
// state fit each other, the splats and the image.
#include <c10/cuda/CUDAException.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>

#include <algorithm>
#include <mutex>
#include <tuple>
#include <utility>

#include "cuda/pair_guess.h"
#include "cuda/stages.h"
#include "torch/views.h"

namespace ar::ops {
namespace {

/// The guesses of all image sizes, for all threads.
class SharedGuesses {
 public:
  static SharedGuesses& instance() {
    static auto* guesses = new SharedGuesses;  // outlives the CUDA context
    return *guesses;
  }
  template <class Use> auto use(Use&& use) {
    const std::lock_guard lock(mutex_);
    return use(guesses_);
  }

 private:
  SharedGuesses()
      : words_(at::empty({cuda::PairGuesses::kSlots}, at::TensorOptions().dtype(at::kLong).pinned_memory(true))),
        guesses_(reinterpret_cast<uint64_t*>(words_.data_ptr<int64_t>())) {}

  std::mutex mutex_;
  Tensor words_;
  cuda::PairGuesses guesses_;
};

bool is_capturing(cudaStream_t stream) {
  cudaStreamCaptureStatus status = cudaStreamCaptureStatusNone;
  C10_CUDA_CHECK(cudaStreamIsCapturing(stream, &status));
  return status != cudaStreamCaptureStatusNone;
}

/// A pair of events, made when the first time is asked for.
class Laps {
 public:
  Laps() = default;
  Laps(const Laps&) = delete;
  ~Laps() {
    for (cudaEvent_t event : events_) {
      if (event) cudaEventDestroy(event);
    }
  }
  double next(cudaStream_t stream) {
    cudaEvent_t& now = events_[turn_];
    const cudaEvent_t before = events_[1 - turn_];
    turn_ = 1 - turn_;
    if (!now) C10_CUDA_CHECK(cudaEventCreate(&now));
    C10_CUDA_CHECK(cudaEventRecord(now, stream));
    C10_CUDA_CHECK(cudaEventSynchronize(now));
    float milliseconds = 0;
    if (before) C10_CUDA_CHECK(cudaEventElapsedTime(&milliseconds, before, now));
    return milliseconds * 1e-3;
  }

 private:
  cudaEvent_t events_[2] = {};
  int turn_ = 0;
};

template <class Element> const Element* elements_of(const Tensor& t) {
  return reinterpret_cast<const Element*>(const_data_or_null<float>(t));
}
template <class Element> Element* mutable_elements_of(const Tensor& t) {
  return reinterpret_cast<Element*>(data_or_null<float>(t));
}
template <class Element> Element* structs_of(const Tensor& t) {
  return reinterpret_cast<Element*>(data_or_null<int32_t>(t));
}

constexpr int64_t kCountsWidth = sizeof(cuda::Counts) / sizeof(int64_t);

/// BlendState::chunks begins with the PlanState, in whole rows; TileChunks follow.
constexpr int64_t kChunkWidth = sizeof(cuda::TileChunk) / sizeof(int32_t);
constexpr int64_t kPlanRows = (sizeof(cuda::PlanState) / sizeof(int32_t) + kChunkWidth - 1) / kChunkWidth;

/// Members that are undefined become null.
ProjectedRows<float> projected_rows_of(const RowTensors& rows) {
  ProjectedRows<float> out;
  out.means2d = const_cast<Vec2<float>*>(elements_of<Vec2<float>>(rows.means2d));
  out.cov2d = const_cast<Sym2<float>*>(elements_of<Sym2<float>>(rows.cov2d));
  out.dets = const_cast<float*>(const_data_or_null<float>(rows.dets));
  out.opacities = const_cast<float*>(const_data_or_null<float>(rows.opacities));
  out.depths = const_cast<float*>(const_data_or_null<float>(rows.depths));
  out.colors = const_cast<Vec3<float>*>(elements_of<Vec3<float>>(rows.colors));
  return out;
}

cuda::TileLists tile_lists_of(const ListTensors& lists) {
  cuda::TileLists out = {};
  out.pairs = lists.pairs.const_data_ptr<int32_t>();
  out.stride = int(lists.pairs.size(1));
  out.tile_offsets = lists.tile_offsets.const_data_ptr<int64_t>();
  out.order = const_data_or_null<int32_t>(lists.ids);
  out.counts = reinterpret_cast<const cuda::Counts*>(lists.counts.const_data_ptr<int64_t>());
  out.n = lists.ids.numel();
  out.capacity = lists.pairs.size(0);
  out.tile_samples = const_data_or_null<int32_t>(lists.tile_samples);
  return out;
}

cuda::PairSumsView pair_sums_of(const ListTensors& lists, const Tensor& pair_grads) {
  cuda::PairSumsView out = {};
  out.n = lists.ids.numel();
  out.ranges = reinterpret_cast<const cuda::PairRange*>(const_data_or_null<int32_t>(lists.splat_offsets));
  out.counts = reinterpret_cast<const cuda::Counts*>(lists.counts.const_data_ptr<int64_t>());
  out.capacity = lists.pairs.size(0);
  out.pair_grads = pair_grads.const_data_ptr<float>();
  return out;
}

/// Without `data` the three colours in the splats.
Channels<float> channels_of(const ChannelTensors& channels) {
  Channels<float> out = {};
  out.count = int(channels.count);
  if (!channels.rows.defined()) return out;
  // A row per Gaussian is one per splat here. Without rows there are no pairs that could read one.
  static const float kNoRow = 0;
  out.data = channels.rows.numel() ? channels.rows.const_data_ptr<float>() : &kNoRow;
  out.stride = channels.count;
  return out;
}

class CudaBackend final : public Backend {
 public:
  explicit CudaBackend(const Tensor& like)
      : guard_(like.device()),
        stream_(c10::cuda::getCurrentCUDAStream()),
        floats_(like.options().requires_grad(std::nullopt)),
        ints_(floats_.dtype(at::kInt)),
        longs_(floats_.dtype(at::kLong)),
        bytes_(floats_.dtype(at::kByte)) {}

  SplatTensors project(const Inputs& in, const FootprintSpec& footprint, const ChannelTensors& channels,
                       ChannelColumns columns, Tensor& radii) override {
    const int64_t n = in.count();
    radii = at::empty({n}, ints_);
    SplatTensors out = make_splats(n);
    cuda::ProjectParams p = {};
    set_projection(p, in, footprint, radii);
    p.splats = data_or_null<float>(out.splats);
    p.channels = channel_rows<float>(channels, columns);
    if (in.colors_precomp && !p.gaussians.colors) {
      p.given.data = const_data_or_null<float>(*in.colors_precomp);
      p.given.stride = in.colors_precomp->size(1);
      p.given.count = int(p.given.stride);
    }
    p.keys = structs_of<uint32_t>(out.keys);
    p.ranges = structs_of<cuda::PairRange>(out.ranges);
    cuda::project(p, stream_);
    check_stage("project", false);
    return out;
  }

  RowTensors project_rows(const Inputs& in, const FootprintSpec& footprint, Tensor& radii) override {
    const int64_t n = in.count();
    check_count(n);
    radii = at::empty({n}, ints_);
    RowTensors out;
    out.means2d = at::empty({n, 2}, floats_);
    out.cov2d = at::empty({n, 3}, floats_);
    out.dets = at::empty({n}, floats_);
    out.opacities = at::empty({n}, floats_);
    out.depths = at::empty({n}, floats_);
    cuda::ProjectRowsParams p = {};
    set_projection(p, in, footprint, radii);
    if (in.shs || in.colors_precomp) out.colors = at::empty({n, 3}, floats_);
    p.rows = projected_rows_of(out);
    cuda::project_rows(p, stream_);
    check_stage("project_rows", false);
    return out;
  }

  SplatTensors shape_rows(const RowTensors& rows, const FootprintSpec& footprint, TileGrid grid) override {
    const int64_t n = rows.means2d.size(0);
    SplatTensors out = make_splats(n);
    cuda::ShapeRowsParams p = {};
    p.n = n;
    p.rows = projected_rows_of(rows);
    p.footprint = footprint.choice;
    p.grid = grid;
    p.splats = data_or_null<float>(out.splats);
    p.keys = structs_of<uint32_t>(out.keys);
    p.ranges = structs_of<cuda::PairRange>(out.ranges);
    cuda::shape_rows(p, stream_);
    check_stage("shape_rows", false);
    return out;
  }

  ListTensors bin(const SplatTensors& splats, const FootprintSpec& footprint, TileGrid grid, const Tensor& background,
                  PassOptions options) override {
    if (options.debug) check_stage("project", true);
    const int64_t n = splats.splats.size(0);
    // An image that cannot be made raises here, before anything is counted for it.
    TORCH_CHECK_VALUE(grid.tiles() < std::numeric_limits<int32_t>::max() / cuda::kSampleClasses,
                      "the image has too many tiles: ", grid.tiles());
    const bool capturing = is_capturing(stream_);
    const int64_t most = std::clamp<int64_t>(n, 1, cuda::max_items() / grid.tiles() + 1) * grid.tiles();
    auto& guesses = SharedGuesses::instance();
    const auto frame = guesses.use([&](cuda::PairGuesses& g) {
      return g.begin(floats_.device().index(), grid.width, grid.height, n, std::min(most, cuda::max_items()),
                     !capturing);
    });
    int64_t capacity = options.exact ? 0 : frame.capacity;
    TORCH_CHECK(capacity > 0 || !capturing,
                "a frame of this size must have been rendered before it is captured in a CUDA graph, without "
                "torch.use_deterministic_algorithms");
    // Memory that must be zero, cleared in one go.
    const int64_t depth_bytes = cuda::depth_sort_scratch(n), emit_bytes = cuda::emit_scratch(n);
    const int64_t tile_bytes = capacity > 0 ? cuda::tile_sort_scratch(capacity, grid) : 0;
    const Tensor scratch = make_zeros(depth_bytes + emit_bytes + tile_bytes);
    auto* depth_scratch = static_cast<std::byte*>(scratch.data_ptr());

    ListTensors out;
    out.splats = splats.splats;
    out.splat_offsets = splats.ranges;
    out.ids = at::empty({n}, ints_);
    out.positions = at::empty({0}, longs_);
    out.counts = at::empty({kCountsWidth}, longs_);
    auto* counts = reinterpret_cast<cuda::Counts*>(out.counts.data_ptr<int64_t>());
    C10_CUDA_CHECK(cudaMemsetAsync(counts, 0, sizeof(cuda::Counts), stream_));
    const Tensor other_order = at::empty({n}, ints_);
    cuda::DepthSort by_depth = {};
    by_depth.n = n;
    by_depth.keys[0] = structs_of<uint32_t>(splats.keys);
    by_depth.keys[1] = by_depth.keys[0] + n;
    by_depth.order[0] = data_or_null<int32_t>(out.ids);
    by_depth.order[1] = data_or_null<int32_t>(other_order);
    by_depth.ranges = structs_of<cuda::PairRange>(splats.ranges);
    by_depth.counts = counts;
    cuda::count_depths(by_depth, depth_scratch, stream_);
    check_stage("count_depths", options.debug);
    Tensor tile_memory = scratch;
    std::byte* tile_scratch = depth_scratch + depth_bytes + emit_bytes;
    if (capacity == 0) {
      const int64_t pairs = out.counts[0].item<int64_t>();
      guesses.use([&](cuda::PairGuesses& g) { g.counted(frame, n, pairs); });
      capacity = std::clamp<int64_t>(pairs, 1, cuda::max_items());
      tile_memory = make_zeros(cuda::tile_sort_scratch(capacity, grid));
      tile_scratch = static_cast<std::byte*>(tile_memory.data_ptr());
    }
    cuda::sort_by_depth(by_depth, depth_scratch, stream_);
    check_stage("sort_by_depth", options.debug);

    cuda::EmitParams emit = {};
    emit.splats = const_data_or_null<float>(splats.splats);
    emit.n = n;
    emit.footprint = footprint.choice.index;
    emit.grid = grid;
    emit.capacity = capacity;
    emit.counts = counts;
    emit.order = by_depth.order[0];
    emit.ranges = structs_of<cuda::PairRange>(splats.ranges);
    emit.status = reinterpret_cast<uint32_t*>(depth_scratch + depth_bytes);
    out.tile_offsets = at::empty({grid.tiles() + 1}, longs_);
    if (options.keep) {
      make_pairs<cuda::SlotPair>(emit, &cuda::EmitParams::slot_pairs, {frame.word, frame.number}, tile_scratch, out,
                                 options.debug);
    } else {
      make_pairs<int32_t>(emit, &cuda::EmitParams::splat_pairs, {frame.word, frame.number}, tile_scratch, out,
                          options.debug);
    }

    out.tile_samples = at::empty({footprint.chosen ? grid.tiles() : 0}, ints_);
    if (footprint.chosen) {
      cuda::ChooseParams p = {};
      p.splats = emit.splats;
      p.tile_samples = out.tile_samples.data_ptr<int32_t>();
      p.lists = tile_lists_of(out);
      p.grid = grid;
      p.background = background.const_data_ptr<float>();
      p.background_count = int(background.numel());
      p.options = footprint.choice.options;
      cuda::choose_samples(p, stream_);
      check_stage("choose_samples", options.debug);
    }
    return out;
  }

  ImageTensors blend(const ListTensors& lists, const FootprintSpec& footprint, TileGrid grid,
                     const ChannelTensors& channels, int64_t color_channels, const Tensor& background,
                     PassOptions options, BlendState& state) override {
    check_counts(lists);
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

    cuda::BlendParams p = {};
    p.lists = tile_lists_of(lists);
    p.grid = grid;
    p.splats = const_data_or_null<float>(lists.splats);
    p.channels = channels_of(channels);
    p.background = background.const_data_ptr<float>();
    p.image = planes_of<float>(out);
    p.alpha = data_or_null<float>(out.alpha);
    p.transmittance = data_or_null<float>(state.transmittance);
    p.last = data_or_null<int32_t>(state.last);

    const bool whole = cuda::blends_groups(footprint.choice.index, channels.count);
    const int64_t tiles = grid.tiles(), capacity = p.lists.capacity;
    const int64_t chunks = whole ? 0 : capacity / cuda::chunk_length(footprint.chosen ? 1 : footprint.samples);
    p.layout = {cuda::compiled_channels(!channels.rows.defined()), options.keep};
    const int64_t max_planes = !whole         ? p.layout.max_planes(grid, footprint.samples, capacity, footprint.chosen)
                               : options.keep ? cuda::max_state_planes(footprint.choice.index, capacity)
                                              : 0;
    state.checkpoints = at::empty({max_planes * kTile * kTile}, floats_);
    state.chunks = at::empty({kPlanRows + chunks + tiles, kChunkWidth}, ints_);
    C10_CUDA_CHECK(cudaMemsetAsync(state.chunks.data_ptr(), 0, sizeof(cuda::PlanState), stream_));
    const Tensor tail = at::empty({chunks + 1, kChunkWidth}, ints_);
    // Tiles in order, their planes, whether they are open, and the open ones by samples.
    const Tensor of_tiles = at::empty({3 + cuda::kSampleClasses, tiles}, ints_);
    auto* of_tile = of_tiles.data_ptr<int32_t>();
    p.plan.state = structs_of<cuda::PlanState>(state.chunks);
    p.plan.chunk_order = structs_of<cuda::TileChunk>(state.chunks) + kPlanRows;
    p.plan.tile_order = of_tile;
    p.plan.tile_planes = of_tile + tiles;
    p.plan.tail = structs_of<cuda::TileChunk>(tail);
    p.tile_open = of_tile + 2 * tiles;
    p.open_tiles = of_tile + 3 * tiles;
    p.checkpoints = data_or_null<float>(state.checkpoints);
    cuda::plan_chunks(p.lists, grid, footprint.samples, whole, p.layout, p.plan, stream_);
    check_stage("plan_chunks", options.debug);
    cuda::blend(footprint.choice.index, p, stream_);
    check_stage("blend", options.debug);
    return out;
  }

  std::vector<Tensor> inspect(const ListTensors& lists, const FootprintSpec& footprint, TileGrid grid,
                              int64_t count) override {
    check_counts(lists);
    const Tensor median = at::empty({grid.height, grid.width}, ints_), dominant = at::empty_like(median),
                 touched = at::zeros({count}, ints_), largest = at::zeros({count}, ints_),
                 total = at::zeros({count}, longs_);
    cuda::InspectParams p = {};
    p.splats = const_data_or_null<float>(lists.splats);
    p.lists = tile_lists_of(lists);
    p.grid = grid;
    p.median = median.data_ptr<int32_t>();
    p.dominant = dominant.data_ptr<int32_t>();
    p.touched = data_or_null<int32_t>(touched);
    p.largest = data_or_null<int32_t>(largest);
    p.units = data_or_null<int64_t>(total);
    cuda::inspect(footprint.choice.index, p, stream_);
    check_stage("inspect", false);
    return {median, dominant, touched, largest.view(at::kFloat), total};
  }

  PairSums blend_vjp(const ListTensors& lists, const BlendState& state, const FootprintSpec& footprint, TileGrid grid,
                     const ChannelTensors& channels, const Tensor& background, const ImageTensors& dL_dimage,
                     MeanSums mean_sums, bool debug) override {
    check_counts(lists);
    check_plan(state);
    const int64_t n = lists.ids.numel(), rows = std::max(lists.pairs.size(0), n);
    const int count = int(channels.count);
    PairSums out;
    out.pairs = at::empty({rows, cuda::kPairGradWidth}, floats_);
    if (mean_sums != MeanSums::kNone) out.means = out.pairs.narrow(1, cuda::kPairMeans, 2);
    cuda::BlendVjpParams p = {};
    p.grid = grid;
    p.splats = const_data_or_null<float>(lists.splats);
    p.channels = channels_of(channels);
    p.background = background.const_data_ptr<float>();
    p.transmittance = state.transmittance.const_data_ptr<float>();
    p.last = state.last.const_data_ptr<int32_t>();
    ImageTensors gradient = dL_dimage;
    if (!channels.rows.defined() && !gradient.color.defined())  // the kernels for three colours look for no null
      gradient.color = at::zeros({3, grid.height, grid.width}, floats_);
    p.dL_dimage = planes_of<const float>(gradient);
    p.dL_dalpha = const_data_or_null<float>(dL_dimage.alpha);
    p.lists = tile_lists_of(lists);
    p.plan = reinterpret_cast<const cuda::PlanState*>(state.chunks.const_data_ptr<int32_t>());
    p.chunk_order = reinterpret_cast<const cuda::TileChunk*>(state.chunks.const_data_ptr<int32_t>()) + kPlanRows;
    p.max_chunks = state.chunks.size(0) - kPlanRows;
    p.checkpoints = const_data_or_null<float>(state.checkpoints);
    p.pair_grads = out.pairs.data_ptr<float>();
    p.mean_sums = mean_sums;

    cuda::SumChannelsParams sum = {};
    sum.sums = pair_sums_of(lists, out.pairs);
    const bool few = count <= cuda::kFewChannels;
    const bool with_sums = channels.rows.defined() && !(few && channels.all_made);
    if (with_sums) {
      out.dL_dchannels = at::empty({n, count}, floats_);
      sum.dL_dchannels = data_or_null<float>(out.dL_dchannels);
      sum.stride = count;
    }
    Tensor channel_sums;
    if (!few) {
      channel_sums = at::empty({rows, cuda::kChannelGroup}, floats_);
      sum.channel_sums = p.channel_sums = channel_sums.data_ptr<float>();
    }
    const int width = few ? cuda::kFewChannels : cuda::kChannelGroup;
    for (int first = 0; first < count; first += width) {
      cuda::blend_vjp(footprint.choice.index, p, first / width, stream_);
      check_stage("blend_vjp", debug);
      sum.first = first;
      sum.count = std::min(count - first, width);
      if (with_sums) cuda::sum_channels(sum, stream_);
      check_stage("sum_channels", debug);
    }
    return out;
  }

  Tensor project_vjp(const Inputs& in, const ListTensors& lists, const FootprintSpec& footprint, const PairSums& sums,
                     ChannelColumns columns, const Grads& grads, bool with_camera, bool debug) override {
    cuda::ProjectVjpParams p = {};
    const Tensor camera_grads = set_projection_vjp(p, in, grads, with_camera);
    p.footprint = footprint.choice;
    p.sums = pair_sums_of(lists, sums.pairs);
    if (columns.color >= 0 || columns.depth >= 0 || columns.inverse_depth >= 0) {
      p.channels_in_pairs = !sums.dL_dchannels.defined();
      p.dL_dchannels.data = const_data_or_null<float>(sums.dL_dchannels);
      p.dL_dchannels.stride = p.channels_in_pairs ? 0 : sums.dL_dchannels.size(1);
      p.dL_dchannels.color = columns.color;
      p.dL_dchannels.depth = columns.depth;
      p.dL_dchannels.inverse_depth = columns.inverse_depth;
    }
    cuda::project_vjp(p, stream_);
    check_stage("project_vjp", debug);
    return camera_grads;
  }

  Tensor project_rows_vjp(const Inputs& in, const Tensor& rows, const RowTensors& dL_drows, const Grads& grads,
                          bool with_camera) override {
    cuda::ProjectRowsVjpParams p = {};
    const Tensor camera_grads = set_projection_vjp(p, in, grads, with_camera);
    p.rows.rows = const_data_or_null<int32_t>(rows);
    p.rows.means2d = elements_of<Vec2<float>>(dL_drows.means2d);
    p.rows.cov2d = elements_of<Sym2<float>>(dL_drows.cov2d);
    p.rows.opacities = const_data_or_null<float>(dL_drows.opacities);
    p.rows.depths = const_data_or_null<float>(dL_drows.depths);
    p.rows.colors = elements_of<Vec3<float>>(dL_drows.colors);
    cuda::project_rows_vjp(p, stream_);
    check_stage("project_rows_vjp", false);
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
    cuda::RowGradsParams p = {};
    p.n = n;
    p.rows = projected_rows_of(rows);
    p.footprint = footprint.choice;
    p.sums = pair_sums_of(lists, sums.pairs);
    p.dL_dmeans2d = mutable_elements_of<Vec2<float>>(out.means2d);
    p.dL_dcov2d = mutable_elements_of<Sym2<float>>(out.cov2d);
    p.dL_dopacities = data_or_null<float>(out.opacities);
    p.absolute = mutable_elements_of<Vec2<float>>(out.absolute);
    cuda::row_grads(p, stream_);
    check_stage("row_grads", false);
    return out;
  }

  Tensor weight(const Tensor& offset, const Tensor& cov2d, const FootprintSpec& footprint) override {
    const Tensor out = at::empty(offset.sizes().slice(0, offset.dim() - 1), floats_);
    AT_DISPATCH_FLOATING_TYPES(offset.scalar_type(), "footprint_weight", [&] {
      auto p = weight_params<WeightParams<scalar_t>, scalar_t>(offset, cov2d, footprint);
      p.weights = data_or_null<scalar_t>(out);
      cuda::weight(footprint.choice.index, p, stream_);
    });
    check_stage("footprint_weight", false);
    return out;
  }

  std::tuple<Tensor, Tensor> weight_vjp(const Tensor& dL_dweight, const Tensor& offset, const Tensor& cov2d,
                                        const FootprintSpec& footprint) override {
    const Tensor dL_doffset = at::empty(offset.sizes(), floats_), dL_dcov = at::empty(cov2d.sizes(), floats_);
    AT_DISPATCH_FLOATING_TYPES(offset.scalar_type(), "footprint_weight_vjp", [&] {
      auto p = weight_params<WeightParams<scalar_t>, scalar_t>(offset, cov2d, footprint);
      p.dL_dweights = const_data_or_null<scalar_t>(dL_dweight);
      p.dL_doffsets = reinterpret_cast<Vec2<scalar_t>*>(data_or_null<scalar_t>(dL_doffset));
      p.dL_dcovs = reinterpret_cast<Sym2<scalar_t>*>(data_or_null<scalar_t>(dL_dcov));
      cuda::weight_vjp(footprint.choice.index, p, stream_);
    });
    check_stage("footprint_weight_vjp", false);
    return {dL_doffset, dL_dcov};
  }

  double lap() override { return laps_.next(stream_); }

 private:
  /// Raises what a launch left behind; with `wait` waits for the stage to end first.
  void check_stage(const char* stage, bool wait) const {
    cudaError_t error = cudaGetLastError();
    if (wait && error == cudaSuccess) error = cudaStreamSynchronize(stream_);
    TORCH_CHECK(error == cudaSuccess, "CUDA error in ", stage, ": ", cudaGetErrorString(error));
  }

  /// Sorts count in 30 bits.
  static void check_count(int64_t n) {
    TORCH_CHECK_VALUE(n <= cuda::max_items(), "CUDA takes at most ", cuda::max_items(), " Gaussians, got ", n);
  }
  /// What the kernels read without looking: checks.h does not know their sizes.
  static void check_counts(const ListTensors& lists) {
    TORCH_CHECK_VALUE(lists.counts.numel() == kCountsWidth, "counts must be what bin returned, got shape ",
                      lists.counts.sizes());
  }
  static void check_plan(const BlendState& state) {
    const Tensor& chunks = state.chunks;
    TORCH_CHECK_VALUE(chunks.dim() == 2 && chunks.size(0) >= kPlanRows && chunks.size(1) == kChunkWidth &&
                          chunks.scalar_type() == at::kInt && state.checkpoints.scalar_type() == at::kFloat,
                      "chunks and checkpoints must be what blend saved, got shape ", chunks.sizes());
  }

  SplatTensors make_splats(int64_t n) const {
    check_count(n);
    SplatTensors out;
    out.splats = at::empty({n, kSplatWidth}, floats_);
    out.keys = at::empty({2, n}, ints_);
    out.ranges = at::empty({n, 2}, ints_);
    return out;
  }
  Tensor make_zeros(int64_t bytes) const {
    const Tensor memory = at::empty({bytes}, bytes_);
    C10_CUDA_CHECK(cudaMemsetAsync(memory.data_ptr(), 0, size_t(bytes), stream_));
    return memory;
  }

  /// What project and project_rows have in common.
  template <class Params>
  static void set_projection(Params& p, const Inputs& in, const FootprintSpec& footprint, const Tensor& radii) {
    p.camera = camera_of<float>(in);
    p.gaussians = gaussians_of<float>(in);
    p.footprint = footprint.choice;
    p.bounds = cull_bounds<float>(footprint.choice);
    p.radii = data_or_null<int32_t>(radii);
  }
  /// What project_vjp and project_rows_vjp have in common. Returns room for the camera's gradient.
  template <class Params>
  Tensor set_projection_vjp(Params& p, const Inputs& in, const Grads& grads, bool with_camera) const {
    p.camera = camera_of<float>(in);
    p.gaussians = gaussians_of<float>(in);
    p.grads = grads_of<float>(in, grads);
    if (!with_camera) return Tensor();
    const Tensor camera_grads = at::empty({cuda::warps_of(in.count()), kCameraGradWidth}, floats_);
    p.camera_grads = data_or_null<float>(camera_grads);
    return camera_grads;
  }

  /// Emits pairs of a splat, or of a splat and its slot, into the member `to`, and sorts them by tile.
  template <class Value>
  void make_pairs(cuda::EmitParams emit, Value* cuda::EmitParams::* to, cuda::PairFeedback feedback, void* scratch,
                  ListTensors& out, bool debug) const {
    constexpr int64_t kStride = sizeof(Value) / sizeof(int32_t);
    const Tensor tiles = at::empty({2, emit.capacity}, ints_);
    const Tensor values[2] = {at::empty({emit.capacity, kStride}, ints_), at::empty({emit.capacity, kStride}, ints_)};
    cuda::TileSort<Value> sort = {};
    sort.capacity = emit.capacity;
    sort.counts = emit.counts;
    sort.tile_offsets = out.tile_offsets.data_ptr<int64_t>();
    sort.feedback = feedback;
    for (int k = 0; k < 2; ++k) {
      sort.tiles[k] = structs_of<uint32_t>(tiles) + k * emit.capacity;
      sort.values[k] = structs_of<Value>(values[k]);
    }
    emit.tiles = sort.tiles[0];
    emit.*to = sort.values[0];
    cuda::emit_pairs(emit, stream_);
    check_stage("emit_pairs", debug);
    cuda::sort_by_tile(sort, emit.grid, scratch, stream_);
    check_stage("sort_by_tile", debug);
    out.pairs = values[cuda::tile_sort_result(emit.grid)];
  }

  c10::cuda::CUDAGuard guard_;
  c10::cuda::CUDAStream stream_;
  at::TensorOptions floats_, ints_, longs_, bytes_;
  Laps laps_;
};

}  // namespace

std::unique_ptr<Backend> make_cuda_backend(const Tensor& like) { return std::make_unique<CudaBackend>(like); }

/// For tests: room for so many pairs in every frame; 0: guesses again, from the start.
void force_pair_capacity(int64_t capacity) {
  SharedGuesses::instance().use([&](cuda::PairGuesses& g) { g.force(capacity); });
}

}  // namespace ar::ops
