"""LightGaussian: (color, radii), and with `f_count` (counts, scores, color, radii).

Repositories: VITA-Group/LightGaussian. A count is the number of pixels in which a Gaussian is seen.
Deviates: a score is the sum of the Gaussian's weights in those pixels, which falls off towards the Gaussian's edge.
"""

from ..footprints import DILATED
from ..render.effects import Effects
from ..render.rasterizer import NOTHING
from ._base import FIELDS, GaussianRasterizer, rasterize_gaussians
from ._base import GaussianRasterizationSettings as Settings

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

_STATS = Effects(gaussian_stats=True)


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2023, and `f_count`."""

    dialect = "lightgaussian"
    repositories = ("LightGaussian",)
    fields = (*FIELDS, "f_count")
    inferred_from = ("f_count",)
    filter = DILATED

    @property
    def outputs(self) -> Effects:
        return _STATS if self.f_count else NOTHING

    def returned(self, color, radii, outputs):
        if not self.f_count:
            return color, radii
        return outputs.gaussian_stats.pixels, outputs.gaussian_stats.sum_weight, color, radii
