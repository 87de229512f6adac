"""Depth and alpha: (color, radii, depth, alpha), all with gradients.

Repositories: dreamgaussian/dreamgaussian, LGM, SC-GS and others with ashawkey's rasterizer. Depth is blended like a
colour on zero. Its settings are those of 3DGS 2023, so this dialect has to be chosen.
"""

from ..render.effects import Effects
from ._base import GaussianRasterizer, rasterize_gaussians
from .depth import GaussianRasterizationSettings as Settings

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2023."""

    dialect = "depth_alpha"
    repositories = ("ashawkey", "DreamGaussian", "LGM", "SC-GS")
    outputs = Effects(depth=True, alpha=True)

    def returned(self, color, radii, outputs):
        return color, radii, outputs.depth, outputs.alpha
