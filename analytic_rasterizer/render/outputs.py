"""What is made of the results of operators: outputs by their names, images before a background, mean depths."""

from __future__ import annotations

from typing import Any

import torch

from ..checks import check_finite
from .autocast import widened
from .effects import Effects, GaussianStats


def normalized(blended: torch.Tensor, alpha: torch.Tensor, smallest: float = 1e-6) -> torch.Tensor:
    """Mean of a blended output over what a pixel shows: `blended` / `alpha`, and 0 where alpha is at most `smallest`.

    Args:
        blended: (..., H, W), for example `Outputs.depth`.
        alpha: (1, H, W) of the same picture.
        smallest: Alpha up to which a pixel counts as showing nothing.

    Returns:
        (..., H, W), in the unit of `blended`. Differentiable in both.
    """
    seen = alpha > smallest
    return torch.where(seen, blended / torch.where(seen, alpha, 1), 0)


def depths(means3D: torch.Tensor, view: torch.Tensor, effects: Any = None) -> torch.Tensor:
    """Depths (P,), world units, of means3D (P, 3) under `view`, the (4, 4) viewmatrix of 3DGS (transposed).

    They are camera-space z, or with `effects` whose lens orders by it the distance from the camera.
    """
    means3D, view = widened(means3D), widened(view).reshape(4, 4)
    x, y, z = means3D.unbind(1)  # not `@`, which autocast and TF32 round

    def along(axis: int) -> torch.Tensor:
        return x * view[0, axis] + y * view[1, axis] + z * view[2, axis] + view[3, axis]

    if isinstance(effects, Effects) and effects.lens is not None and effects.lens.orders_by_distance:
        return torch.stack([along(axis) for axis in range(3)]).norm(dim=0)
    return along(2)


def split_background(
    bg: torch.Tensor, colors_precomp: torch.Tensor | None, size: tuple[int, int], debug: bool = False
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """What the operator takes as background, and the image that comes behind its result: (C,) and None, or zeros and
    (C, H, W).

    Raises:
        ValueError: `bg` is an image of another shape, or not finite. On CUDA, where looking waits for the device, it is
            looked at for `debug` only.
    """
    if bg.dim() != 3:
        return bg, None
    channels = 3 if colors_precomp is None else colors_precomp.shape[-1]
    if bg.shape != (channels, *size):
        raise ValueError(f"bg must have shape {(channels, *size)}, got {tuple(bg.shape)}")
    if (bg.device.type == "cpu" or debug) and not torch.compiler.is_compiling():
        check_finite(bg=bg)
    return bg.new_zeros(channels), bg


def before_background(color: torch.Tensor, alpha: torch.Tensor, background: torch.Tensor) -> torch.Tensor:
    """`color` (C or more, H, W) before an image (C, H, W). There is nothing behind the channels that follow, features.

    Args:
        alpha: (1, H, W).
    """
    behind = (1 - alpha) * background
    return torch.cat([color[: len(background)] + behind, color[len(background) :]])


def named_summary(effects: Effects, summary: list[torch.Tensor]) -> dict[str, Any]:
    """What an op returned as `summary`, by the outputs of `effects` that it was asked for."""
    names = [name for name in ("median_depth", "dominant_index") if getattr(effects, name)]
    outputs = dict(zip(names, summary))
    if effects.gaussian_stats:
        outputs["gaussian_stats"] = GaussianStats(*summary[len(names) :])
    return outputs
