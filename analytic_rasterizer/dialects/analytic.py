"""Analytic-Splatting: (color, radii), and the third column of means2D's gradient is the sum over pixels of its length.

Repositories: lzhnb/Analytic-Splatting; `--dense` densifies by that column. Its settings are those of 3DGS 2023, so this
dialect has to be chosen.
"""

from ..footprints import PAPER
from ._base import GaussianRasterizationSettings as Settings
from ._base import GaussianRasterizer, rasterize_gaussians

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2023."""

    dialect = "analytic"
    repositories = ("Analytic-Splatting",)
    filter = PAPER
    means2d_z = "sum_norm"
