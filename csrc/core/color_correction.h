// A training picture as a camera with vignetting and another exposure would show it: a colour c becomes A v c + b,
// where v is the camera's polynomial of the radius. And the adjoint.
#pragma once

#include <cstdint>

#include "core/vec.h"

namespace ar {

/// Numbers of (A | b), and of the polynomial.
inline constexpr int kCorrection = 12, kVignetting = 2;

template <typename T> struct Correction {
  T rows[3][4];
};

/// v = 1 + sum of k_j (r^(2j) - its mean over the picture), j = 1, 2. r: from the principal point, in halves of the
/// diagonal.
template <typename T> struct Radii {
  int64_t width;         ///< px
  T center_x, center_y;  ///< px
  T per_square;          ///< of r^2, 1 / px^2
  T means[kVignetting];
};

/// Images: [3, pixels].
template <typename T> struct CorrectParams {
  int64_t pixels;
  const T* image;
  const T* matrix;      ///< [3, 4], (A | b); null: the identity.
  const T* vignetting;  ///< [kVignetting]; null: none.
  Radii<T> radii;       ///< Without vignetting not read.
  T* corrected;
};

/// Null: not wanted.
template <typename T> struct CorrectVjpParams {
  int64_t pixels;
  const T* image;
  const T* matrix;
  const T* vignetting;
  Radii<T> radii;
  const T* dL_dcorrected;
  T* dL_dimage;
  T* dL_dmatrix;
  T* dL_dvignetting;
  bool sums() const { return dL_dmatrix || dL_dvignetting; }
};

/// Means are integrals over the picture, so that a polynomial is the same at all its sizes.
template <typename T> Radii<T> radii_of(int64_t height, int64_t width, double center_x, double center_y) {
  struct Axis {
    double square, fourth;  // means
    Axis(double length, double center) {
      const double a = -center, b = length - center;
      square = (b * b * b - a * a * a) / (3 * length);
      fourth = (b * b * b * b * b - a * a * a * a * a) / (5 * length);
    }
  };
  const Axis x(double(width), center_x), y(double(height), center_y);
  const double per_square = 4 / (double(width) * double(width) + double(height) * double(height));
  const double fourth = x.fourth + 2 * x.square * y.square + y.fourth;
  return {width,
          T(center_x),
          T(center_y),
          T(per_square),
          {T((x.square + y.square) * per_square), T(fourth * per_square * per_square)}};
}

template <typename T> AR_HD Correction<T> read_correction(const T* matrix) {
  Correction<T> c;
  for (int i = 0; i < kCorrection; ++i) c.rows[i / 4][i % 4] = matrix ? matrix[i] : T(i % 5 == 0);
  return c;
}

template <typename T> AR_HD Vec3<T> color_at(const T* image, int64_t pixels, int64_t i) {
  return {image[i], image[pixels + i], image[2 * pixels + i]};
}

/// What is multiplied by the coefficients, and v.
template <typename T> struct Falloff {
  T terms[kVignetting] = {};
  T factor = T(1);

  AR_HD Falloff(const T* vignetting, const Radii<T>& radii, int64_t i) {
    const T x = T(i % radii.width) + T(0.5) - radii.center_x, y = T(i / radii.width) + T(0.5) - radii.center_y;
    const T square = (x * x + y * y) * radii.per_square;
    T power = T(1);
    for (int j = 0; j < kVignetting; ++j) {
      power *= square;
      terms[j] = power - radii.means[j];
      factor += vignetting[j] * terms[j];
    }
  }
};

template <bool kVignetted, typename T>
AR_HD void correct_color(const CorrectParams<T>& p, const Correction<T>& correction, int64_t i) {
  Vec3<T> c = color_at(p.image, p.pixels, i);
  if constexpr (kVignetted) c = Falloff<T>(p.vignetting, p.radii, i).factor * c;
  for (int k = 0; k < 3; ++k) {
    const T(&row)[4] = correction.rows[k];
    p.corrected[k * p.pixels + i] = row[0] * c.x + row[1] * c.y + row[2] * c.z + row[3];
  }
}

/// Adds what the pixel has of dL_dmatrix, and after it of dL_dvignetting.
template <bool kVignetted, typename T>
AR_HD void correct_color_vjp(const CorrectVjpParams<T>& p, const Correction<T>& correction, int64_t i, T* sums) {
  const Vec3<T> c = color_at(p.image, p.pixels, i), g = color_at(p.dL_dcorrected, p.pixels, i);
  const T of_rows[3] = {g.x, g.y, g.z}, shown[3] = {c.x, c.y, c.z};
  T colors[4] = {c.x, c.y, c.z, T(1)}, factor = T(1), dL_dfactor = T(0);
  if constexpr (kVignetted) {
    factor = Falloff<T>(p.vignetting, p.radii, i).factor;
    for (int k = 0; k < 3; ++k) colors[k] *= factor;
  }
  for (int k = 0; k < kCorrection; ++k) sums[k] += of_rows[k / 4] * colors[k % 4];
  const auto& rows = correction.rows;
  for (int k = 0; k < 3; ++k) {
    T dL_dcolor = rows[0][k] * g.x + rows[1][k] * g.y + rows[2][k] * g.z;
    if constexpr (kVignetted) {
      dL_dfactor += dL_dcolor * shown[k];
      dL_dcolor *= factor;
    }
    if (p.dL_dimage) p.dL_dimage[k * p.pixels + i] = dL_dcolor;
  }
  if constexpr (kVignetted) {
    const Falloff<T> falloff(p.vignetting, p.radii, i);
    for (int j = 0; j < kVignetting; ++j) sums[kCorrection + j] += dL_dfactor * falloff.terms[j];
  }
}

}  // namespace ar
