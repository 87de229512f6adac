"""3DGS since October 2024 with the accelerated rasterizer: as gs2024, with `dc` apart, and an optimiser.

Repositories: graphdeco-inria/gaussian-splatting with the rasterizer's branch 3dgs_accel, DashGaussian. They look
whether the module has a SparseGaussianAdam, and call with `dc` if it has: it is exported under this dialect alone.
"""

import torch

from ._base import GaussianRasterizer as Rasterizer
from ._base import forward_like, given
from .gs2024 import GaussianRasterizationSettings as Settings

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "SparseGaussianAdam", "rasterize_gaussians"]


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2024."""

    dialect = "accel"
    repositories = ("3DGS accel", "DashGaussian")
    inferred_from_arguments = ("dc",)

    def render(
        self,
        means3D,
        means2D,
        opacities,
        dc=None,
        shs=None,
        colors_precomp=None,
        scales=None,
        rotations=None,
        cov3D_precomp=None,
        **further,
    ) -> tuple:
        """As 3DGS 2024, with the constant harmonics `dc` (P, 1, 3) apart from `shs` (P, M - 1, 3), the others."""
        if given(dc):
            shs = torch.cat([dc, shs], 1) if given(shs) else dc
        return super().render(
            means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp, **further
        )


class GaussianRasterizer(Rasterizer):
    """Renders 3D Gaussians; `forward` takes `dc`."""

    forward = forward_like(GaussianRasterizationSettings.render)


def rasterize_gaussians(
    means3D, means2D, dc, sh, colors_precomp, opacities, scales, rotations, cov3Ds_precomp, raster_settings
) -> tuple:
    """The functional form of `GaussianRasterizer.forward`."""
    return raster_settings.render(
        means3D, means2D, opacities, dc, sh, colors_precomp, scales, rotations, cov3Ds_precomp
    )


class SparseGaussianAdam(torch.optim.Adam):
    """Adam that moves the Gaussians in the picture only, with decays 0.9 and 0.999 and without correction of bias.

    Args:
        params: Groups of one tensor each, whose leading dimension is that of the Gaussians.
        lr: Learning rate of groups that name none.
        eps: Added to the root of the second moment.
    """

    def __init__(self, params, lr: float, eps: float):
        super().__init__(params=params, lr=lr, eps=eps)

    @torch.no_grad()
    def step(self, visibility: torch.Tensor, N: int) -> None:
        """Moves the rows of visible Gaussians; all others keep their values and their moments.

        Args:
            visibility: (N,) bool.
            N: Number of Gaussians.

        Raises:
            ValueError: visibility has another shape, a group has several tensors, or a tensor is not made of N rows.
        """
        if visibility.shape != (N,):
            raise ValueError(f"visibility must have shape ({N},), got {tuple(visibility.shape)}")
        visible = visibility.bool()
        for group in self.param_groups:
            if len(group["params"]) != 1:
                raise ValueError(f"a group must have one tensor, got {len(group['params'])}")
            (parameter,) = group["params"]
            if parameter.grad is None:
                continue
            if len(parameter) != N:
                raise ValueError(f"parameters must have {N} rows, got shape {tuple(parameter.shape)}")
            state = self.state[parameter]
            if not state:
                state["step"] = torch.tensor(0.0)
                state["exp_avg"] = torch.zeros_like(parameter)
                state["exp_avg_sq"] = torch.zeros_like(parameter)
            rows = visible.reshape(-1, *[1] * (parameter.dim() - 1))
            mean = torch.lerp(parameter.grad, state["exp_avg"], 0.9)
            square = torch.lerp(parameter.grad.square(), state["exp_avg_sq"], 0.999)
            moved = parameter - group["lr"] * mean / (square.sqrt() + group["eps"])
            # Not by index: that would wait for the device to count the rows.
            state["exp_avg"].copy_(torch.where(rows, mean, state["exp_avg"]))
            state["exp_avg_sq"].copy_(torch.where(rows, square, state["exp_avg_sq"]))
            parameter.copy_(torch.where(rows, moved, parameter))
