"""The pictures of a capture at several scales, on the device or waiting for it."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from .. import io
from ..io.common import opened_picture
from ..settings import GaussianRasterizationSettings
from .captures import Photograph
from .options import check_scales


class Pictures(NamedTuple):
    """Views and their pictures, on the device or colours on its host. By scale: 2 is half the size."""

    views: list[io.View]  # at scale 1
    settings: dict[int, list[GaussianRasterizationSettings]]  # made once: they hold tensors
    colors: dict[int, list[Tensor]]  # (3, H, W) uint8, on the background; or (4, H, W) premultiplied, with alpha

    def truth(self, scale: int, view: int, background: Tensor | None = None) -> Tensor:
        """(3, H, W) float32 in [0, 1] on the device; `background` (3,) is for pictures with alpha."""
        color = self._color(scale, view).float() / 255
        return color if background is None else color[:3] + (1 - color[3:]) * background[:, None, None]

    def target(self, scale: int, view: int, background: Tensor | None = None) -> Tensor:
        """`truth` as `l1_ssim` takes it: where there is no `background`, (3, H, W) uint8 as stored."""
        return self._color(scale, view) if background is None else self.truth(scale, view, background)

    def _color(self, scale: int, view: int) -> Tensor:
        return self.colors[scale][view].to(self.settings[scale][view].viewmatrix.device, non_blocking=True)

    def resolve(self, **options) -> dict[int, list[GaussianRasterizationSettings]]:
        """The settings with other options, such as `footprint` and `sh_degree`."""
        return {scale: [s._replace(**options) for s in of_scale] for scale, of_scale in self.settings.items()}


def load_pictures(
    items: list[Photograph],
    scales: tuple[int, ...],
    background: tuple[float, float, float] | None,
    device: str | torch.device,
    downsampling: str = "box",
    on_host: bool = False,
) -> Pictures:
    """Reads photographs and reduces them.

    A picture is cut about its centre so that all scales see the same, and where it is not of the size that its view
    states, the view is scaled.

    Args:
        background: Behind pictures with alpha, 0 to 1; None: keep alpha.
        downsampling: As in `TrainingOptions`.
        on_host: Keep colours in pinned memory of the host, from where each comes when it is asked for.

    Raises:
        io.SceneError: A picture that cannot be read, holds numbers that are not finite, or is too small for the scales.
        ValueError: Scales that are not whole numbers of at least 1.
    """
    check_scales(scales)
    pictures = Pictures([], {scale: [] for scale in scales}, {scale: [] for scale in scales})
    with ThreadPoolExecutor() as pool:
        for item, (view, files) in zip(items, pool.map(lambda item: read_photograph(item, scales), items)):
            pictures.views.append(view)
            for scale in scales:
                stored = scale if scale in item.files else 1
                color = reduce(files[stored].to(device), scale // stored, background, downsampling)
                pictures.colors[scale].append(color.cpu().pin_memory() if on_host and color.is_cuda else color)
                # In fractions: the cut makes both sizes multiples of the scale.
                behind = (0.0, 0.0, 0.0) if background is None else background
                pictures.settings[scale].append(view.settings(1 / scale, behind, device=device))
    return pictures


def read_photograph(item: Photograph, scales: tuple[int, ...]) -> tuple[io.View, dict[int, Tensor]]:
    """The view at scale 1, and what is stored at every scale that is needed, (H, W, 4) uint8 of straight alpha."""
    view, rgba = cut(item.files[1], item.view, math.lcm(*scales))
    files = {1: rgba}
    for scale in scales:
        if scale in item.files and scale != 1:
            files[scale] = read_picture(item.files[scale])
            size = (view.height // scale, view.width // scale)
            if files[scale].shape[:2] != size:
                raise io.SceneError(f"{item.files[scale]}: expected {size[1]} x {size[0]} px")
    return view, files


def read_picture(path: Path) -> Tensor:
    """(H, W, 4) uint8 of straight alpha. Raises io.SceneError."""
    with opened_picture(path, "train") as opened:
        if opened.mode != "F" and not opened.mode.startswith("I"):
            return torch.from_numpy(np.array(opened.convert("RGBA")))
        numbers = np.array(opened).astype(np.float64)
        peak = 1 if opened.mode == "F" else 65535
    if not np.isfinite(numbers).all():
        y, x = np.argwhere(~np.isfinite(numbers))[0]
        raise io.SceneError(f"{path}: pixels must be finite, got {numbers[y, x]} at x {x}, y {y}")
    grey = (255 * (numbers / peak).clip(0, 1)).round().astype(np.uint8)
    return torch.from_numpy(np.stack([grey, grey, grey, np.full_like(grey, 255)], 2))


def cut(path: Path, view: io.View, multiple: int) -> tuple[io.View, Tensor]:
    """The picture (H, W, 4), and its view, both cut about the centre to multiples of `multiple` px.

    The principal point moves along. Where the picture is not of the size that the view states, the view is scaled.

    Raises io.SceneError for pictures that are too small, or that were turned by a quarter after their camera was found.
    """
    rgba = read_picture(path)
    height, width = rgba.shape[:2]
    full = view.width, view.height
    if not _is_reduced(width, height, *full) and _is_reduced(height, width, *full):
        raise io.SceneError(
            f"{path}: expected the orientation of its camera, {view.width} x {view.height} px, got {width} x {height}"
        )
    x, y = width / view.width, height / view.height
    cx = x * (view.width / 2 if view.cx is None else view.cx)
    cy = y * (view.height / 2 if view.cy is None else view.cy)
    left, top = width % multiple // 2, height % multiple // 2
    size = (width - width % multiple, height - height % multiple)
    if not all(size):
        raise io.SceneError(f"{path}: {width} x {height} px are too few for these scales")
    view = replace(view, width=size[0], height=size[1], fx=x * view.fx, fy=y * view.fy, cx=cx - left, cy=cy - top)
    return view, rgba[top : top + size[1], left : left + size[0]]


def _is_reduced(width: int, height: int, full_width: int, full_height: int) -> bool:
    """Whether a picture can be another with so many pixels at another scale, both sides rounded up or down."""
    lowest = max((width - 1) / full_width, (height - 1) / full_height)
    return lowest < min((width + 1) / full_width, (height + 1) / full_height)


def reduce(
    rgba: Tensor, scale: int, background: tuple[float, float, float] | None, downsampling: str = "box"
) -> Tensor:
    """(3, H, W) uint8 on the background, or without one (4, H, W) premultiplied with alpha.

    As in the multi-scale Blender set the stored straight RGBA values are averaged over squares of pixels and then
    composited; `bicubic` weights them with a cubic kernel (a = -0.5) of 4 scales' width instead, as Pillow does.
    """
    full = rgba.permute(2, 0, 1).float() / 255
    if downsampling == "bicubic" and scale > 1:
        size = full.shape[1] // scale, full.shape[2] // scale
        full = functional.interpolate(full[None], size, mode="bicubic", antialias=True)[0].clamp(0, 1)
    else:
        full = functional.avg_pool2d(full, scale)
    color, alpha = full.split([3, 1])
    if background is None:
        return (255 * torch.cat([color * alpha, alpha])).round().to(torch.uint8)
    behind = color.new_tensor(background)[:, None, None]
    return (255 * (color * alpha + behind * (1 - alpha))).round().to(torch.uint8)
