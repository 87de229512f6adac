// The ops on CUDA tensors: check, sizes, allocate, launch. Nothing here waits for the device, except
// where there is no earlier frame to guess sizes from, in deterministic mode, and with debug.
#include <ATen/Context.h>
#include <c10/cuda/CUDAException.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>
#include <torch/library.h>

#include <algorithm>
#include <map>
#include <mutex>

#include "cuda/pair_guess.h"
#include "cuda/tasks.h"
#include "torch/views.h"

namespace ar::ops {
namespace {

using c10::cuda::CUDAStream;

/// Raises what a launch left behind; with debug waits for the stage to end first.
void check_stage(const char* stage, const CUDAStream& stream, bool debug) {
  cudaError_t error = cudaGetLastError();
  if (debug && error == cudaSuccess) error = cudaStreamSynchronize(stream);
  TORCH_CHECK(error == cudaSuccess, "CUDA error in ", stage, ": ", cudaGetErrorString(error));
}

void check_cuda(Inputs& in, bool debug) {
  TORCH_CHECK_TYPE(in.means3D.scalar_type() != at::kDouble,
                   "means3D must have dtype float32 on CUDA, got Double; float64 runs on the CPU");
  in.check();
  if (debug) in.check_camera();
}

/// The guesses of all image sizes. The device writes each frame's number of pairs to host memory when it
/// gets there; nobody waits for it.
class PairGuesses {
 public:
  static PairGuesses& instance() {
    static auto* guesses = new PairGuesses;  // outlives the CUDA context
    return *guesses;
  }

  /// Room for a frame, or 0: count its pairs.
  int64_t capacity(int device, TileGrid grid, int64_t gaussians, bool may_wait) {
    const std::lock_guard lock(mutex_);
    if (forced_ > 0) return forced_;
    Entry& entry = of(device, grid);
    return entry.guess.capacity(gaussians, *static_cast<const volatile int64_t*>(entry.seen()), may_wait);
  }
  void counted(int device, TileGrid grid, int64_t gaussians, int64_t pairs) {
    const std::lock_guard lock(mutex_);
    of(device, grid).guess.counted(gaussians, pairs);
  }
  /// Where the device is to leave the number of pairs.
  int64_t* feedback(int device, TileGrid grid) {
    const std::lock_guard lock(mutex_);
    return of(device, grid).seen();
  }
  void force(int64_t capacity) {
    const std::lock_guard lock(mutex_);
    forced_ = capacity;
    for (auto& [key, entry] : entries_) {
      entry.guess = cuda::PairGuess(cuda::max_pairs());
      *entry.seen() = 0;
    }
  }

 private:
  struct Entry {
    Tensor feedback;
    cuda::PairGuess guess{cuda::max_pairs()};
    int64_t* seen() { return feedback.data_ptr<int64_t>(); }
  };
  Entry& of(int device, TileGrid grid) {
    Entry& entry = entries_[{device, grid.width, grid.height}];
    if (!entry.feedback.defined())
      entry.feedback = at::zeros({1}, at::TensorOptions().dtype(at::kLong).pinned_memory(true));
    return entry;
  }

  std::mutex mutex_;
  std::map<std::tuple<int, int, int>, Entry> entries_;
  int64_t forced_ = 0;
};

bool is_capturing(const CUDAStream& stream) {
  cudaStreamCaptureStatus status = cudaStreamCaptureStatusNone;
  C10_CUDA_CHECK(cudaStreamIsCapturing(stream, &status));
  return status != cudaStreamCaptureStatusNone;
}

/// Of Counts, in numbers of 64 bits.
constexpr int64_t kCountsWidth = sizeof(cuda::Counts) / sizeof(int64_t);

/// Memory that must be zero, cleared in one go; and what the device counts.
struct Scratch {
  Tensor memory, counts;
  std::byte *depth_sort, *emit, *plan;

