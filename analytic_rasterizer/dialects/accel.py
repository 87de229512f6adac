"""3DGS since October 2024 with the accelerated rasterizer: as gs2024, with `dc` apart, and an optimiser.

Repositories: graphdeco-inria/gaussian-splatting with the rasterizer's branch 3dgs_accel, DashGaussian. They look
whether the module has a SparseGaussianAdam, and call with `dc` if it has: it is exported under this dialect alone.
"""

import torch

from ..checks import check_tensors
from ..optim import SparseGaussianAdam
from ..render.autocast import way_out_of, widened
from ._base import GaussianRasterizer as Rasterizer
from ._base import forward_like
from ._further import adds, function_that_adds, given
from .gs2024 import GaussianRasterizationSettings as Settings

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "SparseGaussianAdam", "rasterize_gaussians"]


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2024."""

    dialect = "accel"
    repositories = ("3DGS accel", "DashGaussian")
    inferred_from_arguments = ("dc",)

    @adds(dc="opacities")
    def render(self, dc=None, **gaussians) -> tuple:
        """As 3DGS 2024, with the constant harmonics `dc` (P, 1, 3) apart from `shs` (P, M - 1, 3), the others."""
        if given(dc):
            check_tensors(None, dc=dc)
            shs = gaussians.get("shs")
            gaussians["shs"] = _joined(dc, shs) if given(shs) else dc
        return super().render(**gaussians)


def _joined(dc: torch.Tensor, shs: torch.Tensor) -> torch.Tensor:
    """All harmonics (P, M, 3). Raises TypeError or ValueError where the two do not fit together."""
    check_tensors(dc.device, shs=shs)
    dc, shs = widened(dc), widened(shs)
    if shs.dim() != 3 or dc.shape != (len(shs), 1, shs.shape[2]):
        raise ValueError(
            f"dc must have shape (P, 1, 3) and shs (P, M - 1, 3), got {tuple(dc.shape)} and {tuple(shs.shape)}"
        )
    if dc.dtype != shs.dtype:  # cat would make both of the wider one
        raise TypeError(f"dc must have the dtype of shs, {shs.dtype}, got {dc.dtype}{way_out_of(dc.dtype)}")
    return torch.cat([dc, shs], 1)


class GaussianRasterizer(Rasterizer):
    """Renders 3D Gaussians; `forward` takes `dc`."""

    forward = forward_like(GaussianRasterizationSettings.render)


rasterize_gaussians = function_that_adds(__name__, dc="means2D")
