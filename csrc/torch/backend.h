// Backend: a function per stage, and tensors between stages. Ops allocate what all devices share, backends the rest.
#pragma once

#include <ATen/Context.h>
#include <ATen/ops/empty.h>

#include <algorithm>
#include <array>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include "core/order.h"
#include "core/stages.h"
#include "torch/arguments.h"
#include "torch/images.h"

namespace ar::ops {

/// CPU: of Gaussians that may be seen. CUDA: of all, not to count them.
struct SplatTensors {
  Tensor splats;       ///< (n, kSplatWidth).
  Tensor ids, depths;  ///< CPU: (n,), ids ascending.
  Tensor slopes;       ///< CPU: (n, 2) of RayDepth, in the order along rays.
  // CUDA:
  Tensor counts;  ///< Counts, zero.
  Tensor ranges;  ///< (n, kRangeWidth) PairRange.
  Tensor rays;    ///< (n, kRayWidth) RayDepth, in the order along rays.
  Tensor memory;  ///< SplatMemory (cuda_views.h).
};

/// Members that a device does not use are empty.
struct ListTensors {
  Tensor splats;         ///< (n, kSplatWidth).
  Tensor ids;            ///< (n,) int32. CPU: Gaussians. CUDA: splats by depth.
  Tensor pairs;          ///< int32. CPU: (N,) splats. CUDA: (room, kPairWidth), or (room, 1) without keep.
  Tensor tile_offsets;   ///< (tiles + 1,) int64 first pair of a tile, or of a patch where tiles share lists.
  Tensor splat_offsets;  ///< CPU: (n + 1,) int64 into positions. CUDA: (n, kRangeWidth) int32 PairRange.
  Tensor positions;      ///< CPU: (N,) int64 indices of pairs, by splat.
  Tensor counts;         ///< CUDA: (kCountsWidth,) int64 Counts.
  Tensor rays;           ///< (n, kRayWidth) RayDepth, in the order along rays.

  static constexpr size_t kMembers = 8;
  static constexpr int64_t kPairWidth = 2, kRangeWidth = 2, kCountsWidth = 4, kRayWidth = 3;
  template <class Visit> void each(Visit&& visit) {
    visit("splats", splats);
    visit("ids", ids);
    visit("pairs", pairs);
    visit("tile_offsets", tile_offsets);
    visit("splat_offsets", splat_offsets);
    visit("positions", positions);
    visit("counts", counts);
    visit("rays", rays);
  }
};

struct BlendState {
  Tensor transmittance;  ///< (samples, H, W).
  Tensor last;           ///< (samples, H, W) int32.
  Tensor checkpoints;    ///< CUDA: state of pixels between chunks of long lists.
  Tensor chunks;         ///< CUDA: (m, kChunkWidth) int32, the plan (cuda_views.h).

  static constexpr size_t kMembers = 4;
  static constexpr int64_t kChunkWidth = 3;
  template <class Visit> void each(Visit&& visit) {
    visit("transmittance", transmittance);
    visit("last", last);
    visit("checkpoints", checkpoints);
    visit("chunks", chunks);
  }
};

/// What `row_grads` reads of packed rows.
struct KeptRows {
  Tensor covs;       ///< (n, kCovWidth): cov2d and its determinant.
  Tensor opacities;  ///< (n,).

  static constexpr size_t kMembers = 2;
  static constexpr int64_t kCovWidth = 4;
  template <class Visit> void each(Visit&& visit) {
    visit("covs", covs);
    visit("opacities", opacities);
  }
};

/// As in the ops' results. Undefined: not wanted.
struct SummaryTensors {
  Tensor median;                        ///< (1, H, W) depth.
  Tensor dominant;                      ///< (1, H, W) int32.
  Tensor touched, in_front, dominated;  ///< (count,) int32.
  Tensor largest;                       ///< (count,) float32. Kernels compare its bits as int32.
  Tensor total;                         ///< (count,) int64 in units of kWeightUnit.

  template <class Visit> void each(Visit&& visit) {
    visit("median", median);
    visit("dominant", dominant);
    visit("touched", touched);
    visit("largest", largest);
    visit("total", total);
    visit("in_front", in_front);
    visit("dominated", dominated);
  }
};

template <class Members> void append_to(std::vector<Tensor>& list, Members members) {
  members.each([&](const char*, Tensor& t) { list.push_back(t); });
}
template <class Members> Members from_list(const std::vector<Tensor>& list, size_t first) {
  Members members;
  members.each([&](const char*, Tensor& t) { t = list[first++]; });
  return members;
}

struct PairSums {
  Tensor pairs;         ///< CPU: (N, kPairNumbers), plus 3 for colours. CUDA: (room, kPairGradWidth).
  Tensor means;         ///< (N, 2) MeanSums, if wanted.
  Tensor dL_dchannels;  ///< Like ChannelTensors::rows; undefined if `pairs` has all.
};

/// ProjectedRows of core/stages.h, or their gradient.
struct RowTensors {
  Tensor means2d, cov2d, dets, opacities, depths, colors;
  Tensor slopes;    ///< (n, 2) of RayDepth, in the order along rays.
  Tensor absolute;  ///< Of a gradient: (n, 2) sums of |dL/dmeans2d|.
  Tensor packed;    ///< PackedRow or its gradient, instead of all others.
  KeptRows kept;
  double center = 0;       ///< Of pixels, in means2d.
  bool any_color = false;  ///< A colour that is not finite is drawn.

