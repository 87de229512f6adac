"""Images of Pillow, and the colours behind pictures."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from .errors import SceneError, check_content, optional_import, why_unreadable

BLACK = (0.0, 0.0, 0.0)
"""(r, g, b) of a background."""
WHITE = (1.0, 1.0, 1.0)
"""(r, g, b) of a background."""
BACKGROUNDS = {"black": BLACK, "white": WHITE}
"""Backgrounds that have a name."""


def to_image(color: torch.Tensor):
    """A Pillow image of `color` (3, H, W), or (4, H, W) with alpha: clamped to [0, 1], rounded to 8 bits.

    Raises:
        TypeError, ValueError: Not a tensor of floating-point numbers, or of another shape.
        ImportError: Pillow is missing.
    """
    pixels = _bytes_of(color)
    return optional_import("PIL.Image").fromarray(pixels.numpy())


def png(color: torch.Tensor) -> bytes:
    """The file that `to_image` would be saved as, without Pillow. Source: the PNG specification, W3C, third edition."""
    pixels = _bytes_of(color)
    height, width, channels = pixels.shape
    rows = torch.cat([pixels.new_zeros(height, 1), pixels.flatten(1)], 1)  # every row begins with its filter, none
    header = struct.pack(">IIBBBBB", width, height, 8, {3: 2, 4: 6}[channels], 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows.numpy().tobytes())), (b"IEND", b""))
    framed = (struct.pack(">I", len(data)) + kind + data for kind, data in chunks)
    checks = (struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(part + check for part, check in zip(framed, checks))


def _bytes_of(color: torch.Tensor) -> torch.Tensor:
    """(H, W, channels) uint8 on the CPU of colours (channels, H, W). Raises TypeError, ValueError as `to_image`."""
    if not isinstance(color, torch.Tensor):
        raise TypeError(f"color must be a tensor, got {type(color).__name__}")
    if color.dim() != 3 or len(color) not in (3, 4):
        grey = ": expand(3, -1, -1) makes it grey" if color.dim() == 3 and len(color) == 1 else ""
        raise ValueError(f"color must have shape (3, H, W), or (4, H, W) with alpha, got {tuple(color.shape)}{grey}")
    if not color.is_floating_point():
        raise TypeError(f"color must have a floating-point dtype, with colours from 0 to 1, got {color.dtype}")
    pixels = color.detach().clamp(0, 1).mul(255).round().to("cpu", torch.uint8)
    return pixels.permute(1, 2, 0).contiguous()


def check_written(path: Path) -> None:
    """Raises ValueError unless Pillow writes pictures with the suffix of `path`; ImportError if it is missing."""
    pillow = optional_import("PIL.Image")
    if pillow.registered_extensions().get(path.suffix.lower()) not in pillow.SAVE:
        raise ValueError(f"{path}: expected the suffix of a picture, such as .png or .jpg, got {path.suffix!r}")


@contextmanager
def opened_picture(path: Path, extra: str = "cli") -> Iterator[Any]:
    """The Pillow image of a file, while it is open; `extra` installs Pillow. Raises SceneError, naming the file."""
    image = optional_import("PIL.Image", extra)
    try:
        with image.open(path) as opened:
            yield opened
    # Pillow raises any of these for broken files, and an error of its own for pictures of more than 178 megapixels.
    except (OSError, SyntaxError, ValueError, image.DecompressionBombError) as error:
        check_content(path)
        raise SceneError(f"{path}: {why_unreadable(error)}") from None
