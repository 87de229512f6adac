// The data that the stages hand to each other. Views of host or device memory, never owners.
//
// Conventions, once. World to camera is OpenCV's: x right, y down, z forward. 3DGS stores its
// matrices transposed, for row vectors: element (r, c) of the matrix that acts on column vectors is
// at [4 c + r]. Pixel centres are at integers, x to the right, y down: px = ((ndc + 1) W - 1) / 2.
#pragma once

#include <cstdint>

#include "core/constants.h"
#include "core/footprint/contract.h"
#include "core/vec.h"

namespace ar {

/// The grid of tiles over an image.
struct TileGrid {
  int width, height;  ///< px
  AR_HD int columns() const { return (width + kTile - 1) / kTile; }
  AR_HD int rows() const { return (height + kTile - 1) / kTile; }
  AR_HD int64_t tiles() const { return int64_t(columns()) * rows(); }
};

template <typename T> struct CameraView {
  const T* view;      ///< [16] world to camera, transposed
  const T* proj;      ///< [16] world to clip space, transposed
  const T* position;  ///< [3] camera centre, world units
  int width, height;  ///< px
  T tan_half_fov_x, tan_half_fov_y;
  /// [kLensWidth] numbers of a Lens for a full camera (camera.h), or null for a plain one, which knows no more than
  /// the above.
  const T* lens = nullptr;
};

/// Scene parameters. Either scales and rotations or cov3ds, either shs or colors; the others null.
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

/// Gradients of the same, written, not added to. Null where not wanted.
template <typename T> struct GaussianGrads {
  Vec3<T>* means;
  Vec3<T>* scales;
  Vec4<T>* rotations;
  Sym3<T>* cov3ds;  ///< entry off the diagonal: derivative by the one number that fills both places
  T* opacities;
  Vec3<T>* shs;
  Vec3<T>* colors;
  T* means2d;          ///< [n, means2d_stride], in 3DGS's units: per (0.5 W, 0.5 H) px
  int means2d_stride;  ///< 3, or 4 with the sums of absolute values in columns 2 and 3
};

/// Scalars per Splat, whatever the footprint: the alignment rounds all of them up to this.
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

/// What blend_vjp sums for one splat in one tile.
template <typename T> struct PairGrad {
  ShapeGrad<T> shape;
  T weighted;  ///< sum of alpha dL/dalpha
  Vec3<T> color;
};
template <typename T> AR_HD PairGrad<T> operator+(const PairGrad<T>& a, const PairGrad<T>& b) {
  return {a.shape + b.shape, a.weighted + b.weighted, a.color + b.color};
}

}  // namespace ar
