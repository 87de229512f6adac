"""The 3D smoothing filter of Mip-Splatting: no Gaussian finer than the pictures it was trained on could show.

Source: Yu et al., Mip-Splatting: Alias-free 3D Gaussian Splatting, CVPR 2024, Eq. 6-9.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from .effects import Effects
from .outputs import depths

VARIANCE = 0.2  # of the filter, in squares of the finest sampling interval
MARGIN = 0.15  # of the image around it in which a Gaussian still counts as seen


@torch.no_grad()
def compute_3d_filter(means3D: torch.Tensor, cameras: Sequence[Any], variance: float = VARIANCE) -> torch.Tensor:
    """Standard deviation of every Gaussian's filter, from the camera that samples it most finely.

    A camera samples a point at depth z once every z / focal length world units, an orthographic one every
    1 / focal length. A point takes the smallest interval among the cameras that see it, with a margin around the
    image. A point that no camera sees takes the largest interval of all other points.

    Args:
        means3D: (P, 3) centres, world units.
        cameras: `GaussianRasterizationSettings` of the training views, at least one. Size, field of view, matrices and
            the near and far planes of the effects are read.
        variance: Of the filter, in squares of the sampling interval.

    Returns:
        (P,) world units, of the dtype and device of means3D.

    Raises:
        ValueError: No cameras, or means3D has a wrong shape.
    """
    if means3D.dim() != 2 or means3D.shape[1] != 3:
        raise ValueError(f"means3D must have shape (P, 3), got {tuple(means3D.shape)}")
    if not cameras:
        raise ValueError("cameras must hold the settings of at least one view, got none")
    interval = means3D.new_full((len(means3D),), torch.inf)
    for camera in cameras:
        interval = torch.minimum(interval, sampling_interval(means3D, camera))
    seen = interval.isfinite()
    largest = interval[seen].max() if seen.any() else interval.new_zeros(())
    return torch.where(seen, interval, largest) * math.sqrt(variance)


def sampling_interval(means3D: torch.Tensor, camera: Any) -> torch.Tensor:
    """(P,) world units between samples, z / focal length; infinite for a point that the camera does not see.

    `camera` is a `GaussianRasterizationSettings`.
    """
    effects = camera.effects if isinstance(camera.effects, Effects) else Effects()
    clip = camera.projmatrix.reshape(4, 4).to(means3D)
    z = depths(means3D, camera.viewmatrix.to(means3D))
    projected = means3D @ clip[:3] + clip[3]
    inside = (projected[:, :2].abs() <= (1 + 2 * MARGIN) * projected[:, 3:].abs()).all(1)
    # The finer of the two axes.
    focal = max(camera.image_width / camera.tanfovx, camera.image_height / camera.tanfovy) / 2
    inside &= (z > effects.near) & (z < effects.far)
    return torch.where(inside, (torch.ones_like(z) if effects.orthographic else z) / focal, torch.inf)


def apply_3d_filter(
    scales: torch.Tensor, opacities: torch.Tensor, filter_3d: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Scales and opacities of Gaussians convolved with their filters. Differentiable.

    The covariance gains filter_3d^2 along every axis; the opacity falls with the peak, so that the mass of a Gaussian
    stays what it was.

    Args:
        scales: (P, 3) standard deviations, world units.
        opacities: (P, 1) or (P,).
        filter_3d: (P,) world units, from `compute_3d_filter`.

    Returns:
        (scales, opacities) of the same shapes.

    Raises:
        ValueError: The shapes do not fit.
    """
    if scales.dim() != 2 or scales.shape[1] != 3 or filter_3d.shape != scales.shape[:1]:
        raise ValueError(
            f"scales must have shape (P, 3) and filter_3d (P,), got {tuple(scales.shape)} and {tuple(filter_3d.shape)}"
        )
    if opacities.numel() != len(scales):
        raise ValueError(f"opacities must have shape (P, 1) or (P,), got {tuple(opacities.shape)}")
    # hypot neither overflows nor loses small scales, and its gradient is finite unless both arguments are 0.
    width = filter_3d[:, None].expand_as(scales)
    filtered = torch.where(width > 0, torch.hypot(scales, torch.where(width > 0, width, 1)), scales)
    share = torch.where(width > 0, scales / torch.where(width > 0, filtered, 1), 1).prod(1)
    return filtered, opacities * share.reshape(opacities.shape)
