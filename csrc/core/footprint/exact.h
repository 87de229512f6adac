// The footprint `exact`, a reference.
#pragma once

#include "core/footprint/gaussian.h"
#include "core/footprint/normal.h"

namespace ar {

/// I = integral of exp(-|w d|^2 / 2) over the pixel. The integral and its adjoint are moments of z = w d, by quadrature
/// with positive weights (docs/internals/numerics.md, "The exact integral").
///
/// The wide axis is the image axis with the larger variance. z.x depends on it alone; along it z.y falls at the rate
/// `tilt`. A Gaussian narrow across the ridge z.y = 0 is integrated in strips around where the pixel's edges cross it.
struct Exact : FootprintDefaults {
  static constexpr const char* kName = "exact";
  static constexpr bool kExpensive = true;
  static constexpr bool kReference = true, kGeneric = true;
  static constexpr double kExtraLevel = 2 * box_excess(1 / kPixelVariance);

  template <typename T> struct Shape {
    Mat2<T> w;  ///< of whiten_wide_first(), its first row signed so that tilt >= 0
    T amp;      ///< of the Gaussian with covariance Sigma + I/12, a bound of the weight
  };

  template <typename T> struct Terms {
    Mat2<T> w;
    Vec2<T> origin;
    T opacity;
    bool wide_x;
    T along, across, tilt;  ///< dz.x per pixel along the wide axis, dz.y along the other; -dz.y / dz.x
    T crossing;             ///< half the width in z.x of a strip
    int panels;             ///< of a strip
  };

  AR_HD static double radius_variance(FootprintOptions) { return kPixelVariance; }
  AR_HD static double support_variance(FootprintOptions) { return kPixelVariance; }

  template <typename T> AR_HD static Shape<T> prepare(Cov2d<T> cov, FootprintOptions) {
    Mat2<T> w = whiten_wide_first(cov);
    if (slope(w) * along(w) > T(0)) {
      w.xx = -w.xx;
      w.xy = -w.xy;
    }
    return {w, sqrt(cov.det / blur(cov, T(kPixelVariance)).det)};
  }

  template <typename T> AR_HD static Mat2<T> ellipse(const Shape<T>& g) { return whiten_wide_first(widened(g)); }

  template <typename T> AR_HD static T level(const Shape<T>& g, T opacity) {
    const Cov2d<T> wide = widened(g);
    return gaussian_level(g.amp, opacity) + box_excess(wide.yy / wide.det) + box_excess(wide.xx / wide.det);
  }

  template <typename T> AR_HD static Terms<T> terms(const Shape<T>& g, T opacity, Vec2<T> origin = {T(0), T(0)}) {
    const T edge = along(g.w), tilt = -slope(g.w) / edge, steep = max(tilt, T(kMinTilt)), tail = T(kTail<T>);
    // The standard deviation of the integrand along a strip is 1 / sqrt(1 + tilt^2).
    const T length = min(T(2) * min(tail, tail / steep), abs(edge)) * sqrt(T(1) + tilt * tilt);
    const T panels = min(max(T(1), T(1) + length / T(kPanel)), T(kMaxPanels));
    return {g.w, origin, opacity, wide_x(g.w), edge, across(g.w), tilt, tail / steep, int(panels)};
  }

  template <typename T, class V> AR_HD static V alpha(const Terms<T>& t, Vec2<V> p, int) {
    return V(t.opacity) * moments(t, p).value;
  }

  template <typename T, class V>
  AR_HD static void add_alpha_vjp(const Terms<T>& t, Vec2<V> p, int, AlphaGrad<V> grad, ShapeGrad<V>& sums) {
    const Moments<V> m = moments(t, p);
    const V g = grad.dL_dalpha * V(t.opacity);
    sums.offset = {madd(g, m.first.x, sums.offset.x), madd(g, m.first.y, sums.offset.y)};
    sums.shape = {madd(g, m.second.xx, sums.shape.xx), madd(g, m.second.xy, sums.shape.xy),
                  madd(g, m.second.yy, sums.shape.yy)};
  }

  template <typename T> AR_HD static Mat2<T> mean_map(const Shape<T>& g) { return g.w; }

