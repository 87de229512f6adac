// Structs with what the stages of the pass read and write, for the loops of cpu/ and the kernels of cuda/. csrc/torch
// fills them by name. Pointers are views of host or device memory, never owners. "[n]" is the shape of an array.
//
//     project -> bin -> blend          forward
//     blend_vjp -> project_vjp         backward
//
// Conventions. Camera space is OpenCV's: x right, y down, z forward. 3DGS stores its matrices transposed: element (r,
// c) of the matrix that acts on column vectors is at [4 c + r]. Pixel centres are at integers: px = ((ndc + 1) W - 1)
// / 2.
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
/// The tiles on CUDA if samples move. With one sample in a large image blending is so cheap that fewer pairs, in larger
/// tiles, pay. With sixteen samples in a small image, where most splats are smaller than a tile, shorter lists of
/// smaller tiles pay.
AR_HD constexpr int moving_tile_bits(int samples, bool small_image) {
  if (samples == 1 && !small_image) return kTileBits;
  return samples == 16 && small_image ? kMovingTileBits - 1 : kMovingTileBits;
}
/// The tiles on CUDA if samples of a pixel may be spread over lanes (Spread of footprint/contract.h). Such a tile has
/// 256 samples: 8x8 pixels with 4 samples, 4x4 pixels with 16. Four samples are spread in small images only, which have
/// few tiles of 16x16 pixels with long lists; in large images listing more pairs would cost more than it saves.
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

template <typename T> struct CameraView {
  const T* view;      ///< [16] world to camera, transposed
  const T* proj;      ///< [16] world to clip space, transposed
  const T* position;  ///< [3] camera centre, world units
  int width, height;  ///< px
  T tan_half_fov_x, tan_half_fov_y;
  /// [kLensWidth] a Lens, for a FullCamera; or null, for a plain Camera.
  const T* lens = nullptr;
};

/// The scene. Either scales and rotations or cov3ds are null; shs, colors or both are null.
template <typename T> struct Gaussians {
  int64_t n;
  const Vec3<T>* means;      ///< [n] world units
  const Vec3<T>* scales;     ///< [n] standard deviations, world units
  const Vec4<T>* rotations;  ///< [n] quaternions: x of Vec4 is their w
  const Sym3<T>* cov3ds;     ///< [n]
  const T* opacities;        ///< [n]
  const Vec3<T>* shs;        ///< [n, sh_stride]
  const Vec3<T>* colors;     ///< [n]
  int sh_stride;             ///< coefficients per Gaussian in memory
  int sh_degree;             ///< degree in use
  T scale_modifier;
};

/// Two sums per splat for density control, which blend_vjp forms besides the gradient: of positive functions of each
/// pixel's gradient with respect to the mean, so that opposite signs do not cancel.
enum class MeanSums : int32_t {
  kNone,
  kAbsolute,  ///< |dL/dx| and |dL/dy|, per px
  kNorm,      ///< length of the gradient, in the units of GaussianGrads::means2d; the second sum is zero
};

/// Gradients with respect to the members of Gaussians, which are overwritten, or null if not wanted.
template <typename T> struct GaussianGrads {
  /// Whether gradients are added to these arrays, and coefficients to the `dL_dsh` that project_vjp gets.
  static constexpr bool kAdd = false, kAddShs = false;
  Vec3<T>* means;
  Vec3<T>* scales;
  Vec4<T>* rotations;
  Sym3<T>* cov3ds;  ///< off the diagonal: with respect to the number that fills both entries
  T* opacities;
  Vec3<T>* shs;
  Vec3<T>* colors;
  T* means2d;          ///< [n, means2d_stride], per (0.5 W, 0.5 H) px as in 3DGS
  int means2d_stride;  ///< 3: the two sums are added in column 2; 4: they are columns 2 and 3
  MeanSums mean_sums;
};

/// Arrays to which the gradients of another camera are added, without means2d.
template <typename T> struct AddedGrads : GaussianGrads<T> {
  static constexpr bool kAdd = true, kAddShs = true;
};

/// A column of a table: an Element in every row.
template <class Element> struct Column {
  Element* first = nullptr;
  int64_t stride = sizeof(Element);  ///< bytes from one row to the next

  Column() = default;
  AR_HD Column(Element* first_, int64_t stride_ = sizeof(Element)) : first(first_), stride(stride_) {}
  AR_HD explicit operator bool() const { return first != nullptr; }
  AR_HD const Element& operator[](int64_t i) const {
    return *reinterpret_cast<const Element*>(reinterpret_cast<const char*>(first) + i * stride);
  }
};

