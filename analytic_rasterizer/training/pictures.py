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
TURNED = range(2, 9)  # its values for the others
NAMED = 3  # files in a warning
LEAST_SHARE = 1 / 512  # of a pixel that counts: less rounds to none


class Header(NamedTuple):
    """What a picture's file says without its pixels."""

    width: int  # px, as stored
    height: int
    orientation: int  # as in `Stored`

    def fits(self, view: io.View) -> bool:
        """Whether the picture can be that of a camera, at this or another scale."""
        return _is_reduced(self.width, self.height, view.width, view.height)

    def fits_turned(self, view: io.View) -> bool:
        """Whether it can be after a quarter turn."""
        return _is_reduced(self.height, self.width, view.width, view.height)

    def tells_orientation(self, view: io.View) -> bool:
        """Whether it is certainly stored as its camera saw it: EXIF says so, or a quarter turn would not fit."""
        quarter_turn = self.orientation in (5, 6, 7, 8)
        return self.orientation not in TURNED or (quarter_turn and not self.fits_turned(view))


class Stored(NamedTuple):
    """The picture of a file."""

    rgba: Tensor  # (H, W, 4) uint8 of straight alpha
    orientation: int  # how the camera was held, as EXIF counts it
    mask: Tensor | None = None  # (H, W) uint8, 255 where pixels count

    @property
    def header(self) -> Header:
        """Size and orientation."""
        return Header(self.rgba.shape[1], self.rgba.shape[0], self.orientation)


