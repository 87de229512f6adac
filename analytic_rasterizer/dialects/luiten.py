"""Luiten's: (color, radii, median depth), and settings without `debug`.

Repositories: SplaTAM, Dynamic3DGaussians. The median depth is that of the Gaussian behind which less than half of a
pixel's light is left; it has no gradient, and is 15 where more gets through.
"""

import torch

from ..footprints import DILATED
from ..render.effects import Effects
from ._base import FIELDS, GaussianRasterizer, rasterize_gaussians
from ._base import GaussianRasterizationSettings as Settings

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

NO_DEPTH = 15.0  # what the original returns where there is no median


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2023 without `debug`, which may be given all the same."""

    dialect = "luiten"
    repositories = ("SplaTAM", "Dynamic3DGaussians")
    fields = tuple(name for name in FIELDS if name != "debug")
    inferred_without = ("debug",)
    filter = DILATED
    outputs = Effects(median_depth=True)
    debug = False

    def __new__(cls, *args, **kwargs):
        if cls is GaussianRasterizationSettings and ("debug" in kwargs or len(args) == len(FIELDS)):
            cls = _SettingsWithDebug
        return super().__new__(cls, *args, **kwargs)

    def returned(self, color, radii, outputs):
        return color, radii, torch.threshold(outputs.median_depth, 0.0, NO_DEPTH)


class _SettingsWithDebug(GaussianRasterizationSettings):
    fields = FIELDS
