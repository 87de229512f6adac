"""What splats carry into the images of gsplat's `rasterization`: a row per splat."""

from __future__ import annotations

from collections.abc import Callable

import torch

from ...rotations import rotation_matrices
from ...stages import Splats
from .arguments import Signal, Sizes

_AT_ONCE = 3  # channels of harmonics that `project` evaluates


def values_of_rows(splats: Splats, sizes: Sizes, signal: Signal) -> torch.Tensor:
    """(R, D) of a signal without harmonics."""
    table = splats.camera_ids.long()
    if not signal.per_camera:
        table = table // sizes.cameras
    rows = table * sizes.gaussians + splats.gaussian_ids.long()
    return signal.values.flatten(0, -2).index_select(0, rows)


def harmonics_of_rows(
    splats: Splats, sizes: Sizes, signal: Signal, projected: Callable[[torch.Tensor], Splats]
) -> torch.Tensor:
    """(R, D) of a signal of harmonics: their sum plus 1/2, which colours clamp at zero and this does not.

    It is put together from colours, so that the harmonics are those of csrc/core/sh.h: a clamped colour c has the
    value 1 minus the colour of the negated coefficients.

    Args:
        projected: What `project` makes of harmonics with three channels. Gaussians whose coefficients are not finite
            are missing there; here they get NaN.
    """
    keys = _keys(splats, sizes)
    channels = []
    for values in signal.values.split(_AT_ONCE, -1):
        count = values.shape[-1]
        values = torch.nn.functional.pad(values, (0, _AT_ONCE - count))
        above, below = projected(values), projected(-values)
        sums = torch.where(above.colors > 0, above.colors, 1 - below.colors)[:, :count]
        found, last = _keys(above, sizes), len(sums)
        places = torch.searchsorted(found, keys)
        there = torch.nn.functional.pad(found, (0, 1), value=-1)[places] == keys
        with_missing = torch.cat([sums, sums.new_full((1, count), torch.nan)])
        channels.append(with_missing.index_select(0, torch.where(there, places, last)))
    return torch.cat(channels, 1)


def _keys(splats: Splats, sizes: Sizes) -> torch.Tensor:
    """(R,) ascending, one number for each camera and Gaussian."""
    return splats.camera_ids.long() * sizes.gaussians + splats.gaussian_ids.long()


def _by_camera(splats: Splats, sizes: Sizes, of_gaussians: torch.Tensor, count: int) -> list[torch.Tensor]:
    """Rows of (..., N, D), for each of `count` cameras. A Gaussian is once in each: gradients add up in one order."""
    flat = of_gaussians.flatten(0, -3) if of_gaussians.dim() > 2 else of_gaussians[None]
    ids = splats.gaussian_ids.long().split(splats.row_splits.diff().tolist())
    return [flat[camera // sizes.cameras].index_select(0, ids[camera]) for camera in range(count)]


def depths_of_rows(
    splats: Splats, sizes: Sizes, means: torch.Tensor, viewmats: torch.Tensor, distance: bool
) -> torch.Tensor:
    """(R,) camera-space z of the means, or their distance from the camera, world units. Differentiable."""
    views = viewmats.reshape(-1, 4, 4)
    parts = []
    for view, rows in zip(views, _by_camera(splats, sizes, means, len(views))):
        axes = view[:3] if distance else view[2:3]
        of_camera = (rows[:, None] * axes[:, :3]).sum(-1) + axes[:, 3]
        parts.append(of_camera.norm(dim=1) if distance else of_camera[:, 0])
    return torch.cat(parts)


def normals_of_rows(
    splats: Splats,
    sizes: Sizes,
    means: torch.Tensor,
    quats: torch.Tensor,
    rays: Callable[[int, torch.Tensor], torch.Tensor],
) -> torch.Tensor:
    """(R, 3) third axes of the Gaussians in the world, of the two opposite ones that which faces the camera.

    Args:
        rays: By the camera and means (n, 3), directions of the rays that reach them: (n, 3) or (3,).
    """
    count = splats.cameras
    axes = rotation_matrices(quats)[..., 2]
    parts = []
    both = zip(_by_camera(splats, sizes, axes, count), _by_camera(splats, sizes, means.detach(), count))
    for camera, (normals, rows) in enumerate(both):
        away = (normals * rays(camera, rows)).sum(1, keepdim=True) > 0
        parts.append(torch.where(away, -normals, normals))
    return torch.cat(parts)
