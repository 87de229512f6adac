"""The size of a capture: what the learning rate of the means and the limits of size are measured in.

Also cameras that are too far away to be right. [3DGS] takes the radius of the cameras for the size. That fits cameras
around an object, which are as far from each other as from what they see. Those of a tripod are all at one place, and a
camera with a wrong pose may be anywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from ..cameras.camera import View
from ..cameras.lens import Lens

RADIUS_FACTOR = 1.1  # [3DGS]
SEEN_SHARE = 0.5  # of the distance of what cameras see: the least extent
OUTLYING = 10  # times as far from the middle as every other camera
MOST_OUTLIERS = 5  # at most one in so many cameras is an outlier
MOST_VIEWS, MOST_POINTS = 64, 2048  # of which a median is taken
GRID = 33  # points along each side of a picture, at which its lens is looked at
ROUNDING = 1e-9  # of coordinates: cameras no further apart are at one place


def extent_of(views: Sequence[View], points: Tensor | None = None) -> float:
    """The extent of a capture, world units: 1.1 times the largest distance of a camera from the mean of all [3DGS], or
    half the distance of what the cameras see, if that is more.

    Args:
        views: The cameras. Outliers count: see `outliers_of`.
        points: (P, 3) on the CPU, where there is something to see; None: only the cameras count.

    Returns:
        More than 0: cameras at one place that see nothing have the extent 1.
    """
    places = places_of(views)
    radius = RADIUS_FACTOR * (places - places.mean(0)).norm(dim=1).max().item()
    seen = 0.0 if points is None else seen_distance(views, points)
    return max(radius, SEEN_SHARE * seen) or 1.0


def seen_distance(views: Sequence[View], points: Tensor) -> float:
    """The distance from a camera to the points that it shows: the median over points, then over cameras. World units.

    Of many points and cameras a part is looked at. 0 where no camera shows a point.
    """
    views = views[:: -(-len(views) // MOST_VIEWS)]
    points = points.detach()[:: max(-(-len(points) // MOST_POINTS), 1)].double()
    w2c = torch.stack([view.w2c for view in views]).double()
    distances = []
    for view, seen in zip(views, points @ w2c[:, :3, :3].mT + w2c[:, None, :3, 3]):
        column, row = view.pixels_of(seen).unbind(1)
        shown = (column >= 0) & (column < view.width) & (row >= 0) & (row < view.height)
        if shown.any():
            distances.append(seen[shown].norm(dim=1).median())
    return torch.stack(distances).median().item() if distances else 0.0


def outliers_of(views: Sequence[View], points: Tensor | None = None) -> dict[int, float]:
    """Cameras so far from all others that their poses must be wrong: places in `views`, and distances in world units.

    The distance is that from the middle, the median of all cameras. An outlier is OUTLYING times as far from it as
    every camera that is none, and as what the cameras see. At most a fifth of the cameras are outliers, but one may
    always be among three; where there are points, and the far cameras show none of them, fewer than half are.

    Args:
        points: As of `extent_of`.
    """
    if len(views) < 3:
        return {}
    places = places_of(views)
    middle = places.median(0).values
    distances, order = (places - middle).norm(dim=1).sort()
    # The reach of the cameras that are certainly none, then that of each one more.
    few = len(views) - max(len(views) // MOST_OUTLIERS, 1)
    first = few if points is None else min(few, len(views) // 2 + 1)
    least = max(0.0 if points is None else seen_distance(views, points), ROUNDING * middle.abs().max().item())
    for i in range(first, len(views)):
        if distances[i] > OUTLYING * max(distances[i - 1].item(), least):
            far = order[i:].tolist()
            if i >= few or all(seen_distance([views[view]], points) == 0 for view in far):
                return dict(zip(far, distances[i:].tolist()))
    return {}


@lru_cache(maxsize=64)
def _shown_share(lens: Lens, width: int, height: int, fx: float, fy: float, middle: tuple[float, float]) -> float:
    view = View("", width, height, fx, fy, torch.eye(4, dtype=torch.float64, device="cpu"), *middle, lens=lens)
    x, y = (size * (torch.arange(GRID, dtype=torch.float64, device="cpu") + 0.5) / GRID for size in (width, height))
    return view.rays_of(torch.cartesian_prod(x, y)).isfinite().all(1).double().mean().item()


def shown_share(view: View) -> float:
    """The share of a picture's pixels that show something: less than 1 where a lens folds back inside it."""
    if view.lens is None:
        return 1.0
    return _shown_share(view.lens, view.width, view.height, view.fx, view.fy, view.middle)


def is_one_pose(views: Sequence[View]) -> bool:
    """Whether all cameras are at one place and look in one direction, so that there is one view of the scene."""
    w2c = torch.stack([view.w2c for view in views]).double()
    places = places_of(views)
    apart = (places - places[0]).abs().max().item()
    turned = (w2c[:, :3, :3] - w2c[0, :3, :3]).abs().max().item()
    return apart <= ROUNDING * (1 + places.abs().max().item()) and turned <= ROUNDING


def places_of(views: Sequence[View]) -> Tensor:
    """Where the cameras are, (V, 3) float64, world units."""
    return torch.stack([torch.linalg.inv(view.w2c)[:3, 3] for view in views]).double()
