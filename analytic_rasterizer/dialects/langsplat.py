"""LangSplat: (color, language features, radii), blended in one pass.

Repositories: minghanqin/LangSplat. `include_feature` says whether the features are rendered; where they are not, their
image is zero.
"""

from ..footprints import DILATED
from ._base import FIELDS, forward_like, render_by, with_channels
from ._base import GaussianRasterizationSettings as Settings
from ._base import GaussianRasterizer as Rasterizer

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2023, and `include_feature`."""

    dialect = "langsplat"
    repositories = ("LangSplat",)
    fields = (*FIELDS, "include_feature")
    inferred_from = ("include_feature",)
    filter = DILATED

    def render(
        self,
        means3D,
        means2D,
        opacities,
        shs=None,
        colors_precomp=None,
        language_feature_precomp=None,
        scales=None,
        rotations=None,
        cov3D_precomp=None,
    ) -> tuple:
        """As 3DGS 2023; `language_feature_precomp` (P, 3), or (P, K), is blended on zero with the colours' weights."""
        arguments = means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp
        if self.include_feature:
            if language_feature_precomp is None:
                raise ValueError("language_feature_precomp must be given where include_feature is set, got None")
            features, (color, radii, *further) = with_channels(self, language_feature_precomp, *arguments)
        else:
            color, radii, *further = super().render(*arguments)
            features = color.new_zeros(color.shape)
        return color, features, radii, *further


class GaussianRasterizer(Rasterizer):
    """Renders 3D Gaussians; `forward` takes `language_feature_precomp`."""

    forward = forward_like(GaussianRasterizationSettings.render)


def rasterize_gaussians(
    means3D,
    means2D,
    sh,
    colors_precomp,
    language_feature_precomp,
    opacities,
    scales,
    rotations,
    cov3Ds_precomp,
    raster_settings,
) -> tuple:
    """The functional form of `GaussianRasterizer.forward`."""
    arguments = means3D, means2D, opacities, sh, colors_precomp, scales, rotations, cov3Ds_precomp
    return render_by(raster_settings, *arguments, language_feature_precomp=language_feature_precomp)
