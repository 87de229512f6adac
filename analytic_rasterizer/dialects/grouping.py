"""Gaussian Grouping: (color, radii, objects), blended in one pass.

Repositories: lkeab/gaussian-grouping. `sh_objs` (P, 1, 16) holds the identity of each Gaussian, as features.
"""

from ..footprints import DILATED
from ._base import GaussianRasterizationSettings as Settings
from ._base import GaussianRasterizer as Rasterizer
from ._base import forward_like
from ._further import adds, feature_rows, function_that_adds, given, with_channels

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

CHANNELS = 16


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2023."""

    dialect = "grouping"
    repositories = ("Gaussian Grouping",)
    inferred_from_arguments = ("sh_objs",)
    filter = DILATED

    @adds(sh_objs="shs")
    def render(self, sh_objs=None, **gaussians) -> tuple:
        """As 3DGS 2023; `sh_objs` (P, 1, K), or (P, K), is blended on zero with the colours' weights.

        Without it the third value is zero, (16, H, W).
        """
        if given(sh_objs):
            objects, (color, radii, *further) = with_channels(self, feature_rows("sh_objs", sh_objs), **gaussians)
        else:
            color, radii, *further = super().render(**gaussians)
            objects = color.new_zeros(CHANNELS, *color.shape[1:])
        return color, radii, objects, *further


class GaussianRasterizer(Rasterizer):
    """Renders 3D Gaussians; `forward` takes `sh_objs`."""

    forward = forward_like(GaussianRasterizationSettings.render)


rasterize_gaussians = function_that_adds(__name__, sh_objs="sh")
