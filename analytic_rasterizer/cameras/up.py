"""The direction that is up in the world, by the cameras that took pictures of it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .camera import View

SPREAD = 0.02  # variance of the horizontal edges' directions in their plane, below which they have one direction
LEVEL = 0.1  # their variance out of this plane, in that in it, up to which cameras were held level


def mean_up(views: Sequence[View]) -> Tensor:
    """(3,) unit vector: the mean direction that is up in the pictures; that of the first where they cancel."""
    ups = -torch.stack([view.w2c[1, :3] for view in views])
    mean = ups.mean(0)
    return torch.nn.functional.normalize(mean if mean.norm() > 0.1 else ups[0], dim=0)


def level_up(views: Sequence[View]) -> Tensor:
    """(3,) unit vector that is up in the world, if photographers held their cameras level.

    It is the direction across the horizontal edges of all pictures. Where all pictures were taken in one direction, or
    cameras were turned, it is the mean of what is up in the pictures.
    """
    up = mean_up(views)
    edges = torch.stack([view.w2c[0, :3] for view in views])
    values, vectors = torch.linalg.eigh(edges.T @ edges / len(views))
    if values[1] > SPREAD and values[0] < LEVEL * values[1]:
        up = vectors[:, 0] * torch.where(vectors[:, 0] @ up < 0, -1, 1)
    return torch.nn.functional.normalize(up, dim=0)
