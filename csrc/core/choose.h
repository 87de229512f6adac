// How many samples the pixels of a tile need: what `adaptive` decides before it blends.
//
// A pixel of few samples errs where its splats are finer than the pixel and hide each other: the mean of
// a product of alphas is not the product of their means. Walking a tile's list front to back, with the
// tile's mean alpha of each splat as its share, SampleEstimate adds up the variance of that error, to
// which a splat contributes by how much its alpha varies inside a pixel, by how much those in front do,
// and by how far its colour is from the pixel's. docs/numerics.md, "Samples of a tile", says how well it
// predicts the error, and where the limits come from.
#pragma once

#include "core/footprint/adaptive.h"
#include "core/stages.h"

namespace ar {

/// Largest estimates for which 1, 4 and 8 samples do.
template <typename T> struct SampleLimits {
  T of[3];

  AR_HD int choose(T estimate) const {
    return estimate <= of[0] ? 1 : estimate <= of[1] ? 4 : estimate <= of[2] ? 8 : 16;
  }
};

/// A splat in a tile.
template <typename T> struct TileShare {
  T alpha;   ///< mean over the tile, about
  T detail;  ///< of that share: mean square gradient of alpha over its mean, about [1/px^2]
  T edge;    ///< of that share: the steps of alpha where it falls below the minimum, on their own
};

/// `d` = centre of the tile - mean [px]. The tile is taken as the Gaussian of its variance.
template <typename T> AR_HD TileShare<T> tile_share(const AdaptiveShape<T>& shape, T opacity, Vec2<T> d) {
  const Cov2d<T>& cov = shape.cov;
  const T variance = T(kBoxVariance<8>), sqrt_det = shape.sqrt_det;
  const Cov2d<T> fine = blur(cov, variance), pixel = blur(cov, T(kPixelVariance)),
                 tile = blur(cov, T(kTile * kTile / 12.0));
  // One division and one root for each.
  const T of_tile = T(1) / tile.det, of_fine = T(1) / fine.det, mass = opacity * sqrt_det;
  const T q = (tile.yy * d.x * d.x - T(2) * tile.xy * d.x * d.y + tile.xx * d.y * d.y) * of_tile;
  const T alpha = mass * sqrt(of_tile) * exp2(T(-0.5 * kLog2e) * q);
  const T detail = mass * sqrt(of_fine) * variance * ((fine.xx + fine.yy) * of_fine);
  // The length of the ellipse on which alpha is the minimum, over the splat's mass.
  const T level = max(T(0), gaussian_level(sqrt_det / sqrt(pixel.det), opacity));
  const T ring = sqrt(level * T(0.5) * (pixel.xx + pixel.yy)) / mass;
  return {min(alpha, T(kAlphaMax)), detail, T(0.03 * kAlphaMin * kAlphaMin) * min(ring, T(1e4))};
}

template <typename T> struct SampleEstimate {
  /// Transmittance below which what is behind counts no more.
  static constexpr double kDark = 0.03;

  T transmittance = T(1), front = T(0);  // front: detail of what has been passed
  T total = T(0);
  Vec3<T> first = {T(0), T(0), T(0)}, second = {T(0), T(0), T(0)}, color = {T(0), T(0), T(0)};

  AR_HD bool dark() const { return transmittance < T(kDark); }

  AR_HD void add(TileShare<T> share, Vec3<T> c) {
    const T through = T(1) - share.alpha, shown = transmittance * share.alpha;
    const T detail = share.alpha * share.detail;
    const T weight = transmittance * transmittance * (detail * front + share.alpha * share.edge);
    total += weight;
    first += weight * c;
    second += weight * mul(c, c);
    color += shown * c;
    front += detail / (through * through);
    transmittance *= through;
  }

  /// Root mean square over the channels of the error that a single sample makes, up to a factor.
  AR_HD T value(Vec3<T> background) const {
    const Vec3<T> mean = color + transmittance * background;
    const auto variance = [&](T m, T s1, T s2) { return max(T(0), s2 - T(2) * m * s1 + m * m * total); };
    return sqrt((variance(mean.x, first.x, second.x) + variance(mean.y, first.y, second.y) +
                 variance(mean.z, first.z, second.z)) /
                T(3));
  }
};

template <typename T> AR_HD Vec2<T> tile_center(TileGrid grid, int64_t tile) {
  const T half = T(0.5) * T(kTile - 1);
  return {T(tile % grid.columns() * kTile) + half, T(tile / grid.columns() * kTile) + half};
}

/// Limits fitted so that 99% of the pixels are within `tolerance` of 16 samples, at the tolerances of the
/// columns; powers between them, in proportion beyond.
template <typename T> SampleLimits<T> sample_limits(double tolerance) {
  constexpr int kRows = 5;
  constexpr double kTolerances[kRows] = {0.25 / 255, 0.5 / 255, 1.0 / 255, 2.0 / 255, 4.0 / 255};
  constexpr double kLimits[3][kRows] = {{6.26e-5, 1.51e-4, 2.62e-4, 3.63e-4, 8.85e-4},
                                        {2.66e-4, 4.27e-4, 7.31e-4, 2.79e-3, 3.98e-3},
                                        {4.32e-4, 1.50e-3, 3.10e-3, 3.98e-3, 6.48e-3}};
  int row = 0;
  while (row < kRows - 1 && tolerance >= kTolerances[row + 1]) ++row;
  const bool between = row < kRows - 1 && tolerance > kTolerances[0];
  SampleLimits<T> limits;
  for (int c = 0; c < 3; ++c) {
    const double* of = kLimits[c];
    const double power =
        between ? std::log(of[row + 1] / of[row]) / std::log(kTolerances[row + 1] / kTolerances[row]) : 1;
    limits.of[c] = T(of[row] * std::pow(tolerance / kTolerances[row], power));
  }
  return limits;
}

}  // namespace ar