  Scratch(int64_t n, const Tensor& like, const CUDAStream& stream) {
    const int64_t sort = cuda::depth_sort_scratch(n), total = sort + cuda::emit_scratch(n) + cuda::kPlanCounters * 4;
    memory = at::empty({total}, like.options().dtype(at::kByte));
    counts = at::empty({kCountsWidth}, like.options().dtype(at::kLong));
    depth_sort = static_cast<std::byte*>(memory.data_ptr());
    emit = depth_sort + sort;
    plan = emit + cuda::emit_scratch(n);
    C10_CUDA_CHECK(cudaMemsetAsync(memory.data_ptr(), 0, total, stream));
    C10_CUDA_CHECK(cudaMemsetAsync(counts.data_ptr(), 0, sizeof(cuda::Counts), stream));
  }
  cuda::Counts* counts_view() const { return reinterpret_cast<cuda::Counts*>(counts.data_ptr<int64_t>()); }
};

struct Projected {
  Tensor splats, keys, ranges, radii;
};

Projected project(const Inputs& in, const cuda::ForwardStages& stages, const CUDAStream& stream, bool debug) {
  const int64_t n = in.count();
  const auto floats = in.means3D.options(), ints = floats.dtype(at::kInt);
  Projected out{at::empty({n, kSplatWidth}, floats), at::empty({2, n}, ints), at::empty({n, 2}, ints),
                at::empty({n}, ints)};
  stages.project({camera_of<float>(in), gaussians_of<float>(in), footprint_options(in.option),
                  out.splats.data_ptr<float>(), reinterpret_cast<uint32_t*>(out.keys.data_ptr<int32_t>()),
                  reinterpret_cast<cuda::PairRange*>(out.ranges.data_ptr<int32_t>()), out.radii.data_ptr<int32_t>()},
                 stream);
  check_stage("project", stream, debug);
  return out;
}

struct Binned {
  Tensor order, pairs, tile_offsets;
  int64_t capacity;
};

/// Emits and sorts pairs of a splat, or of a splat and its slot.
template <class Value>
void make_pairs(cuda::EmitTask emit, Value* const (&values)[2], int64_t* tile_offsets, Tensor& tiles,
                const cuda::ForwardStages& stages, const CUDAStream& stream, bool debug) {
  auto* tile = reinterpret_cast<uint32_t*>(tiles.data_ptr<int32_t>());
  emit.tiles = tile;
  stages.emit_pairs(emit, stream);
  check_stage("emit_pairs", stream, debug);
  const int64_t bytes = cuda::tile_sort_scratch(emit.capacity, emit.grid);
  const Tensor scratch = at::empty({bytes}, tiles.options().dtype(at::kByte));
  C10_CUDA_CHECK(cudaMemsetAsync(scratch.data_ptr(), 0, bytes, stream));
  cuda::sort_by_tile(
      cuda::TileSort<Value>{
          emit.capacity, emit.counts, {tile, tile + emit.capacity}, {values[0], values[1]}, tile_offsets},
      emit.grid, scratch.data_ptr(), stream);
  check_stage("sort_by_tile", stream, debug);
}

/// `exact`: make room for the pairs there are, not for a guess.
Binned bin(const Inputs& in, const Projected& projected, const cuda::ForwardStages& stages, const CUDAStream& stream,
           const Scratch& scratch, bool keep, bool exact, bool debug) {
  const int64_t n = in.count();
  const TileGrid grid = grid_of(in);
  const auto ints = projected.radii.options(), longs = ints.dtype(at::kLong);
  auto* ranges = reinterpret_cast<cuda::PairRange*>(projected.ranges.data_ptr<int32_t>());
  PairGuesses& guesses = PairGuesses::instance();
  const int device = in.means3D.get_device();
  const bool capturing = is_capturing(stream);
  int64_t capacity = exact ? 0 : guesses.capacity(device, grid, n, !capturing);
  TORCH_CHECK(capacity > 0 || !capturing,
              "a frame of this size must have been rendered before it is captured in a CUDA graph, without "
              "torch.use_deterministic_algorithms");
  Binned out;
  out.order = at::empty({n}, ints);
  const Tensor other = at::empty({n}, ints);
  auto* counts = scratch.counts_view();
  auto* keys = reinterpret_cast<uint32_t*>(projected.keys.data_ptr<int32_t>());
  const cuda::DepthSort by_depth = {
      n, {keys, keys + n}, {out.order.data_ptr<int32_t>(), other.data_ptr<int32_t>()}, ranges, counts};
  cuda::count_depths(by_depth, scratch.depth_sort, stream);
  check_stage("count_depths", stream, debug);
  if (capacity == 0) {
    const int64_t pairs = scratch.counts[0].item<int64_t>();
    guesses.counted(device, grid, n, pairs);
    capacity = std::clamp<int64_t>(pairs, 1, cuda::max_pairs());
  }
  out.capacity = capacity;
  cuda::sort_by_depth(by_depth, scratch.depth_sort, stream);
  check_stage("sort_by_depth", stream, debug);
  cuda::EmitTask emit{};
  emit.splats = projected.splats.const_data_ptr<float>();
  emit.n = n;
  emit.grid = grid;
  emit.capacity = capacity;
  emit.counts = counts;
  emit.order = out.order.const_data_ptr<int32_t>();
  emit.ranges = ranges;
  emit.status = reinterpret_cast<uint32_t*>(scratch.emit);
  Tensor tiles = at::empty({2, capacity}, ints);
  out.tile_offsets = at::empty({grid.tiles() + 1}, longs);
  const Tensor first = at::empty({capacity, keep ? 2 : 1}, ints), second = at::empty_like(first);
  if (keep) {
    cuda::SlotPair* values[2] = {reinterpret_cast<cuda::SlotPair*>(first.data_ptr<int32_t>()),
                                 reinterpret_cast<cuda::SlotPair*>(second.data_ptr<int32_t>())};
    emit.slot_pairs = values[0];
    make_pairs(emit, values, out.tile_offsets.data_ptr<int64_t>(), tiles, stages, stream, debug);
  } else {
    int32_t* values[2] = {first.data_ptr<int32_t>(), second.data_ptr<int32_t>()};
    emit.splat_pairs = values[0];
    make_pairs(emit, values, out.tile_offsets.data_ptr<int64_t>(), tiles, stages, stream, debug);
  }
  out.pairs = cuda::tile_sort_result(grid) == 0 ? first : second;
  return out;
}

cuda::TileLists lists_of(const Tensor& splats, const Tensor& order, const Tensor& pairs, const Tensor& tile_offsets,
                         const Tensor& counts, const Tensor& tile_samples) {
  return {splats.const_data_ptr<float>(),
          pairs.const_data_ptr<int32_t>(),
          int(pairs.size(1)),
          tile_offsets.const_data_ptr<int64_t>(),
          order.const_data_ptr<int32_t>(),
          reinterpret_cast<cuda::Counts*>(counts.data_ptr<int64_t>()),
          order.size(0),
          pairs.size(0),
          tile_samples.numel() ? tile_samples.data_ptr<int32_t>() : nullptr};
}

/// Memory of a plan. The backward pass goes on with the chunks that the forward pass made: (n, 3) tile,
/// chunk and checkpoint, longest first.
struct Plan {
  Tensor chunks, tile_planes, tile_order, rest;
  int64_t max_planes;
  cuda::ChunkPlan view;

