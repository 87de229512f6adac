// Constants of 3DGS, sizes of tiles, and limits that keep float32 finite. A test compares the viewer's copies.
#pragma once

namespace ar {

/// Edge of a square tile [px], and its log2.
inline constexpr int kTileBits = 4, kTile = 1 << kTileBits;
/// On CUDA where samples move: see moving_grid().
inline constexpr int kMovingTileBits = 3, kMovingTile = 1 << kMovingTileBits;
/// On CUDA in the order along rays.
inline constexpr int kRayTileBits = 3;
/// An image with fewer such tiles is small.
inline constexpr int kSmallImageTiles = 4096;
/// With fewer 16x16 tiles CUDA spreads four samples over lanes (spread_grid()).
inline constexpr int kSpreadImageTiles = 4096;

/// Least camera-space z of a mean [world units].
inline constexpr double kNear = 0.2;

/// The Jacobian of a pinhole clamps x/z and y/z to this times tan(fov/2).
inline constexpr double kFrustumClamp = 1.3;

/// A smaller alpha counts as zero.
inline constexpr double kAlphaMin = 1.0 / 255.0;

/// log2(kAlphaMin) - 1e-4, hundreds of times the errors of rounding and exp2.
inline constexpr double kLogAlphaMin = -7.99445;

inline constexpr double kAlphaMax = 0.99;

/// A sample stops before T falls below this.
inline constexpr double kTransmittanceMin = 1e-4;

/// In 3DGS's radius: the least square of half the eigenvalues' difference [px^4].
inline constexpr double kRadiusMinGap = 0.1;

/// Variance of the unit pixel along each axis [px^2].
inline constexpr double kPixelVariance = 1.0 / 12.0;

/// Added to every level, so that rounding loses no pair, except of needles longer than 280 to 1000 px
/// (docs/internals/numerics.md, "Support").
inline constexpr double kLevelSlack = 1e-2;

/// Ten roundings: the margin of a Gaussian's reach.
inline constexpr double kReachMargin = 1 + 2e-6;

/// Five roundings of float32: the error of a whitened coordinate, relative to the sum of its terms.
inline constexpr double kBoxRounding = 3e-7;

// Gaussians beyond these are culled: nothing derived overflows a float.
/// det Sigma [px^4]: standard deviations up to 3e7 px.
inline constexpr double kMaxDet = 1e30;
/// World units.
inline constexpr double kMaxScale = 1e18;
inline constexpr double kMaxOpacity = 1e6, kMaxColor = 1e12;

/// A negative det Sigma counts as zero up to this share of Sigma_xx Sigma_yy: 16 roundings.
inline constexpr double kSingular = 1e-6;

/// An entry of the whitening matrix [1/px]. Only `point` without dilation exceeds it.
inline constexpr double kMaxWhitening = 1e7;

/// Limit of 1/|q| of a quaternion q, and of its gradient, which grows alike.
inline constexpr double kMaxQuaternionGrad = 1e38;

inline constexpr int kMaxChannels = 512;

/// Weights are summed as integers of this unit: their order changes no bit.
inline constexpr double kWeightUnit = 1.0 / 4294967296.0;

inline constexpr double kPi = 3.14159265358979323846;
inline constexpr double kLog2e = 1.44269504088896340736;

}  // namespace ar
