// Structs that the stages of a frame read and write, on both devices. "[n]" is a shape. A gradient of a symmetric
// matrix has its off-diagonal entries doubled (Sym2 in vec.h).
//
//     project -> bin -> blend          forward
//     blend_vjp -> project_vjp         backward
//
// Conventions. Camera space is OpenCV's: x right, y down, z forward. 3DGS stores matrices transposed: element (r, c) of
// the matrix that acts on column vectors is at [4 c + r]. Pixel centres are at integers: px = ((ndc + 1) W - 1) / 2.
#pragma once

#include <cstddef>
#include <cstdint>

#include "core/constants.h"
#include "core/footprint/contract.h"
#include "core/vec.h"

namespace ar {

struct TileGrid {
  int width, height;          ///< px
  int tile_bits = kTileBits;  ///< log2 of a tile's side [px]
  AR_HD int side() const { return 1 << tile_bits; }
  AR_HD int columns() const { return (width + side() - 1) >> tile_bits; }
  AR_HD int rows() const { return (height + side() - 1) >> tile_bits; }
  AR_HD int64_t tiles() const { return int64_t(columns()) * rows(); }
  AR_HD bool operator==(const TileGrid& other) const {
    return width == other.width && height == other.height && tile_bits == other.tile_bits;
  }
};

AR_HD bool is_small_image(TileGrid grid) {
  return TileGrid{grid.width, grid.height, kMovingTileBits}.tiles() < kSmallImageTiles;
}
/// The tiles on CUDA if samples move. One sample in a large image is so cheap that fewer pairs pay; sixteen in a small
/// one want shorter lists.
AR_HD constexpr int moving_tile_bits(int samples, bool small_image) {
  if (samples == 1 && !small_image) return kTileBits;
  return samples == 16 && small_image ? kMovingTileBits - 1 : kMovingTileBits;
}
/// The tiles on CUDA if samples may be spread over lanes (Spread), 256 samples each. In large images more pairs cost
/// more than shorter lists save.
AR_HD constexpr int spread_tile_bits(int lanes, bool small_image) {
  return lanes == 16 ? kTileBits - 2 : lanes == 4 && small_image ? kTileBits - 1 : kTileBits;
}
AR_HD TileGrid spread_grid(int lanes, int width, int height) {
  const bool small_image = TileGrid{width, height}.tiles() < kSpreadImageTiles;
  return {width, height, spread_tile_bits(lanes, small_image)};
}
AR_HD TileGrid moving_grid(int samples, int width, int height) {
  return {width, height, moving_tile_bits(samples, is_small_image({width, height}))};
}

AR_HD TileGrid ray_grid(int width, int height) { return {width, height, kRayTileBits}; }

template <typename T> struct CameraView {
  const T* view;      ///< [16] world to camera, transposed
  const T* proj;      ///< [16] world to clip space, transposed
  const T* position;  ///< [3] camera centre, world units
  int width, height;  ///< px
  T tan_half_fov_x, tan_half_fov_y;
  /// [kLensWidth] the Lens of a FullCamera; null: a plain Camera.
  const T* lens = nullptr;
};

/// Arrays of [n]. Either scales and rotations or cov3ds are null; shs, colors or both are null.
template <typename T> struct Gaussians {
  int64_t n;
  const Vec3<T>* means;      ///< world units
  const Vec3<T>* scales;     ///< standard deviations, world units
  const Vec4<T>* rotations;  ///< quaternions: x of Vec4 is their w
  const Sym3<T>* cov3ds;
  const T* opacities;
  const Vec3<T>* shs;  ///< [n, sh_stride]
  const Vec3<T>* colors;
  int sh_stride;  ///< coefficients per Gaussian in memory
  int sh_degree;  ///< in use
  T scale_modifier;
};

/// kOfModel: the camera model's.
enum class DepthKind : int32_t { kNone, kOfModel, kZ, kDistance };

/// Two more sums per splat, for density control: of each pixel's dL/dmean.
enum class MeanSums : int32_t {
  kNone,
  kAbsolute,  ///< |dL/dx| and |dL/dy|, per px
  kNorm,      ///< length, in the units of GaussianGrads::means2d; the second sum is zero
};

/// By the members of Gaussians; null: not wanted.
template <typename T> struct GaussianGrads {
  /// Whether gradients are added, also to the `dL_dsh` of project_vjp.
  AR_HD static constexpr bool adds() { return false; }
  AR_HD static constexpr bool adds_shs() { return false; }
  Vec3<T>* means;
  Vec3<T>* scales;
  Vec4<T>* rotations;
  Sym3<T>* cov3ds;
  T* opacities;
  Vec3<T>* shs;
  Vec3<T>* colors;
  T* means2d;          ///< [n, means2d_stride] per (0.5 W, 0.5 H) px, as in 3DGS
  int means2d_stride;  ///< 3: column 2 is the total of the two sums; 4: they are columns 2 and 3
  MeanSums mean_sums;
};

template <class Element> struct Column {
  Element* first = nullptr;
  int64_t stride = sizeof(Element);  ///< bytes between rows

  Column() = default;
  AR_HD Column(Element* first_, int64_t stride_ = sizeof(Element)) : first(first_), stride(stride_) {}
  AR_HD explicit operator bool() const { return first != nullptr; }
  AR_HD const Element& operator[](int64_t i) const {
    return *reinterpret_cast<const Element*>(reinterpret_cast<const char*>(first) + i * stride);
  }
};

inline constexpr int kSplatWidth = 12;
inline constexpr int kSplatColor = 9;

template <class F, typename T> struct alignas(16) Splat {
  Vec2<T> mean;  ///< px
  typename F::template Shape<T> shape;
  T opacity;
  T level;  ///< of the support ellipse; <= 0: touches no pixel
  Vec3<T> color;
};

/// Of any footprint.
template <typename T> struct alignas(16) SplatRow {
  Vec2<T> mean;
  T shape[kShapeWidth];
  T opacity;
  T level;
  Vec3<T> color;
};
static_assert(sizeof(SplatRow<float>) == kSplatWidth * sizeof(float));
static_assert(offsetof(SplatRow<float>, color) == kSplatColor * sizeof(float));

/// Null data: the three colours in the splats.
template <typename T> struct Channels {
  const T* data;
  int64_t stride;      ///< numbers between rows
  const int32_t* ids;  ///< [splats] row of a splat; null: splat i has row i
  int count;

  AR_HD const T* row(int32_t splat) const { return data + (ids ? ids[splat] : splat) * stride; }
};

/// Where `project` writes channels, unless they are three colours.
template <typename T> struct ChannelRows {
  T* data;  ///< or null
  int64_t stride;
  int color, depth, inverse_depth;  ///< first columns; -1: not wanted
};

/// Null: not wanted or, of a gradient, zero.
template <typename T> struct Planes {
  T* first;  ///< [split, height, width]
  int split;
  T* extra[2];  ///< [height, width] each: channels from `split` on

  AR_HD T* plane(int channel, int64_t size) const {
    if (channel >= split) return extra[channel - split];
    return first ? first + channel * size : nullptr;
  }
};

template <typename T> struct PairGrad {
  ShapeGrad<T> shape;
  T weighted;  ///< sum of alpha dL/dalpha
};
template <typename T> AR_HD PairGrad<T> operator+(const PairGrad<T>& a, const PairGrad<T>& b) {
  return {a.shape + b.shape, a.weighted + b.weighted};
}

template <typename T> struct ShownGrad {
  Vec3<T> color;
  T depth;
};
template <typename T> struct RowShownGrad : ShownGrad<T> {
  T shown_depth;
  DepthKind order, shown;
};

template <typename T> struct ProjectParams {
  CameraView<T> camera;
  Gaussians<T> gaussians;
  FootprintChoice footprint;
  T* splats;       ///< SplatRow for every Gaussian that may be seen
  int32_t* radii;  ///< [n] 3DGS's radius [px]; 0: culled
  ChannelRows<T> channels;
  Channels<T> given;  ///< the caller's, or null: a row that is not finite culls its Gaussian
};

/// Public rows, which no footprint has shaped.
template <typename T> struct ProjectedRows {
  Vec2<T>* means2d = nullptr;  ///< px
  Sym2<T>* cov2d = nullptr;    ///< px^2
  T* dets = nullptr;           ///< of cov2d, px^4; negative: touches no pixel
  T* opacities = nullptr;      ///< with the amplitude of a camera's blur
  T* depths = nullptr;         ///< world units
  Vec3<T>* colors = nullptr;   ///< or null
  T center = T(0);             ///< of pixels, in means2d [px]
};

/// A camera's Gaussians among the rows of all cameras.
struct RowPlaces {
  const int32_t* rows = nullptr;   ///< [n] row of a Gaussian, or -1
  const int32_t* ends = nullptr;   ///< [n] or else: rows up to and including this Gaussian's
  const int32_t* radii = nullptr;  ///< [rows, 2] or else: every Gaussian has a row, which counts if this is positive
  int64_t first = 0, last = 0;     ///< with `ends`: rows of the camera, without `last`

