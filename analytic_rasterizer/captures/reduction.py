"""Coarse pictures of photographs, their masks and their depths."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from ..checks import check_value
from ..declared import Range

LEAST_SHARE = 1 / 512  # of a pixel that counts: less rounds to none

SCALES = Range(
    lambda scales: len(scales) > 0 and all(scale >= 1 and scale % 1 == 0 for scale in scales),
    "whole numbers of at least 1",
)


def check_scales(scales: tuple[int, ...]) -> None:
    """Raises ValueError unless there are scales, all of them whole numbers of at least 1."""
    check_value("scales", SCALES.fits(scales), SCALES.expected, scales)


def reduce(
    rgba: Tensor,
    scale: int,
    background: tuple[float, float, float] | None,
    downsampling: str = "box",
    mask: Tensor | None = None,
) -> tuple[Tensor, Tensor | None]:
    """(3, H, W) uint8 on the background, or without one (4, H, W) premultiplied with alpha; and (H, W) of the mask.

    Averaged are the stored values, over squares of pixels or with `downsampling` "bicubic" with a cubic kernel
    (a = -0.5) of 4 scales' width, as Pillow does. Colours count by their alpha. With "blender" they do not: straight
    colours and alpha are averaged apart and then composited, as the files of the multi-scale Blender set were made.
    With a mask (H, W) the mean is that of what counts, by its share; where nothing counts the result is black.
    """
    if scale == 1 and mask is None and bool((rgba[:, :, 3] == 255).all()):
        # Most photographs: what follows would give the same.
        return rgba[:, :, : 4 if background is None else 3].permute(2, 0, 1).contiguous(), None
    full = rgba.permute(2, 0, 1).float() / 255
    if downsampling != "blender":
        full[:3] *= full[3:]
    share = None
    if mask is not None:
        share = mask.float()[None] / 255
        full = full * share
    full = _reduced(full, scale, downsampling)
    if share is not None:
        share = _reduced(share, scale, downsampling)
        counts = share > LEAST_SHARE
        full, share = torch.where(counts, full / share, 0), torch.where(counts, share.clamp_max(1), 0)
    if downsampling == "bicubic" and scale > 1:  # the kernel overshoots, and not in all channels alike
        full = full.clamp(0, 1)
        full[:3] = torch.minimum(full[:3], full[3:])
    color, alpha = full.split([3, 1])
    if downsampling == "blender":
        color = color * alpha
    if background is None:
        color = torch.cat([color, alpha])
    else:
        color = color + color.new_tensor(background)[:, None, None] * (1 - alpha)
    if share is None:
        return _levels(color), None
    return _levels(torch.where(share > 0, color, 0)), _levels(share)[0]


def _reduced(planes: Tensor, scale: int, downsampling: str) -> Tensor:
    if downsampling == "bicubic" and scale > 1:
        size = planes.shape[1] // scale, planes.shape[2] // scale
        return functional.interpolate(planes[None], size, mode="bicubic", antialias=True)[0]
    return functional.avg_pool2d(planes, scale) if scale > 1 else planes


def _levels(planes: Tensor) -> Tensor:
    return (255 * planes).round().to(torch.uint8)


def reduced_depths(planes: Tensor, scale: int, mask: Tensor | None) -> Tensor:
    """(2, H, W) float16 of inverse depths and how much each pixel counts, at a scale: means of what counts.

    Args:
        planes: (2, h, w) float32, inverse depths times the share that counts, and this share.
        mask: (h, w) uint8 of the picture; None: all of it counts.
    """
    planes = planes if mask is None else planes * (mask.float() / 255)
    weighted, shares = functional.avg_pool2d(planes, scale) if scale > 1 else planes
    counts = shares > LEAST_SHARE
    return torch.stack([torch.where(counts, weighted / shares, 0), torch.where(counts, shares, 0)]).half()
