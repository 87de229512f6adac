// What a footprint defines: the model that turns a projected Gaussian into its weight I in a pixel. A footprint F is a
// struct of static functions and constants, and a line in registry.h; nothing else names it. FootprintDefaults has the
// defaults. docs/adding-a-footprint.md explains how to write a footprint.
//
// T is float or double, V is T or a pack of lanes of T (lanes.h). Sigma is the projected covariance [px^2],
// d = pixel centre - projected mean [px]. The node of a sample is its position relative to the pixel centre [px].
//
// Constants:
//
//   kName                the name for users: "box"
//   kKey                 a unique key: "box4". Footprints with the same name differ in an option. Default: the name
//   kOption              the option for users, see Option. Default: none
//   kReference           true: meant for comparisons; the CPU compiles it for one instruction set. Default: false
//   kGeneric             true: CUDA has no kernels for few channels, only the slower ones for any number of channels.
//                        Default: false
//   kPage                the formula of the viewer's page (viewer/page/shaders.js): "gaussian" with a peak of 1,
//                        "compensated" with the mass of the splat, "cumulants" or "window"; the first three use the
//                        variance of support_variance(). Default: null, the page cannot draw it
//   kExpensive           true: CUDA kernels find out exactly which pixels a splat reaches. Default: false
//   Pixels               a type with the same Shape, terms, alpha, adjoint, ellipse and samples. Blending is compiled
//                        for it, once for all footprints that name it. Default: F
//   kSamples             samples of a pixel, each with its own transmittance. Default: 1
//   Spread               a type that blends one sample of a pixel, with the same Shape, ellipse and level. CUDA
//                        compiles kernels for it where spread_grid() of core/stages.h has small tiles: lane s blends
//                        the sample at node(s), and p (below) is the position of that sample. Default: void, none
//   kLanes               of a Spread: the samples of a pixel. Default: 1
//   kReach               largest |coordinate| of a node [px]. Default: 0
//   kExtraLevel          no level (below) exceeds 2 ln(255 opacity) + kExtraLevel. Default: 0
//
// Once per splat:
//
//   support_variance(FootprintOptions)   no ellipse (below) is wider than Sigma widened by this variance [px^2]
//   radius_variance(FootprintOptions)    variance added to Sigma for the radius that 3DGS reports [px^2]
//   Shape<T>                             an aggregate of kShapeWidth numbers T, which the splat carries
//   prepare(Cov2d<T>, FootprintOptions) -> Shape<T>
//   ellipse(Shape<T>) -> Mat2<T>         a matrix w, a Cholesky factor with the wide axis first if it is one, and
//   level(Shape<T>, opacity) -> T        the level, so that opacity * I(d + node) < 1/255 where
//                                        |w (d + node)|^2 > level; level <= 0 if that is so everywhere
//   mean_map(Shape<T>) -> Mat2<T>        the matrix m for which dL/dmean = m^T sums.offset [dL/dpx]
//   prepare_vjp(Cov2d<T>, Shape<T>, ShapeGrad<T> sums, weighted, FootprintOptions) -> SplatGrad<T>
//                                        from the sums over all pixels to the gradient of the splat
//
// Once per tile and splat:
//
//   terms(Shape<T>, opacity, Vec2<T> origin) -> Terms<T>
//                                        numbers for all pixels. origin = a point of the tile - mean [px]; default:
//                                        zero
//
// Once per pixel and sample, with p = pixel centre - that point of the tile [px] and s the number of the sample:
//
//   alpha(Terms<T>, Vec2<V> p, s) -> V   opacity * I
//   add_alpha_vjp(Terms<T>, Vec2<V> p, s, AlphaGrad<V>, ShapeGrad<V>& sums)
//                                        adds to the five sums
//
// The five sums of ShapeGrad run over pixels and samples, in the coordinates that are cheapest for the footprint.
// `weighted` is the sum of AlphaGrad::weighted.
//
// Samples that move, as those of moment.h, have a displacement `moved` from the node [px]. It is zero before the first
// splat, and every splat that is composited changes it. Then p of alpha includes it: pixel centre - point of the tile +
// moved. Such footprints define:
//
//   kMoves                               true. Default: false
//   kMoveReach                           largest |coordinate| of a displacement [px]; kReach includes it
//   node(s) -> Vec2<double>              the node of sample s
//   move(Terms<T>, Vec2<V> p, s, alpha, Vec2<V> moved) -> Vec2<V>
//                                        the displacement after a splat; alpha is 0 if the splat was not composited
//   alpha_and_move_vjp(Terms<T>, Vec2<V> p, s, alpha, free, dL_dalpha, moved, Vec2<V>& dL_dmoved) -> MoveGrad<V>
//                                        the adjoint of alpha and move. `free`: alpha is opacity * I and not the cap;
//                                        `moved` is before the splat; dL_dmoved is read as after it, written as before
//
// Blending uses the same functions in another form, with whitened coordinates z and the position of a sample,
// node + displacement, relative to the pixel centre:
//
//   cell(s) -> Bounds<T>                 limits of the position of sample s [px]
//   whitened(Terms<T>, Vec2<V> p, 0) -> Vec2<V>                            z of a point
//   whitened_node(Terms<T>, Vec2<V> from, Vec2<V> place) -> Vec2<V>        z of a point at `place` relative to
//                                        another with z = `from` (on the CPU the pixel centre, for all samples)
//   whitened_row(Terms<T>, V y) -> Vec2<V>                                 z of (0, y) (on CUDA for a row of cells)
//   log_alpha(Terms<T>, Vec2<V> z) -> V  log2(opacity * I)
//   move_in, add_alpha_and_move_in_vjp   move and alpha_and_move_vjp with z, a position or displacement, and its Bounds
//                                        or UnitCell. A mask tells move_in whether the splat was composited, and not
//                                        alpha; the adjoint adds to sums
//   move_in_with_slope                   move_in that changes its argument, and its MoveSlope
//   kMoveGradUnit                        gradients with respect to positions are multiplied by this, the cheapest
//                                        unit, from splat to splat
//
// With a UnitCell lengths are in edges of cells, and positions are relative to the corner of the cell.
#pragma once

