"""The position of a capture in the world: the offset of its coordinates, the region that its cameras look at, and
random points to start from."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .. import io
from ..cameras.focus import nearest_to_lines
from .extent import ROUNDING, places_of

# Of the distance from zero over the size of a capture. Below, float32 holds positions to 4e-6 of the size, and the
# smallest steps of a training still move them.
FARTHEST = 64
ROUNDNESS = 20  # of an offset: it is a multiple of a power of ten that is at least so many times smaller than the size
NEAREST_DEPTH, FARTHEST_DEPTH = 0.25, 4.0  # of random points, in depths of the focus
# Depths of a focus, in distances of the cameras from their mean: the largest, and the one of cameras without a focus.
FARTHEST_FOCUS, DEPTH_WITHOUT_FOCUS = 100, 10
HALF_EDGE = 1.3  # of the cube of random points; NeRF-synthetic objects fit in it


def offset_of(views: list[io.View], points: Tensor | None) -> tuple[float, float, float] | None:
    """What to take off all positions so that float32 holds them well; None where it does as they are.

    It is the focus of the cameras if they have one near them, otherwise their middle, rounded. The size of the capture
    is measured by medians, so that a few cameras or points that are far off have no say.

    Args:
        points: (P, 3) float64, of what the cameras see.
    """
    centers = places_of(views)
    middle = centers.median(dim=0).values
    known = [centers] if points is None else [centers, points.double()]
    size = max((positions - middle).norm(dim=1).median().item() for positions in known)
    if size <= ROUNDING * middle.abs().max().item():
        size = 1.0
    if middle.norm().item() <= FARTHEST * size:
        return None
    focus, _ = focus_of(views)
    if focus is not None and (focus - middle).norm().item() <= 2 * size:
        middle = focus
    digits = -math.floor(math.log10(size / ROUNDNESS))
    return tuple(round(number, digits) + 0.0 for number in middle.tolist())


def random_points(count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Positions (count, 3) in the cube from -1.3 to 1.3, where NeRF-synthetic scenes are, and grey, (count, 3) of 0.5.

    Drawn by `seed`, on the CPU. Random colours, of which nothing is known, would only have to be unlearned.
    """
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(count, 3, generator=generator, dtype=torch.float32, device="cpu")
    return HALF_EDGE * (2 * uniform - 1), torch.full_like(uniform, 0.5)


def points_in_view(views: list[io.View], count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Random positions (count, 3) in front of the cameras, float32, and grey, (count, 3) of colours in [0, 1].

    Each is in a random pixel of a random view. Its depth is between NEAREST_DEPTH and FARTHEST_DEPTH times that of the
    focus, uniform in its logarithm.
    """
    _, depth = focus_of(views)
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(count, 3, generator=generator, dtype=torch.float64, device="cpu")
    chosen = torch.randint(len(views), (count,), generator=generator, device="cpu")
    z = depth * NEAREST_DEPTH * (FARTHEST_DEPTH / NEAREST_DEPTH) ** uniform[:, 2]
    size = torch.tensor([(v.width, v.height) for v in views], dtype=torch.float64, device="cpu")[chosen]
    pixels, positions = uniform[:, :2] * size, torch.empty_like(uniform)
    for i in chosen.unique().tolist():
        of_view = chosen == i
        rays = views[i].rays_of(pixels[of_view])
        positions[of_view] = rays * (z[of_view] / views[i].depths_of(rays))[:, None]
    # Where a lens shows nothing, a point is ahead.
    positions = torch.where(positions.isfinite(), positions, torch.stack([0 * z, 0 * z, z], 1))
    in_camera = torch.cat([positions, torch.ones_like(z[:, None])], 1)
    c2w = torch.linalg.inv(torch.stack([view.w2c for view in views]))
    points = (c2w[chosen] @ in_camera[:, :, None])[:, :3, 0]
    return points.float(), torch.full((count, 3), 0.5, dtype=torch.float32, device="cpu")


def focus_of(views: list[io.View]) -> tuple[Tensor | None, float]:
    """The focus of the cameras, the point nearest to all optical axes, (3,) float64; and its median depth, world units.

    Cameras whose axes are parallel, or meet behind them, have no focus: None. For them the depth is DEPTH_WITHOUT_FOCUS
    times the distance of the cameras from their mean. For cameras at one position it is 1: they see no depth.
    """
    c2w = torch.linalg.inv(torch.stack([view.w2c for view in views]))
    mean = c2w[:, :3, 3].mean(0)
    centers, axes = c2w[:, :3, 3] - mean, c2w[:, :3, 2]
    spread = centers.norm(dim=1).median().item()
    if spread <= ROUNDING * (1 + mean.abs().max().item()):
        return None, 1.0
    focus = nearest_to_lines(centers, axes)
    depth = ((focus - centers) * axes).sum(1).median().item()
    if not spread / 2 < depth < FARTHEST_FOCUS * spread:
        return None, DEPTH_WITHOUT_FOCUS * spread
    return focus + mean, depth
