// What a footprint is: the model that turns a projected Gaussian into its weight I in a pixel.
//
// A footprint F is a struct of static functions and constants, and a line in registry.h. Nothing else in the project
// names it. FootprintDefaults has the defaults. docs/adding-a-footprint.md explains how to write one.
//
// In what follows T is float or double, and V is T or a pack of lanes of T (lanes.h). Sigma is the projected covariance
// [px^2], d = pixel centre - projected mean [px], and a node is where a sample lies, seen from the pixel's centre [px].
//
// Constants:
//
//   kName                what users call it: "box"
//   kKey                 its own key: "box4". Footprints of one name differ in an option. Default: the name
//   kOption              the option that users may set, see Option. Default: none
//   kReference           true: meant to compare others with; the CPU compiles it for one instruction set. Default:
//   false kGeneric             true: CUDA blends it with the kernels for any number of channels alone, which exist for
//   every
//                        footprint. They are slower, but it adds no kernels for four channels or fewer. Default: false
//   kPage                the formula by which the viewer's page draws it (viewer/page/shaders.js): "gaussian" with a
//   peak
//                        of 1, "compensated" with the mass of the splat, "cumulants" or "window"; for the first three
//                        with the variance that support_variance() states. Default: null, the page cannot draw it
//   kExpensive           true: CUDA kernels would rather find out exactly which pixels a splat reaches than work out
//                        weights in vain. Default: false
//   Pixels               a type with the same Shape, terms, alpha, adjoint, ellipse and samples, for which blending is
//                        compiled instead, once for all footprints that name it. Default: F
//   kSamples             samples of a pixel, each with its own transmittance. Default: 1
//   Spread               a type that blends one sample of a pixel, with the same Shape, ellipse and level. CUDA kernels
//                        are compiled for it where spread_grid() of core/stages.h has small tiles: there each of kLanes
//                        lanes has a sample, that of lane s at node(s), and p is the place of the sample and not of the
//                        pixel. kReach is that of the pixel. Default: void, there is none
//   kLanes               of a Spread: the samples of a pixel. Default: 1
//   kReach               largest |coordinate| of a sample's node [px]. Default: 0
//   kExtraLevel          no level (below) exceeds 2 ln(255 opacity) + kExtraLevel. Default: 0
//
// Once per splat:
//
//   support_variance(FootprintOptions)   no ellipse (below) is wider than Sigma widened by this variance [px^2]
//   radius_variance(FootprintOptions)    variance added to Sigma for the radius that 3DGS reports [px^2]
//   Shape<T>                             what a splat carries: an aggregate of kShapeWidth numbers T
//   prepare(Cov2d<T>, FootprintOptions) -> Shape<T>
//   ellipse(Shape<T>) -> Mat2<T>         a matrix w, with the wide axis first if it is a Cholesky factor, and
//   level(Shape<T>, opacity) -> T        the level, such that opacity * I(d + node) < 1/255 wherever
//                                        |w (d + node)|^2 > level; level <= 0 where that holds everywhere
//   mean_map(Shape<T>) -> Mat2<T>        the matrix m for which dL/dmean = m^T sums.offset [dL/dpx]
//   prepare_vjp(Cov2d<T>, Shape<T>, ShapeGrad<T> sums, weighted, FootprintOptions) -> SplatGrad<T>
//                                        from the sums over all pixels to the gradient of the splat
//
// Once per tile and splat:
//
//   terms(Shape<T>, opacity, Vec2<T> origin) -> Terms<T>
//                                        numbers that all pixels share. origin = a point of the tile - mean [px]; it is
//                                        zero unless given
//
// Once per pixel and sample, with p = pixel centre - that point of the tile [px] and s the number of the sample:
//
//   alpha(Terms<T>, Vec2<V> p, s) -> V   opacity * I
//   add_alpha_vjp(Terms<T>, Vec2<V> p, s, AlphaGrad<V>, ShapeGrad<V>& sums)
//                                        adds this sample's part to the five sums
//
// The five numbers of ShapeGrad are summed over pixels and samples in whatever coordinates make them cheap; prepare_vjp
// gives them meaning. `weighted` is the sum of AlphaGrad::weighted, which the gradient with respect to the opacity
// needs anyway.
//
// Samples may carry a state besides their transmittance, as those of moment.h do. With
//
//   kMoves                               true. Default: false
//
// a sample has a displacement `moved` from its node [px]. It is zero in front of the first splat, and every splat that
// is composited changes it. Then p of alpha is pixel centre - that point of the tile + moved, and these are needed too:
//
//   kMoveReach                           largest |coordinate| of a displacement [px], which kReach has to include
//   node(s) -> Vec2<double>              the node of sample s
//   move(Terms<T>, Vec2<V> p, s, alpha, Vec2<V> moved) -> Vec2<V>
//                                        the displacement behind a splat. alpha is that which was composited; where it
//                                        is 0 the splat was not, and nothing moves
//   alpha_and_move_vjp(Terms<T>, Vec2<V> p, s, alpha, free, dL_dalpha, moved, Vec2<V>& dL_dmoved) -> MoveGrad<V>
//                                        the adjoint of alpha and move. alpha is what was composited, and `free` says
//                                        where that is opacity * I and not the cap; `moved` is that in front of the
//                                        splat; dL_dmoved is read behind the splat and left in front of it
//
// Blending, on both devices, uses the same functions in another form, from whitened coordinates z. A sample has a
// place, node + displacement, seen from the pixel's centre:
//
//   cell(s) -> Bounds<T>                 where the place of sample s may be [px]
//   whitened(Terms<T>, Vec2<V> p, 0) -> Vec2<V>                            z of a point
//   whitened_node(Terms<T>, Vec2<V> from, Vec2<V> place) -> Vec2<V>        z of a point at `place` from another, whose
//                                        z is `from`: on the CPU the pixel's centre, which all samples share
//   whitened_row(Terms<T>, V y) -> Vec2<V>                                 z of (0, y): on CUDA the start of a row of
//                                        cells, which these share
//   log_alpha(Terms<T>, Vec2<V> z) -> V  log2(opacity * I)
//   move_in, add_alpha_and_move_in_vjp   move and alpha_and_move_vjp, from z, and a place or a displacement with its
//                                        Bounds or UnitCell; move_in takes alpha as if the splat was composited, and
//                                        a mask that says whether it was; the adjoint adds to sums
//   move_in_with_slope                   move_in of a place that is changed, and its MoveSlope
//
// With a UnitCell all lengths are in edges of cells, and places are seen from their cell's corner. Gradients with
// respect to places are carried from splat to splat in the unit that is cheapest for the footprint:
//
//   kMoveGradUnit                        so many times what they are
#pragma once

