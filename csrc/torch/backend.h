// What a device must be able to do: a stage per function. The ops (rasterize.cpp, stages.cpp) are written once for all
// devices. They check the arguments and allocate what is the same everywhere; a backend allocates the rest, sets the
// parameters of its stages (core/stages.h) and launches them.
#pragma once

#include <ATen/Context.h>
#include <ATen/ops/empty.h>

#include <array>
#include <memory>
#include <vector>

#include "core/stages.h"
#include "torch/arguments.h"
#include "torch/images.h"

namespace ar::ops {

/// Splats on their way from `project` to `bin`. On the CPU there is a row for every Gaussian that may be seen; on CUDA
/// one for every Gaussian, so that nothing has to be counted.
struct SplatTensors {
  Tensor splats;  ///< (n, kSplatWidth) SplatRow
  Tensor ids;     ///< (n,) int32, CPU: the Gaussian of each, ascending
  Tensor depths;  ///< (n,) CPU
  Tensor counts;  ///< (4,) int64, CUDA: the numbers of Counts (csrc/cuda/params.h), which `project` sets to zero
  Tensor ranges;  ///< (n, 2) int32, CUDA: first slot, for a backward pass, and number of pairs of each
  Tensor memory;  ///< bytes, CUDA: SplatMemory (cuda_views.h)
};

/// Splats by tile, front to back: what `bin` makes and `blend` reads. Members that a device does not use are empty.
struct ListTensors {
  Tensor splats;  ///< (n, kSplatWidth)
  Tensor ids;     ///< (n,) int32; CPU: the Gaussian of each splat; CUDA: splats in the order of depth
  Tensor pairs;   ///< CPU: (N,) int32 splats; CUDA: (room, 2) splats and slots, or (room, 1) without a backward pass
  Tensor tile_offsets;   ///< (tiles + 1,) int64, first pair of each tile; of a patch, where tiles share lists
  Tensor splat_offsets;  ///< CPU: (n + 1,) int64 into positions; CUDA: (n, 2) int32 first slot and number of slots
  Tensor positions;      ///< CPU: (N,) int64 places in `pairs` of each splat's pairs
  Tensor counts;         ///< CUDA: the numbers of Counts (csrc/cuda/params.h)

  static constexpr size_t kMembers = 7;
  template <class Visit> void each(Visit&& visit) {
    visit("splats", splats);
    visit("ids", ids);
    visit("pairs", pairs);
    visit("tile_offsets", tile_offsets);
    visit("splat_offsets", splat_offsets);
    visit("positions", positions);
    visit("counts", counts);
  }
};

/// What `blend` leaves for its adjoint.
struct BlendState {
  Tensor transmittance;  ///< (samples, H, W)
  Tensor last;           ///< (samples, H, W) int32
  Tensor checkpoints;    ///< CUDA: state of every pixel between chunks of long lists
  Tensor chunks;         ///< CUDA: (m, 3) int32: the plan's counts, then tile, chunk and plane of every chunk

  static constexpr size_t kMembers = 4;
  template <class Visit> void each(Visit&& visit) {
    visit("transmittance", transmittance);
    visit("last", last);
    visit("checkpoints", checkpoints);
    visit("chunks", chunks);
  }
};

/// The members of a struct above as a list of tensors, for an op to return, and back.
template <class Members> void append_to(std::vector<Tensor>& list, Members members) {
  members.each([&](const char*, Tensor& t) { list.push_back(t); });
}
template <class Members> Members from_list(const std::vector<Tensor>& list, size_t first) {
  Members members;
  members.each([&](const char*, Tensor& t) { t = list[first++]; });
  return members;
}

/// Sums over the pairs of every splat, as `blend_vjp` leaves them for `project_vjp` or `row_grads`.
struct PairSums {
  Tensor pairs;  ///< CPU: (N, 6), or (N, 9) with the three colours; CUDA: (room, kPairGradWidth)
  Tensor means;  ///< (N, 2) MeanSums, if they are wanted
  /// Like ChannelTensors::rows; undefined where the pairs hold the three colours, or all that `project` made.
  Tensor dL_dchannels;
};

/// The public form of splats (ProjectedRows in core/stages.h), or gradients with respect to it.
struct RowTensors {
  Tensor means2d, cov2d, dets, opacities, depths, colors;
  Tensor absolute;  ///< of a gradient (n, 2): sums over pixels of |dL/dmeans2d|, if PairSums has them
  /// In the place of all others (n, kPackedWidth) PackedRow, or of a gradient (n, kPackedGradWidth or more).
  Tensor packed;
  Tensor kept_covs, kept_opacities;  ///< (n, 4), (n,): all that row_grads reads of packed rows