  std::array<Tensor*, 5> numbers() { return {&means2d, &cov2d, &dets, &opacities, &depths}; }
};

/// RowOutputs of core/stages.h: rows of all cameras.
struct ProjectedTensors {
  Tensor means2d, cov2d, dets, opacities, depths;
  Tensor features;                  ///< (n, K), three colours first if `colored`, a depth last if `shows_depth`.
  Tensor radii;                     ///< (n,), or (n, 2) of a RowMeasure, which has conics too.
  Tensor conics, shown_opacities;   ///< Or undefined.
  Tensor slopes;                    ///< (n, 2) of RayDepth; undefined: not in the order along rays.
  Tensor gaussian_ids, camera_ids;  ///< Or undefined.
  Tensor ends;                      ///< (P,) int32 of this camera; undefined: a table.
  Tensor flags;                     ///< (P,) int32, instead of all others.
  bool colored = false, shows_depth = false;
  int64_t camera = 0, first = 0, last = 0;  ///< Of its rows, `last` only with `ends`.
  double center = 0;
};

/// The gradient of what `project_rows` wrote; undefined tensors are zero.
struct ProjectedGrads {
  Tensor means2d, cov2d, opacities, depths;
  Tensor features;  ///< As ProjectedTensors::features.
  Tensor packed;    ///< Instead of all others.
  bool colored = false, shows_depth = false;
  DepthKind order = DepthKind::kOfModel, shown = DepthKind::kNone;
  Tensor rows, ends, radii;  ///< Of RowPlaces, or undefined.
  int64_t first = 0, last = 0;
};

/// PackedRows of core/stages.h.
struct PackedTensors {
  Tensor rows;        ///< (room, kPackedWidth).
  Tensor radii, ids;  ///< (room,) int32.
  Tensor ends;        ///< (P,) int32.
  Tensor first;       ///< () int64.
  int64_t first_id;
};

struct WeightTensors {
  Tensor offset, cov2d, weight;
  Tensor dL_dweight, dL_doffset, dL_dcov2d;
};

struct FootprintSpec {
  FootprintChoice choice;
  int samples;  ///< Per pixel.
  bool moves;   ///< Samples have a position as state.
  int lanes;    ///< Of CUDA, for a pixel's samples.
  int window;   ///< Slots (core/order.h); 0: in the order of centres.

  bool along_rays() const { return window > 0; }
};
/// Between a footprint's key and the window's size: "moment4:ray24".
inline constexpr std::string_view kRayMark = ":ray";
FootprintSpec find_footprint(const std::string& key, double option);

/// On CUDA some have small tiles (cuda/dispatch.h).
TileGrid grid_of(const FootprintSpec& footprint, int64_t width, int64_t height, bool cuda);

struct Pass {
  FootprintSpec footprint;
  TileGrid grid;
  bool keep = false;   ///< For a backward pass.
  bool debug = false;  ///< Wait for every stage.
  bool exact;          ///< Count pairs, which CUDA else guesses.

  template <class Arguments>
  Pass(const Arguments& a, const Tensor& like)
      : footprint(find_footprint(a.footprint, a.option)),
        grid(grid_of(footprint, a.image_width, a.image_height, like.is_cuda())),
        exact(at::globalContext().deterministicAlgorithms()) {}
};

/// For `blend` and blend_vjp. Raises if there are too many channels for the order.
template <typename T> RayOrder<T> ray_order_of(const ListTensors& lists, const Pass& pass, int64_t channels) {
  TORCH_CHECK_VALUE(!pass.footprint.along_rays() || channels <= kMaxRayChannels, "order 'ray' can blend at most ",
                    kMaxRayChannels, " channels, got ", channels);
  return {const_pointer<RayDepth<T>>(lists.rays), pass.footprint.window};
}

inline BlendState make_state(const Pass& pass, const Tensor& like) {
  if (!pass.keep) return {};
  const std::vector<int64_t> planes = {pass.footprint.samples, pass.grid.height, pass.grid.width};
  BlendState state;
  state.transmittance = at::empty(planes, like.options());
  state.last = at::empty(planes, like.options().dtype(at::kInt));
  return state;
}

class Backend {
 public:
  virtual ~Backend() = default;

