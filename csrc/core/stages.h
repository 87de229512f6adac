// What the stages of the pass read and write: one commented struct per stage, shared by the CPU's loops and the GPU's
// kernels. Members are views of host or device memory, never owners, and are filled by name. "[n]" is the shape of an
// array; "or null" marks what may be missing.
//
//     project -> bin -> blend          forward
//     blend_vjp -> project_vjp         backward
//
// Conventions, once. World to camera is OpenCV's: x right, y down, z forward. 3DGS stores its matrices transposed, for
// row vectors: element (r, c) of the matrix that acts on column vectors is at [4 c + r]. Pixel centres are at integers,
// x to the right, y down: px = ((ndc + 1) W - 1) / 2.
#pragma once

#include <cstddef>
#include <cstdint>

#include "core/constants.h"
#include "core/footprint/contract.h"
#include "core/vec.h"

namespace ar {

/// The grid of square tiles over an image.
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
/// The tiles on CUDA where `samples` samples of a pixel move. With one of them in a large image, blending a splat in a
/// pixel costs so little that tiles are worth being large: fewer pairs have to be listed, and fetched by a block. With
/// nine or more in a small image, where most splats are smaller than a tile, tiles are small: their lists are shorter,
/// and a splat reaches more of a block's samples.
AR_HD constexpr int moving_tile_bits(int samples, bool small_image) {
  if (samples == 1 && !small_image) return kTileBits;
  return samples >= 9 && small_image ? kMovingTileBits - 1 : kMovingTileBits;
}
/// The tiles on CUDA where the samples of a pixel may be spread over so many lanes (Spread of contract.h). A tile whose
/// samples are has 256 of them: 8x8 pixels with 4 samples, 4x4 with 16. Sixteen samples are spread in every image. Four
/// are in small ones, where there would be few tiles of 16x16 pixels, with long lists; in large ones smaller tiles
/// would save less than it costs to list more pairs.
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
  /// [kLensWidth] numbers of a Lens for a full camera (camera.h), or null for a plain camera, which has only the
  /// members above.
  const T* lens = nullptr;
};

/// Scene parameters. A Gaussian has either scales and rotations or cov3ds, and shs or colors or neither of them; what
/// it does not have is null.
template <typename T> struct Gaussians {
  int64_t n;
  const Vec3<T>* means;      ///< [n] world units
  const Vec3<T>* scales;     ///< [n] standard deviations, world units, or null
  const Vec4<T>* rotations;  ///< [n] quaternions (w, x, y, z) stored as (x, y, z, w) of Vec4, or null
  const Sym3<T>* cov3ds;     ///< [n] or null
  const T* opacities;        ///< [n]
  const Vec3<T>* shs;        ///< [n, sh_stride] or null
  const Vec3<T>* colors;     ///< [n] or null
  int sh_stride;             ///< coefficients per Gaussian in memory
  int sh_degree;             ///< degree in use
  T scale_modifier;
};

/// What blend_vjp sums over pixels besides the gradient: positive functions of a pixel's gradient with respect to the
/// splat's mean, so that pixels with gradients of opposite signs do not cancel. Density control reads them. There are
/// two sums per splat.
enum class MeanSums : int32_t {
  kNone,
  kAbsolute,  ///< |dL/dx| and |dL/dy|, per px
  kNorm,      ///< the length of the gradient, in the units of GaussianGrads::means2d; the second sum is zero
};

/// Gradients with respect to the members of Gaussians, which are overwritten. Null where not wanted.
template <typename T> struct GaussianGrads {
  /// Whether gradients are added to these arrays, and coefficients to the `dL_dsh` that project_vjp gets.
  static constexpr bool kAdd = false, kAddShs = false;
  Vec3<T>* means;
  Vec3<T>* scales;
  Vec4<T>* rotations;
  /// An entry off the diagonal is the derivative with respect to the one number that fills both places.
  Sym3<T>* cov3ds;
  T* opacities;
  Vec3<T>* shs;
  Vec3<T>* colors;
  T* means2d;          ///< [n, means2d_stride], in 3DGS's units: per (0.5 W, 0.5 H) px
  int means2d_stride;  ///< 3, or 4
  MeanSums mean_sums;  ///< with stride 3 the two sums are added up in column 2; with 4 they are columns 2 and 3
};

/// The same, to which the gradients of another camera are added. There is no means2d.
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

/// Scalars per splat, for every footprint.
inline constexpr int kSplatWidth = 12;
/// Index of the first scalar of a splat's colour.
inline constexpr int kSplatColor = 9;