  /// -1: none.
  AR_HD int64_t of(int64_t i) const {
    if (rows) return rows[i];
    if (!ends) return radii && radii[2 * (first + i)] <= 0 ? -1 : first + i;
    const int32_t before = i > 0 ? ends[i - 1] : 0;
    return ends[i] > before && before >= 0 && first + before < last ? first + before : -1;
  }
};

template <typename T> struct RowRules {
  DepthKind order = DepthKind::kOfModel, shown = DepthKind::kNone;
  bool measured = false;  ///< by RowMeasure (core/rows.h)
  // Of a RowMeasure:
  T variance = T(0);          ///< of its ellipse, beyond the covariance [px^2]
  bool compensated = false;   ///< its opacity keeps the integral
  T radius_clip = T(0);       ///< [px]
  T near = T(0), far = T(0);  ///< of the depth by `order`
};

/// Pointers may be null, except those of ProjectedRows.
template <typename T> struct RowOutputs : ProjectedRows<T> {
  T* features = nullptr;  ///< [rows, stride]
  int64_t stride = 0;
  bool colored = false, shows_depth = false;  ///< first three columns, last column
  int32_t* radii = nullptr;                   ///< [rows] 3DGS's; [rows, 2] of a RowMeasure
  Vec3<T>* conics = nullptr;                  ///< [rows] of a RowMeasure, as are the opacities
  T* shown_opacities = nullptr;               ///< [rows]
  int32_t* gaussian_ids = nullptr;            ///< [rows]
  int32_t* camera_ids = nullptr;              ///< [rows]
  int32_t camera = 0;
  RowPlaces places;           ///< without `ends` a table: a Gaussian without a row has zeros, and det -1
  Vec2<T>* slopes = nullptr;  ///< [rows] of RayDepth (core/order.h)
};

/// Sent to other ranks.
template <typename T> struct alignas(16) PackedRow {
  Vec2<T> mean;
  Sym2<T> cov;
  T opacity, depth;
  Vec3<T> color;
  T det;                                                    ///< negative: touches no pixel
  std::conditional_t<sizeof(T) == 4, int32_t, int64_t> id;  ///< index among all ranks
};
inline constexpr int kPackedWidth = 12, kPackedDepth = 6;
static_assert(sizeof(PackedRow<float>) == kPackedWidth * sizeof(float));
static_assert(sizeof(PackedRow<double>) == kPackedWidth * sizeof(double));
static_assert(offsetof(PackedRow<float>, depth) == kPackedDepth * sizeof(float));

/// Columns of the gradient by a PackedRow. kPackedAbsolute, optional: sums over pixels of |dL/dmean|.
inline constexpr int kPackedMean = 0, kPackedCov = 2, kPackedOpacity = 5, kPackedColor = 6, kPackedAbsolute = 9;
inline constexpr int kPackedGradWidth = 9, kPackedGradWidthAbsolute = 11;

/// Null columns are zero.
template <typename T> struct ProjectedRowGrads {
  RowPlaces places;
  Column<const Vec2<T>> means2d;
  Column<const Sym2<T>> cov2d;
  Column<const T> opacities;
  Column<const T> depths;  ///< of the kind `order`
  Column<const Vec3<T>> colors;
  Column<const T> shown_depths;  ///< of the kind `shown`
  DepthKind order = DepthKind::kOfModel, shown = DepthKind::kNone;
};

template <typename T> struct PackedRows {
  PackedRow<T>* rows;    ///< [room] or null
  int64_t room;          ///< rows beyond it are not written
  const int64_t* first;  ///< [1] index of this camera's first row
  const int32_t* ends;   ///< [gaussians] as RowPlaces::ends, also where a colour is not finite
  int32_t *radii, *ids;  ///< [room] radius, 0 if the colour is not finite; index of the Gaussian
  int64_t first_id;      ///< of Gaussian 0
};

/// Rows may hold any numbers; one that is no splat touches no tile.
template <typename T> struct ShapeRowsParams {
  int64_t n;
  ProjectedRows<T> rows;  ///< without colours: black
  FootprintChoice footprint;
  TileGrid grid;
  bool any_color;              ///< else a row whose colour is not finite touches no tile
  T* splats;                   ///< [n] SplatRow
  const PackedRow<T>* packed;  ///< [n] instead of `rows`, or null
  /// [n, 4] cov2d and determinants, [n] opacities, for the adjoint; or null.
  T *kept_covs, *kept_opacities;
};

template <typename T> struct RowGradsParams {
  int64_t n;
  ProjectedRows<T> rows;  ///< read: cov2d, dets, opacities
  FootprintChoice footprint;
  Vec2<T>* dL_dmeans2d;
  Sym2<T>* dL_dcov2d;
  T* dL_dopacities;
  Vec2<T>* absolute;    ///< [n] sums over pixels of |dL/dmeans2d|, or null
  Vec3<T>* dL_dcolors;  ///< [n] of the colours in the splats, or null
  // For packed rows: what shape_rows kept, instead of `rows`; [n, packed_width] gradients, instead of the above.
  const T *kept_covs, *kept_opacities;
  T* packed;
  int packed_width;

  AR_HD Cov2d<T> cov(int64_t i) const {
    if (kept_covs) return {kept_covs[4 * i], kept_covs[4 * i + 1], kept_covs[4 * i + 2], kept_covs[4 * i + 3]};
    const Sym2<T> c = rows.cov2d[i];
    return {c.xx, c.xy, c.yy, rows.dets[i]};
  }
  AR_HD T opacity(int64_t i) const { return kept_opacities ? kept_opacities[i] : rows.opacities[i]; }
};

template <typename T> struct BlendParams {
  TileGrid grid;
  const T* splats;
  Channels<T> channels;
  const T* background;  ///< [channels.count]
  Planes<T> image;      ///< one per channel
  T* alpha;             ///< [height, width] 1 - mean transmittance, or null
  // For the backward pass, or null.
  T* transmittance;  ///< [samples, height, width] after the last splat of the sample
  int32_t* last;     ///< [samples, height, width] pairs of the tile up to the sample's last splat
};

/// Null: not wanted.
template <typename T> struct InspectParams {
  const T* splats;
  TileGrid grid;
  const T* depths;    ///< of splats
  T* median;          ///< [height, width] depth of PixelSummary::median, or 0
  int32_t* dominant;  ///< [height, width] a Gaussian or -1
  // Added to, or raised (`largest`). All or none.
  int32_t* touched;    ///< [n] pixels that show the Gaussian
  int32_t* largest;    ///< [n] largest weight, as the bits of a float
  int64_t* units;      ///< [n] sum of weights in units of kWeightUnit
  int32_t* in_front;   ///< [n] pixels with Shown::in_front
  int32_t* dominated;  ///< [n] pixels with this `dominant`
};

template <typename T> struct BlendVjpParams {
  TileGrid grid;
  const T* splats;
  Channels<T> channels;
  const T* background;
  const T* transmittance;
  const int32_t* last;
  Planes<const T> dL_dimage;
  const T* dL_dalpha;  ///< [height, width], or null
};

template <typename T> struct ProjectVjpParams {
  CameraView<T> camera;
  Gaussians<T> gaussians;
  FootprintChoice footprint;
  GaussianGrads<T> grads;
  /// As ProjectParams::channels. `data` is null if three colours were blended.
  ChannelRows<const T> dL_dchannels;
};

}  // namespace ar
