// Colour by direction from real spherical harmonics of degree 0 to 4, and the adjoint. kMax: the largest compiled,
// since the fourth costs registers and memory.
#pragma once

#include "core/vec.h"

namespace ar {

AR_HD constexpr int sh_count(int degree) { return (degree + 1) * (degree + 1); }

inline constexpr int kMaxShDegree = 4;

/// Basis functions at the unit vector d, in the order and sign of 3DGS (Condon-Shortley).
template <int kMax, typename T> AR_HD void sh_basis(int degree, Vec3<T> d, T* basis) {
  const T x = d.x, y = d.y, z = d.z;
  basis[0] = T(0.28209479177387814);
  if (degree < 1) return;
  const T c1 = T(0.4886025119029199);
  basis[1] = -c1 * y;
  basis[2] = c1 * z;
  basis[3] = -c1 * x;
  if (degree < 2) return;
  const T xx = x * x, yy = y * y, zz = z * z;
  basis[4] = T(1.0925484305920792) * x * y;
  basis[5] = T(-1.0925484305920792) * y * z;
  basis[6] = T(0.31539156525252005) * (T(2) * zz - xx - yy);
  basis[7] = T(-1.0925484305920792) * x * z;
  basis[8] = T(0.5462742152960396) * (xx - yy);
  if (degree < 3) return;
  basis[9] = T(-0.5900435899266435) * y * (T(3) * xx - yy);
  basis[10] = T(2.890611442640554) * x * y * z;
  basis[11] = T(-0.4570457994644658) * y * (T(4) * zz - xx - yy);
  basis[12] = T(0.3731763325901154) * z * (T(2) * zz - T(3) * xx - T(3) * yy);
  basis[13] = T(-0.4570457994644658) * x * (T(4) * zz - xx - yy);
  basis[14] = T(1.445305721320277) * z * (xx - yy);
  basis[15] = T(-0.5900435899266435) * x * (xx - T(3) * yy);
  if constexpr (kMax >= 4) {
    if (degree < 4) return;
    basis[16] = T(2.5033429417967046) * x * y * (xx - yy);
    basis[17] = T(-1.7701307697799304) * y * z * (T(3) * xx - yy);
    basis[18] = T(0.9461746957575601) * x * y * (T(7) * zz - T(1));
    basis[19] = T(-0.6690465435572892) * y * z * (T(7) * zz - T(3));
    basis[20] = T(0.10578554691520431) * (zz * (T(35) * zz - T(30)) + T(3));
    basis[21] = T(-0.6690465435572892) * x * z * (T(7) * zz - T(3));
    basis[22] = T(0.47308734787878004) * (xx - yy) * (T(7) * zz - T(1));
    basis[23] = T(-1.7701307697799304) * x * z * (xx - T(3) * yy);
    basis[24] = T(0.6258357354491761) * (xx * (xx - T(3) * yy) - yy * (T(3) * xx - yy));
  }
}

/// Of sum_k weight[k] basis[k](d), by three independent coordinates d.
template <int kMax, typename T> AR_HD Vec3<T> sh_basis_vjp(int degree, Vec3<T> d, const T* weight) {
  Vec3<T> g = {T(0), T(0), T(0)};
  if (degree < 1) return g;
  const T x = d.x, y = d.y, z = d.z;
  const T c1 = T(0.4886025119029199);
  g = {-c1 * weight[3], -c1 * weight[1], c1 * weight[2]};
  if (degree < 2) return g;
  const T c2 = T(1.0925484305920792), c20 = T(0.31539156525252005), c22 = T(0.5462742152960396);
  g += Vec3<T>{c2 * (y * weight[4] - z * weight[7]) - T(2) * x * (c20 * weight[6] - c22 * weight[8]),
               c2 * (x * weight[4] - z * weight[5]) - T(2) * y * (c20 * weight[6] + c22 * weight[8]),
               T(4) * c20 * z * weight[6] - c2 * (y * weight[5] + x * weight[7])};
  if (degree < 3) return g;
  const T xx = x * x, yy = y * y, zz = z * z;
  const T c33 = T(0.5900435899266435), c32 = T(2.890611442640554), c31 = T(0.4570457994644658),
          c30 = T(0.3731763325901154), c3z = T(1.445305721320277);
  g += Vec3<T>{-c33 * (T(6) * x * y * weight[9] + T(3) * (xx - yy) * weight[15]) + c32 * y * z * weight[10] +
                   c31 * (T(2) * x * y * weight[11] - (T(4) * zz - T(3) * xx - yy) * weight[13]) -
                   T(6) * c30 * x * z * weight[12] + T(2) * c3z * x * z * weight[14],
               -c33 * (T(3) * (xx - yy) * weight[9] - T(6) * x * y * weight[15]) + c32 * x * z * weight[10] -
                   c31 * ((T(4) * zz - xx - T(3) * yy) * weight[11] - T(2) * x * y * weight[13]) -
                   T(6) * c30 * y * z * weight[12] - T(2) * c3z * y * z * weight[14],
               c32 * x * y * weight[10] - T(8) * c31 * z * (y * weight[11] + x * weight[13]) +
                   T(3) * c30 * (T(2) * zz - xx - yy) * weight[12] + c3z * (xx - yy) * weight[14]};
  if constexpr (kMax >= 4) {
    if (degree < 4) return g;
    const T c44 = T(2.5033429417967046), c43 = T(-1.7701307697799304), c42 = T(0.9461746957575601),
            c41 = T(-0.6690465435572892), c40 = T(0.10578554691520431), c4z = T(0.47308734787878004),
            c4x = T(0.6258357354491761), seven = T(7) * zz;
    g += Vec3<T>{c44 * y * (T(3) * xx - yy) * weight[16] + c43 * T(6) * x * y * z * weight[17] +
                     c42 * y * (seven - T(1)) * weight[18] + c41 * z * (seven - T(3)) * weight[21] +
                     c4z * T(2) * x * (seven - T(1)) * weight[22] + c43 * T(3) * z * (xx - yy) * weight[23] +
                     c4x * T(4) * x * (xx - T(3) * yy) * weight[24],
                 c44 * x * (xx - T(3) * yy) * weight[16] + c43 * T(3) * z * (xx - yy) * weight[17] +
                     c42 * x * (seven - T(1)) * weight[18] + c41 * z * (seven - T(3)) * weight[19] -
                     c4z * T(2) * y * (seven - T(1)) * weight[22] - c43 * T(6) * x * y * z * weight[23] +
                     c4x * T(4) * y * (yy - T(3) * xx) * weight[24],
                 c43 * y * (T(3) * xx - yy) * weight[17] + c42 * T(14) * x * y * z * weight[18] +
                     c41 * (T(21) * zz - T(3)) * (y * weight[19] + x * weight[21]) +
                     c40 * z * (T(140) * zz - T(60)) * weight[20] + c4z * T(14) * z * (xx - yy) * weight[22] +
                     c43 * x * (xx - T(3) * yy) * weight[23]};
  }
  return g;
}

/// Colour before the clamp at zero.
template <int kMax, typename T> AR_HD Vec3<T> sh_color(int degree, const T* basis, const Vec3<T>* coefficients) {
  constexpr int kCount = sh_count(kMax);
  Vec3<T> color = {T(0.5), T(0.5), T(0.5)};
  AR_UNROLL for (int k = 0; k < kCount; ++k) {
    if (k < sh_count(degree)) color += basis[k] * coefficients[k];
  }
  return color;
}

}  // namespace ar
