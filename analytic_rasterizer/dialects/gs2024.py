"""3DGS since October 2024: (color, radii, inverse depth).

Repositories: graphdeco-inria/gaussian-splatting, with the rasterizer's branch dr_aa, and what came from it.
Deviates: `antialiasing` asks for a filter of one pixel, which integrating over the pixel already is. It changes nothing
unless the user chose the footprint `point`, which becomes `mip` with the same variance.
"""

from ..footprints import COMPENSATED, DILATED, Footprint
from ..render.effects import Effects
from ._base import FIELDS, GaussianRasterizer, _resolved, rasterize_gaussians
from ._base import GaussianRasterizationSettings as Settings

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2023, and `antialiasing`."""

    dialect = "gs2024"
    repositories = ("3DGS 2024", "gaussian-splatting")
    fields = (*FIELDS, "antialiasing")
    optional = {"antialiasing": False}  # noqa: RUF012
    inferred_from = ("antialiasing",)
    outputs = Effects(inverse_depth=True)

    def footprint_in_use(self) -> Footprint:
        footprint = super().footprint_in_use()
        if self.antialiasing and footprint.name == DILATED:
            return _resolved(COMPENSATED, variance=footprint.option)
        return footprint

    def returned(self, color, radii, outputs):
        return color, radii, outputs.inverse_depth
