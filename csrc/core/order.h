// Order along rays, Effects(order="ray") (docs/internals/numerics.md, "Order along rays"): at which depth the ray of a
// pixel meets a splat, and the window in which a pixel sorts the splats of its list. The definition knows only scene,
// camera and window: pictures depend neither on tiles nor on the device.
//
//   The splats of the list that show in a sample of the pixel enter a window of n slots one after the other. If it is
//   full, the nearest of these n + 1 leaves and is composited; of equal depths the first in the list. At the end of the
//   list all leave, the nearest first.
//
// So no splat is lost, and in a window as long as the list the order is exact. A splat that moves nodes is evaluated
// when it leaves.
#pragma once

#include "core/constants.h"
#include "core/covariance_vjp.h"
#include "core/rows.h"

namespace ar {

/// Added to a projected covariance for the slope below [px^2], so that a splat seen edge-on has one.
inline constexpr double kRayVariance = 1e-4;

inline constexpr int kMaxRayWindow = 64, kMaxRayChannels = 4;

/// The depth in the pixel p is `depth` + `slope` (p - mean of the splat): where the density along the ray is largest,
/// for rays that the affine projection takes to be parallel.
template <typename T> struct RayDepth {
  T depth;        ///< of the centre, world units
  Vec2<T> slope;  ///< [world units / px]
};

/// Of splats, and the size of the window; 0: the order of centres.
template <typename T> struct RayOrder {
  const RayDepth<T>* depths;  ///< [splats]
  int window;
};

/// d: pixel - mean [px]. The same bits in tiles of all sizes.
template <typename T, class V> AR_HD V depth_in_pixel(const RayDepth<T>& of, Vec2<V> d) {
  return madd(V(of.slope.x), d.x, madd(V(of.slope.y), d.y, V(of.depth)));
}

/// Sigma_zu (Sigma_uv + v I)^-1 from the rows of factors, wide axis first: x of the image, y, and z along the depth.
/// `cov` is Sigma_uv, perhaps blurred; zx = z . x.
template <typename T, class AcrossOf> AR_HD Vec2<T> ray_slope(Cov2d<T> cov, T zx, T zy, const AcrossOf& across) {
  const Cov2d<T> c = blur(cov, T(kRayVariance));
  const bool wide_x = c.xx >= c.yy;
  const T wide = wide_x ? c.xx : c.yy, ratio = quotient(c.xy, wide);
  // across(ratio) = z . (narrow row - ratio wide row), which is small without cancelling.
  const T narrow_slope = quotient(across(wide_x, ratio), quotient(c.det, wide));
  const T wide_slope = quotient(wide_x ? zx : zy, wide) - ratio * narrow_slope;
  const Vec2<T> slope = wide_x ? Vec2<T>{wide_slope, narrow_slope} : Vec2<T>{narrow_slope, wide_slope};
  const bool finite = within(slope.x, 1e18) && within(slope.y, 1e18);
  return finite ? slope : Vec2<T>{T(0), T(0)};
}

/// Of Gaussian i at `view`. dh: the derivative by `view` of the depth that orders splats.
template <class Cam, typename T>
AR_HD Vec2<T> ray_slope(const Cam& camera, const Gaussians<T>& g, int64_t i, Vec3<T> view, Vec3<T> dh) {
  const Factors<T> f = project_covariance(camera, g, i, view);
  const Cov2d<T> cov = seen_covariance(camera, g, i, view, f).cov;
  const Vec3<T> axis = dh.x * xyz(camera.view_x) + dh.y * xyz(camera.view_y) + dh.z * xyz(camera.view_z);
  Vec3<T> x = f.row_x, y = f.row_y, z;
  if (g.cov3ds) {
    x = f.jacobian.x, y = f.jacobian.y, z = g.cov3ds[i] * axis;
  } else {
    z = mul(combine_rows(axis, f.rotation), f.scale);
  }
  return ray_slope(cov, dot(z, x), dot(z, y), [&](bool wide_x, T ratio) AR_HD_LAMBDA {
    return wide_x ? dot(z, y - ratio * x) : dot(z, x - ratio * y);
  });
}

template <class Cam, typename T>
AR_HD Vec2<T> ray_slope(const Cam& camera, const Gaussians<T>& g, int64_t i, Vec3<T> view, DepthKind order) {
  return ray_slope(camera, g, i, view, depth_by_vjp(order, camera, view, T(1)));
}

/// A splat in the window of a pixel, by its place in the tile's list; -1: none. Footprints whose samples stay keep
/// their alphas.
template <class V, int kKept> struct WindowEntry {
  V depth;
  IndexOf<V> place;
  V raw[kKept > 0 ? kKept : 1];  ///< opacity * weight of each sample

  AR_HD static WindowEntry nothing(V depth) {
    WindowEntry entry = {depth, IndexOf<V>(-1), {}};
    AR_UNROLL for (int s = 0; s < kKept; ++s) entry.raw[s] = V(ScalarOf<V>(0));
    return entry;
  }
};
/// Numbers of an entry beside depth and place.
template <class P> inline constexpr int kKeptInWindow = P::kMoves ? 0 : P::kSamples;

template <class V, int kKept>
AR_HD WindowEntry<V, kKept> select(MaskOf<V> m, const WindowEntry<V, kKept>& a, const WindowEntry<V, kKept>& b) {
  WindowEntry<V, kKept> out;
  out.depth = select(m, a.depth, b.depth);
  out.place = select(m, a.place, b.place);
  AR_UNROLL for (int s = 0; s < kKept; ++s) out.raw[s] = select(m, a.raw[s], b.raw[s]);
  return out;
}

/// Puts `next`, later in the list than the window, into the window, and returns the nearest. Slots are sorted by depth,
/// equal depths by place. `nothing` of depth -infinity changes nothing.
template <class V, int kKept>
AR_HD WindowEntry<V, kKept> exchange_nearest(WindowEntry<V, kKept>* slots, int count,
                                             const WindowEntry<V, kKept>& next) {
  WindowEntry<V, kKept> previous = slots[0];
  MaskOf<V> after = next.depth < previous.depth;
  const WindowEntry<V, kKept> nearest = select(after, next, previous);
  for (int k = 1; k < count; ++k) {
    const WindowEntry<V, kKept> slot = slots[k];
    const MaskOf<V> after_slot = next.depth < slot.depth;
    slots[k - 1] = select(after_slot, select(after, previous, next), slot);
    previous = slot;
    after = after_slot;
  }
  slots[count - 1] = select(after, previous, next);
  return nearest;
}

/// Whether a splat whose samples move may show in a pixel: nodes stay within it, and move on before the splat leaves
/// the window. Exact, with half of the slack of lists: all tiles that have the pixel list the splat. `d`: pixel - mean.
template <class P, typename T> struct PixelReach {
  Mat2<T> w;
  T level;
  Vec2<T> along;  ///< |w d| is least at d.x = along.x d.y of a row, and at d.y = along.y d.x of a column

  AR_HD static PixelReach of(const Splat<P, T>& splat) {
    const Mat2<T> w = P::ellipse(splat.shape);
    const T b = w.xx * w.xy + w.yx * w.yy;
    return {w,
            splat.level + T(0.5 * kLevelSlack),
            {-quotient(b, w.xx * w.xx + w.yx * w.yx), -quotient(b, w.xy * w.xy + w.yy * w.yy)}};
  }
  template <class V> AR_HD MaskOf<V> reaches(Vec2<V> d) const {
    const V reach = V(T(P::kReach)), zero = V(T(0));
    const Vec2<V> lo = {d.x - reach, d.y - reach}, hi = {d.x + reach, d.y + reach};
    // The pixel's row and column next to the mean; one of them has the point that the ellipse reaches first.
    const V x = min(max(zero, lo.x), hi.x), y = min(max(zero, lo.y), hi.y);
    const V in_row = min(max(V(along.x) * y, lo.x), hi.x), in_column = min(max(V(along.y) * x, lo.y), hi.y);
    const Vec2<V> a = transform(w, Vec2<V>{in_row, y}), b = transform(w, Vec2<V>{x, in_column});
    return min(madd(a.x, a.x, a.y * a.y), madd(b.x, b.x, b.y * b.y)) <= V(level);
  }
};

}  // namespace ar