  /// Those that every splat has.
  std::array<Tensor*, 5> numbers() { return {&means2d, &cov2d, &dets, &opacities, &depths}; }
};

/// Where `project_rows` leaves packed rows (PackedRows in core/stages.h).
struct PackedTensors {
  Tensor rows;        ///< (room, kPackedWidth)
  Tensor radii, ids;  ///< (room,) int32
  Tensor ends;        ///< (P,) int32
  Tensor first;       ///< () int64
  int64_t first_id;
};

/// What `inspect` finds, in the order in which the op returns it.
struct SummaryTensors {
  Tensor median, dominant;         ///< (H, W) int32
  Tensor touched, largest, total;  ///< (count,) int32, float32 whose bits are raised as int32, int64
  Tensor in_front, dominated;      ///< (count,) int32
};

/// One weight per element, or its adjoint.
struct WeightTensors {
  Tensor offset, cov2d;
  Tensor weight;                             ///< written
  Tensor dL_dweight, dL_doffset, dL_dcov2d;  ///< of the adjoint, which reads the first
};

/// The chosen footprint.
struct FootprintSpec {
  FootprintChoice choice;
  int samples;  ///< of a pixel
  bool moves;   ///< samples carry a state besides their transmittance
  int lanes;    ///< over which a pixel's samples may be spread on CUDA
};

/// The footprint of this key and number. Raises ValueError if there is none.
FootprintSpec find_footprint(const std::string& key, double option);

/// The tiles of an image: on CUDA those of samples that move or are spread over lanes may be smaller.
TileGrid grid_of(const FootprintSpec& footprint, int64_t width, int64_t height, bool cuda);

/// What all stages of a pass share.
struct Pass {
  FootprintSpec footprint;
  TileGrid grid;
  bool keep = false;   ///< what a backward pass needs
  bool debug = false;  ///< wait for every stage, so that the stage that failed is the one that raises
  bool exact;          ///< count pairs before room is made for them, whatever earlier frames had

  /// For tensors like `like`.
  template <class Arguments>
  Pass(const Arguments& a, const Tensor& like)
      : footprint(find_footprint(a.footprint, a.option)),
        grid(grid_of(footprint, a.image_width, a.image_height, like.is_cuda())),
        exact(at::globalContext().deterministicAlgorithms()) {}
};

/// With pass.keep, room for the members of BlendState that are the same on every device.
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

  // Forward.
  /// Splats of every Gaussian that may be seen. Writes `radii` (P,) int32, and into `channels` the columns it makes.
  virtual SplatTensors project(const Inputs& in, const Pass& pass, const ChannelTensors& channels,
                               const Tensor& radii) = 0;
  /// Writes the public rows of all Gaussians (P, ...) and radii; rows of those with radius 0 are undefined. Without
  /// rows it writes only radii, which are not zero for colours that are not finite.
  virtual void project_rows(const Inputs& in, const Pass& pass, const RowTensors& rows, const Tensor& radii) = 0;
  /// The same in packed rows, of those Gaussians alone that have a radius.
  virtual void pack_rows(const Inputs& in, const Pass& pass, const PackedTensors& packed) = 0;
  /// Splats from public rows. Writes `kept_covs` and `kept_opacities` if they are given.
  virtual SplatTensors shape_rows(const RowTensors& rows, const Pass& pass) = 0;
  /// Lists by tile and depth.
  virtual ListTensors bin(const SplatTensors& splats, const Pass& pass) = 0;
  /// Whether there was no room for a list of each tile, which with Pass::exact there is but for more pairs than a list
  /// can have. Waits for the device.
  virtual bool tiles_share_lists(const ListTensors&) { return false; }
  /// Writes `image` and, with pass.keep, the tensors of make_state; makes the others of `state`.
  virtual void blend(const ListTensors& lists, const Pass& pass, const ChannelTensors& channels,
                     const ImageTensors& image, BlendState& state) = 0;
  virtual void inspect(const ListTensors& lists, const Pass& pass, const SummaryTensors& summary) = 0;

  // Backward.
  /// Before blend_vjp, and beside it where the device can: zeros in `grads` for what project_vjp, which must follow,
  /// leaves out.
  virtual void zero_culled_grads(const Inputs&, const ListTensors&, const Pass&, const Grads&) {}
  virtual PairSums blend_vjp(const ListTensors& lists, const BlendState& state, const Pass& pass,
                             const ChannelTensors& channels, const ImageTensors& dL_dimage, MeanSums mean_sums) = 0;
  /// Writes `grads`; returns sums of the camera's gradient, (parts, kCameraGradWidth), if it is wanted.
  virtual Tensor project_vjp(const Inputs& in, const ListTensors& lists, const Pass& pass, const PairSums& sums,
                             const ChannelTensors& channels, const Grads& grads) = 0;
  /// The same from the gradient of public rows; `rows` (P,) int32 has the row of each Gaussian, or -1. Adds to `grads`
  /// if grads.add.
  virtual Tensor project_rows_vjp(const Inputs& in, const Tensor& rows, const RowTensors& dL_drows,
                                  const Grads& grads) = 0;
  /// Writes the gradient with respect to means2d, cov2d and opacities of public rows, and `absolute`.
  virtual void row_grads(const RowTensors& rows, const ListTensors& lists, const Pass& pass, const PairSums& sums,
                         const RowTensors& dL_drows) = 0;

  /// One weight per element; where dL_dweight is given the adjoint instead.
  virtual void weight(const WeightTensors& tensors, const FootprintSpec& footprint) = 0;

  /// Time since the last call on the device's clock [s]; waits for the device.
  virtual double lap() = 0;
};

/// Threads of a loop on the CPU: as many as torch's, but no more than the CPU quota of the container. Torch counts all
/// cores, and those who use up their quota are stopped until the next period.
int thread_count();

/// For tensors like `like`; makes its device the current one while it lives.
std::unique_ptr<Backend> make_cpu_backend(const Tensor& like);
std::unique_ptr<Backend> make_cuda_backend(const Tensor& like);
inline std::unique_ptr<Backend> make_backend(const Tensor& like) {
#if defined(AR_WITH_CUDA)
  if (like.is_cuda()) return make_cuda_backend(like);
#endif
  return make_cpu_backend(like);
}

}  // namespace ar::ops
