"""Scaffold-GS: (color, radii), and `GaussianRasterizer.visible_filter`, which projects only.

Repositories: city-super/Scaffold-GS, Octree-GS. Every dialect has `visible_filter`; this one has the filter that those
models were trained with. Its settings are those of 3DGS 2023, so it has to be chosen.
"""

from ..footprints import DILATED
from ._base import GaussianRasterizationSettings as Settings
from ._base import GaussianRasterizer, rasterize_gaussians

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2023."""

    dialect = "scaffold"
    repositories = ("Scaffold-GS", "Octree-GS")
    filter = DILATED
