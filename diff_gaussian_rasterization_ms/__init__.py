"""The name under which Mini-Splatting imports the rasterizer that also returns statistics of every Gaussian.

Mini-Splatting trains through this module and evaluates through diff_gaussian_rasterization: once this one has been
imported, both render with its filter.
"""

from analytic_rasterizer.dialects import _base
from analytic_rasterizer.dialects.mini import (
    GaussianRasterizationSettings,
    GaussianRasterizer,
    rasterize_gaussians,
)

_base.use_filter_of_companion(GaussianRasterizationSettings.filter)

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]