  template <typename T>
  AR_HD static SplatGrad<T> prepare_vjp(Cov2d<T>, const Shape<T>& g, ShapeGrad<T> sums, T, FootprintOptions) {
    return moments_vjp(g.w, sums, GradFrame::kTriangular);
  }

 private:
  /// Integrals of f = exp(-|z|^2 / 2), f z and f z z^T over the pixel [px^2].
  template <class V> struct Moments {
    V value;
    Vec2<V> first;
    Sym2<V> second;
  };

  /// Beyond it the Gaussian counts as zero: exp(-z^2 / 2) is 2e-11 and 5e-32.
  template <typename T> static constexpr double kTail = sizeof(T) == 4 ? 7 : 12;
  /// Longest panel for kManyNodes, in standard deviations of the integrand.
  static constexpr double kPanel = 3.3;
  /// 1 + 2 kTail sqrt(2) / kPanel.
  static constexpr int kMaxPanels = 11;
  /// Keeps crossings finite.
  static constexpr double kMinTilt = 1e-6;

  template <typename T> AR_HD static T square(T x) { return x * x; }

  // One entry of the first row of w is zero.
  template <typename T> AR_HD static bool wide_x(const Mat2<T>& w) { return w.xx != T(0); }
  template <typename T> AR_HD static T along(const Mat2<T>& w) { return w.xx + w.xy; }
  template <typename T> AR_HD static T across(const Mat2<T>& w) { return wide_x(w) ? w.yy : w.yx; }
  template <typename T> AR_HD static T slope(const Mat2<T>& w) { return wide_x(w) ? w.yx : w.yy; }

  /// Sigma + I/12, as sums of squares.
  template <typename T> AR_HD static Cov2d<T> widened(const Shape<T>& g) {
    const T wide = T(1) / square(along(g.w)), deviation = T(1) / across(g.w);
    const T rate = -slope(g.w) * deviation;
    const T other = square(deviation) + rate * rate * wide;
    const Cov2d<T> cov = {wide_x(g.w) ? wide : other, rate * wide, wide_x(g.w) ? other : wide,
                          wide * square(deviation)};
    return blur(cov, T(kPixelVariance));
  }

  /// Of the pixel along an axis, relative to its point nearest to the mean [px], where rounding matters least.
  template <class V> struct Edges {
    V begin, end;
    AR_HD V middle() const { return V(ScalarOf<V>(0.5)) * (begin + end); }
  };
  template <class V> struct Pixel {
    Vec2<V> z;  ///< of the point nearest to the mean
    Edges<V> wide, narrow;
  };

  template <typename T, class V> AR_HD static Moments<V> moments(const Terms<T>& t, Vec2<V> p) {
    const V half = V(T(0.5)), zero = V(T(0)), one = V(T(1));
    const Vec2<V> d = {p.x + V(t.origin.x), p.y + V(t.origin.y)};
    const Vec2<V> lo = {d.x - half, d.y - half}, hi = {d.x + half, d.y + half};
    const Vec2<V> nearest = {max(lo.x, zero) + min(hi.x, zero), max(lo.y, zero) + min(hi.y, zero)};
    const Edges<V> x = {clamp(lo.x, -one, zero), clamp(hi.x, zero, one)};
    const Edges<V> y = {clamp(lo.y, -one, zero), clamp(hi.y, zero, one)};
    const Pixel<V> pixel = {transform(t.w, nearest), t.wide_x ? x : y, t.wide_x ? y : x};
    if (t.across <= T(0.5)) return by_product_rule<kFewNodes<T>>(t, pixel);
    if (t.across <= T(2)) return by_product_rule<kManyNodes<T>>(t, pixel);
    return by_strips(t, pixel);
  }

  template <int N, typename T, class V>
  AR_HD static Moments<V> by_product_rule(const Terms<T>& t, const Pixel<V>& pixel) {
    using Rule = GaussLegendre<N, T>;
    const V zero = V(T(0)), across = V(t.across);
    Moments<V> m = {zero, {zero, zero}, {zero, zero, zero}};
    for (int i = 0; i < N; ++i) {
      const V step = V(t.along) * (pixel.wide.middle() + V(Rule::node(i))), x = pixel.z.x + step;
      const V middle = madd(across, pixel.narrow.middle(), madd(V(-t.tilt), step, pixel.z.y));
      NormalMoments<V> line = {zero, zero, zero};
      AR_UNROLL for (int j = 0; j < N; ++j) {
        const V y = madd(across, V(Rule::node(j)), middle), f = V(Rule::weight(j)) * normal(y);
        line = {line.value + f, madd(f, y, line.first), madd(f * y, y, line.second)};
      }
      add(V(Rule::weight(i)) * normal(x), x, line, m);
    }
    return m;
  }

