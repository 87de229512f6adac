// The contract of a footprint: from a projected Gaussian to its weight I in a pixel. A footprint F is a struct of
// static functions and constants, and a line in registry.h (docs/internals/adding-a-footprint.md).
//
// T is float or double, V is T or a pack of lanes of T (lanes.h). Sigma is the projected covariance [px^2]. d = pixel
// centre - projected mean [px]. The node of a sample is its position relative to the pixel centre [px].
//
// Constants, with defaults in FootprintDefaults:
//
//   kName         the name for users: "box"
//   kKey          a unique key: "box4". Default: the name
//   kOption       that option
//   kReference    true: for comparisons; the CPU compiles it for one instruction set
//   kGeneric      true: CUDA has only the slower kernels, for any number of channels
//   kAlongRays    true: splats may be ordered along rays (core/order.h)
//   kExpensive    true: CUDA finds out exactly which boxes of pixels a splat reaches
//   kPage         the formula of the viewer's page, a key of KINDS in viewer/page/footprint.wgsl.js, with the variance
//                 of support_variance(); null: the page cannot draw F
//   Pixels        a type with the same Shape, terms, alpha, adjoint, ellipse and samples. Blending is compiled once for
//                 all footprints that name this type; void: for F
//   kSamples      samples of a pixel, each with its own transmittance
//   Spread        a type for one sample, with the same Shape, ellipse and level, for CUDA where spread_grid() of
//                 core/stages.h has small tiles: lane s blends the sample at node(s), and p (below) is its position;
//                 void: none
//   kLanes        of a Spread: the samples of a pixel
//   kReach        largest |coordinate| of a node [px]
//   kExtraLevel   no level (below) exceeds 2 ln(255 opacity) + kExtraLevel
//
// Once per splat:
//
//   support_variance(options)   no ellipse (below) is wider than Sigma widened by this variance [px^2]
//   radius_variance(options)    added to Sigma for the radius that 3DGS reports [px^2]
//   Shape<T>                    an aggregate of kShapeWidth numbers T, which the splat carries
//   prepare(cov, options) -> Shape
//   ellipse(shape) -> Mat2 w    a Cholesky factor has the wide axis first
//   level(shape, opacity)       opacity * I(d + node) < 1/255 where |w (d + node)|^2 > level; everywhere if level <= 0
//
//   mean_map(shape) -> Mat2 m   dL/dmean = m^T sums.offset [dL/dpx]
//   prepare_vjp(cov, shape, sums, weighted, options) -> SplatGrad
//                               `sums`: the five sums of ShapeGrad over all pixels and samples, in the coordinates that
//                               are cheapest for F; `weighted`: the sum of AlphaGrad::weighted
//
// Once per tile and splat:
//
//   terms(shape, opacity, origin) -> Terms
//                               numbers for all pixels. origin = a point of the tile - mean [px]; default: zero
//
// Once per pixel and sample s, with p = pixel centre - that point of the tile [px]:
//
//   alpha(terms, p, s) -> V     opacity * I
//   add_alpha_vjp(terms, p, s, AlphaGrad, ShapeGrad& sums)
//
// Samples that move have a displacement `moved` from the node [px], which every composited splat changes, and p
// includes. Such footprints define more; moment.h has the arguments.
//
//   kMoves                      true
//   kMoveReach                  largest |coordinate| of a displacement [px]; kReach includes it
//   node                        of sample s
//   move                        `moved` after the splat; alpha is 0 if the splat was not composited
//   alpha_and_move_vjp          the adjoint of both. `free`: alpha is not capped; `moved`: before the splat;
//                               dL_dmoved: read as after the splat, written as before it
//
// In whitened coordinates z. `place` is a sample's position, node + displacement, relative to the pixel centre.
//
//   cell                        limits of the position of sample s
//   whitened, whitened_row      z of the point p, and of (0, y)
//   whitened_node               z of the point at `place` relative to a point with z = `from`
//   log_alpha                   log2(opacity * I)
//
//   move_in                     move by z and a Bounds or UnitCell; a mask says whether the splat was composited
//   add_alpha_and_move_in_vjp   its adjoint with that of alpha, added to sums
//   move_in_with_slope          move_in that changes its argument and returns its MoveSlope
//   kMoveGradUnit               unit of gradients by positions between splats: the cheapest
#pragma once

#include <cstddef>
#include <type_traits>

#include "core/constants.h"
#include "core/vec.h"