#include <cstddef>
#include <type_traits>

#include "core/constants.h"
#include "core/vec.h"

namespace ar {

/// Projected covariance [px^2]. det is carried because recomputing it from the entries cancels:
/// a needle of 30 x 1e-3 px has det <= 0 in float32 more often than not (docs/numerics.md).
template <typename T> struct Cov2d {
  T xx, xy, yy, det;
};

/// Cov2d after convolution with an isotropic Gaussian of variance v.
template <typename T> AR_HD Cov2d<T> blur(Cov2d<T> c, T v) {
  return {c.xx + v, c.xy, c.yy + v, c.det + v * (c.xx + c.yy) + v * v};
}

/// Difference of the eigenvalues.
template <typename T> AR_HD T eigenvalue_gap(Cov2d<T> c) {
  const T dx = c.xx - c.yy, dy = T(2) * c.xy;
  return sqrt(dx * dx + dy * dy);
}

template <class... F> struct FootprintList {};

/// Numbers of a footprint's Shape.
inline constexpr int kShapeWidth = 5;

/// The number that a footprint takes at run time: `dilation` of point, `variance` of mip [px^2]. What changes the code
/// of a pixel is a template parameter instead.
struct FootprintOptions {
  double number;
};

/// A footprint of the registry, by its place there, and its options.
struct FootprintChoice {
  int index;
  FootprintOptions options;
};

/// The option of a footprint: a number that it takes at run time, or a value that distinguishes it from other
/// footprints of the same name.
struct Option {
  const char* name = nullptr;   ///< null: there is no option
  const char* value = nullptr;  ///< value of the option that selects this footprint; null: it is a number at run time
  double number = 0;            ///< its default
  bool is_default = true;       ///< of footprints of the same name: this one is taken if the option is not given
};

/// The gradient with respect to an alpha, and that times the alpha, which is with respect to its logarithm. A footprint
/// takes what it needs, and what nothing uses the compiler leaves out.
template <class V> struct AlphaGrad {
  V dL_dalpha, weighted;
};

/// Five sums over pixels. What they mean is up to the footprint: see its add_alpha_vjp and prepare_vjp.
template <class V> struct ShapeGrad {
  Vec2<V> offset;
  Sym2<V> shape;
};
template <class V> AR_HD ShapeGrad<V> operator+(ShapeGrad<V> a, ShapeGrad<V> b) {
  return {a.offset + b.offset, a.shape + b.shape};
}

/// Where a node may be [px].
template <class V> struct Bounds {
  Vec2<V> lo, hi;

  static constexpr int kUnits = 1;  ///< of length in a pixel
  /// at + length along, held within the bounds.
  AR_HD Vec2<V> held(V length, Vec2<V> along, Vec2<V> at) const {
    const Vec2<V> next = {madd(length, along.x, at.x), madd(length, along.y, at.y)};
    return {min(max(next.x, lo.x), hi.x), min(max(next.y, lo.y), hi.y)};
  }
  /// Whether a place before it is held stays as it is.
  AR_HD MaskOf<V> free_x(V x) const { return (x >= lo.x) & (x <= hi.x); }
  AR_HD MaskOf<V> free_y(V y) const { return (y >= lo.y) & (y <= hi.y); }
};

/// The same in the unit of length in which the cell of the node is [0, 1] x [0, 1], n of them in a pixel. On a device
/// that costs fewer instructions.
template <int n> struct UnitCell {
  static constexpr int kUnits = n;
  template <class V> AR_HD Vec2<V> held(V length, Vec2<V> along, Vec2<V> at) const {
    return {saturated_madd(length, along.x, at.x), saturated_madd(length, along.y, at.y)};
  }
  template <class V> AR_HD MaskOf<V> free_x(V x) const { return in_unit_interval(x); }
  template <class V> AR_HD MaskOf<V> free_y(V y) const { return in_unit_interval(y); }
};

/// What one sample that moves adds to the sums of one splat.
template <class V> struct MoveGrad {
  V weighted;         ///< what is added to the sum `weighted`: raw dL_draw
  ShapeGrad<V> sums;  ///< what is added to the five sums
};

/// How a splat that was composited into a sample that moves depends on the sample's place in front of it.
template <class V> struct MoveSlope {
  Vec2<V> alpha;             ///< gradient of alpha, times kMoveGradUnit
  Sym2<V> step;              ///< the place behind changes by (1 + step) times the change of the place in front,
  MaskOf<V> free_x, free_y;  ///< in those coordinates that are not held at a bound
};

/// What most footprints have in common.
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

/// Over how many lanes the samples of a pixel may be spread: kLanes of its Spread.
template <class F> constexpr int spread_lanes() {
  if constexpr (std::is_void_v<typename F::Spread>) {
    return 1;
  } else {
    return F::Spread::kLanes;
  }
}

/// What is known about the w of a SplatGrad.
enum class GradFrame {
  kTriangular,  ///< w is a Cholesky factor of the inverse of Sigma + variance I, either axis first, up to the signs of
                ///< its rows
  kAxes,        ///< its rows are the axes of Sigma over their standard deviations
  kPixels,      ///< it is the identity: dL_dwhite is the gradient with respect to Sigma itself
};

/// Gradient of one splat. dL = dL_dmean . dmean + tr(dL_dwhite w dSigma w^T) + dL_dlog_amp d(log amp),
/// amp = sqrt(det Sigma / det(Sigma + variance I)). Both parts stay in factors until they meet those of Sigma
/// (covariance.h): the sum w^T dL_dwhite w cancels for needles, and d(log amp), a difference of inverses, for
/// splats much wider than a pixel, where it vanishes.
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

/// All of the gradient with respect to Sigma, as one matrix: for a Sigma that is known by its entries only.
template <typename T> AR_HD Sym2<T> cov_grad(Cov2d<T> c, const SplatGrad<T>& grad) {
  const Sym2<T> g = congruence_transposed(grad.w, grad.dL_dwhite);
  if (grad.dL_dlog_amp == T(0)) return g;  // det Sigma may be zero
  const Sym2<T> a = log_amp_grad(c, grad.variance);
  return g + Sym2<T>{grad.dL_dlog_amp * a.xx, grad.dL_dlog_amp * a.xy, grad.dL_dlog_amp * a.yy};
}

}  // namespace ar
