// A training picture as a photograph of another exposure would show it: a colour c becomes A c + b. And the adjoint.
#pragma once

#include <cstdint>

#include "core/vec.h"

namespace ar {

/// Numbers of (A | b).
inline constexpr int kCorrection = 12;

template <typename T> struct Correction {
  T rows[3][4];
};

/// Images: [3, pixels].
template <typename T> struct CorrectParams {
  int64_t pixels;
  const T* image;
  const T* matrix;  ///< [3, 4], (A | b)
  T* corrected;
};

/// Null: not wanted.
template <typename T> struct CorrectVjpParams {
  int64_t pixels;
  const T* image;
  const T* matrix;
  const T* dL_dcorrected;
  T* dL_dimage;
  T* dL_dmatrix;
};

template <typename T> AR_HD Correction<T> read_correction(const T* matrix) {
  Correction<T> c;
  for (int i = 0; i < kCorrection; ++i) c.rows[i / 4][i % 4] = matrix[i];
  return c;
}

template <typename T> AR_HD Vec3<T> color_at(const T* image, int64_t pixels, int64_t i) {
  return {image[i], image[pixels + i], image[2 * pixels + i]};
}

template <typename T> AR_HD void correct_color(const CorrectParams<T>& p, const Correction<T>& correction, int64_t i) {
  const Vec3<T> c = color_at(p.image, p.pixels, i);
  for (int k = 0; k < 3; ++k) {
    const T(&row)[4] = correction.rows[k];
    p.corrected[k * p.pixels + i] = row[0] * c.x + row[1] * c.y + row[2] * c.z + row[3];
  }
}

/// Adds what the pixel has of dL_dmatrix.
template <typename T>
AR_HD void correct_color_vjp(const CorrectVjpParams<T>& p, const Correction<T>& correction, int64_t i, T* dL_dmatrix) {
  const Vec3<T> c = color_at(p.image, p.pixels, i), g = color_at(p.dL_dcorrected, p.pixels, i);
  const T of_rows[3] = {g.x, g.y, g.z}, colors[4] = {c.x, c.y, c.z, T(1)};
  for (int k = 0; k < kCorrection; ++k) dL_dmatrix[k] += of_rows[k / 4] * colors[k % 4];
  if (!p.dL_dimage) return;
  const auto& rows = correction.rows;
  for (int k = 0; k < 3; ++k) p.dL_dimage[k * p.pixels + i] = rows[0][k] * g.x + rows[1][k] * g.y + rows[2][k] * g.z;
}

}  // namespace ar
