// The constants of 3D Gaussian Splatting that the whole pipeline shares.
#pragma once

namespace ar {

/// Edge of a square tile [px], and its logarithm to base 2.
inline constexpr int kTileBits = 4, kTile = 1 << kTileBits;
/// The same on CUDA where samples move (csrc/cuda/blend_moving.cuh), but see moving_grid() of core/stages.h.
inline constexpr int kMovingTileBits = 3, kMovingTile = 1 << kMovingTileBits;
/// An image with fewer tiles of that size is small: CUDA has other kernels for samples that move in it.
inline constexpr int kSmallImageTiles = 4096;
/// An image with so many tiles of 16x16 pixels or more does not have four samples of a pixel spread over lanes on CUDA
/// (spread_grid() of core/stages.h).
inline constexpr int kSpreadImageTiles = 4096;

/// A Gaussian is culled unless the camera-space z of its mean exceeds this [world units].
inline constexpr double kNear = 0.2;

/// x/z and y/z are clamped to this many tan(fov) in the Jacobian of the projection.
inline constexpr double kFrustumClamp = 1.3;

/// A splat is skipped where its alpha is below this.
inline constexpr double kAlphaMin = 1.0 / 255.0;

/// Below log2(kAlphaMin) by 1e-4, hundreds of times what rounding and exp2 of any device are wrong by: no splat whose
/// exponent is below this reaches kAlphaMin.
inline constexpr double kLogAlphaMin = -7.99445;

/// Alpha never exceeds this.
inline constexpr double kAlphaMax = 0.99;

/// A sample stops before its transmittance would fall below this.
inline constexpr double kTransmittanceMin = 1e-4;

/// In the radius that 3DGS reports, the largest eigenvalue of a covariance exceeds the mean of the two by no less than
/// the root of this [px^4].
inline constexpr double kRadiusMinGap = 0.1;

/// Variance of the unit pixel along each axis [px^2].
inline constexpr double kPixelVariance = 1.0 / 12.0;

/// Added to the level of every support ellipse. It exceeds what float32 rounds there, in the extents of the ellipse and
/// in |w d|^2 of a pixel, but for needles longer than 280 to 1000 px (docs/numerics.md, "Support"): no pair is lost.
inline constexpr double kLevelSlack = 1e-2;

/// Makes up for the rounding of an upper bound of how far a Gaussian reaches, some ten operations.
inline constexpr double kReachMargin = 1 + 2e-6;

/// Five roundings of float32: what a whitened coordinate errs by, relative to the sum of its two terms.
inline constexpr double kBoxRounding = 3e-7;

/// A splat is culled where det Sigma [px^4] is not below this, so that nothing derived from it
/// overflows a float: standard deviations up to 3e7 px pass.
inline constexpr double kMaxDet = 1e30;
/// Scales beyond this, in world units, have squares that no float holds: degenerate.
inline constexpr double kMaxScale = 1e18;
/// Opacities and colours beyond these have products that no float holds: degenerate.
inline constexpr double kMaxOpacity = 1e6, kMaxColor = 1e12;

/// A negative det Sigma counts as zero where it is at most so much of Sigma_xx Sigma_yy, what rounding the entries of
/// a cov3d to float can do (16 2^-24); beyond, the splat is culled.
inline constexpr double kSingular = 1e-6;

/// A splat is culled where its whitening matrix [1/px] exceeds this, for the same reason. Only
/// `point` without dilation can get there: every other footprint's ellipse is wider than 1/56 px.
inline constexpr double kMaxWhitening = 1e7;

/// The gradient with respect to a quaternion grows as 1/|q|. It is limited to this, which fits a float, and so is
/// 1/|q|.
inline constexpr double kMaxQuaternionGrad = 1e38;

/// Channels that can be blended in one pass.
inline constexpr int kMaxChannels = 512;

/// Weights are added up as whole numbers of 2^-32, so that the order in which pixels come changes no bit.
inline constexpr double kWeightUnit = 1.0 / 4294967296.0;

inline constexpr double kPi = 3.14159265358979323846;
inline constexpr double kLog2e = 1.44269504088896340736;

}  // namespace ar
