"""Gaussian Grouping: (color, radii, objects), blended in one pass.

Repositories: lkeab/gaussian-grouping. `sh_objs` (P, 1, 16) holds the identity of each Gaussian, as features.
"""

from ..footprints import DILATED
from ._base import GaussianRasterizationSettings as Settings
from ._base import GaussianRasterizer as Rasterizer
from ._base import feature_rows, forward_like, given, render_by, with_channels

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

CHANNELS = 16


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2023."""

    dialect = "grouping"
    repositories = ("Gaussian Grouping",)
    inferred_from_arguments = ("sh_objs",)
    filter = DILATED

    def render(
        self,
        means3D,
        means2D,
        opacities,
        shs=None,
        sh_objs=None,
        colors_precomp=None,
        scales=None,
        rotations=None,
        cov3D_precomp=None,
    ) -> tuple:
        """As 3DGS 2023; `sh_objs` (P, 1, K), or (P, K), is blended on zero with the colours' weights.

        Without it the third value is zero, (16, H, W).
        """
        arguments = means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp
        if given(sh_objs):
            objects, (color, radii, *further) = with_channels(self, feature_rows("sh_objs", sh_objs), *arguments)
        else:
            color, radii, *further = super().render(*arguments)
            objects = color.new_zeros(CHANNELS, *color.shape[1:])
        return color, radii, objects, *further


class GaussianRasterizer(Rasterizer):
    """Renders 3D Gaussians; `forward` takes `sh_objs`."""

    forward = forward_like(GaussianRasterizationSettings.render)


def rasterize_gaussians(
    means3D, means2D, sh, sh_objs, colors_precomp, opacities, scales, rotations, cov3Ds_precomp, raster_settings
) -> tuple:
    """The functional form of `GaussianRasterizer.forward`."""
    arguments = means3D, means2D, opacities, sh, colors_precomp, scales, rotations, cov3Ds_precomp
    return render_by(raster_settings, *arguments, sh_objs=sh_objs)