  /// A tile has `samples` or, where they are chosen, fewer: then in more chunks, but no more planes.
  Plan(TileGrid grid, int64_t capacity, int samples, bool chosen, const at::TensorOptions& ints, std::byte* counters) {
    const int64_t n = grid.tiles(), most = capacity / cuda::chunk_length(chosen ? 1 : samples),
                  full = capacity / cuda::chunk_length(samples);
    // Tiles with a single chunk have none; of the others less than a chunk is not full. No number of
    // samples takes more planes per pair than the largest.
    max_planes = chosen ? 2 * capacity * samples / cuda::chunk_length(samples) : std::min(full + n, 2 * full) * samples;
    chunks = at::empty({most + n, 3}, ints);
    tile_planes = at::empty({n}, ints);
    tile_order = at::empty({n}, ints);
    rest = at::empty({most + 1, 3}, ints);
    view = {reinterpret_cast<cuda::TileChunk*>(chunks.data_ptr<int32_t>()), tile_order.data_ptr<int32_t>(),
            tile_planes.data_ptr<int32_t>(), reinterpret_cast<cuda::TileChunk*>(rest.data_ptr<int32_t>()),
            reinterpret_cast<int32_t*>(counters)};
  }
};

struct BlendedImage {
  Tensor color, transmittance, last, checkpoints, chunks;
  std::vector<Tensor> alpha;  ///< one, if asked for
};

/// Samples of every tile; empty where all have the same.
Tensor choose(const Inputs& in, const Projected& projected, const Binned& binned, const cuda::ForwardStages& stages,
              const CUDAStream& stream, const Scratch& scratch, bool debug) {
  const TileGrid grid = grid_of(in);
  const Tensor out = at::empty({stages.choose ? grid.tiles() : 0}, projected.radii.options());
  if (stages.choose) {
    stages.choose({lists_of(projected.splats, binned.order, binned.pairs, binned.tile_offsets, scratch.counts, out),
                   grid, in.background.const_data_ptr<float>(), footprint_options(in.option)},
                  stream);
    check_stage("choose", stream, debug);
  }
  return out;
}

/// `lists.counts` has pairs and splats, and zeros. `plan_counters` are zero.
BlendedImage blend(const cuda::TileLists& lists, TileGrid grid, const Tensor& background,
                   const cuda::ForwardStages& stages, const CUDAStream& stream, std::byte* plan_counters, bool keep,
                   bool with_alpha, bool debug) {
  const auto floats = background.options(), ints = floats.dtype(at::kInt);
  const int64_t samples = keep ? stages.samples : 0, height = grid.height, width = grid.width;
  const Plan plan(grid, lists.capacity, stages.samples, lists.tile_samples != nullptr, ints, plan_counters);
  int64_t* feedback = PairGuesses::instance().feedback(background.get_device(), grid);  // for the next frame's guess
  cuda::plan_chunks(lists, grid, stages.samples, plan.view, feedback, stream);
  check_stage("plan_chunks", stream, debug);
  const Tensor tile_open = at::empty({1 + cuda::kSampleClasses, grid.tiles()}, ints);
  BlendedImage out{at::empty({3, height, width}, floats),
                   at::empty({samples, height, width}, floats),
                   at::empty({samples, height, width}, ints),
                   at::empty({plan.max_planes, kTile * kTile, 4}, floats),
                   plan.chunks,
                   {}};
  if (with_alpha) out.alpha.push_back(at::empty({height, width}, floats));
  stages.blend({lists, plan.view, grid, background.const_data_ptr<float>(), tile_open.data_ptr<int32_t>(),
                tile_open.data_ptr<int32_t>() + grid.tiles(),
                reinterpret_cast<cuda::Checkpoint*>(out.checkpoints.data_ptr<float>()), out.color.data_ptr<float>(),
                keep ? out.transmittance.data_ptr<float>() : nullptr, keep ? out.last.data_ptr<int32_t>() : nullptr,
                with_alpha ? out.alpha[0].data_ptr<float>() : nullptr},
               stream);
  check_stage("blend", stream, debug);
  return out;
}
BlendedImage blend(const Inputs& in, const Projected& projected, const Binned& binned, const Tensor& tile_samples,
                   const cuda::ForwardStages& stages, const CUDAStream& stream, const Scratch& scratch, bool keep,
                   bool with_alpha, bool debug) {
  return blend(
      lists_of(projected.splats, binned.order, binned.pairs, binned.tile_offsets, scratch.counts, tile_samples),
      grid_of(in), in.background, stages, stream, scratch.plan, keep, with_alpha, debug);
}

RasterizeOutput rasterize_cuda(const Tensor& means3D, const OptionalTensor& means2D, const Tensor& opacities,
                               const OptionalTensor& shs, const OptionalTensor& colors_precomp,
                               const OptionalTensor& scales, const OptionalTensor& rotations,
                               const OptionalTensor& cov3D_precomp, const Tensor& bg, const Tensor& viewmatrix,
                               const Tensor& projmatrix, const Tensor& campos, const OptionalTensor& lens,
                               int64_t image_height, int64_t image_width, double tanfovx, double tanfovy,
                               double scale_modifier, int64_t sh_degree, std::string footprint, double option,
                               bool keep, bool with_alpha, bool debug) {
  Inputs in{means3D, opacities,      means2D,    shs,       colors_precomp, scales,       rotations,   cov3D_precomp,
            bg,      viewmatrix,     projmatrix, campos,    lens,           image_height, image_width, tanfovx,
            tanfovy, scale_modifier, sh_degree,  footprint, option};
  check_cuda(in, debug);
  const auto& stages = found(cuda::find_forward(footprint), footprint);
  const c10::cuda::CUDAGuard guard(means3D.device());
  const CUDAStream stream = c10::cuda::getCurrentCUDAStream();
  const bool exact = at::globalContext().deterministicAlgorithms();
  const Scratch scratch(in.count(), means3D, stream);
  const Projected projected = project(in, stages, stream, debug);
  const Binned binned = bin(in, projected, stages, stream, scratch, keep, exact, debug);
  const Tensor tile_samples = choose(in, projected, binned, stages, stream, scratch, debug);
  const BlendedImage image =
      blend(in, projected, binned, tile_samples, stages, stream, scratch, keep, with_alpha, debug);
  const auto kept = [&](const Tensor& t) { return keep ? t : at::empty({0}, t.options()); };
  return {image.color,
          projected.radii,
          kept(projected.splats),
          kept(binned.order),
          kept(binned.pairs),
          kept(binned.tile_offsets),
          kept(projected.ranges),
          at::empty({0}, projected.radii.options()),
          image.transmittance,
          image.last,
          kept(image.checkpoints),
          kept(image.chunks),
          kept(scratch.counts),
          tile_samples,
          image.alpha};
}

/// Time between stages, in seconds.
class StageTimer {
 public:
  explicit StageTimer(const CUDAStream& stream) : stream_(stream) {
    for (cudaEvent_t& event : events_) C10_CUDA_CHECK(cudaEventCreate(&event));
    mark();
  }
  ~StageTimer() {
    for (cudaEvent_t event : events_) cudaEventDestroy(event);
  }
  void mark() { C10_CUDA_CHECK(cudaEventRecord(events_[marks_++], stream_)); }
  Tensor seconds() const {
    C10_CUDA_CHECK(cudaEventSynchronize(events_[3]));
    const Tensor out = at::empty({3}, at::kDouble);
    for (int i = 0; i < 3; ++i) {
      float milliseconds = 0;
      C10_CUDA_CHECK(cudaEventElapsedTime(&milliseconds, events_[i], events_[i + 1]));
      out.data_ptr<double>()[i] = milliseconds * 1e-3;
    }
    return out;
  }

