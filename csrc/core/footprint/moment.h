// The footprint `moment`: the pixel as S equal square cells, each with its own transmittance. A splat is evaluated at
// the centroid of the light that earlier splats have left in the cell (docs/internals/numerics.md, "Moving nodes").
#pragma once

#include "core/footprint/gaussian.h"

namespace ar {

/// "moment1" ... "moment16"; the cells begin at the seventh character.
template <int S> struct MomentKey {
  static constexpr char kText[] = {
      'm', 'o', 'm', 'e', 'n', 't', S >= 10 ? '1' : char('0' + S), S >= 10 ? char('0' + S % 10) : '\0', '\0'};
};

/// n x n cells, S = n^2. At first a cell is a Gaussian at its centre. `Pixels` is reset: nodes of the base class do not
/// move.
template <int S> struct Moment : GaussianFootprint<1, true> {
  using Pixels = void;
  static constexpr const char* kPage = "moving";
  using Gaussian = GaussianFootprint<1, true>;
  static_assert(S == 1 || S == 4 || S == 16, "moment has 1, 4 or 16 samples");

  static constexpr const char* kName = "moment";
  static constexpr const char* kKey = MomentKey<S>::kText;
  static constexpr Option kOption = {"samples", MomentKey<S>::kText + 6, 0, S == 4};
  static constexpr int kSamples = S, kSide = S == 1 ? 1 : S == 4 ? 2 : 4;  ///< cells along an edge
  static constexpr double kVariance = kPixelVariance / S;                  ///< [px^2]
  static constexpr double kReach = 0.5;                                    ///< nodes stay in their cells

  static constexpr bool kMoves = true, kAlongRays = S <= 4;
  static constexpr double kMoveReach = 0.5 / kSide;
  static constexpr double kMoveGradUnit = kBase2 * kBase2;  ///< both z and the sums have kBase2 as a factor

  AR_HD static double radius_variance(FootprintOptions) { return kPixelVariance; }
  AR_HD static double support_variance(FootprintOptions) { return kVariance; }

  /// Centre of a cell [px]. One rounding, so that T is as good as double.
  template <typename T = double> AR_HD static constexpr Vec2<T> node(int s) {
    return {edge<T>(2 * (s % kSide) + 1), edge<T>(2 * (s / kSide) + 1)};
  }

  template <typename T> AR_HD static GaussianShape<T> prepare(Cov2d<T> cov, FootprintOptions) {
    return Gaussian::prepare_with(cov, T(kVariance));
  }

  template <typename T>
  AR_HD static SplatGrad<T> prepare_vjp(Cov2d<T>, const GaussianShape<T>& shape, ShapeGrad<T> sums, T weighted,
                                        FootprintOptions) {
    return Gaussian::prepare_vjp_with(shape, sums, weighted, T(kVariance));
  }

  template <typename T, class V> AR_HD static V alpha(const Terms<T>& t, Vec2<V> p, int s) {
    return Gaussian::alpha(t, p + place<T, V>(s), 0);
  }

  template <typename T, class V>
  AR_HD static void add_alpha_vjp(const Terms<T>& t, Vec2<V> p, int s, AlphaGrad<V> grad, ShapeGrad<V>& sums) {
    Gaussian::add_alpha_vjp(t, p + place<T, V>(s), 0, grad, sums);
  }

  template <typename T, class V>
  AR_HD static Vec2<V> move(const Terms<T>& t, Vec2<V> p, int s, V alpha, Vec2<V> moved) {
    const V reach = V(T(kMoveReach));
    return move_in(t, Gaussian::whitened(t, p + place<T, V>(s), 0), alpha, alpha > V(T(0)), moved,
                   Bounds<V>{{-reach, -reach}, {reach, reach}});
  }

  template <typename T, class V>
  AR_HD static MoveGrad<V> alpha_and_move_vjp(const Terms<T>& t, Vec2<V> p, int s, V alpha, MaskOf<V> free, V dL_dalpha,
                                              Vec2<V> moved, Vec2<V>& dL_dmoved) {
    const V zero = V(T(0)), reach = V(T(kMoveReach)), unit = V(T(kMoveGradUnit));
    MoveGrad<V> grad = {zero, {{zero, zero}, {zero, zero, zero}}};
    Vec2<V> in_units = {dL_dmoved.x * unit, dL_dmoved.y * unit};
    add_alpha_and_move_in_vjp(t, Gaussian::whitened(t, p + place<T, V>(s), 0), alpha, free, alpha * dL_dalpha, moved,
                              Bounds<V>{{-reach, -reach}, {reach, reach}}, in_units, grad);
    dL_dmoved = {divide(in_units.x, unit), divide(in_units.y, unit)};
    return grad;
  }

  template <typename T> AR_HD static Bounds<T> cell(int s) {
    const int x = 2 * (s % kSide), y = 2 * (s / kSide);
    return {{edge<T>(x), edge<T>(y)}, {edge<T>(x + 2), edge<T>(y + 2)}};
  }

  template <typename T, class V> AR_HD static Vec2<V> whitened_node(const Terms<T>& t, Vec2<V> from, Vec2<V> place) {
    return transform(t.w, place, from);
  }
  template <typename T, class V> AR_HD static Vec2<V> whitened_row(const Terms<T>& t, V y) {
    return {V(t.node[0].x), madd(V(t.w.yy), y, V(t.node[0].y))};
  }

  /// move() by whitened coordinates z. `at`: the node's position or displacement, in the unit of w^-1. `mask`: the
  /// splat was composited; alpha may be nonzero where it was not.
  template <typename T, class V, class Cell>
  AR_HD static Vec2<V> move_in(const Terms<T>& t, Vec2<V> z, V alpha, MaskOf<V> mask, Vec2<V> at, const Cell& cell) {
    const Vec2<V> along = transform_transposed(t.w, z);
    // The same bits: a GPU thread skips instructions at no cost.
    if constexpr (std::is_same_v<MaskOf<V>, bool>) {
      const V length = length_of<T, V, Cell>(alpha);
      if (mask) at = cell.held(length, along, at);
      return at;
    } else {
      return cell.held(select(mask, length_of<T, V, Cell>(alpha), V(T(0))), along, at);
    }
  }

  /// alpha_and_move_vjp() by z, added to `sums`. q is the v r y of docs/internals/numerics.md. dL_dat is in
  /// kMoveGradUnit. alpha and `weighted` = alpha dL_dalpha are zero where the splat was not composited.
  template <typename T, class V, class Cell>
  AR_HD static void add_alpha_and_move_in_vjp(const Terms<T>& t, Vec2<V> z, V alpha, MaskOf<V> free, V weighted,
                                              Vec2<V> at, const Cell& cell, Vec2<V>& dL_dat, MoveGrad<V>& sums) {
    const V zero = V(T(0)), unit = V(T(1 / kMoveGradUnit)), r = odds(alpha), length = V(T(step<Cell>())) * r;
    const Vec2<V> next = moved(length, transform_transposed(t.w, z), at);
    const Vec2<V> behind = {select(cell.free_x(next.x), dL_dat.x, zero), select(cell.free_y(next.y), dL_dat.y, zero)};
    const Vec2<V> y = transform(t.w, behind), q = {length * y.x, length * y.y};
    // alpha v z.y / (1 - alpha)^2 = z.q / (1 - alpha), where 1 / (1 - alpha) = 1 + r
    const V g = select(free, madd(madd(unit, r, unit), madd(z.x, q.x, z.y * q.y), weighted), zero);
    const Vec2<V> offset = {madd(g, z.x, -q.x), madd(g, z.y, -q.y)};
    sums.weighted = sums.weighted + g;
    sums.sums.offset = sums.sums.offset + offset;
    Sym2<V>& shape = sums.sums.shape;
    shape = {madd(z.x, offset.x - q.x, shape.xx), madd(z.x, offset.y, madd(-q.x, z.y, shape.xy)),
             madd(z.y, offset.y - q.y, shape.yy)};
    dL_dat = {madd(-V(t.w.xx), offset.x, madd(-V(t.w.yx), offset.y, behind.x)), madd(-V(t.w.yy), offset.y, behind.y)};
  }

  /// Moves `at` as move_in() does. Returns J and dalpha of docs/internals/numerics.md, "Adjoint of moving nodes".
  /// `free`: alpha is not capped.
  template <typename T, class V, class Cell>
  AR_HD static MoveSlope<V> move_in_with_slope(const Terms<T>& t, Vec2<V> z, V alpha, MaskOf<V> free, const Cell& cell,
                                               Vec2<V>& at) {
    const V zero = V(T(0)), unit = V(T(1 / kMoveGradUnit));
    const V length = length_of<T, V, Cell>(alpha), r = V(T(1 / step<Cell>())) * length;
    const Vec2<V> along = transform_transposed(t.w, z), next = moved(length, along, at);
    at = cell.held(length, along, at);
    // dalpha = -unit alpha along.dat, dr = -unit r (1 + r) along.dat
    const V by_alpha = select(free, -alpha, zero), by_r = select(free, unit * length * (V(T(1)) + r), zero);
    const Vec2<V> steeper = {by_r * along.x, by_r * along.y};
    const V xx = madd(V(t.w.xx), V(t.w.xx), V(t.w.yx) * V(t.w.yx));
    const V xy = V(t.w.yx) * V(t.w.yy), yy = V(t.w.yy) * V(t.w.yy);
    return {{by_alpha * along.x, by_alpha * along.y},
            {madd(length, xx, -steeper.x * along.x), madd(length, xy, -steeper.x * along.y),
             madd(length, yy, -steeper.y * along.y)},
            next.x == at.x,
            next.y == at.y};
  }

 private:
  /// In the unit of length of `Cell`.
  template <class Cell> static constexpr double variance() { return kVariance * Cell::kUnits * Cell::kUnits; }
  /// v / kBase2^2, since (Sigma + v I)^-1 d = w^T z / kBase2^2.
  template <class Cell> static constexpr double step() { return variance<Cell>() / kMoveGradUnit; }
  /// step() alpha / (1 - alpha). In the divisor the factor is free on a device. Without fused multiply-adds the error
  /// is up to 1 / (1 - kAlphaMax) = 100 roundings.
  template <typename T, class V, class Cell> AR_HD static V length_of(V alpha) {
    const V per_step = V(T(1 / step<Cell>()));
    return divide(alpha, madd(-per_step, alpha, per_step));
  }

  /// The position after a splat, before the clamp.
  template <class V> AR_HD static Vec2<V> moved(V length, Vec2<V> along, Vec2<V> at) {
    return {madd(length, along.x, at.x), madd(length, along.y, at.y)};
  }

  /// In half cells from the pixel's edge -> px from its centre.
  template <typename T> AR_HD static constexpr T edge(int half_cells) { return T(half_cells - kSide) / T(2 * kSide); }

  template <typename T, class V> AR_HD static Vec2<V> place(int s) { return {V(node<T>(s).x), V(node<T>(s).y)}; }
};

}  // namespace ar
