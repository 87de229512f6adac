"""What cameras look at: the point nearest to their optical axes."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .camera import View

CONVERGING = 0.05  # share of the views' directions across a common line, below which they do not converge
IN_FRONT = 0.75  # share of the views that must have what they converge on in front of them


def focus(views: Sequence[View]) -> Tensor | None:
    """(3,) the point nearest to the optical axes of the views, world units; None where they do not converge on one.

    That is where a capture of an object has it. Cameras that look the same way, or outwards, converge on nothing.
    """
    directions = torch.stack([view.w2c[2, :3] for view in views])
    places = torch.stack([position(view) for view in views])
    if torch.linalg.eigvalsh(_across(directions).mean(0))[0] < CONVERGING:
        return None
    point = nearest_to_lines(places, directions)
    in_front = ((point - places) * directions).sum(1) > 0
    return point if in_front.double().mean() >= IN_FRONT else None


def nearest_to_lines(points: Tensor, directions: Tensor) -> Tensor:
    """(3,) the point with the least sum of squared distances from lines; of several the one nearest to the mean point.

    Args:
        points: (N, 3) float64, a point of every line.
        directions: (N, 3) float64 unit vectors.
    """
    mean = points.mean(0)  # taken off, so that little is rounded far from zero
    across = _across(directions)
    found = torch.linalg.lstsq(across.sum(0), (across @ (points - mean)[:, :, None]).sum(0)).solution[:, 0]
    return found + mean


def _across(directions: Tensor) -> Tensor:
    """(N, 3, 3) projections across unit vectors (N, 3): |across (x - point)| is the distance of x from a line."""
    return torch.eye(3, dtype=directions.dtype, device="cpu") - directions[:, :, None] * directions[:, None, :]


def position(view: View) -> Tensor:
    """(3,) where the camera is, world units."""
    return -view.w2c[:3, :3].T @ view.w2c[:3, 3]
