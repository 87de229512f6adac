"""3DGS-MCMC: (color, radii, is_used), and `compute_relocation`.

Repositories: ubc-vision/3dgs-mcmc. Its settings are those of 3DGS 2023, so this dialect has to be chosen.
Deviates: `is_used`, which the repository does not read, is 1 for every Gaussian that was not culled.
"""

from ..footprints import DILATED
from ..relocation import compute_relocation
from ._base import GaussianRasterizationSettings as Settings
from ._base import GaussianRasterizer, rasterize_gaussians

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "compute_relocation", "rasterize_gaussians"]


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2023."""

    dialect = "mcmc"
    repositories = ("3dgs-mcmc",)
    filter = DILATED

    def returned(self, color, radii, outputs):
        return color, radii, (radii > 0).int()
