"""Feature 3DGS: (color, feature map, radii, depth).

Repositories: ShijieZhou-UCLA/feature-3dgs. `semantic_feature` (P, 1, K) holds a feature of each Gaussian.
"""

from ..footprints import DILATED
from ..render.effects import Effects
from ._base import GaussianRasterizationSettings as Settings
from ._base import GaussianRasterizer as Rasterizer
from ._base import feature_rows, forward_like, render_by, with_channels

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2023."""

    dialect = "feature3dgs"
    repositories = ("Feature 3DGS",)
    inferred_from_arguments = ("semantic_feature",)
    filter = DILATED
    outputs = Effects(depth=True)

    def render(
        self,
        means3D,
        means2D,
        opacities,
        shs=None,
        colors_precomp=None,
        semantic_feature=None,
        scales=None,
        rotations=None,
        cov3D_precomp=None,
    ) -> tuple:
        """As 3DGS 2023; `semantic_feature` (P, 1, K), or (P, K), is blended on zero with the colours' weights."""
        if semantic_feature is None:
            raise ValueError("semantic_feature must be given in dialect feature3dgs, got None")
        rows = feature_rows("semantic_feature", semantic_feature)
        arguments = means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp
        features, (color, radii, *further) = with_channels(self, rows, *arguments)
        return color, features, radii, *further

    def returned(self, color, radii, outputs):
        return color, radii, outputs.depth


class GaussianRasterizer(Rasterizer):
    """Renders 3D Gaussians; `forward` takes `semantic_feature`."""

    forward = forward_like(GaussianRasterizationSettings.render)


def rasterize_gaussians(
    means3D,
    means2D,
    sh,
    colors_precomp,
    semantic_feature,
    opacities,
    scales,
    rotations,
    cov3Ds_precomp,
    raster_settings,
) -> tuple:
    """The functional form of `GaussianRasterizer.forward`."""
    arguments = means3D, means2D, opacities, sh, colors_precomp, scales, rotations, cov3Ds_precomp
    return render_by(raster_settings, *arguments, semantic_feature=semantic_feature)
