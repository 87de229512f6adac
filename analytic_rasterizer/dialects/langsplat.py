"""LangSplat: (color, language features, radii), blended in one pass.

Repositories: minghanqin/LangSplat. `include_feature` says whether the features are rendered; where they are not, their
image is zero.
"""

from ..footprints import DILATED
from ._base import FIELDS, forward_like
from ._base import GaussianRasterizationSettings as Settings
from ._base import GaussianRasterizer as Rasterizer
from ._further import adds, function_that_adds, with_channels

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2023, and `include_feature`."""

    dialect = "langsplat"
    repositories = ("LangSplat",)
    fields = (*FIELDS, "include_feature")
    inferred_from = ("include_feature",)
    filter = DILATED

    @adds(language_feature_precomp="colors_precomp")
    def render(self, language_feature_precomp=None, **gaussians) -> tuple:
        """As 3DGS 2023; `language_feature_precomp` (P, 3), or (P, K), is blended on zero with the colours' weights."""
        if self.include_feature:
            if language_feature_precomp is None:
                raise ValueError("language_feature_precomp must be given where include_feature is set, got None")
            features, (color, radii, *further) = with_channels(self, language_feature_precomp, **gaussians)
        else:
            color, radii, *further = super().render(**gaussians)
            features = color.new_zeros(color.shape)
        return color, features, radii, *further


class GaussianRasterizer(Rasterizer):
    """Renders 3D Gaussians; `forward` takes `language_feature_precomp`."""

    forward = forward_like(GaussianRasterizationSettings.render)


rasterize_gaussians = function_that_adds(__name__, language_feature_precomp="colors_precomp")
