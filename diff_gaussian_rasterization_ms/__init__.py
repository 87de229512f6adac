"""The name under which Mini-Splatting imports the rasterizer that also returns statistics of every Gaussian."""

from analytic_rasterizer.dialects.mini import (
    GaussianRasterizationSettings,
    GaussianRasterizer,
    rasterize_gaussians,
)

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]
