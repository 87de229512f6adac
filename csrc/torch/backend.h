// What a device must be able to do for the pass that recipe.h writes down once: a stage per function. A backend
// allocates what its stages need, fills their parameters (core/stages.h) by name and launches them. Arguments have been
// checked.
#pragma once

#include <memory>
#include <vector>

#include "core/stages.h"
#include "torch/arguments.h"

namespace ar::ops {

/// Splats on their way from `project` to `bin`. On the CPU there is a row for every Gaussian that may be seen; on CUDA
/// one for every Gaussian, so that nothing has to be counted.
struct SplatTensors {
  Tensor splats;  ///< (n, kSplatWidth) SplatRow
  Tensor ids;     ///< (n,) int32, CPU: the Gaussian of each, ascending
  Tensor depths;  ///< (n,) CPU
  Tensor keys;    ///< (2, n) int32, CUDA: keys in the order of depth, and room for them
  Tensor ranges;  ///< (n, 2) int32, CUDA: first pair and number of pairs of each
};

/// Splats by tile, front to back: what `bin` makes and `blend` reads. Members that a device does not use are empty.
struct ListTensors {
  Tensor splats;  ///< (n, kSplatWidth)
  Tensor ids;     ///< (n,) int32; CPU: the Gaussian of each splat; CUDA: splats in the order of depth
  Tensor pairs;   ///< CPU: (N,) int32 splats; CUDA: (room, 2) splats and slots, or (room, 1) without a backward pass
  Tensor tile_offsets;   ///< (tiles + 1,) int64, first pair of each tile
  Tensor splat_offsets;  ///< CPU: (n + 1,) int64 into positions; CUDA: (n, 2) int32 first slot and number of slots
  Tensor positions;      ///< CPU: (N,) int64 places in `pairs` of each splat's pairs
  Tensor counts;         ///< CUDA: the numbers of Counts (csrc/cuda/stages.h)
  Tensor tile_samples;   ///< (tiles,) int32, samples of each tile, where they are chosen

