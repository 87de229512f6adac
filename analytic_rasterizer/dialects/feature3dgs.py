"""Feature 3DGS: (color, feature map, radii, depth).

Repositories: ShijieZhou-UCLA/feature-3dgs. `semantic_feature` (P, 1, K) holds a feature of each Gaussian.
"""

from ..footprints import DILATED
from ..render.effects import Effects
from ._base import GaussianRasterizationSettings as Settings
from ._base import GaussianRasterizer as Rasterizer
from ._base import forward_like
from ._further import adds, feature_rows, function_that_adds, with_channels

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2023."""

    dialect = "feature3dgs"
    repositories = ("Feature 3DGS",)
    inferred_from_arguments = ("semantic_feature",)
    filter = DILATED
    outputs = Effects(depth=True)

    @adds(semantic_feature="colors_precomp")
    def render(self, semantic_feature=None, **gaussians) -> tuple:
        """As 3DGS 2023; `semantic_feature` (P, 1, K), or (P, K), is blended on zero with the colours' weights."""
        if semantic_feature is None:
            raise ValueError("semantic_feature must be given in dialect feature3dgs, got None")
        rows = feature_rows("semantic_feature", semantic_feature)
        features, (color, radii, *further) = with_channels(self, rows, **gaussians)
        return color, features, radii, *further

    def returned(self, color, radii, outputs):
        return color, radii, outputs.depth


class GaussianRasterizer(Rasterizer):
    """Renders 3D Gaussians; `forward` takes `semantic_feature`."""

    forward = forward_like(GaussianRasterizationSettings.render)


rasterize_gaussians = function_that_adds(__name__, semantic_feature="colors_precomp")
