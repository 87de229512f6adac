"""3DGS 2023, the default: (color, radii).

Repositories: graphdeco-inria/gaussian-splatting until August 2024, SuGaR, InstantSplat, pixelSplat, MVSplat,
DepthSplat, GaussianAvatars, and most that came from them. What differs is inferred from the settings where possible.
"""

from ._base import GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]