/// A projected Gaussian. Scalars only, so that an array of them is a matrix of T.
template <class F, typename T> struct alignas(16) Splat {
  Vec2<T> mean;  ///< px
  typename F::template Shape<T> shape;
  T opacity;
  T level;  ///< of the support ellipse; <= 0: touches no pixel
  Vec3<T> color;
};

/// A Splat whose footprint is known only at run time: its shape is kShapeWidth numbers.
template <typename T> struct alignas(16) SplatRow {
  Vec2<T> mean;
  T shape[kShapeWidth];
  T opacity;
  T level;
  Vec3<T> color;
};
static_assert(sizeof(SplatRow<float>) == kSplatWidth * sizeof(float));
static_assert(offsetof(SplatRow<float>, color) == kSplatColor * sizeof(float));

/// What is blended: a row of `count` channels per splat. Where these are three colours, the rows lie in the splats
/// themselves; otherwise they are a table of their own.
template <typename T> struct Channels {
  const T* data;
  int64_t stride;      ///< numbers from one row to the next
  const int32_t* ids;  ///< [splats] row of each splat, or null: splat i has row i
  int count;

  AR_HD const T* row(int32_t splat) const { return data + (ids ? ids[splat] : splat) * stride; }
};

/// Where `project` writes what is blended besides three colours: a row per Gaussian.
template <typename T> struct ChannelRows {
  T* data;                          ///< null where there is nothing to write
  int64_t stride;                   ///< numbers from one row to the next
  int color, depth, inverse_depth;  ///< first column of each, -1 where it is not wanted
};

/// One image (height, width) per channel. The channels below `split` lie one after the other; there are at most two
/// more, each in memory of its own.
template <typename T> struct Planes {
  T* first;  ///< [split, height, width]; null: these channels are not wanted or, of a gradient, zero
  int split;
  T* extra[2];  ///< [height, width] each; null likewise

  AR_HD T* plane(int channel, int64_t size) const {
    if (channel >= split) return extra[channel - split];
    return first ? first + channel * size : nullptr;
  }
};

/// What blend_vjp sums for one splat in one tile, besides its channels.
template <typename T> struct PairGrad {
  ShapeGrad<T> shape;
  T weighted;  ///< sum of alpha dL/dalpha
};
template <typename T> AR_HD PairGrad<T> operator+(const PairGrad<T>& a, const PairGrad<T>& b) {
  return {a.shape + b.shape, a.weighted + b.weighted};
}

/// Gradient with respect to what a splat contributes to pixels besides its shape and opacity.
template <typename T> struct ShownGrad {
  Vec3<T> color;
  T depth;  ///< with respect to camera-space z
};

/// Parameters of `project`: Gaussians to splats, or to the rows of ProjectedRows.
template <typename T> struct ProjectParams {
  CameraView<T> camera;
  Gaussians<T> gaussians;
  FootprintChoice footprint;
  T* splats;       ///< SplatRow for every Gaussian that may be seen
  int32_t* radii;  ///< [n] 3DGS's radius, px; 0: culled
  ChannelRows<T> channels;
  Channels<T> given;  ///< channels that the caller gave, examined for numbers that are not finite; data may be null
};

/// Splats as the public stages hand them out: independent of the footprint. Row i of every array is splat i.
template <typename T> struct ProjectedRows {
  Vec2<T>* means2d;  ///< px
  Sym2<T>* cov2d;    ///< px^2
  T* dets;           ///< determinant of cov2d, px^4, which would cancel if it were computed from the entries
  T* opacities;      ///< with the amplitude of a camera's blur
  T* depths;         ///< camera-space z, world units
  Vec3<T>* colors;   ///< or null
};

/// A row of ProjectedRows in one piece, as it travels between ranks. Scalars only, so that an array is a matrix of T.
template <typename T> struct alignas(16) PackedRow {
  Vec2<T> mean;
  Sym2<T> cov;
  T opacity, depth;
  Vec3<T> color;
  T det;                                                    ///< negative: touches no pixel
  std::conditional_t<sizeof(T) == 4, int32_t, int64_t> id;  ///< of the Gaussian among those of all ranks
};
inline constexpr int kPackedWidth = 12, kPackedDepth = 6;
static_assert(sizeof(PackedRow<float>) == kPackedWidth * sizeof(float));
static_assert(sizeof(PackedRow<double>) == kPackedWidth * sizeof(double));
static_assert(offsetof(PackedRow<float>, depth) == kPackedDepth * sizeof(float));

/// The gradient with respect to a PackedRow: columns of a row of scalars. cov.xy: with respect to the one number that
/// fills both places; `absolute`, which may be missing: sums over pixels of |dL/dmean|.
inline constexpr int kPackedMean = 0, kPackedCov = 2, kPackedOpacity = 5, kPackedColor = 6, kPackedAbsolute = 9;
inline constexpr int kPackedGradWidth = 9, kPackedGradWidthAbsolute = 11;

