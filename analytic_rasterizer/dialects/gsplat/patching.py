"""What gsplat's own programs call besides `rasterization`, and how they come to call all of it here."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch

from ... import relocation
from ...cameras.rotations import product, rotation_matrices
from .rendering import rasterization, upper_triangle

_TORCH_FLAG = "_force_torch_backend"  # of gsplat.strategy.ops: whether noise is added without gsplat's CUDA code


def rasterization_2dgs(*args: Any, **kwargs: Any) -> None:
    """gsplat's rasterizer of 2D Gaussian splatting, which this package does not have.

    Raises:
        NotImplementedError: Always.
    """
    raise NotImplementedError(
        "rasterization_2dgs is not supported: 2DGS intersects rays with discs, see docs/gsplat.md"
    )


def compute_relocation(
    opacities: torch.Tensor, scales: torch.Tensor, ratios: torch.Tensor, binoms: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """gsplat's function of that name, which its MCMCStrategy calls. See `relocation.compute_relocation`.

    Args:
        opacities: (P,) or (P, 1), 0 to 1.
        scales: (P, 3) world units.
        ratios: (P,) integers: how many Gaussians take the place of each.
        binoms: (n, n) binomial coefficients, with ratios up to n.

    Returns:
        New opacities and new scales, in the shapes of the old.

    Raises:
        TypeError: Not a tensor.
        ValueError: Wrong shape.
    """
    return relocation.compute_relocation(opacities, scales, ratios, binoms, len(binoms))


def quat_scale_to_covar_preci(
    quats: torch.Tensor,
    scales: torch.Tensor,
    compute_covar: bool = True,
    compute_preci: bool = True,
    triu: bool = False,
) -> tuple[torch.Tensor | None, torch.Tensor | None]:
    """gsplat's function of that name, which its MCMCStrategy calls: covariances and their inverses. Differentiable.

    Args:
        quats: (..., 4) quaternions (w, x, y, z) of any length; zero is the identity.
        scales: (..., 3) standard deviations, world units.
        compute_covar, compute_preci: Which of the two to make.
        triu: Return (..., 6), the upper triangles row by row, in place of (..., 3, 3).

    Returns:
        Covariances and their inverses, None for what is not asked for.

    Raises:
        ValueError: Wrong shape.
    """
    if quats.shape[-1:] != (4,) or scales.shape != (*quats.shape[:-1], 3):
        raise ValueError(
            f"quats must have shape (..., 4) and scales (..., 3), got {tuple(quats.shape)} and {tuple(scales.shape)}"
        )
    rotations = rotation_matrices(quats)

    def squared(factors: torch.Tensor) -> torch.Tensor:
        square = rotations * factors[..., None, :]
        square = product(square, square.mT)
        return upper_triangle(square) if triu else square

    return squared(scales) if compute_covar else None, squared(1 / scales) if compute_preci else None


def patch() -> None:
    """Puts this package's functions in the place of gsplat's, whose CUDA kernels are then not needed.

    To be called before other modules import names from gsplat: what they have imported already stays gsplat's. The
    three functions are `rasterization`, `compute_relocation` and `quat_scale_to_covar_preci`, which is what gsplat's
    DefaultStrategy and MCMCStrategy and nerfstudio's splatfacto call. Before version 1.5 `meta["radii"]` had one
    number per splat: then it is the larger one of the two. The noise of MCMCStrategy has CUDA code of its own since
    version 1.6; it is told to take torch.

    Raises:
        ImportError: gsplat is not installed, or is older than its strategies. Tested with 1.4.0 and 1.5.3, and with the
            signature of 1.6.
    """
    import gsplat
    import gsplat.relocation
    import gsplat.rendering
    import gsplat.strategy.ops

    gsplat.rasterization = gsplat.rendering.rasterization = rasterization_of_installed()
    gsplat.relocation.compute_relocation = gsplat.strategy.ops.compute_relocation = compute_relocation
    gsplat.quat_scale_to_covar_preci = gsplat.strategy.ops.quat_scale_to_covar_preci = quat_scale_to_covar_preci
    if hasattr(gsplat.strategy.ops, _TORCH_FLAG):
        setattr(gsplat.strategy.ops, _TORCH_FLAG, True)


def rasterization_of_installed() -> Callable[..., Any]:
    """`rasterization`, with the `meta` that the strategies of the installed gsplat read."""
    import gsplat

    version = tuple(int(number) for number in gsplat.__version__.split(".")[:2])
    return rasterization if version >= (1, 5) else _with_one_radius


@functools.wraps(rasterization)
def _with_one_radius(*args: Any, **kwargs: Any) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    images, alphas, meta = rasterization(*args, **kwargs)
    return images, alphas, meta | {"radii": meta["radii"].amax(-1)}
