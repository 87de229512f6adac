"""The files of photographs and masks, read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from .. import io
from ..io.errors import optional_import
from ..io.images import opened_picture

ORIENTATION, UPRIGHT = 0x0112, 1  # a tag of EXIF, and its value for pictures that are as they are stored
TURNED = range(2, 9)  # its values for the others
LOSSY = ("JPEG", "MPO", "WEBP", "AVIF")  # formats of Pillow, in which black is not always 0
ALPHA_MODES = ("RGBA", "LA", "PA", "La", "RGBa")  # of Pillow
MASK_SIZE = 256  # px of the longer side of masks that random points are placed by
STRIP = 64  # rows that are converted at a time


class Header(NamedTuple):
    """What a picture's file says without its pixels."""

    width: int  # px, as stored
    height: int
    orientation: int  # as in `Stored`

    def fits(self, view: io.View) -> bool:
        """Whether the picture can be that of a camera, at this or another scale."""
        return is_reduced(self.width, self.height, view.width, view.height)

    def fits_turned(self, view: io.View) -> bool:
        """Whether it can be after a quarter turn."""
        return is_reduced(self.height, self.width, view.width, view.height)

    def is_cut(self, view: io.View) -> bool:
        """Whether it has one side of its camera's picture, and not the other."""
        return not self.fits(view) and (self.width == view.width) != (self.height == view.height)

    def tells_orientation(self, view: io.View) -> bool:
        """Whether it is certainly stored as its camera saw it: EXIF says so, or a quarter turn would not fit."""
        quarter_turn = self.orientation in (5, 6, 7, 8)
        return self.orientation not in TURNED or (quarter_turn and not self.fits_turned(view))


class Stored(NamedTuple):
    """The picture of a file."""

    rgba: Tensor  # (H, W, 4) uint8 of straight alpha
    orientation: int  # how the camera was held, as EXIF counts it
    mask: Tensor | None = None  # (H, W) uint8, 255 where pixels count
    depth: Tensor | None = None  # (2, h, w) float32 of `depth_planes`, of any size

    def map(self, change: Callable[[Tensor], Tensor]) -> Stored:
        """With other tensors."""
        mask, depth = (None if tensor is None else change(tensor) for tensor in (self.mask, self.depth))
        return self._replace(rgba=change(self.rgba), mask=mask, depth=depth)

    @property
    def header(self) -> Header:
        """Size and orientation."""
        return Header(self.rgba.shape[1], self.rgba.shape[0], self.orientation)


def read_mask(path: Path, width: int, height: int) -> Tensor:
    """(H, W) uint8 of a mask for a picture of this size: 255 where it is neither black nor transparent.

    That is COLMAP's and nerfstudio's rule. In formats that lose something, black is up to half of the brightest level.
    A mask of one colour with alpha is its alpha. A mask of another size is scaled; pixels on its edges then count in
    part. Raises io.SceneError for a mask that cannot be read, or that has another shape than the picture.
    """
    with opened_picture(path, "train") as opened:
        counts = _counts(opened)
    own_height, own_width = counts.shape
    if not (is_reduced(own_width, own_height, width, height) or is_reduced(width, height, own_width, own_height)):
        raise io.SceneError(
            f"{path}: expected a mask of the shape of its picture, {width} x {height} px, got {own_width} x "
            f"{own_height}"
        )
    counted = 255 * torch.from_numpy(counts).to(torch.uint8)
    if (own_width, own_height) == (width, height):
        return counted
    return functional.interpolate(counted[None, None].float(), (height, width), mode="area")[0, 0].round().byte()