  static constexpr size_t kMembers = 8;
  template <class Visit> void each(Visit&& visit) {
    visit("splats", splats);
    visit("ids", ids);
    visit("pairs", pairs);
    visit("tile_offsets", tile_offsets);
    visit("splat_offsets", splat_offsets);
    visit("positions", positions);
    visit("counts", counts);
    visit("tile_samples", tile_samples);
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

/// What is blended. Without `rows` the three colours in the splats.
struct ChannelTensors {
  Tensor rows;            ///< (m, count) contiguous, or undefined
  bool by_gaussian;       ///< a row per Gaussian; else per splat
  bool all_made = false;  ///< by `project`: only project_vjp looks at their gradient
  int64_t count;
};

/// An image as separate tensors: `color` holds the first channels (C, H, W), every one of `extra` another (H, W).
/// As gradients they may be undefined: zero.
struct ImageTensors {
  Tensor color;
  int64_t color_channels = 0;
  std::vector<Tensor> extra;
  Tensor alpha;  ///< (H, W), undefined where nobody wants it
};

/// Columns of `rows` in ChannelTensors that `project` fills, -1 where it does not (ChannelRows in core/stages.h).
struct ChannelColumns {
  int color = -1, depth = -1, inverse_depth = -1;
};

/// Sums over the pairs of every splat, as `blend_vjp` leaves them for `project_vjp` or `row_grads`.
struct PairSums {
  Tensor pairs;  ///< CPU: (N, 6), or (N, 9) with the three colours; CUDA: (room, kPairGradWidth)
  Tensor means;  ///< CPU: (N, 2) MeanSums, if they are wanted
  /// Like ChannelTensors::rows; undefined where the pairs hold the three colours, or all that `project` made.
  Tensor dL_dchannels;
};

/// The public form of splats (ProjectedRows in core/stages.h), and gradients with respect to it.
struct RowTensors {
  Tensor means2d, cov2d, dets, opacities, depths, colors;
  Tensor absolute;  ///< of a gradient (n, 2): sums over pixels of |dL/dmeans2d|, if PairSums has them
};

/// Whether a pass waits for its stages, and what it keeps.
struct PassOptions {
  bool keep;           ///< for a backward pass
  bool alpha;          ///< make the image of alpha
  bool debug;          ///< wait for every stage, so that the stage that failed is the one that raises
  bool exact = false;  ///< count pairs before room is made for them, whatever earlier frames had
};

/// The chosen footprint.
struct FootprintSpec {
  std::string key;
  FootprintChoice choice;
  int samples;  ///< the most that a pixel has
  bool chosen;  ///< per tile
};

class Backend {
 public:
  virtual ~Backend() = default;

  // Forward.
  /// Splats of every Gaussian that may be seen, and `radii` (P,) int32. `channels` has room for the columns.
  virtual SplatTensors project(const Inputs& in, const FootprintSpec& footprint, const ChannelTensors& channels,
                               ChannelColumns columns, Tensor& radii) = 0;
  /// The public rows of all Gaussians (P, ...) and radii; rows of those with radius 0 are undefined.
  virtual RowTensors project_rows(const Inputs& in, const FootprintSpec& footprint, Tensor& radii) = 0;
  /// Splats from public rows.
  virtual SplatTensors shape_rows(const RowTensors& rows, const FootprintSpec& footprint, TileGrid grid) = 0;
  /// Lists by tile and depth, and samples per tile, for which the first three channels of `background` are looked at.
  virtual ListTensors bin(const SplatTensors& splats, const FootprintSpec& footprint, TileGrid grid,
                          const Tensor& background, PassOptions options) = 0;
  virtual ImageTensors blend(const ListTensors& lists, const FootprintSpec& footprint, TileGrid grid,
                             const ChannelTensors& channels, int64_t color_channels, const Tensor& background,
                             PassOptions options, BlendState& state) = 0;
  /// median, dominant, touched, largest, total (schema of `inspect`).
  virtual std::vector<Tensor> inspect(const ListTensors& lists, const FootprintSpec& footprint, TileGrid grid,
                                      int64_t count) = 0;

  // Backward.
  virtual PairSums blend_vjp(const ListTensors& lists, const BlendState& state, const FootprintSpec& footprint,
                             TileGrid grid, const ChannelTensors& channels, const Tensor& background,
                             const ImageTensors& dL_dimage, MeanSums mean_sums, bool debug) = 0;
  /// Writes `grads`; returns sums of the camera's gradient, (parts, kCameraGradWidth), if `with_camera`.
  virtual Tensor project_vjp(const Inputs& in, const ListTensors& lists, const FootprintSpec& footprint,
                             const PairSums& sums, ChannelColumns columns, const Grads& grads, bool with_camera,
                             bool debug) = 0;
  /// The same from the gradient of public rows; `rows` (P,) int32 has the row of each Gaussian, or -1.
  virtual Tensor project_rows_vjp(const Inputs& in, const Tensor& rows, const RowTensors& dL_drows, const Grads& grads,
                                  bool with_camera) = 0;
  /// Gradient with respect to means2d, cov2d and opacities of public rows.
  virtual RowTensors row_grads(const RowTensors& rows, const ListTensors& lists, const FootprintSpec& footprint,
                               const PairSums& sums) = 0;

  // One weight per element.
  virtual Tensor weight(const Tensor& offset, const Tensor& cov2d, const FootprintSpec& footprint) = 0;
  virtual std::tuple<Tensor, Tensor> weight_vjp(const Tensor& dL_dweight, const Tensor& offset, const Tensor& cov2d,
                                                const FootprintSpec& footprint) = 0;

  /// Time since the last call on the device's clock [s]; waits for the device.
  virtual double lap() = 0;
};

/// For tensors like `like`; makes its device the current one while it lives.
std::unique_ptr<Backend> make_cpu_backend(const Tensor& like);
std::unique_ptr<Backend> make_cuda_backend(const Tensor& like);

}  // namespace ar::ops
