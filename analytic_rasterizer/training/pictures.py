"""The pictures of a capture at several scales, on the device or waiting for it."""

from __future__ import annotations

import math
import os
import warnings
from collections import deque
from collections.abc import Iterator
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
from .undistortion import without_lens

ORIENTATION, UPRIGHT = 0x0112, 1  # a tag of EXIF, and its value for pictures that are as they are stored
NAMED = 3  # files in a warning


class Stored(NamedTuple):
    """The picture of a file."""

    rgba: Tensor  # (H, W, 4) uint8 of straight alpha
    orientation: int  # how the camera was held, as EXIF counts it


class Pictures(NamedTuple):
    """Views and their pictures, on the device or colours on its host. By scale: 2 is half the size.

    Attributes:
        views: At scale 1.
        settings: By scale, for every view.
        colors: By scale, for every view: (3, H, W) uint8, on the background; or (4, H, W) premultiplied, with alpha.
    """

    views: list[io.View]
    settings: dict[int, list[GaussianRasterizationSettings]]  # made once: they hold tensors
    colors: dict[int, list[Tensor]]

    def truth(self, scale: int, view: int, background: Tensor | None = None) -> Tensor:
        """The picture of a `view` at a `scale`, (3, H, W) float32 in [0, 1] on the device.

        `background` (3,) is for pictures with alpha.
        """
        color = self._color(scale, view).float() / 255
        return color if background is None else color[:3] + (1 - color[3:]) * background[:, None, None]

    def target(self, scale: int, view: int, background: Tensor | None = None) -> Tensor:
        """`truth` of `scale` and `view` as `l1_ssim` takes it: without a `background`, (3, H, W) uint8 as stored."""
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

    A picture that is to be undistorted is resampled to that of a pinhole, see `lenses.without_lens`. All pictures are
    cut about their centres, so that all scales show the same. Views are scaled to the sizes of their pictures.

    Args:
        items: What `load_capture` found.
        scales: Whole numbers, 2 for half the size.
        background: (r, g, b) in [0, 1] for pictures with alpha; None: keep alpha.
        device: Of the pictures and the settings.
        downsampling: As in `TrainingOptions`.
        on_host: Keep colours in pinned memory of the host, from where each comes when it is asked for.

    Warns of pictures that EXIF says to turn, unless their sizes show that they fit their cameras as they are stored.
    They are not turned.

    Raises:
        io.SceneError: A picture that cannot be read, holds numbers that are not finite, or is too small for the scales.
        ValueError: Scales that are not whole numbers of at least 1.
    """
    check_scales(scales)
    pictures = Pictures([], {scale: [] for scale in scales}, {scale: [] for scale in scales})
    to_turn = []
    for item, files in zip(items, _read_ahead(items, scales)):
        if not _tells_orientation(files[1], item.view):
            to_turn.append(item.files[1])
        view, rgba = fitted(files[1].rgba.to(device), item, math.lcm(*scales))
        pictures.views.append(view)
        for scale in scales:
            stored = scale if scale in item.files and scale != 1 else 1
            whole = rgba if stored == 1 else files[stored].rgba.to(device)
            if whole.shape[:2] != (view.height // stored, view.width // stored):
                raise io.SceneError(
                    f"{item.files[stored]}: expected {view.width // stored} x {view.height // stored} px"
                )
            color = reduce(whole, scale // stored, background, downsampling)
            pictures.colors[scale].append(color.cpu().pin_memory() if on_host and color.is_cuda else color)
            # In fractions: the cut makes both sizes multiples of the scale.
            behind = (0.0, 0.0, 0.0) if background is None else background
            pictures.settings[scale].append(view.settings(1 / scale, behind, device=device))
    if to_turn:
        named = ", ".join(str(path) for path in to_turn[:NAMED])
        warnings.warn(
            f"EXIF says to turn or mirror {len(to_turn)} pictures, which are used as they are stored, as COLMAP does; "
            f"cameras that were found for the turned pictures do not fit them: {named}"
            + (", .." if len(to_turn) > NAMED else ""),
            stacklevel=2,
        )
    return pictures


def _read_ahead(items: list[Photograph], scales: tuple[int, ...]) -> Iterator[dict[int, Stored]]:
    """What is stored of each photograph at every scale that is needed. Threads read some photographs ahead."""
    with ThreadPoolExecutor() as pool:
        ahead: deque = deque()
        for item in items:
            ahead.append(pool.submit(_read_files, item, scales))
            if len(ahead) > 2 * (os.cpu_count() or 1):  # more would only wait in memory
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()


def _read_files(item: Photograph, scales: tuple[int, ...]) -> dict[int, Stored]:
    return {scale: read_file(item.files[scale]) for scale in {1, *scales} if scale in item.files}


def read_file(path: Path) -> Stored:
    """A picture and its orientation. Raises io.SceneError."""
    with opened_picture(path, "train") as opened:
        if opened.mode != "F" and not opened.mode.startswith("I"):
            return Stored(torch.from_numpy(np.array(opened.convert("RGBA"))), _orientation(opened))
        numbers, orientation = np.array(opened).astype(np.float64), _orientation(opened)
        peak = 1 if opened.mode == "F" else 65535
    if not np.isfinite(numbers).all():
        y, x = np.argwhere(~np.isfinite(numbers))[0]
        raise io.SceneError(f"{path}: pixels must be finite, got {numbers[y, x]} at x {x}, y {y}")
    grey = (255 * (numbers / peak).clip(0, 1)).round().astype(np.uint8)
    return Stored(torch.from_numpy(np.stack([grey, grey, grey, np.full_like(grey, 255)], 2)), orientation)


def read_picture(path: Path) -> Tensor:
    """(H, W, 4) uint8 of straight alpha. Raises io.SceneError."""
    return read_file(path).rgba


def _orientation(opened) -> int:
    try:
        return opened.getexif().get(ORIENTATION, UPRIGHT)
    except Exception:  # whatever is wrong with EXIF, the picture is good
        return UPRIGHT


def _tells_orientation(stored: Stored, view: io.View) -> bool:
    """Whether a picture is certainly stored as its camera saw it: EXIF says so, or a quarter turn would not fit."""
    quarter_turn = stored.orientation in (5, 6, 7, 8)
    height, width = stored.rgba.shape[:2]
    other = _is_reduced(height, width, view.width, view.height)
    return stored.orientation not in range(2, 9) or (quarter_turn and not other)


def fitted(rgba: Tensor, item: Photograph, multiple: int) -> tuple[io.View, Tensor]:
    """The picture (H, W, 4) of a photograph and its view, cut about the centre to multiples of px.

    It is undistorted if that is wanted. The principal point moves along. Where the picture is not of the size that the
    view states, the view is scaled.

    Raises io.SceneError for pictures that are too small, or that were turned by a quarter after their camera was found.
    """
    path, view = item.files[1], item.view
    height, width = rgba.shape[:2]
    full = view.width, view.height
    if not _is_reduced(width, height, *full) and _is_reduced(height, width, *full):
        raise io.SceneError(
            f"{path}: expected the orientation of its camera, {view.width} x {view.height} px, got {width} x {height}"
        )
    x, y = width / view.width, height / view.height
    cx = x * (view.width / 2 if view.cx is None else view.cx)
    cy = y * (view.height / 2 if view.cy is None else view.cy)
    view = replace(view, width=width, height=height, fx=x * view.fx, fy=y * view.fy, cx=cx, cy=cy)
    if item.undistort:
        try:
            view, rgba = without_lens(rgba, view)
        except io.SceneError as error:
            raise io.SceneError(f"{path}: {error}") from None
    left, top = view.width % multiple // 2, view.height % multiple // 2
    size = (view.width - view.width % multiple, view.height - view.height % multiple)
    if not all(size):
        raise io.SceneError(f"{path}: {width} x {height} px are too few for these scales")
    view = replace(view, width=size[0], height=size[1], cx=view.cx - left, cy=view.cy - top)
    return view, rgba[top : top + size[1], left : left + size[0]]


def _is_reduced(width: int, height: int, full_width: int, full_height: int) -> bool:
    """Whether a picture can be another with so many pixels at another scale, both sides rounded up or down."""
    lowest = max((width - 1) / full_width, (height - 1) / full_height)
    return lowest < min((width + 1) / full_width, (height + 1) / full_height)


def reduce(
    rgba: Tensor, scale: int, background: tuple[float, float, float] | None, downsampling: str = "box"
) -> Tensor:
    """(3, H, W) uint8 on the background, or without one (4, H, W) premultiplied with alpha.

    Averaged are the stored values, over squares of pixels or with `downsampling` "bicubic" with a cubic kernel
    (a = -0.5) of 4 scales' width, as Pillow does. Colours count by their alpha. With "blender" they do not: straight
    colours and alpha are averaged apart and then composited, as the files of the multi-scale Blender set were made.
    """
    if scale == 1 and bool((rgba[:, :, 3] == 255).all()):  # most photographs: what follows would give the same
        return rgba[:, :, : 4 if background is None else 3].permute(2, 0, 1).contiguous()
    full = rgba.permute(2, 0, 1).float() / 255
    if downsampling != "blender":
        full[:3] *= full[3:]
    if downsampling == "bicubic" and scale > 1:
        size = full.shape[1] // scale, full.shape[2] // scale
        full = functional.interpolate(full[None], size, mode="bicubic", antialias=True)[0].clamp(0, 1)
        full[:3] = torch.minimum(full[:3], full[3:])  # the kernel overshoots, and not in all channels alike
    elif scale > 1:
        full = functional.avg_pool2d(full, scale)
    color, alpha = full.split([3, 1])
    if downsampling == "blender":
        color = color * alpha
    if background is None:
        return (255 * torch.cat([color, alpha])).round().to(torch.uint8)
    behind = color.new_tensor(background)[:, None, None]
    return (255 * (color + behind * (1 - alpha))).round().to(torch.uint8)
