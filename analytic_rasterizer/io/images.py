"""Images of Pillow, and the colours behind pictures."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from .errors import SceneError, first_line, optional_import

BLACK = (0.0, 0.0, 0.0)
"""(r, g, b) of a background."""
WHITE = (1.0, 1.0, 1.0)
"""(r, g, b) of a background."""
BACKGROUNDS = {"black": BLACK, "white": WHITE}
"""Backgrounds that have a name."""


def to_image(color: torch.Tensor):
    """A Pillow image of `color` (3, H, W), or (4, H, W) with alpha: clamped to [0, 1], rounded to 8 bits.

    Raises:
        ImportError: Pillow is missing.
    """
    pixels = color.detach().clamp(0, 1).mul(255).round().to("cpu", torch.uint8)
    return optional_import("PIL.Image").fromarray(pixels.permute(1, 2, 0).contiguous().numpy())


@contextmanager
def opened_picture(path: Path, extra: str = "cli") -> Iterator[Any]:
    """The Pillow image of a file, while it is open; `extra` installs Pillow. Raises SceneError, naming the file."""
    image = optional_import("PIL.Image", extra)
    try:
        with image.open(path) as opened:
            yield opened
    # Pillow raises any of these for broken files, and an error of its own for pictures of more than 178 megapixels.
    except (OSError, SyntaxError, ValueError, image.DecompressionBombError) as error:
        raise SceneError(f"{path}: unreadable or cut short ({first_line(error)})") from None