def counted_pixels(path: Path, mask: Path | None) -> Tensor | None:
    """(H, W) bool, of at most MASK_SIZE px, where most of a square of pixels of a photograph counts, and is opaque.

    None where all do, or a file cannot be read.
    """
    planes = []
    try:
        with opened_picture(path, "train") as opened:
            size, has_alpha = opened.size, opened.mode in ALPHA_MODES or "transparency" in opened.info
        if has_alpha:
            planes.append(read_file(path).rgba[:, :, 3])
        if mask is not None:
            planes.append(read_mask(mask, *size))
    except io.SceneError:
        return None  # who loads the picture says so
    planes = [plane for plane in planes if (plane < 255).any()]
    if not planes:
        return None
    reduction = -(-max(size) // MASK_SIZE)
    counted = torch.stack(planes).amin(0)[None, None].float()
    return functional.avg_pool2d(counted, reduction, ceil_mode=True)[0, 0] > 127


def _counts(opened) -> np.ndarray:
    """(H, W) bool: where the Pillow image of a mask lets pixels count."""
    lossy, alpha = opened.format in LOSSY, None
    if opened.mode in ALPHA_MODES or "transparency" in opened.info:
        opened = opened.convert("RGBA")
        alpha = np.array(opened.getchannel("A"))
    grey = opened.mode in ("1", "L", "F") or opened.mode.startswith("I")
    levels = np.array(opened) if grey else np.array(opened.convert("RGB")).max(2)
    bright = levels > (levels.max() / 2 if lossy else 0)
    if alpha is None or alpha.min() == 255:
        return bright
    return alpha > 0 if levels.min() == levels.max() else bright & (alpha > 0)


def broken_files(files: Iterable[Path]) -> dict[Path, io.SceneError]:
    """The files of pictures that cannot be decoded, and what is wrong with them. Reads all of them, in threads."""

    def look(path: Path) -> io.SceneError | None:
        try:
            read_file(path, 1)
        except io.SceneError as error:
            return error
        return None

    files = list(dict.fromkeys(files))
    with ThreadPoolExecutor() as pool:
        return {path: error for path, error in zip(files, pool.map(look, files)) if error is not None}


def unreadable_pictures(errors: Sequence[io.SceneError], count: int) -> io.SceneError:
    """One error for those of so many pictures."""
    first = errors[0].message
    if len(errors) > 1:
        first = f"{len(errors)} of {count} pictures cannot be read, the first is {first}"
    return io.SceneError(first, *errors[0].advice, "--missing skip leaves out what cannot be read")


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
            return Stored(_rgba(opened), _orientation(opened))
        numbers, orientation = np.array(opened).astype(np.float64), _orientation(opened)
        peak = 1 if opened.mode == "F" else 65535
    if not np.isfinite(numbers).all():
        y, x = np.argwhere(~np.isfinite(numbers))[0]
        raise io.SceneError(f"{path}: pixels must be finite, got {numbers[y, x]} at x {x}, y {y}")
    grey = (255 * (numbers / peak).clip(0, 1)).round().astype(np.uint8)
    return Stored(torch.from_numpy(np.stack([grey, grey, grey, np.full_like(grey, 255)], 2)), orientation)


def _rgba(opened) -> Tensor:
    """(H, W, 4) uint8 of a Pillow image of a file.

    In strips: whole, the copies on the way take three times the memory, and longer. A JPEG has its decoder write here,
    without a copy: in half the time, and without the lock of the interpreter, for which a training that goes on while
    threads read would have to wait.
    """
    place = None
    if opened.format in ("JPEG", "MPO") and opened.mode == "RGB":
        rgba = np.empty((*reversed(opened.size), 4), np.uint8)
        place = _as_memory_of(opened, rgba)
    opened.load()
    if place is not None and opened.im is place:
        rgba[..., 3] = 255
        return torch.from_numpy(rgba)
    width, height = opened.size
    rgba = np.empty((height, width, 4), np.uint8)
    for top in range(0, height, STRIP):
        bottom = min(top + STRIP, height)
        rgba[top:bottom] = opened.crop((0, top, width, bottom)).convert("RGBA")
    return torch.from_numpy(rgba)


def _as_memory_of(opened, rgba: np.ndarray) -> Any:
    """Pillow's memory of an image that is not read yet, of mode RGB, put into an array: it has four bytes per pixel.

    None with a Pillow that has no such thing: it is none of what Pillow promises.
    """
    try:
        opened.im = optional_import("PIL.Image").core.map_buffer(rgba, opened.size, "raw", 0, ("RGB", 0, 1))
    except (AttributeError, TypeError, ValueError):
        return None
    return opened.im


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


def read_size(path: Path) -> tuple[int, int]:
    """Width and height, px. Raises io.SceneError."""
    with opened_picture(path, "train") as opened:
        return opened.size


def is_reduced(width: int, height: int, full_width: int, full_height: int) -> bool:
    """Whether a picture can be another with so many pixels at another scale, both sides rounded up or down."""
    lowest = max((width - 1) / full_width, (height - 1) / full_height)
    return lowest < min((width + 1) / full_width, (height + 1) / full_height)