  template <typename T, class V> AR_HD static Moments<V> by_strips(const Terms<T>& t, const Pixel<V>& pixel) {
    const V zero = V(T(0)), tail = V(T(kTail<T>)), crossing = V(t.crossing);
    const V along = V(t.along), across = V(t.across), scale = V(T(1) / max(t.tilt, T(kMinTilt)));
    // Steps in z.x to two edges of the pixel, and to where the ridge crosses the others.
    const V edge = along * pixel.wide.begin, opposite = along * pixel.wide.end;
    const V first = min(edge, opposite), last = max(edge, opposite);
    const V enters = madd(across, pixel.narrow.begin, pixel.z.y) * scale;
    const V middle = madd(across, pixel.narrow.middle(), pixel.z.y) * scale;
    const V leaves = madd(across, pixel.narrow.end, pixel.z.y) * scale;
    const V begin = max(max(first, -tail), clamp(enters, first, last) - crossing);
    const V end = max(begin, min(min(last, tail), clamp(leaves, first, last) + crossing));
    const V inside = clamp(min(enters + crossing, middle), begin, end);
    const V outside = clamp(max(leaves - crossing, middle), begin, end);
    Moments<V> m = {zero, {zero, zero}, {zero, zero, zero}};
    add_strip(t, pixel, begin, inside, m);
    add_strip(t, pixel, outside, end, m);
    if (t.across > T(2 * kTail<T>)) {
      // Between the strips the pixel covers the ridge's width.
      const V from = pixel.z.x + inside, to = pixel.z.x + outside;
      const NormalMoments<V> ridge = abs(t.along) <= T(0.5)
                                         ? short_interval_moments(V(T(0.5)) * (from + to), outside - inside)
                                         : interval_moments(from, to);
      const V all = V(T(2.5066282746310005024));
      m.value = madd(all, ridge.value, m.value);
      m.first.x = madd(all, ridge.first, m.first.x);
      m.second.xx = madd(all, ridge.second, m.second.xx);
      m.second.yy = madd(all, ridge.value, m.second.yy);
    }
    const V area = V(T(1) / abs(t.along * t.across));
    return {area * m.value,
            {area * m.first.x, area * m.first.y},
            {area * m.second.xx, area * m.second.xy, area * m.second.yy}};
  }

  template <typename T, class V>
  AR_HD static void add_strip(const Terms<T>& t, const Pixel<V>& pixel, V from, V to, Moments<V>& m) {
    using Rule = GaussLegendre<kManyNodes<T>, T>;
    const V length = (to - from) * V(T(1) / T(t.panels)), across = V(t.across);
    for (int k = 0; k < t.panels; ++k) {
      const V middle = madd(length, V(T(k) + T(0.5)), from);
      for (int i = 0; i < kManyNodes<T>; ++i) {
        const V step = madd(length, V(Rule::node(i)), middle), x = pixel.z.x + step;
        const V y = madd(V(-t.tilt), step, pixel.z.y);
        const NormalMoments<V> line =
            interval_moments(madd(across, pixel.narrow.begin, y), madd(across, pixel.narrow.end, y));
        add(length * V(Rule::weight(i)) * normal(x), x, line, m);
      }
    }
  }

  /// Adds w times the moments along the line z.x = x.
  template <class V> AR_HD static void add(V w, V x, const NormalMoments<V>& line, Moments<V>& m) {
    const V wx = w * x, value = wx * line.value;
    m.value = madd(w, line.value, m.value);
    m.first = {m.first.x + value, madd(w, line.first, m.first.y)};
    m.second = {madd(value, x, m.second.xx), madd(wx, line.first, m.second.xy), madd(w, line.second, m.second.yy)};
  }

  template <class V> AR_HD static V clamp(V x, V lo, V hi) { return min(max(x, lo), hi); }
};

}  // namespace ar