  /// Whether `blend` or `inspect` writes this output, by its name in kImageSwitches or SummaryTensors.
  virtual bool writes(std::string_view output) const = 0;

  /// Writes radii (P,) int32, and its columns of `channels`.
  virtual SplatTensors project(const Inputs& in, const Pass& pass, const ChannelTensors& channels,
                               const Tensor& radii) = 0;
  virtual void project_rows(const Inputs& in, const Pass& pass, const RowRules<double>& rules,
                            const ProjectedTensors& rows) = 0;
  virtual void pack_rows(const Inputs& in, const Pass& pass, const PackedTensors& packed) = 0;
  virtual SplatTensors shape_rows(const RowTensors& rows, const Pass& pass) = 0;
  virtual ListTensors bin(const SplatTensors& splats, const Pass& pass) = 0;
  /// Waits for the device.
  virtual bool tiles_share_lists(const ListTensors&) { return false; }
  /// Writes `image` and what make_state() made, and makes the rest of `state`.
  virtual void blend(const ListTensors& lists, const Pass& pass, const ChannelTensors& channels,
                     const ImageTensors& image, BlendState& state) = 0;
  /// All but median and dominant are zero before. `depths`: the result of `project` (on CUDA undefined: those of the
  /// Gaussians `in`); or of rows, without `in`.
  virtual void inspect(const ListTensors& lists, const Pass& pass, const Tensor& depths, const Inputs* in,
                       const SummaryTensors& summary) = 0;

  /// Where project_vjp, which must follow, writes nothing. May run beside blend_vjp.
  virtual void zero_culled_grads(const Inputs&, const ListTensors&, const Pass&, const Grads&) {}
  virtual PairSums blend_vjp(const ListTensors& lists, const BlendState& state, const Pass& pass,
                             const ChannelTensors& channels, const ImageTensors& dL_dimage, MeanSums mean_sums) = 0;
  /// Writes `grads`. Returns parts of the camera's gradient, (parts, kCameraGradWidth).
  virtual Tensor project_vjp(const Inputs& in, const ListTensors& lists, const Pass& pass, const PairSums& sums,
                             const ChannelTensors& channels, const Grads& grads) = 0;
  /// The same from gradients of public rows. Adds if grads.add.
  virtual Tensor project_rows_vjp(const Inputs& in, const ProjectedGrads& dL_drows, const Grads& grads) = 0;
  /// `parts`: what the two above returned. Adds up in double, in a fixed order.
  virtual void sum_camera_grads(const Tensor& parts, const Grads& grads) = 0;
  virtual void row_grads(const RowTensors& rows, const ListTensors& lists, const Pass& pass, const PairSums& sums,
                         const RowTensors& dL_drows) = 0;

  /// With dL_dweight the adjoint.
  virtual void weight(const WeightTensors& tensors, const FootprintSpec& footprint) = 0;

  /// Seconds of the device since the last call. Waits for it.
  virtual double lap() = 0;
};

/// For tests: an output that ops refuse.
inline std::string& withheld_output() {
  static std::string name;
  return name;
}

/// Raises if the device does not write an output.
inline void check_output(const Backend& backend, std::string_view name, const Tensor& like) {
  TORCH_CHECK_NOT_IMPLEMENTED(backend.writes(name) && name != withheld_output(), name, " cannot be made on ",
                              at::DeviceTypeName(like.device().type(), /*lower_case=*/true), " yet");
}

inline ImageTensors make_images(const Backend& backend, const ChannelTensors& channels, const ImageSwitches& wanted,
                                TileGrid grid) {
  const at::TensorOptions options = channels.background.options();
  ImageTensors out;
  for (size_t k = 0; k < kImageCount; ++k) {
    if (!wanted[k]) continue;
    check_output(backend, name_of(kImageSwitches[k]), channels.background);
    out.others[k] = at::empty({grid.height, grid.width}, options);
  }
  out.color = at::empty({channels.color_channels, grid.height, grid.width}, options);
  return out;
}

/// Torch's number, but at most the container's CPU quota.
int thread_count();

/// The device of `like` is the current one while the backend lives.
std::unique_ptr<Backend> make_cpu_backend(const Tensor& like);
std::unique_ptr<Backend> make_cuda_backend(const Tensor& like);
inline std::unique_ptr<Backend> make_backend(const Tensor& like) {
#if defined(AR_WITH_CUDA)
  if (like.is_cuda()) return make_cuda_backend(like);
#endif
  return make_cpu_backend(like);
}

}  // namespace ar::ops