#include <cstddef>
#include <type_traits>

#include "core/constants.h"
#include "core/vec.h"

namespace ar {

/// Projected covariance [px^2]. det from the entries would cancel: in float32 most needles of 30 x 1e-3 px would have
/// det <= 0.
template <typename T> struct Cov2d {
  T xx, xy, yy, det;
};

/// c + v I.
template <typename T> AR_HD Cov2d<T> blur(Cov2d<T> c, T v) {
  return {c.xx + v, c.xy, c.yy + v, c.det + v * (c.xx + c.yy) + v * v};
}

/// Difference of the eigenvalues.
template <typename T> AR_HD T eigenvalue_gap(Cov2d<T> c) {
  const T dx = c.xx - c.yy, dy = T(2) * c.xy;
  return sqrt(dx * dx + dy * dy);
}

template <class... F> struct FootprintList {};

inline constexpr int kShapeWidth = 5;

/// An option at run time: `dilation` of point, `variance` of mip [px^2]. Options that change the code of a pixel are
/// template parameters.
struct FootprintOptions {
  double number;
};

/// A footprint, by its index in the registry.
struct FootprintChoice {
  int index;
  FootprintOptions options;
};

/// The option of a footprint: a number at run time, or a value that selects among footprints with the same name.
struct Option {
  const char* name = nullptr;   ///< null: no option
  const char* value = nullptr;  ///< selects this footprint; null: a number at run time
  double number = 0;            ///< default of a number
  bool is_default = true;       ///< this footprint is used if the option is not given
};

/// The gradient with respect to alpha, and to its logarithm (times alpha). A footprint uses either.
template <class V> struct AlphaGrad {
  V dL_dalpha, weighted;
};

/// Five sums over pixels, with a meaning that add_alpha_vjp and prepare_vjp of a footprint share.
template <class V> struct ShapeGrad {
  Vec2<V> offset;
  Sym2<V> shape;
};
template <class V> AR_HD ShapeGrad<V> operator+(ShapeGrad<V> a, ShapeGrad<V> b) {
  return {a.offset + b.offset, a.shape + b.shape};
}

/// Limits of a position [px].
template <class V> struct Bounds {
  Vec2<V> lo, hi;

  static constexpr int kUnits = 1;  ///< of length per pixel
  /// at + length along, clamped.
  AR_HD Vec2<V> held(V length, Vec2<V> along, Vec2<V> at) const {
    const Vec2<V> next = {madd(length, along.x, at.x), madd(length, along.y, at.y)};
    return {min(max(next.x, lo.x), hi.x), min(max(next.y, lo.y), hi.y)};
  }
  /// Whether the clamp leaves a coordinate as it is.
  AR_HD MaskOf<V> free_x(V x) const { return (x >= lo.x) & (x <= hi.x); }
  AR_HD MaskOf<V> free_y(V y) const { return (y >= lo.y) & (y <= hi.y); }
};

/// The same where the cell is [0, 1] x [0, 1], with n units of length per pixel. On a device the clamp is free.
template <int n> struct UnitCell {
  static constexpr int kUnits = n;
  template <class V> AR_HD Vec2<V> held(V length, Vec2<V> along, Vec2<V> at) const {
    return {saturated_madd(length, along.x, at.x), saturated_madd(length, along.y, at.y)};
  }
  template <class V> AR_HD MaskOf<V> free_x(V x) const { return in_unit_interval(x); }
  template <class V> AR_HD MaskOf<V> free_y(V y) const { return in_unit_interval(y); }
};

/// What a sample that moves adds to the sums of a splat.
template <class V> struct MoveGrad {
  V weighted;  ///< raw dL_draw
  ShapeGrad<V> sums;
};

/// Derivatives of a splat's alpha, and of the position after it, with respect to the position before it.
template <class V> struct MoveSlope {
  Vec2<V> alpha;             ///< times kMoveGradUnit
  Sym2<V> step;              ///< of the position: 1 + step
  MaskOf<V> free_x, free_y;  ///< coordinates that are not clamped
};

struct FootprintDefaults {
  using Pixels = void;  // the footprint itself
  using Spread = void;  // none
  static constexpr int kLanes = 1;
  static constexpr std::nullptr_t kKey = nullptr;  // the name
  static constexpr const char* kPage = nullptr;    // none
  static constexpr Option kOption = {};
  static constexpr bool kReference = false, kGeneric = false, kExpensive = false;
  static constexpr int kSamples = 1;
  static constexpr double kReach = 0, kExtraLevel = 0;
  static constexpr bool kMoves = false;
};

/// What blending is compiled for.
template <class F> using PixelsOf = std::conditional_t<std::is_void_v<typename F::Pixels>, F, typename F::Pixels>;

/// Lanes over which the samples of a pixel may be spread.
template <class F> constexpr int spread_lanes() {
  if constexpr (std::is_void_v<typename F::Spread>) {
    return 1;
  } else {
    return F::Spread::kLanes;
  }
}

/// The kind of w in a SplatGrad.
enum class GradFrame {
  kTriangular,  ///< a Cholesky factor of (Sigma + variance I)^-1, either axis first, with any signs of rows
  kAxes,        ///< rows are the axes of Sigma divided by their standard deviations
  kPixels,      ///< the identity: dL_dwhite is the gradient with respect to Sigma
};

/// Gradient of one splat. dL = dL_dmean . dmean + tr(dL_dwhite w dSigma w^T) + dL_dlog_amp d(log amp),
/// amp = sqrt(det Sigma / det(Sigma + variance I)). It is in factors for covariance_vjp.h: the sum w^T dL_dwhite w
/// would cancel for needles, and d(log amp), a difference of inverses, for splats much wider than a pixel.
template <typename T> struct SplatGrad {
  Vec2<T> dL_dmean;
  Mat2<T> w;
  Sym2<T> dL_dwhite;
  T dL_dlog_amp, variance;
  GradFrame frame;
};

/// Gradient of log amp with respect to Sigma: (Sigma^-1 - Sigma'^-1) / 2 = v adj(Sigma) adj(Sigma') / (2 det det'),
/// whose terms do not cancel.
template <typename T> AR_HD Sym2<T> log_amp_grad(Cov2d<T> c, T v) {
  const T scale = quotient(T(0.5) * v, blur(c, v).det), square = c.xy * c.xy;
  return {scale * quotient(c.yy * (c.yy + v) + square, c.det), -scale * (quotient(c.xy, c.det) * (c.xx + c.yy + v)),
          scale * quotient(c.xx * (c.xx + v) + square, c.det)};
}

/// The gradient with respect to Sigma as one matrix, for a Sigma without factors.
template <typename T> AR_HD Sym2<T> cov_grad(Cov2d<T> c, const SplatGrad<T>& grad) {
  const Sym2<T> g = congruence_transposed(grad.w, grad.dL_dwhite);
  if (grad.dL_dlog_amp == T(0)) return g;  // det Sigma may be zero
  const Sym2<T> a = log_amp_grad(c, grad.variance);
  return g + Sym2<T>{grad.dL_dlog_amp * a.xx, grad.dL_dlog_amp * a.xy, grad.dL_dlog_amp * a.yy};
}

}  // namespace ar