namespace ar {

/// Projected covariance [px^2]. det comes from factors (docs/internals/numerics.md, "Determinant from factors").
template <typename T> struct Cov2d {
  T xx, xy, yy, det;
};

/// c + v I.
template <typename T> AR_HD Cov2d<T> blur(Cov2d<T> c, T v) {
  return {c.xx + v, c.xy, c.yy + v, c.det + v * (c.xx + c.yy) + v * v};
}

template <typename T> AR_HD T eigenvalue_gap(Cov2d<T> c) {
  const T dx = c.xx - c.yy, dy = T(2) * c.xy;
  return sqrt(dx * dx + dy * dy);
}

template <class... F> struct FootprintList {};

inline constexpr int kShapeWidth = 5;

/// `dilation` of point, `variance` of mip [px^2]. Other options are template parameters.
struct FootprintOptions {
  double number;
};

struct FootprintChoice {
  int index;
  FootprintOptions options;
};

struct Option {
  const char* name = nullptr;   ///< null: no option
  const char* value = nullptr;  ///< selects this footprint; null: a number
  double number = 0;            ///< its default
  bool is_default = true;
};

/// `weighted` is alpha dL_dalpha.
template <class V> struct AlphaGrad {
  V dL_dalpha, weighted;
};

/// Sums over pixels.
template <class V> struct ShapeGrad {
  Vec2<V> offset;
  Sym2<V> shape;
};
template <class V> AR_HD ShapeGrad<V> operator+(ShapeGrad<V> a, ShapeGrad<V> b) {
  return {a.offset + b.offset, a.shape + b.shape};
}

template <class V> struct Bounds {
  Vec2<V> lo, hi;

  static constexpr int kUnits = 1;  ///< of length per pixel
  AR_HD Vec2<V> held(V length, Vec2<V> along, Vec2<V> at) const {
    const Vec2<V> next = {madd(length, along.x, at.x), madd(length, along.y, at.y)};
    return {min(max(next.x, lo.x), hi.x), min(max(next.y, lo.y), hi.y)};
  }
  /// Not clamped.
  AR_HD MaskOf<V> free_x(V x) const { return (x >= lo.x) & (x <= hi.x); }
  AR_HD MaskOf<V> free_y(V y) const { return (y >= lo.y) & (y <= hi.y); }
};

/// [0, 1]^2: positions are from its corner, in edges of cells, n per pixel. On a device the clamp is free.
template <int n> struct UnitCell {
  static constexpr int kUnits = n;
  template <class V> AR_HD Vec2<V> held(V length, Vec2<V> along, Vec2<V> at) const {
    return {saturated_madd(length, along.x, at.x), saturated_madd(length, along.y, at.y)};
  }
  template <class V> AR_HD MaskOf<V> free_x(V x) const { return in_unit_interval(x); }
  template <class V> AR_HD MaskOf<V> free_y(V y) const { return in_unit_interval(y); }
};

template <class V> struct MoveGrad {
  V weighted;
  ShapeGrad<V> sums;
};

/// Derivatives by the position before a splat.
template <class V> struct MoveSlope {
  Vec2<V> alpha;             ///< of the splat's alpha, times kMoveGradUnit
  Sym2<V> step;              ///< of the position after the splat: 1 + step
  MaskOf<V> free_x, free_y;  ///< not clamped
};

struct FootprintDefaults {
  using Pixels = void;
  using Spread = void;
  static constexpr int kLanes = 1;
  static constexpr std::nullptr_t kKey = nullptr;
  static constexpr const char* kPage = nullptr;
  static constexpr Option kOption = {};
  static constexpr bool kReference = false, kGeneric = false, kExpensive = false, kAlongRays = false;
  static constexpr int kSamples = 1;
  static constexpr double kReach = 0, kExtraLevel = 0;
  static constexpr bool kMoves = false;
};

template <class F> using PixelsOf = std::conditional_t<std::is_void_v<typename F::Pixels>, F, typename F::Pixels>;

template <class F> constexpr int spread_lanes() {
  if constexpr (std::is_void_v<typename F::Spread>) {
    return 1;
  } else {
    return F::Spread::kLanes;
  }
}

/// The kind of w in a SplatGrad.
enum class GradFrame {
  kTriangular,  ///< a Cholesky factor of (Sigma + variance I)^-1, either axis first, rows of any sign
  kAxes,        ///< rows: the axes of Sigma over their standard deviations
  kPixels,      ///< the identity: dL_dwhite is dL/dSigma
};

/// dL = dL_dmean . dmean + tr(dL_dwhite w dSigma w^T) + dL_dlog_amp d(log amp), with amp = sqrt(det Sigma / det(Sigma +
/// variance I)). In factors until covariance_vjp.h, since products would cancel (docs/internals/numerics.md,
/// "Gradients").
template <typename T> struct SplatGrad {
  Vec2<T> dL_dmean;
  Mat2<T> w;
  Sym2<T> dL_dwhite;
  T dL_dlog_amp, variance;
  GradFrame frame;
};

/// Gradient of log amp by Sigma, without cancellation (docs/internals/numerics.md, "Gradient of an amplitude").
template <typename T> AR_HD Sym2<T> log_amp_grad(Cov2d<T> c, T v) {
  const T scale = quotient(T(0.5) * v, blur(c, v).det), square = c.xy * c.xy;
  return {scale * quotient(c.yy * (c.yy + v) + square, c.det), -scale * (quotient(c.xy, c.det) * (c.xx + c.yy + v)),
          scale * quotient(c.xx * (c.xx + v) + square, c.det)};
}

/// For a Sigma without factors.
template <typename T> AR_HD Sym2<T> cov_grad(Cov2d<T> c, const SplatGrad<T>& grad) {
  const Sym2<T> g = congruence_transposed(grad.w, grad.dL_dwhite);
  if (grad.dL_dlog_amp == T(0)) return g;  // det Sigma may be zero
  const Sym2<T> a = log_amp_grad(c, grad.variance);
  return g + Sym2<T>{grad.dL_dlog_amp * a.xx, grad.dL_dlog_amp * a.xy, grad.dL_dlog_amp * a.yy};
}

}  // namespace ar
