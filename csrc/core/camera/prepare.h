// From a user's camera to what kernels read, and the adjoint: matrices of a pose and intrinsics (CameraSource), a Lens
// of numbers and tensors (LensSource). In double, rounded once.
#pragma once

#include "core/camera/limits.h"

namespace ar {

inline constexpr double kClipNear = 0.01, kClipFar = 100;  ///< of clip-space z, which nothing reads

/// Limits of lenses, rad; limits.h finds what is not known.
struct KnownLimits {
  double fold = 0, reach = 0;  ///< 0: not known
  int height = 0;              ///< of the picture [px]
};

/// Tensors of numbers of a lens, or null.
template <typename T> struct LensTensors {
  const T *tan_half_fov_x, *tan_half_fov_y, *aperture, *focus, *shift, *turn, *screen, *distortion;
  const T *view, *proj;  ///< [16] transposed: they tell the middle of the picture
};

/// x/z and y/z at the middle of the picture, where clip_x = p_xx x + p_xz z is zero.
struct MiddleOfView {
  Vec3<double> axes[3], clip[2];  ///< of the camera, and of x and y in clip space; or gradients
  Mat2<double> p;                 ///< [p_xx p_xz; p_yy p_yz]

  AR_HD void project() {
    const auto share = [&](int axis, int k) { return dot(axes[axis], clip[k]) / dot(axes[axis], axes[axis]); };
    p = {share(0, 0), share(2, 0), share(1, 1), share(2, 1)};
  }
  template <typename T> AR_HD void read(const T* view, const T* proj) {  // transposed
    for (int k = 0; k < 3; ++k) axes[k] = {double(view[k]), double(view[4 + k]), double(view[8 + k])};
    for (int k = 0; k < 2; ++k) clip[k] = {double(proj[k]), double(proj[4 + k]), double(proj[8 + k])};
    project();
  }
  AR_HD Vec2<double> middle() const { return {-p.xy / p.xx, -p.yy / p.yx}; }
  AR_HD MiddleOfView vjp(Vec2<double> dL_dmiddle) const {
    MiddleOfView to = {};
    const auto add = [&](int axis, int k, double value, double dL_dvalue) {
      const Vec3<double> a = axes[axis], c = clip[k];
      const double scale = dL_dvalue / dot(a, a);
      to.axes[axis] += scale * c + (-2 * value * scale) * a;
      to.clip[k] += scale * a;
    };
    add(0, 0, p.xx, dL_dmiddle.x * p.xy / (p.xx * p.xx));
    add(2, 0, p.xy, -dL_dmiddle.x / p.xx);
    add(1, 1, p.yx, dL_dmiddle.y * p.yy / (p.yx * p.yx));
    add(2, 1, p.yy, -dL_dmiddle.y / p.yx);
    return to;
  }
};

/// The gradient by both matrices, transposed, from that by a Lens.
template <typename T>
AR_HD void write_middle_vjp(const T* view, const T* proj, const T* dL_dlens, T* dL_dview, T* dL_dproj) {
  const Lens<T>& by_lens = *reinterpret_cast<const Lens<T>*>(dL_dlens);
  MiddleOfView of_view;
  of_view.read(view, proj);
  const MiddleOfView by = of_view.vjp({double(by_lens.center.x), double(by_lens.center.y)});
  for (int k = 0; k < 16; ++k) dL_dview[k] = dL_dproj[k] = T(0);
  const auto put = [](T* to, Vec3<double> v) { to[0] = T(v.x), to[4] = T(v.y), to[8] = T(v.z); };
  for (int k = 0; k < 3; ++k) put(dL_dview + k, by.axes[k]);
  for (int k = 0; k < 2; ++k) put(dL_dproj + k, by.clip[k]);
}

/// A lens as the drop-in's settings have it: without `reach` and `fold`.
template <typename T> struct LensSource {
  Lens<double> numbers;
  LensTensors<T> tensors;
  KnownLimits limits;
  T* out;  ///< Lens<T>

  static constexpr int count = 1;
  AR_HD Lens<double> lens(int) const {
    Lens<double> l = numbers;
    const auto put = [](double* to, const T* from, int n) {
      for (int k = 0; from && k < n; ++k) to[k] = double(from[k]);
    };
    put(&l.tan_half_fov.x, tensors.tan_half_fov_x, 1);
    put(&l.tan_half_fov.y, tensors.tan_half_fov_y, 1);
    put(&l.aperture, tensors.aperture, 1);
    put(&l.focus, tensors.focus, 1);
    put(&l.shift.x, tensors.shift, 3);
    put(&l.turn.x, tensors.turn, 3);
    put(&l.screen.x, tensors.screen, 2);
    put(l.distortion, tensors.distortion, kDistortion);
    if (!tensors.view) return l;
    MiddleOfView of_view;
    of_view.read(tensors.view, tensors.proj);
    l.center = of_view.middle();
    return l;
  }
  AR_HD T* lens_of(int) const { return out; }
  AR_HD void write_matrices(int) const {}
};

/// All with the same model, size and planes.
template <typename T> struct CameraSource {
  int count;
  const T *views, *intrinsics, *coefficients;  ///< [count, 4, 4], [count, 3, 3], [count, kDistortion] or null
  int width, height;
  bool off_center;
  Lens<double> numbers;
  KnownLimits limits;
  T *viewmatrix, *projmatrix, *position, *out;  ///< [count, ...]; `out`: Lens<T>

  struct Pose {
    Vec4<double> rows[3];
    double fx, fy, cx, cy;
  };
  AR_HD Pose pose(int c) const {
    Pose p;
    const T *v = views + 16 * c, *k = intrinsics + 9 * c;
    for (int r = 0; r < 3; ++r)
      p.rows[r] = {double(v[4 * r]), double(v[4 * r + 1]), double(v[4 * r + 2]), double(v[4 * r + 3])};
    p.fx = double(k[0]), p.cx = double(k[2]), p.fy = double(k[4]), p.cy = double(k[5]);
    return p;
  }
  /// Of clip space: per x/z and y/z, and the principal point.
  AR_HD Vec2<double> scale(const Pose& p) const { return {2 * p.fx / width, 2 * p.fy / height}; }
  AR_HD Vec2<double> offset(const Pose& p) const { return {2 * p.cx / width - 1, 2 * p.cy / height - 1}; }
  AR_HD Vec4<double> clip_w(const Pose& p) const { return orthographic() ? Vec4<double>{0, 0, 0, 1} : p.rows[2]; }
  AR_HD MiddleOfView middle_of(const Pose& p) const {
    const Vec2<double> s = scale(p), o = offset(p);
    const Vec4<double> w = clip_w(p), x = s.x * p.rows[0] + o.x * w, y = s.y * p.rows[1] + o.y * w;
    MiddleOfView of_view = {{xyz(p.rows[0]), xyz(p.rows[1]), xyz(p.rows[2])}, {xyz(x), xyz(y)}, {}};
    of_view.project();
    return of_view;
  }
  AR_HD bool orthographic() const { return numbers.model == double(kCameraModel<Orthographic>); }
  AR_HD bool has_center() const { return off_center || limit_kind(numbers) != LimitKind::kNone; }

  AR_HD Lens<double> lens(int c) const {
    const Pose p = pose(c);
    Lens<double> l = numbers;
    l.tan_half_fov = {width / (2 * p.fx), height / (2 * p.fy)};
    if (has_center()) l.center = middle_of(p).middle();
    for (int k = 0; coefficients && k < kDistortion; ++k) l.distortion[k] = double(coefficients[kDistortion * c + k]);
    return l;
  }
  AR_HD T* lens_of(int c) const { return out + kLensWidth * c; }

  /// Columns of the rotation's inverse times `det`.
  struct Inverse {
    Vec3<double> x, y, z;
    double det;
    AR_HD explicit Inverse(const Pose& p) {
      const Vec3<double> a = xyz(p.rows[0]), b = xyz(p.rows[1]), c = xyz(p.rows[2]);
      x = cross(b, c), y = cross(c, a), z = cross(a, b);
      det = dot(a, x);
    }
    /// The inverse times v, and its transpose times v.
    AR_HD Vec3<double> times(Vec3<double> v) const { return (1 / det) * (v.x * x + v.y * y + v.z * z); }
    AR_HD Vec3<double> transposed_times(Vec3<double> v) const {
      return {dot(x, v) / det, dot(y, v) / det, dot(z, v) / det};
    }
  };
  /// -R^-1 t; NaN if R is singular.
  AR_HD Vec3<double> position_of(const Pose& p) const {
    return -1.0 * Inverse(p).times({p.rows[0].w, p.rows[1].w, p.rows[2].w});
  }

  AR_HD void write_matrices(int c) const {
    const Pose p = pose(c);
    const Vec4<double> last = {0, 0, 0, 1}, w = clip_w(p);
    const Vec2<double> s = scale(p), o = offset(p);
    const double depth = kClipFar / (kClipFar - kClipNear);
    const Vec4<double> clip[4] = {s.x * p.rows[0] + o.x * w, s.y * p.rows[1] + o.y * w,
                                  depth * (p.rows[2] + (-kClipNear) * last), w};
    const Vec4<double> view[4] = {p.rows[0], p.rows[1], p.rows[2], last};
    const auto put = [&](T* to, const Vec4<double>* rows) {
      for (int r = 0; r < 4; ++r)
        to[r] = T(rows[r].x), to[4 + r] = T(rows[r].y), to[8 + r] = T(rows[r].z), to[12 + r] = T(rows[r].w);
    };
    put(viewmatrix + 16 * c, view);
    put(projmatrix + 16 * c, clip);
    const Vec3<double> at = position_of(p);
    position[3 * c] = T(at.x), position[3 * c + 1] = T(at.y), position[3 * c + 2] = T(at.z);
  }
};

/// By what CameraSource wrote (null: none), and read.
template <typename T> struct CameraSourceGrads {
  const T *viewmatrix, *projmatrix, *position, *lens;
  T *views, *intrinsics, *coefficients;  ///< the last may be null
};

template <typename T> AR_HD void camera_source_vjp(const CameraSource<T>& from, const CameraSourceGrads<T>& g, int c) {
  const auto p = from.pose(c);
  const auto row = [&](const T* matrices, int r) -> Vec4<double> {
    if (!matrices) return {0, 0, 0, 0};
    const T* m = matrices + 16 * c;
    return {double(m[r]), double(m[4 + r]), double(m[8 + r]), double(m[12 + r])};
  };
  Vec4<double> by_rows[3] = {row(g.viewmatrix, 0), row(g.viewmatrix, 1), row(g.viewmatrix, 2)};
  Vec4<double> by_x = row(g.projmatrix, 0), by_y = row(g.projmatrix, 1);
  const Vec4<double> by_w = row(g.projmatrix, 3);
  double by_fx = 0, by_fy = 0;
  if (g.lens) {
    const Lens<T>& by_lens = *reinterpret_cast<const Lens<T>*>(g.lens + kLensWidth * c);
    const Lens<double> lens = from.lens(c);
    by_fx -= double(by_lens.tan_half_fov.x) * lens.tan_half_fov.x / p.fx;
    by_fy -= double(by_lens.tan_half_fov.y) * lens.tan_half_fov.y / p.fy;
    if (from.has_center()) {
      const MiddleOfView by = from.middle_of(p).vjp({double(by_lens.center.x), double(by_lens.center.y)});
      const auto widened = [](Vec3<double> v) { return Vec4<double>{v.x, v.y, v.z, 0}; };
      for (int r = 0; r < 3; ++r) by_rows[r] = by_rows[r] + widened(by.axes[r]);
      by_x = by_x + widened(by.clip[0]);
      by_y = by_y + widened(by.clip[1]);
    }
    for (int k = 0; g.coefficients && k < kDistortion; ++k) g.coefficients[kDistortion * c + k] = by_lens.distortion[k];
  }
  const Vec2<double> s = from.scale(p), o = from.offset(p);
  by_rows[0] = by_rows[0] + s.x * by_x;
  by_rows[1] = by_rows[1] + s.y * by_y;
  by_rows[2] = by_rows[2] + (kClipFar / (kClipFar - kClipNear)) * row(g.projmatrix, 2);
  if (!from.orthographic()) by_rows[2] = by_rows[2] + (o.x * by_x + (o.y * by_y + by_w));
  by_fx += dot(p.rows[0], by_x) * 2 / from.width;
  by_fy += dot(p.rows[1], by_y) * 2 / from.height;
  const Vec4<double> w = from.clip_w(p);
  const double by_cx = dot(w, by_x) * 2 / from.width, by_cy = dot(w, by_y) * 2 / from.height;
  if (g.position) {
    const T* at = g.position + 3 * c;
    const typename CameraSource<T>::Inverse inverse(p);
    const Vec3<double> y = inverse.transposed_times({double(at[0]), double(at[1]), double(at[2])});
    const Vec3<double> position = from.position_of(p);
    const double by_t[3] = {-y.x, -y.y, -y.z};
    for (int r = 0; r < 3; ++r) by_rows[r] = by_rows[r] + by_t[r] * Vec4<double>{position.x, position.y, position.z, 1};
  }
  for (int r = 0; r < 4; ++r) {
    const Vec4<double> v = r < 3 ? by_rows[r] : Vec4<double>{0, 0, 0, 0};
    T* to = g.views + 16 * c + 4 * r;
    to[0] = T(v.x), to[1] = T(v.y), to[2] = T(v.z), to[3] = T(v.w);
  }
  const double of_intrinsics[9] = {by_fx, 0, by_cx, 0, by_fy, by_cy, 0, 0, 0};
  for (int k = 0; k < 9; ++k) g.intrinsics[9 * c + k] = T(of_intrinsics[k]);
}

/// Writes a lens. `fold`: rad, unless it is known; `seen`: as of reach_of().
template <class Source> AR_HD void write_lens(const Source& source, int c, double fold, int seen) {
  Lens<double> lens = source.lens(c);
  const LimitKind kind = limit_kind(lens);
  const KnownLimits& known = source.limits;
  if (kind != LimitKind::kNone) {
    if (known.fold > 0) fold = known.fold;
    lens.reach = measured(kind, known.reach > 0 ? known.reach : reach_of(kind, lens, fold, seen, known.height));
    // Of a lens that is no map nothing is seen.
    lens.fold = kind == LimitKind::kLatitude ? 0 : fold > 0 ? measured(kind, fold) : -1;
  }
  auto* to = source.lens_of(c);
  const double* from = &lens.tan_half_fov.x;
  for (int k = 0; k < kLensWidth; ++k) to[k] = std::decay_t<decltype(to[0])>(from[k]);
}

template <class Source> bool finds_fold(const Source& source) {
  return may_fold(limit_kind(source.numbers)) && !(source.limits.fold > 0);
}
template <class Source> bool finds_reach(const Source& source) {
  return may_fold(limit_kind(source.numbers)) && !(source.limits.reach > 0);
}

}  // namespace ar