/// Scalars of a splat with any footprint, and the index of its colour.
inline constexpr int kSplatWidth = 12;
inline constexpr int kSplatColor = 9;

/// A projected Gaussian. An array of splats is a matrix of T.
template <class F, typename T> struct alignas(16) Splat {
  Vec2<T> mean;  ///< px
  typename F::template Shape<T> shape;
  T opacity;
  T level;  ///< of the support ellipse; <= 0: the splat touches no pixel
  Vec3<T> color;
};

/// A Splat whose footprint is known at run time only.
template <typename T> struct alignas(16) SplatRow {
  Vec2<T> mean;
  T shape[kShapeWidth];
  T opacity;
  T level;
  Vec3<T> color;
};
static_assert(sizeof(SplatRow<float>) == kSplatWidth * sizeof(float));
static_assert(offsetof(SplatRow<float>, color) == kSplatColor * sizeof(float));

/// A row of `count` channels per splat, which are blended. Rows of three colours are in the splats themselves.
template <typename T> struct Channels {
  const T* data;
  int64_t stride;      ///< numbers between rows
  const int32_t* ids;  ///< [splats] row of each splat; null: splat i has row i
  int count;

  AR_HD const T* row(int32_t splat) const { return data + (ids ? ids[splat] : splat) * stride; }
};

/// Where `project` writes channels other than three colours: a row per Gaussian.
template <typename T> struct ChannelRows {
  T* data;                          ///< or null
  int64_t stride;                   ///< numbers between rows
  int color, depth, inverse_depth;  ///< first columns; -1: not wanted
};

/// One image per channel. At most two channels, from `split` on, are apart from the others. A null pointer: these
/// channels are not wanted or, of a gradient, zero.
template <typename T> struct Planes {
  T* first;  ///< [split, height, width]
  int split;
  T* extra[2];  ///< [height, width] each

  AR_HD T* plane(int channel, int64_t size) const {
    if (channel >= split) return extra[channel - split];
    return first ? first + channel * size : nullptr;
  }
};

/// Sums of blend_vjp for a pair, besides those of its channels.
template <typename T> struct PairGrad {
  ShapeGrad<T> shape;
  T weighted;  ///< sum of alpha dL/dalpha
};
template <typename T> AR_HD PairGrad<T> operator+(const PairGrad<T>& a, const PairGrad<T>& b) {
  return {a.shape + b.shape, a.weighted + b.weighted};
}

/// Gradient with respect to the colour and the depth of a splat.
template <typename T> struct ShownGrad {
  Vec3<T> color;
  T depth;
};

/// Parameters of `project`: from Gaussians to splats, or to ProjectedRows.
template <typename T> struct ProjectParams {
  CameraView<T> camera;
  Gaussians<T> gaussians;
  FootprintChoice footprint;
  T* splats;       ///< SplatRow for every Gaussian that may be seen
  int32_t* radii;  ///< [n] 3DGS's radius, px; 0: culled
  ChannelRows<T> channels;
  Channels<T> given;  ///< the caller's channels, of which numbers that are not finite cull a Gaussian; data may be null
};

/// The splats of the public stages, without a footprint. Row i of every array is splat i.
template <typename T> struct ProjectedRows {
  Vec2<T>* means2d;  ///< px
  Sym2<T>* cov2d;    ///< px^2
  T* dets;           ///< determinants of cov2d, px^4: computed from the entries they would cancel
  T* opacities;      ///< with the amplitude of a camera's blur
  T* depths;         ///< world units
  Vec3<T>* colors;   ///< or null
};

/// A row of ProjectedRows as it is sent to other ranks. An array of them is a matrix of T.
template <typename T> struct alignas(16) PackedRow {
  Vec2<T> mean;
  Sym2<T> cov;
  T opacity, depth;
  Vec3<T> color;
  T det;                                                    ///< negative: the row touches no pixel
  std::conditional_t<sizeof(T) == 4, int32_t, int64_t> id;  ///< of the Gaussian among those of all ranks
};
inline constexpr int kPackedWidth = 12, kPackedDepth = 6;
static_assert(sizeof(PackedRow<float>) == kPackedWidth * sizeof(float));
static_assert(sizeof(PackedRow<double>) == kPackedWidth * sizeof(double));
static_assert(offsetof(PackedRow<float>, depth) == kPackedDepth * sizeof(float));

