"""The position of a capture in the world: the offset of its coordinates, and the region that its cameras look at."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .. import io
from .extent import ROUNDING, places_of

# Of the distance from zero over the size of a capture. Below, float32 holds positions to 4e-6 of the size, and the
# smallest steps of a training still move them.
FARTHEST = 64
NEAREST_DEPTH, FARTHEST_DEPTH = 0.25, 4.0  # of random points, in depths of the focus
# Depths of a focus, in distances of the cameras from their mean: the largest, and the one of cameras without a focus.
FARTHEST_FOCUS, DEPTH_WITHOUT_FOCUS = 100, 10


def offset_of(views: list[io.View], points: Tensor | None) -> tuple[float, float, float] | None:
    """What to take off all positions so that float32 holds them well; None where it does as they are.

    It is round: a multiple of a power of ten that is about the size of the capture. Medians, so that a few cameras or
    points that are far off have no say.

    Args:
        points: (P, 3) float64, of what the cameras see.
    """
    centers = places_of(views)
    middle = centers.median(dim=0).values
    known = [centers] if points is None else [centers, points.double()]
    size = max((positions - middle).norm(dim=1).median().item() for positions in known) or 1.0
    if middle.norm().item() <= FARTHEST * size:
        return None
    step = 10.0 ** math.ceil(math.log10(size))
    return tuple(round(number / step) * step + 0.0 for number in middle.tolist())


def points_in_view(views: list[io.View], count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Random positions (count, 3) in front of the cameras, float32, and grey, (count, 3) of colours in [0, 1].

    Each is in a random pixel of a random view. Its depth is between NEAREST_DEPTH and FARTHEST_DEPTH times
    `depth_of_focus`, uniform in its logarithm.
    """
    c2w = torch.linalg.inv(torch.stack([view.w2c for view in views]))
    depth = depth_of_focus(c2w[:, :3, 3], c2w[:, :3, 2])
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(count, 3, generator=generator, dtype=torch.float64, device="cpu")
    chosen = torch.randint(len(views), (count,), generator=generator, device="cpu")
    z = depth * NEAREST_DEPTH * (FARTHEST_DEPTH / NEAREST_DEPTH) ** uniform[:, 2]
    middles = [(v.width / 2 if v.cx is None else v.cx, v.height / 2 if v.cy is None else v.cy) for v in views]
    size, middle, focal = (
        torch.tensor(rows, dtype=torch.float64, device="cpu")[chosen]
        for rows in ([(v.width, v.height) for v in views], middles, [(v.fx, v.fy) for v in views])
    )
    xy = (uniform[:, :2] * size - middle) / focal * z[:, None]
    in_camera = torch.cat([xy, z[:, None], torch.ones_like(z[:, None])], 1)
    points = (c2w[chosen] @ in_camera[:, :, None])[:, :3, 0]
    return points.float(), torch.full((count, 3), 0.5, dtype=torch.float32, device="cpu")


def depth_of_focus(centers: Tensor, axes: Tensor) -> float:
    """The median depth of the focus, the point nearest to all optical axes, in front of the cameras. World units.

    Cameras whose axes are parallel, or meet behind them, have no focus. For them the depth is DEPTH_WITHOUT_FOCUS times
    the distance of the cameras from their mean. For cameras at one position it is 1: they see no depth.

    Args:
        centers, axes: (N, 3) float64, of unit length.
    """
    spread = (centers - centers.mean(0)).norm(dim=1).median().item()
    if spread <= ROUNDING * centers.abs().max().item():
        return 1.0
    # The distance of x from an axis is |across (x - center)|.
    across = torch.eye(3, dtype=axes.dtype, device="cpu") - axes[:, :, None] * axes[:, None, :]
    focus = torch.linalg.lstsq(across.sum(0), (across @ centers[:, :, None]).sum(0)).solution[:, 0]
    depth = ((focus - centers) * axes).sum(1).median().item()
    return depth if spread / 2 < depth < FARTHEST_FOCUS * spread else DEPTH_WITHOUT_FOCUS * spread
