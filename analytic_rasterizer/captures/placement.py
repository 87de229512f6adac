"""The position of a capture in the world: the offset of its coordinates, the region that its cameras look at, and
random points to start from."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .. import io
from ..cameras.focus import nearest_to_lines
from .evidence import single_threaded
from .extent import ROUNDING, places_of

# Of the distance from zero over the size of a capture. Below, float32 holds positions to 4e-6 of the size, and the
# smallest steps of a training still move them.
FARTHEST = 64
ROUNDNESS = 20  # of an offset: it is a multiple of a power of ten that is at least so many times smaller than the size
NEAREST_DEPTH, FARTHEST_DEPTH = 0.25, 4.0  # of random points, in depths of the focus
DEPTHS = 12  # of a ray, among which that of a random point is drawn
MOST_RAYS, MOST_LOOKS = 20_000, 25  # of which depths are weighed; views that are asked whether they count a point
BEYOND = 0.25  # weight of a depth beyond the focus, where the most is 1
HULL = 4  # power of the share of the views of a point that count it
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

    float32, drawn by `seed`, on the CPU. Random colours, of which nothing is known, would only have to be unlearned.
    """
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(count, 3, generator=generator, dtype=torch.float32, device="cpu")
    return HALF_EDGE * (2 * uniform - 1), torch.full_like(uniform, 0.5)


@single_threaded()
def points_in_view(
    views: list[io.View], count: int, seed: int, masks: list[Tensor | None] | None = None
) -> tuple[Tensor, Tensor]:
    """Random positions (count, 3) about what the cameras look at, float32, and grey, (count, 3) of colours in [0, 1].

    Each is on the ray of a random pixel of a random view that counts. Its depth is between NEAREST_DEPTH and
    FARTHEST_DEPTH times that of the focus, in one of DEPTHS parts that are even in the logarithm. A part is drawn with
    a weight: the square of how many photographs count what is there, of the most along the ray, so that few points are
    just before a camera, where one photograph alone would learn them. What is beyond the focus has BEYOND more, for a
    background. And all is less where photographs look and do not count: with masks, outside of the visual hull.

    Args:
        masks: (H, W) bool of each view, of any size, where its pixels count; None: everywhere.
    """
    masks = masks or [None] * len(views)
    _, depth = focus_of(views)
    generator = torch.Generator().manual_seed(seed)
    rays = max(min(count, MOST_RAYS), 1)
    chosen = torch.randint(len(views), (rays,), generator=generator, device="cpu")
    origins = torch.empty(rays, 3, dtype=torch.float64, device="cpu")
    directions = torch.empty_like(origins)  # of which the depth is 1
    for i in chosen.unique().tolist():
        of_view = chosen == i
        found = views[i].rays_of(_counted_pixels(views[i], masks[i], int(of_view.sum()), generator))
        found = found / views[i].depths_of(found)[:, None]
        # Where a lens shows nothing, a point is ahead.
        found = torch.where(found.isfinite().all(1, keepdim=True), found, found.new_tensor([0.0, 0.0, 1.0]))
        c2w = torch.linalg.inv(views[i].w2c.double())
        origins[of_view], directions[of_view] = c2w[:3, 3], found @ c2w[:3, :3].T

    def along(parts: Tensor) -> Tensor:  # (rays, P) of [0, DEPTHS] to (rays, P, 3)
        z = depth * NEAREST_DEPTH * (FARTHEST_DEPTH / NEAREST_DEPTH) ** (parts / DEPTHS)
        return origins[:, None] + z[:, :, None] * directions[:, None]

    middles = torch.arange(DEPTHS, dtype=torch.float64, device="cpu") + 0.5
    places = along(middles.expand(rays, -1)).flatten(0, 1)
    looks = range(0, len(views), -(-len(views) // MOST_LOOKS))
    shown, counted = (sum(each) for each in zip(*(_looks(views[i], masks[i], places) for i in looks)))
    shown, counted = (each.view(rays, DEPTHS).double() for each in (shown, counted))
    weights = (counted / counted.amax(1, keepdim=True).clamp_min(1)) ** 2 + BEYOND * (middles >= DEPTHS / 2)
    weights *= (counted / shown.clamp_min(1)) ** HULL
    weights[(weights == 0).all(1)] = 1.0
    parts = torch.multinomial(weights, -(-count // rays), replacement=True, generator=generator)
    parts = parts + torch.rand(parts.shape, generator=generator, dtype=torch.float64, device="cpu")
    points = along(parts).flatten(0, 1)[:count]
    return points.float(), torch.full((count, 3), 0.5, dtype=torch.float32, device="cpu")


def _counted_pixels(view: io.View, mask: Tensor | None, count: int, generator: torch.Generator) -> Tensor:
    """Random pixels (count, 2) of a view, where its mask lets some count."""
    uniform = torch.rand(count, 2, generator=generator, dtype=torch.float64, device="cpu")
    if mask is not None and mask.any():
        cells = mask.nonzero()
        cells = cells[torch.randint(len(cells), (count,), generator=generator, device="cpu")].flip(1)
        uniform = (cells + uniform) / uniform.new_tensor(mask.shape[::-1])
    return uniform * uniform.new_tensor([view.width, view.height])


def _looks(view: io.View, mask: Tensor | None, points: Tensor) -> tuple[Tensor, Tensor]:
    """(N,) bool: whether a view shows points (N, 3), and whether it counts there."""
    w2c = view.w2c.double()
    share = view.pixels_of(points @ w2c[:3, :3].T + w2c[:3, 3]) / points.new_tensor([view.width, view.height])
    inside = ((share >= 0) & (share < 1)).all(1)
    if mask is None:
        return inside, inside
    height, width = mask.shape
    column, row = (share.nan_to_num().clamp(0, 1) * share.new_tensor([width, height])).long().unbind(1)
    return inside, inside & mask[row.clamp_max(height - 1), column.clamp_max(width - 1)]


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