/// Columns of the gradient with respect to a PackedRow. Covariance xy: with respect to the number that fills both
/// entries. Absolute, which may be missing: sums over pixels of |dL/dmean|.
inline constexpr int kPackedMean = 0, kPackedCov = 2, kPackedOpacity = 5, kPackedColor = 6, kPackedAbsolute = 9;
inline constexpr int kPackedGradWidth = 9, kPackedGradWidthAbsolute = 11;

/// Gradient with respect to ProjectedRows, for the adjoint of `project`.
template <typename T> struct ProjectedRowGrads {
  const int32_t* rows;  ///< [n] row of each Gaussian, or -1
  Column<const Vec2<T>> means2d;
  Column<const Sym2<T>> cov2d;  ///< xy: with respect to the number that fills both entries
  Column<const T> opacities;
  Column<const T> depths;        ///< or null
  Column<const Vec3<T>> colors;  ///< or null
};

/// Where `project_rows` writes rows of several cameras instead of ProjectedRows.
template <typename T> struct PackedRows {
  PackedRow<T>* rows;    ///< [room]; null: not wanted
  int64_t room;          ///< rows beyond it are not written
  const int64_t* first;  ///< [1] index of this camera's first row
  const int32_t* ends;  ///< [gaussians] rows up to this Gaussian and with it; a colour that is not finite has a row too
  int32_t *radii, *ids;  ///< [room] radius, 0 if the colour is not finite; index of the Gaussian
  int64_t first_id;      ///< PackedRow::id of Gaussian 0
};

/// From public rows to splats. Rows may have any numbers; a row that is no splat touches no tile.
template <typename T> struct ShapeRowsParams {
  int64_t n;
  ProjectedRows<T> rows;  ///< without colours the splats are black
  FootprintChoice footprint;
  TileGrid grid;
  T* splats;                   ///< [n] SplatRow
  const PackedRow<T>* packed;  ///< [n] read instead of `rows`, or null
  /// [n, 4] cov2d and determinants, and [n] opacities of `packed`, for the adjoint; or null.
  T *kept_covs, *kept_opacities;
};

/// From sums of pairs to the gradient with respect to the public rows, which is zero for a row without pairs.
template <typename T> struct RowGradsParams {
  int64_t n;
  ProjectedRows<T> rows;  ///< read: cov2d, dets, opacities
  FootprintChoice footprint;
  Vec2<T>* dL_dmeans2d;
  Sym2<T>* dL_dcov2d;  ///< xy: with respect to the number that fills both entries
  T* dL_dopacities;
  Vec2<T>* absolute;  ///< [n] sums over pixels of |dL/dmeans2d|, or null
  // Of packed rows, or null. Instead of `rows`: what shape_rows kept. Instead of the gradients above: rows of
  // packed_width numbers, with the gradient with respect to the colours.
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

/// Parameters of `blend`: from the splats of every tile, in order of depth, to an image.
template <typename T> struct BlendParams {
  TileGrid grid;
  const T* splats;
  Channels<T> channels;
  const T* background;  ///< [channels.count]
  Planes<T> image;      ///< one per channel
  T* alpha;             ///< [height, width] 1 - mean transmittance, or null
  // For the backward pass, or null.
  T* transmittance;  ///< [samples, height, width] after the last splat of the sample
  int32_t* last;     ///< [samples, height, width] number of the tile's pairs up to the last splat of the sample
};

/// Parameters of `inspect`: from the splats of every tile to statistics of pixels and of the n Gaussians.
template <typename T> struct InspectParams {
  const T* splats;
  TileGrid grid;
  int32_t* median;    ///< [height, width] Gaussians, or -1; see PixelSummary
  int32_t* dominant;  ///< [height, width]
  // Added to, or raised (the largest weight).
  int32_t* touched;    ///< [n] pixels that show the Gaussian
  int32_t* largest;    ///< [n] largest weight, as the bits of a float
  int64_t* units;      ///< [n] sum of weights in units of kWeightUnit
  int32_t* in_front;   ///< [n] pixels of Shown::in_front
  int32_t* dominated;  ///< [n] pixels with this `dominant`
};

/// Parameters of `blend_vjp`: from the gradient with respect to an image to sums per pair (PairGrad).
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

/// Parameters of `project_vjp`: from sums per pair to the gradient with respect to the Gaussians.
template <typename T> struct ProjectVjpParams {
  CameraView<T> camera;
  Gaussians<T> gaussians;
  FootprintChoice footprint;
  GaussianGrads<T> grads;
  /// With respect to the rows of ProjectParams::channels. `data` is null if only three colours were blended, whose
  /// gradients are in the sums of the pairs.
  ChannelRows<const T> dL_dchannels;
};

}  // namespace ar
