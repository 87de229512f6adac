// What the stages of the pass read and write: one commented struct per stage, shared by the CPU's loops and the GPU's
// kernels. Members are views of host or device memory, never owners, and are filled by name.
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

/// Scene parameters. Either scales and rotations or cov3ds, either shs or colors or neither; the others are null.
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

/// What blend_vjp sums over pixels besides the gradient: functions of a pixel's gradient with respect to the splat's
/// mean, in which pixels that pull to different sides do not cancel. Density control looks at them.
enum class MeanSums : int32_t {
  kNone,
  kAbsolute,  ///< |dL/dx| and |dL/dy| per px
  kNorm,      ///< the length of the gradient in the units of GaussianGrads::means2d; and zero
};

/// Gradients with respect to the same, written, not added to. Null where not wanted.
template <typename T> struct GaussianGrads {
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
  MeanSums mean_sums;  ///< in column 2 of three, absolute values added; absolute values in columns 2 and 3 of four
};

/// Scalars per splat, whatever the footprint.
inline constexpr int kSplatWidth = 12;
/// Where its colour begins.
inline constexpr int kSplatColor = 9;

/// A projected Gaussian. Scalars only, so that an array of them is a matrix of T.
template <class F, typename T> struct alignas(16) Splat {
  Vec2<T> mean;  ///< px
  typename F::template Shape<T> shape;
  T opacity;
  T level;  ///< of the support ellipse; <= 0: touches no pixel
  Vec3<T> color;
};

/// The same row where the footprint is known only at run time: its shape is five numbers.
template <typename T> struct alignas(16) SplatRow {
  Vec2<T> mean;
  T shape[kShapeWidth];
  T opacity;
  T level;
  Vec3<T> color;
};
static_assert(sizeof(SplatRow<float>) == kSplatWidth * sizeof(float));
static_assert(offsetof(SplatRow<float>, color) == kSplatColor * sizeof(float));

/// What is blended: a row of numbers per splat. Three colours lie in the splats themselves; other channels do not.
template <typename T> struct Channels {
  const T* data;
  int64_t stride;      ///< numbers from one row to the next
  const int32_t* ids;  ///< [splats] row of each splat, or null: a splat's own number
  int count;

  AR_HD const T* row(int32_t splat) const { return data + (ids ? ids[splat] : splat) * stride; }
};

/// Where `project` writes what is blended besides three colours: a row per Gaussian.
template <typename T> struct ChannelRows {
  T* data;                          ///< null where there is nothing to write
  int64_t stride;                   ///< numbers from one row to the next
  int color, depth, inverse_depth;  ///< first column of each, -1 where it is not wanted
};

/// One image (height, width) per channel. The channels from `split` on lie by themselves.
template <typename T> struct Planes {
  T* first;  ///< [split, height, width]; null: all of it is missing, or as a gradient zero
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

/// Gradient with respect to what a splat shows besides its shape.
template <typename T> struct ShownGrad {
  Vec3<T> color;
  T depth;  ///< with respect to camera-space z
};

/// Gaussians to splats, or to the rows of ProjectedRows.
template <typename T> struct ProjectParams {
  CameraView<T> camera;
  Gaussians<T> gaussians;
  FootprintChoice footprint;
  T* splats;       ///< SplatRow for every Gaussian that may be seen
  int32_t* radii;  ///< [n] 3DGS's radius, px; 0: culled
  ChannelRows<T> channels;
  Channels<T> given;  ///< channels of the caller's, looked at for numbers that are not finite; data may be null
};

/// The public form of splats, whatever the footprint. Row i of each belongs together.
template <typename T> struct ProjectedRows {
  Vec2<T>* means2d;  ///< px
  Sym2<T>* cov2d;    ///< px^2
  T* dets;           ///< determinant of cov2d, px^4, without the cancellation of working it out from the entries
  T* opacities;      ///< with the amplitude of a camera's blur
  T* depths;         ///< camera-space z, world units
  Vec3<T>* colors;   ///< or null
};

/// Gradient with respect to the same, by Gaussian.
template <typename T> struct ProjectedRowGrads {
  const int32_t* rows;  ///< [n] row of each Gaussian, or -1
  const Vec2<T>* means2d;
  const Sym2<T>* cov2d;  ///< xy: with respect to the one number that fills both places
  const T* opacities;
  const T* depths;
  const Vec3<T>* colors;
};

/// Public rows to splats. Nothing is known about their numbers: a row that makes no splat touches no tile.
template <typename T> struct ShapeRowsParams {
  int64_t n;
  ProjectedRows<T> rows;  ///< read; without colours the splats are black
  FootprintChoice footprint;
  TileGrid grid;
  T* splats;  ///< [n] SplatRow
};

/// Sums of pairs to the gradient with respect to public rows, written for every row: zero where it has no pairs.
template <typename T> struct RowGradsParams {
  int64_t n;
  ProjectedRows<T> rows;  ///< read: cov2d, dets, opacities
  FootprintChoice footprint;
  Vec2<T>* dL_dmeans2d;
  Sym2<T>* dL_dcov2d;  ///< xy: with respect to the one number that fills both places
  T* dL_dopacities;
  Vec2<T>* absolute;  ///< [n] sums over pixels of |dL/dmeans2d|, or null
};

/// Splats, by tile and depth, to an image.
template <typename T> struct BlendParams {
  TileGrid grid;
  const T* splats;
  Channels<T> channels;
  const T* background;  ///< [channels.count]
  Planes<T> image;      ///< one per channel
  T* alpha;             ///< [height, width] 1 - mean transmittance, or null
  T* transmittance;     ///< [samples, height, width] of every sample at the end, or null without a backward pass
  int32_t* last;        ///< [samples, height, width] pairs of the tile up to the last one composited, or null
};

/// Splats, by tile and depth, to what every pixel shows of the `n` Gaussians.
template <typename T> struct InspectParams {
  const T* splats;
  TileGrid grid;
  int32_t* median;    ///< [height, width] Gaussians, or -1; see PixelSummary
  int32_t* dominant;  ///< [height, width]
  // What is known of each of the n Gaussians: numbers of pixels and the sum to add to, the largest weight to raise.
  int32_t* touched;    ///< [n] pixels that show it
  int32_t* largest;    ///< [n] largest weight, as the bits of a float
  int64_t* units;      ///< [n] sum of weights in units of kWeightUnit
  int32_t* in_front;   ///< [n] pixels of Shown::in_front
  int32_t* dominated;  ///< [n] pixels whose `dominant` it is
};

/// The gradient of an image to sums per pair.
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

/// Sums per pair to the gradient of the Gaussians.
template <typename T> struct ProjectVjpParams {
  CameraView<T> camera;
  Gaussians<T> gaussians;
  FootprintChoice footprint;
  GaussianGrads<T> grads;
  /// Gradient of the rows that ProjectParams::channels wrote; `data` is null where three colours in the pairs' sums are
  /// all.
  ChannelRows<const T> dL_dchannels;
};

}  // namespace ar