/// Gradient with respect to ProjectedRows, for the adjoint of `project`. A row of zeros is that of a Gaussian without
/// gradient.
template <typename T> struct ProjectedRowGrads {
  const int32_t* rows;  ///< [n] row of each Gaussian, or -1
  Column<const Vec2<T>> means2d;
  Column<const Sym2<T>> cov2d;  ///< xy: with respect to the one number that fills both places
  Column<const T> opacities;
  Column<const T> depths;        ///< or null
  Column<const Vec3<T>> colors;  ///< or null
};

/// Where `project_rows` writes PackedRow instead of ProjectedRows: those of the Gaussians that may be seen, as `ends`
/// counts them.
template <typename T> struct PackedRows {
  PackedRow<T>* rows;    ///< [room] of several cameras; null: they are not wanted
  int64_t room;          ///< what would lie behind it is not written
  const int64_t* first;  ///< [1] place of this camera's rows
  const int32_t* ends;   ///< [gaussians] how many up to this one, itself included, have a radius without their colours
  int32_t *radii, *ids;  ///< [room] radius, 0 if the colour is not finite; Gaussian
  int64_t first_id;      ///< PackedRow::id of Gaussian 0
};

/// Public rows to splats. The caller may have put any numbers into the rows: a row that makes no splat touches no tile.
template <typename T> struct ShapeRowsParams {
  int64_t n;
  ProjectedRows<T> rows;  ///< read; without colours the splats are black
  FootprintChoice footprint;
  TileGrid grid;
  T* splats;                   ///< [n] SplatRow
  const PackedRow<T>* packed;  ///< [n] read in the place of `rows`; or null
  /// [n, 4] cov2d and its determinant, and [n] opacities of `packed`, which its adjoint needs; or null.
  T *kept_covs, *kept_opacities;
};

/// Sums of pairs to the gradient with respect to the public rows. It is written for every row, zero for one without
/// pairs.
template <typename T> struct RowGradsParams {
  int64_t n;
  ProjectedRows<T> rows;  ///< read: cov2d, dets, opacities
  FootprintChoice footprint;
  Vec2<T>* dL_dmeans2d;
  Sym2<T>* dL_dcov2d;  ///< xy: with respect to the one number that fills both places
  T* dL_dopacities;
  Vec2<T>* absolute;  ///< [n] sums over pixels of |dL/dmeans2d|, or null
  // In the place of `rows`: what shape_rows kept; and of the gradients: rows of kPackedGradWidth numbers or more, with
  // the gradient with respect to the colours, which were blended. Or null.
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

/// Parameters of `blend`: the splats of every tile, in order of depth, to an image.
template <typename T> struct BlendParams {
  TileGrid grid;
  const T* splats;
  Channels<T> channels;
  const T* background;  ///< [channels.count]
  Planes<T> image;      ///< one per channel
  T* alpha;             ///< [height, width] 1 - mean transmittance, or null
  // What the backward pass needs; null where there will be none.
  T* transmittance;  ///< [samples, height, width] of every sample behind its last splat
  int32_t* last;     ///< [samples, height, width] number of pairs of the tile up to the last one composited
};

/// Parameters of `inspect`: the splats of every tile to how much every pixel shows of the `n` Gaussians.
template <typename T> struct InspectParams {
  const T* splats;
  TileGrid grid;
  int32_t* median;    ///< [height, width] Gaussians, or -1; see PixelSummary
  int32_t* dominant;  ///< [height, width]
  // Statistics of each of the n Gaussians, added to or, the largest weight, raised.
  int32_t* touched;    ///< [n] pixels that show it
  int32_t* largest;    ///< [n] largest weight, as the bits of a float
  int64_t* units;      ///< [n] sum of weights in units of kWeightUnit
  int32_t* in_front;   ///< [n] pixels of Shown::in_front
  int32_t* dominated;  ///< [n] pixels whose `dominant` it is
};

/// Parameters of `blend_vjp`: the gradient with respect to an image to sums per pair (PairGrad).
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

/// Parameters of `project_vjp`: sums per pair to the gradient with respect to the Gaussians.
template <typename T> struct ProjectVjpParams {
  CameraView<T> camera;
  Gaussians<T> gaussians;
  FootprintChoice footprint;
  GaussianGrads<T> grads;
  /// Gradient with respect to the rows that ProjectParams::channels wrote. `data` is null where only three colours were
  /// blended, whose gradients are in the sums of the pairs.
  ChannelRows<const T> dL_dchannels;
};

}  // namespace ar
