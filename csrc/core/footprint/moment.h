// The pixel as S equal cells, each composited with a transmittance of its own, looked at from the centroid of the light
// that the splats in front have left in it (docs/numerics.md, "Moving nodes").
#pragma once

#include "core/footprint/gaussian.h"

namespace ar {

/// "moment1" ... "moment16", behind which stands the number of cells alone.
template <int S> struct MomentKey {
  static constexpr char kText[] = {
      'm', 'o', 'm', 'e', 'n', 't', S >= 10 ? '1' : char('0' + S), S >= 10 ? char('0' + S % 10) : '\0', '\0'};
};

/// n x n cells, S = n^2. At rest each is the Gaussian of the cell's variance at its centre, as `box` has them. Blended
/// as itself: `Pixels` of the base would stand still.
template <int S> struct Moment : GaussianFootprint<1, true> {
  using Pixels = void;
  using Gaussian = GaussianFootprint<1, true>;
  static_assert(S == 1 || S == 4 || S == 9 || S == 16, "moment has 1, 4, 9 or 16 samples");

  static constexpr const char* kName = "moment";
  static constexpr const char* kKey = MomentKey<S>::kText;
  static constexpr Option kOption = {"samples", MomentKey<S>::kText + 6, 0, S == 4};
  static constexpr int kSamples = S, kSide = S == 1 ? 1 : S == 4 ? 2 : S == 9 ? 3 : 4;  ///< cells along an edge
  static constexpr double kVariance = kPixelVariance / S;                               ///< of a cell [px^2]
  static constexpr double kReach = 0.5;                                                 ///< nodes stay in their cells

  static constexpr bool kMoves = true;
  static constexpr double kMoveReach = 0.5 / kSide;

  AR_HD static double radius_variance(FootprintOptions) { return kPixelVariance; }
  AR_HD static double support_variance(FootprintOptions) { return kVariance; }

  /// Centre of a cell [px from the pixel's centre].
  AR_HD static constexpr Vec2<double> node(int s) {
    return {(s % kSide + 0.5) / kSide - 0.5, (s / kSide + 0.5) / kSide - 0.5};
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
  AR_HD static void add_alpha_vjp(const Terms<T>& t, Vec2<V> p, int s, V alpha, V dL_dalpha, ShapeGrad<V>& sums) {
    Gaussian::add_alpha_vjp(t, p + place<T, V>(s), 0, alpha, dL_dalpha, sums);
  }

  template <typename T, class V>
  AR_HD static Vec2<V> move(const Terms<T>& t, Vec2<V> p, int s, V alpha, Vec2<V> moved) {
    const Vec2<V> next = moved + step(t, Gaussian::whitened(t, p + place<T, V>(s), 0), ratio(alpha));
    const V reach = V(T(kMoveReach));
    return {min(max(next.x, -reach), reach), min(max(next.y, -reach), reach)};
  }

  /// With z = w d, y = w dL_dmoved and r = alpha / (1 - alpha), both times kBase2 as the sums are. A coordinate that
  /// move() has held at its bound does not depend on anything.
  template <typename T, class V>
  AR_HD static MoveGrad<V> alpha_and_move_vjp(const Terms<T>& t, Vec2<V> p, int s, V raw, V alpha, MaskOf<V> free,
                                              V dL_dalpha, Vec2<V> moved, Vec2<V>& dL_dmoved) {
    const V zero = V(T(0)), reach = V(T(kMoveReach)), two = V(T(2)), scale = V(T(kStep));
    const V r = ratio(alpha);
    const Vec2<V> z = Gaussian::whitened(t, p + place<T, V>(s), 0);
    const Vec2<V> next = moved + step(t, z, r);
    const Vec2<V> behind = {select(abs(next.x) > reach, zero, dL_dmoved.x),
                            select(abs(next.y) > reach, zero, dL_dmoved.y)};
    const Vec2<V> y = transform(t.w, behind);
    const V slope = V(T(1)) + r;  // 1 / (1 - alpha), whose square is dr / dalpha
    const V by_move = scale * madd(z.x, y.x, z.y * y.y) * slope * slope;
    const V g = select(free, raw * (dL_dalpha + by_move), zero), vr = V(T(kVariance)) * r;
    MoveGrad<V> grad;
    grad.weighted = g;
    grad.sums.offset = {madd(g, z.x, -vr * y.x), madd(g, z.y, -vr * y.y)};
    grad.sums.shape = {z.x * madd(g, z.x, -two * vr * y.x), madd(g * z.x, z.y, -vr * madd(z.x, y.y, z.y * y.x)),
                       z.y * madd(g, z.y, -two * vr * y.y)};
    const Vec2<V> by_place = transform_transposed(t.w, grad.sums.offset);
    const V unit = V(T(1 / (kBase2 * kBase2)));
    dL_dmoved = {behind.x - unit * by_place.x, behind.y - unit * by_place.y};
    return grad;
  }

 private:
  /// (Sigma + v I)^-1 d is w^T z over kBase2^2.
  static constexpr double kStep = kVariance / (kBase2 * kBase2);

  template <typename T, class V> AR_HD static Vec2<V> place(int s) { return {V(T(node(s).x)), V(T(node(s).y))}; }

  template <class V> AR_HD static V ratio(V alpha) { return divide(alpha, V(ScalarOf<V>(1)) - alpha); }

  /// v r (Sigma + v I)^-1 d, before the bound.
  template <typename T, class V> AR_HD static Vec2<V> step(const Terms<T>& t, Vec2<V> z, V r) {
    const Vec2<V> along = transform_transposed(t.w, z);
    const V length = V(T(kStep)) * r;
    return {length * along.x, length * along.y};
  }
};

}  // namespace ar
