"""Depth as a third value: (color, radii, depth).

Repositories: hustvl/4DGaussians, ingra14m/Deformable-3D-Gaussians and others with ingra14m's rasterizer. Depth is
blended like a colour on zero. Its settings are those of 3DGS 2023: the dialect has to be chosen, but where
`means2D_densify` is given.
"""

from ..checks import check_tensors
from ..footprints import DILATED
from ..render.effects import Effects
from ._base import GaussianRasterizationSettings as Settings
from ._base import GaussianRasterizer as Rasterizer
from ._base import forward_like, rasterize_gaussians
from ._further import adds, given

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2023."""

    dialect = "depth"
    repositories = ("4DGaussians", "Deformable-3D-Gaussians", "Deformable-3DGS")
    inferred_from_arguments = ("means2D_densify",)
    filter = DILATED
    outputs = Effects(depth=True)

    @adds(means2D_densify="cov3D_precomp")
    def render(self, means2D_densify=None, **gaussians) -> tuple:
        """As 3DGS 2023; `means2D_densify`, of the shape of means2D, receives the gradient that means2D receives."""
        if given(means2D_densify):
            check_tensors(None, means2D_densify=means2D_densify)
            means2D = gaussians.get("means2D")
            if given(means2D) and means2D_densify.shape != means2D.shape:
                raise ValueError(
                    f"means2D_densify must have the shape of means2D, {tuple(means2D.shape)}, got "
                    f"{tuple(means2D_densify.shape)}"
                )
            gaussians["means2D"] = means2D + means2D_densify if given(means2D) else means2D_densify
        return super().render(**gaussians)

    def returned(self, color, radii, outputs):
        return color, radii, outputs.depth


class GaussianRasterizer(Rasterizer):
    """Renders 3D Gaussians; `forward` takes `means2D_densify`."""

    forward = forward_like(GaussianRasterizationSettings.render)