 private:
  CUDAStream stream_;
  cudaEvent_t events_[4] = {};
  int marks_ = 0;
};

StagesOutput rasterize_stages_cuda(const Tensor& means3D, const Tensor& opacities, const OptionalTensor& shs,
                                   const OptionalTensor& colors_precomp, const OptionalTensor& scales,
                                   const OptionalTensor& rotations, const OptionalTensor& cov3D_precomp,
                                   const Tensor& bg, const Tensor& viewmatrix, const Tensor& projmatrix,
                                   const Tensor& campos, const OptionalTensor& lens, int64_t image_height,
                                   int64_t image_width, double tanfovx, double tanfovy, double scale_modifier,
                                   int64_t sh_degree, std::string footprint, double option) {
  Inputs in{means3D, opacities,      std::nullopt, shs,       colors_precomp, scales,       rotations,   cov3D_precomp,
            bg,      viewmatrix,     projmatrix,   campos,    lens,           image_height, image_width, tanfovx,
            tanfovy, scale_modifier, sh_degree,    footprint, option};
  check_cuda(in, false);
  const auto& stages = found(cuda::find_forward(footprint), footprint);
  const c10::cuda::CUDAGuard guard(means3D.device());
  const CUDAStream stream = c10::cuda::getCurrentCUDAStream();
  StageTimer timer(stream);
  const Scratch scratch(in.count(), means3D, stream);
  const Projected projected = project(in, stages, stream, false);
  timer.mark();
  const Binned binned = bin(in, projected, stages, stream, scratch, false, true, false);
  timer.mark();
  const Tensor tile_samples = choose(in, projected, binned, stages, stream, scratch, false);
  const BlendedImage image = blend(in, projected, binned, tile_samples, stages, stream, scratch, false, false, false);
  timer.mark();
  const Tensor seconds = timer.seconds();
  const int64_t pairs = scratch.counts[0].item<int64_t>();
  // As on the CPU: only the Gaussians that were kept, and splats counted among those.
  const Tensor kept = projected.radii.gt(0);
  const Tensor ids = kept.nonzero().select(1, 0), place = kept.cumsum(0, at::kLong).sub(1);
  const Tensor view = viewmatrix.reshape({4, 4});
  const Tensor depths = (means3D.matmul(view.slice(0, 0, 3).select(1, 2)) + view[3][2]).index_select(0, ids);
  const Tensor splats = projected.splats.index_select(0, ids);
  const Tensor compact = place.index_select(0, binned.pairs.select(1, 0).slice(0, 0, pairs).to(at::kLong)).to(at::kInt);
  return {image.color, projected.radii,     ids.to(at::kInt), depths, splats.narrow(1, 0, 2).clone(),
          compact,     binned.tile_offsets, seconds};
}

/// The lists of rasterize must fit each other, the Gaussians and the image size.
void check_fit(const Tensor& splats, const Tensor& order, const Tensor& pairs, const Tensor& tile_offsets,
               const Tensor& counts, const Tensor& tile_samples, int64_t n, TileGrid grid, bool chosen) {
  TORCH_CHECK_TYPE(splats.scalar_type() == at::kFloat, "splats must have dtype float32 on CUDA, got ",
                   splats.scalar_type());
  TORCH_CHECK_VALUE(splats.size(0) == n && order.numel() == n && pairs.dim() == 2 && pairs.size(1) == 2 &&
                        pairs.numel() > 0 && tile_offsets.numel() == grid.tiles() + 1 &&
                        counts.numel() == kCountsWidth && tile_samples.numel() == (chosen ? grid.tiles() : 0),
                    "splats ... tile_samples must be the outputs of rasterize with keep=True for ", n,
                    " Gaussians and this image size, got splats of shape ", shape_of(splats),
                    " and tile_offsets of shape ", shape_of(tile_offsets));
}

InspectOutput inspect_cuda(const Tensor& splats, const Tensor& order, const Tensor& pairs, const Tensor& tile_offsets,
                           const Tensor& counts, const Tensor& tile_samples, int64_t count, int64_t image_height,
                           int64_t image_width, std::string footprint) {
  check_lists(splats, {order, pairs, tile_offsets, counts, tile_samples});
  check_image_size(image_height, image_width);
  const auto& stages = found(cuda::find_forward(footprint), footprint);
  const TileGrid grid = {int(image_width), int(image_height)};
  check_fit(splats, order, pairs, tile_offsets, counts, tile_samples, count, grid, stages.choose != nullptr);
  const c10::cuda::CUDAGuard guard(splats.device());
  const CUDAStream stream = c10::cuda::getCurrentCUDAStream();
  const auto ints = order.options();
  const Tensor median = at::empty({image_height, image_width}, ints), dominant = at::empty_like(median),
               touched = at::zeros({count}, ints), largest = at::zeros({count}, ints),
               total = at::zeros({count}, ints.dtype(at::kLong));
  stages.inspect({lists_of(splats, order, pairs, tile_offsets, counts, tile_samples), grid, median.data_ptr<int32_t>(),
                  dominant.data_ptr<int32_t>(), touched.data_ptr<int32_t>(), largest.data_ptr<int32_t>(),
                  total.data_ptr<int64_t>()},
                 stream);
  check_stage("inspect", stream, false);
  return {median, dominant, touched, largest.view(at::kFloat), total};
}

ChannelsOutput rasterize_channels_cuda(const Tensor& colors, const Tensor& bg, int64_t image_height,
                                       int64_t image_width, std::string footprint, double, const Tensor& splats,
                                       const Tensor& order, const Tensor& pairs, const Tensor& tile_offsets,
                                       const Tensor& counts, const Tensor& tile_samples, bool keep, bool debug) {
  check_lists(splats, {order, pairs, tile_offsets, counts, tile_samples});
  check_channels(colors, bg, splats);
  check_image_size(image_height, image_width);
  const auto& stages = found(cuda::find_forward(footprint), footprint);
  const TileGrid grid = {int(image_width), int(image_height)};
  check_fit(splats, order, pairs, tile_offsets, counts, tile_samples, colors.size(0), grid, stages.choose != nullptr);
  const c10::cuda::CUDAGuard guard(colors.device());
  const CUDAStream stream = c10::cuda::getCurrentCUDAStream();
  Tensor own = splats.clone();
  own.narrow(1, kSplatColor, 3).copy_(colors);
  Tensor own_counts = at::zeros_like(counts);
  constexpr int64_t kFound =
      offsetof(cuda::Counts, planes) / sizeof(int64_t);  // pairs and splats; the rest is of a plan
  own_counts.narrow(0, 0, kFound).copy_(counts.narrow(0, 0, kFound));
  const Tensor plan_counters = at::zeros({cuda::kPlanCounters}, order.options());
  const BlendedImage image =
      blend(lists_of(own, order, pairs, tile_offsets, own_counts, tile_samples), grid, bg.contiguous(), stages, stream,
            static_cast<std::byte*>(plan_counters.data_ptr()), keep, false, debug);
  return {image.color, image.checkpoints, image.chunks, own_counts};
}

/// The tensors that rasterize hands to its vjp must fit each other. Their contents are rasterize's own.
void check_saved(const Inputs& in, const Tensor& splats, const Tensor& order, const Tensor& pairs,
                 const Tensor& tile_offsets, const Tensor& ranges, const Tensor& transmittance, const Tensor& last,
                 const Tensor& checkpoints, const Tensor& chunks, const Tensor& counts, const Tensor& tile_samples,
                 const cuda::ForwardStages& stages) {
  const int64_t n = in.count();
  const std::vector<int64_t> image = {stages.samples, in.image_height, in.image_width};
  const int64_t tiles = grid_of(in).tiles();
  bool ok = splats.sizes() == at::IntArrayRef({n, kSplatWidth}) && order.sizes() == at::IntArrayRef({n}) &&
            pairs.dim() == 2 && pairs.size(1) == 2 && pairs.numel() > 0 && tile_offsets.numel() == tiles + 1 &&
            ranges.sizes() == at::IntArrayRef({n, 2}) && transmittance.sizes() == image && last.sizes() == image &&
            checkpoints.dim() == 3 && chunks.dim() == 2 && chunks.size(1) == 3 && counts.numel() == kCountsWidth &&
            tile_samples.numel() == (stages.choose ? tiles : 0);
  for (const Tensor* t : {&splats, &order, &pairs, &tile_offsets, &ranges, &transmittance, &last, &checkpoints, &chunks,
                          &counts, &tile_samples})
    ok = ok && t->is_contiguous() && t->device() == in.means3D.device();
  TORCH_CHECK_VALUE(ok,
                    "splats ... counts must be the outputs of rasterize with keep=True for the same arguments, got "
                    "splats of shape ",
                    shape_of(splats), " and transmittance of shape ", shape_of(transmittance));
}

Grads rasterize_vjp_cuda(const Tensor& dL_dcolor, const OptionalTensor& dL_dalpha, const Tensor& means3D,
                         const OptionalTensor& means2D, const Tensor& opacities, const OptionalTensor& shs,
                         const OptionalTensor& colors_precomp, const OptionalTensor& scales,
                         const OptionalTensor& rotations, const OptionalTensor& cov3D_precomp, const Tensor& bg,
                         const Tensor& viewmatrix, const Tensor& projmatrix, const Tensor& campos,
                         const OptionalTensor& lens, int64_t image_height, int64_t image_width, double tanfovx,
                         double tanfovy, double scale_modifier, int64_t sh_degree, std::string footprint, double option,
                         const Tensor& splats, const Tensor& order, const Tensor& pairs, const Tensor& tile_offsets,
                         const Tensor& ranges, const Tensor&, const Tensor& transmittance, const Tensor& last,
                         const Tensor& checkpoints, const Tensor& chunks, const Tensor& counts,
                         const Tensor& tile_samples, Needs needs, bool debug) {
  Inputs in{means3D, opacities,      means2D,    shs,       colors_precomp, scales,       rotations,   cov3D_precomp,
            bg,      viewmatrix,     projmatrix, campos,    lens,           image_height, image_width, tanfovx,
            tanfovy, scale_modifier, sh_degree,  footprint, option};
  check_cuda(in, debug);
  in.check_gradient(dL_dcolor, dL_dalpha);
  const auto& forward = found(cuda::find_forward(footprint), footprint);
  const auto& stages = found(cuda::find_backward(footprint), footprint);
  check_saved(in, splats, order, pairs, tile_offsets, ranges, transmittance, last, checkpoints, chunks, counts,
              tile_samples, forward);
  const c10::cuda::CUDAGuard guard(means3D.device());
  const CUDAStream stream = c10::cuda::getCurrentCUDAStream();
  Grads out = make_grads(in, needs);
  const GaussianGrads<float> grads = grads_of<float>(in, out);
  const TileGrid grid = grid_of(in);
  const cuda::TileLists lists = lists_of(splats, order, pairs, tile_offsets, counts, tile_samples);
  const Tensor pair_grads = at::empty({std::max(pairs.size(0), in.count()), cuda::kPairGradWidth}, means3D.options());
  const Tensor g = dL_dcolor.contiguous(), g_alpha = dL_dalpha ? dL_dalpha->contiguous() : Tensor();
  stages.blend_vjp(
      {lists, reinterpret_cast<const cuda::TileChunk*>(chunks.const_data_ptr<int32_t>()), grid, chunks.size(0),
       in.background.const_data_ptr<float>(),
       reinterpret_cast<const cuda::Checkpoint*>(checkpoints.const_data_ptr<float>()),
       transmittance.const_data_ptr<float>(), last.const_data_ptr<int32_t>(), g.const_data_ptr<float>(),
       const_data_or_null<float>(g_alpha), pair_grads.data_ptr<float>(), grads.means2d && grads.means2d_stride == 4},
      stream);
  check_stage("blend_vjp", stream, debug);
  const Tensor camera_grads = make_camera_grads(in, needs, cuda::warps_of(in.count()));
  stages.project_vjp({camera_of<float>(in), gaussians_of<float>(in), footprint_options(option),
                      reinterpret_cast<const cuda::PairRange*>(ranges.const_data_ptr<int32_t>()), lists.counts,
                      pairs.size(0), pair_grads.const_data_ptr<float>(), grads, data_or_null<float>(camera_grads)},
                     stream);
  check_stage("project_vjp", stream, debug);
  set_camera_grads(in, needs, camera_grads, out);
  return out;
}

Tensor footprint_weight_cuda(const Tensor& offset, const Tensor& cov2d, std::string footprint, double option) {
  check_weight_arguments(offset, cov2d, option);
  const auto& stages = found(cuda::find_forward(footprint), footprint);
  const c10::cuda::CUDAGuard guard(offset.device());
  const CUDAStream stream = c10::cuda::getCurrentCUDAStream();
  const Tensor d = offset.contiguous(), c = cov2d.contiguous();
  const Tensor out = at::empty(offset.sizes().slice(0, offset.dim() - 1), offset.options());
  const auto run = [&](auto task, auto launch) {
    task.weights = out.data_ptr<std::remove_pointer_t<decltype(task.weights)>>();
    launch(task, stream);
  };
  if (offset.scalar_type() == at::kFloat) {
    run(weight_task<WeightTask<float>, float>(d, c, option), stages.weight_float);
  } else {
    run(weight_task<WeightTask<double>, double>(d, c, option), stages.weight_double);
  }
  check_stage("footprint_weight", stream, false);
  return out;
}

std::tuple<Tensor, Tensor> footprint_weight_vjp_cuda(const Tensor& dL_dweight, const Tensor& offset,
                                                     const Tensor& cov2d, std::string footprint, double option) {
  check_weight_arguments(offset, cov2d, option);
  check_weight_gradient(dL_dweight, offset);
  const auto& stages = found(cuda::find_backward(footprint), footprint);
  const c10::cuda::CUDAGuard guard(offset.device());
  const CUDAStream stream = c10::cuda::getCurrentCUDAStream();
  const Tensor g = dL_dweight.contiguous(), d = offset.contiguous(), c = cov2d.contiguous();
  const Tensor dL_doffset = at::empty(offset.sizes(), offset.options()),
               dL_dcov = at::empty(cov2d.sizes(), cov2d.options());
  const auto run = [&](auto task, auto launch) {
    using T = std::remove_pointer_t<decltype(task.weights)>;
    task.dL_dweights = g.const_data_ptr<T>();
    task.dL_doffsets = reinterpret_cast<Vec2<T>*>(dL_doffset.data_ptr<T>());
    task.dL_dcovs = reinterpret_cast<Sym2<T>*>(dL_dcov.data_ptr<T>());
    launch(task, stream);
  };
  if (offset.scalar_type() == at::kFloat) {
    run(weight_task<WeightTask<float>, float>(d, c, option), stages.weight_vjp_float);
  } else {
    run(weight_task<WeightTask<double>, double>(d, c, option), stages.weight_vjp_double);
  }
  check_stage("footprint_weight_vjp", stream, false);
  return {dL_doffset, dL_dcov};
}

TORCH_LIBRARY_IMPL(analytic_rasterizer, CUDA, m) {
  m.impl("rasterize", rasterize_cuda);
  m.impl("rasterize_vjp", rasterize_vjp_cuda);
  m.impl("rasterize_stages", rasterize_stages_cuda);
  m.impl("rasterize_channels", rasterize_channels_cuda);
  m.impl("inspect", inspect_cuda);
  m.impl("footprint_weight", footprint_weight_cuda);
  m.impl("footprint_weight_vjp", footprint_weight_vjp_cuda);
}

}  // namespace

void force_pair_capacity(int64_t capacity) { PairGuesses::instance().force(capacity); }

}  // namespace ar::ops