class Pictures(NamedTuple):
    """Views and their pictures, on the device or colours on its host. By scale: 2 is half the size.

    Attributes:
        views: At scale 1.
        settings: By scale, for every view.
        colors: By scale, for every view: (3, H, W) uint8, on the background; or (4, H, W) premultiplied, with alpha.
            Black where nothing counts; otherwise the mean of what counts.
        masks: By scale, for every view: (H, W) uint8, the share of each pixel that counts; None: all of them count,
            in all views if it stands for the dict.
    """

    views: list[io.View]
    settings: dict[int, list[GaussianRasterizationSettings]]  # made once: they hold tensors
    colors: dict[int, list[Tensor]]
    masks: dict[int, list[Tensor | None]] | None = None

    def truth(self, scale: int, view: int, background: Tensor | None = None) -> Tensor:
        """The picture of a `view` at a `scale`, (3, H, W) float32 in [0, 1] on the device.

        `background` (3,) is for pictures with alpha.
        """
        color = self._color(scale, view).float() / 255
        return color if background is None else color[:3] + (1 - color[3:]) * background[:, None, None]

    def target(self, scale: int, view: int, background: Tensor | None = None) -> Tensor:
        """`truth` of `scale` and `view` as `l1_ssim` takes it: without a `background`, (3, H, W) uint8 as stored."""
        return self._color(scale, view) if background is None else self.truth(scale, view, background)

    def mask(self, scale: int, view: int) -> Tensor | None:
        """(H, W) float32 on the device: the share of each pixel of a `view` at a `scale` that counts. None: all do."""
        stored = None if self.masks is None else self.masks[scale][view]
        return None if stored is None else self._on_device(stored, scale, view).float() / 255

    def _on_device(self, stored: Tensor, scale: int, view: int) -> Tensor:
        return stored.to(self.settings[scale][view].viewmatrix.device, non_blocking=True)

    def _color(self, scale: int, view: int) -> Tensor:
        return self._on_device(self.colors[scale][view], scale, view)

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

    A picture that is to be undistorted is resampled to that of a pinhole, see `undistortion.without_lens`. All pictures
    are cut about their centres, so that all scales show the same. Views are scaled to the sizes of their pictures.

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
    pictures = Pictures([], *({scale: [] for scale in scales} for _ in range(3)))
    to_turn = []
    for item, files in zip(items, _read_ahead(items, scales)):
        if not files[1].header.tells_orientation(item.view):
            to_turn.append(item.files[1])
        mask = None if files[1].mask is None else files[1].mask.to(device)
        view, rgba, mask = fitted(files[1].rgba.to(device), item, math.lcm(*scales), mask)
        pictures.views.append(view)
        for scale in scales:
            stored = scale if scale in item.files and scale != 1 else 1
            whole, whole_mask = (rgba, mask) if stored == 1 else _stored(files[stored], item, device)
            if whole.shape[:2] != (view.height // stored, view.width // stored):
                raise io.SceneError(
                    f"{item.files[stored]}: expected {view.width // stored} x {view.height // stored} px"
                )
            made = reduce(whole, scale // stored, background, downsampling, whole_mask)
            color, share = (t.cpu().pin_memory() if on_host and t is not None and t.is_cuda else t for t in made)
            pictures.colors[scale].append(color)
            pictures.masks[scale].append(share)
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


def _stored(stored: Stored, item: Photograph, device: str | torch.device) -> tuple[Tensor, Tensor | None]:
    """A picture of a coarse scale and its mask, as the file has them."""
    rgba, mask = stored.rgba.to(device), None if stored.mask is None else stored.mask.to(device)
    return _with_alpha_as_mask(rgba, mask) if item.alpha_is_mask else (rgba, mask)


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
    found = {scale: read_file(item.files[scale]) for scale in {1, *scales} if scale in item.files}
    if item.mask is None:
        return found
    return {
        scale: stored._replace(mask=read_mask(item.mask, stored.rgba.shape[1], stored.rgba.shape[0]))
        for scale, stored in found.items()
    }


def read_mask(path: Path, width: int, height: int) -> Tensor:
    """(H, W) uint8 of a mask for a picture of this size: 255 where it is brighter than half of its brightest pixel.

    A mask of another size is scaled; pixels on its edges then count in part. Raises io.SceneError for a mask that
    cannot be read, or that has another shape than the picture.
    """
    with opened_picture(path, "train") as opened:
        levels = torch.from_numpy(np.array(opened.convert("L")))
    own_height, own_width = levels.shape
    if not (_is_reduced(own_width, own_height, width, height) or _is_reduced(width, height, own_width, own_height)):
        raise io.SceneError(
            f"{path}: expected a mask of the shape of its picture, {width} x {height} px, got {own_width} x "
            f"{own_height}"
        )
    counted = 255 * (levels > levels.max() / 2).to(torch.uint8)
    if (own_width, own_height) == (width, height):
        return counted
    return functional.interpolate(counted[None, None].float(), (height, width), mode="area")[0, 0].round().byte()


def read_file(path: Path, largest: int | None = None) -> Stored:
    """A picture and its orientation. Raises io.SceneError.

    Args:
        path: The file.
        largest: Px of the longer side that are wanted: a .jpg is read at a half, a quarter or an eighth of its size if
            a reduction by a whole number to no more than that begins with it. None: whole.
    """
    with opened_picture(path, "train") as opened:
        if largest is not None:
            reduction = -(-max(opened.size) // largest)
            opened.draft(None, tuple(max(1, length // reduction) for length in opened.size))
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


def read_header(path: Path) -> Header:
    """Reads no pixels, and no EXIF behind them, which is rare. Raises io.SceneError."""
    with opened_picture(path, "train") as opened:
        # Pillow decodes a .png that has no EXIF before its pixels, to look behind them.
        upright = opened.format == "PNG" and "exif" not in opened.info
        return Header(*opened.size, UPRIGHT if upright else _orientation(opened))


def fitted(
    rgba: Tensor, item: Photograph, multiple: int, mask: Tensor | None = None
) -> tuple[io.View, Tensor, Tensor | None]:
    """The picture (H, W, 4) of a photograph, its view and its mask (H, W), cut about the centre to multiples of px.

    They are undistorted if that is wanted. The principal point moves along. Where the picture is not of the size that
    the view states, the view is scaled. Where alpha is a mask, the picture becomes opaque.

    Raises io.SceneError for pictures that are too small, or that were turned by a quarter after their camera was found.
    """
    path, view = item.files[1], item.view
    height, width = rgba.shape[:2]
    header = Header(width, height, UPRIGHT)
    if not header.fits(view) and header.fits_turned(view):
        raise io.SceneError(
            f"{path}: expected the orientation of its camera, {view.width} x {view.height} px, got {width} x {height}"
        )
    x, y = width / view.width, height / view.height
    cx, cy = (factor * middle for factor, middle in zip((x, y), view.middle))
    view = replace(view, width=width, height=height, fx=x * view.fx, fy=y * view.fy, cx=cx, cy=cy)
    rgba, mask = _with_alpha_as_mask(rgba, mask) if item.alpha_is_mask else (rgba, mask)
    if item.undistort:
        try:
            view, rgba, mask = _undistorted(rgba, mask, view)
        except io.SceneError as error:
            raise io.SceneError(f"{path}: {error}") from None
    left, top = view.width % multiple // 2, view.height % multiple // 2
    size = (view.width - view.width % multiple, view.height - view.height % multiple)
    if not all(size):
        raise io.SceneError(f"{path}: {width} x {height} px are too few for these scales")
    view = replace(view, width=size[0], height=size[1], cx=view.cx - left, cy=view.cy - top)
    rows, columns = slice(top, top + size[1]), slice(left, left + size[0])
    return view, rgba[rows, columns], None if mask is None else mask[rows, columns]


def _with_alpha_as_mask(rgba: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """An opaque picture, and the mask of what was opaque and counted."""
    alpha = rgba[..., 3]
    if bool((alpha == 255).all()):
        return rgba, mask
    opaque = torch.cat([rgba[..., :3], torch.full_like(rgba[..., 3:], 255)], 2)
    return opaque, alpha if mask is None else _product(alpha, mask)


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Of two shares in uint8."""
    return (a.float() * b / 255).round().byte()


def _undistorted(rgba: Tensor, mask: Tensor | None, view: io.View) -> tuple[io.View, Tensor, Tensor | None]:
    """The picture and the mask of the pinhole. No colour of what does not count gets into pixels beside it."""
    if mask is None:
        return *without_lens(rgba, view), None
    # Colours count by their alpha, and this alpha is zero where nothing counts.
    counted = torch.cat([rgba[..., :3], _product(rgba[..., 3], mask)[..., None]], 2)
    pinhole, seen = without_lens(counted, view)
    _, masks = without_lens(
        torch.cat([mask[..., None].expand(-1, -1, 3), torch.full_like(rgba[..., 3:], 255)], 2), view
    )
    share = masks[..., 0]
    alpha = torch.where(share > 0, 255 * seen[..., 3].float() / share, 0).clamp_max(255).round().byte()
    return pinhole, torch.cat([seen[..., :3], alpha[..., None]], 2), share


def _is_reduced(width: int, height: int, full_width: int, full_height: int) -> bool:
    """Whether a picture can be another with so many pixels at another scale, both sides rounded up or down."""
    lowest = max((width - 1) / full_width, (height - 1) / full_height)
    return lowest < min((width + 1) / full_width, (height + 1) / full_height)


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
