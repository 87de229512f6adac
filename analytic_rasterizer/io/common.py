"""What scenes, views and pictures need in common."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

BLACK = (0.0, 0.0, 0.0)
"""(r, g, b) of a background."""
WHITE = (1.0, 1.0, 1.0)
"""(r, g, b) of a background."""
BACKGROUNDS = {"black": BLACK, "white": WHITE}
"""Backgrounds that have a name."""


class SceneError(ValueError):
    """A scene or views file that cannot be used; the message names the file and what is wrong."""


@contextmanager
def naming(path) -> Iterator[None]:
    """Puts the file's name in front of the message of a SceneError."""
    try:
        yield
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from None


@contextmanager
def unreadable() -> Iterator[None]:
    """Turns whatever a reader raises for a broken file into a SceneError, and lets a missing library pass."""
    try:
        yield
    except (SceneError, ImportError):
        raise
    except Exception as error:  # libraries raise a different type for every way in which a file can be broken
        reason = first_line(error) or type(error).__name__
        raise SceneError(f"unreadable or cut short ({reason})") from None


FORMATS = {
    ".ply": "ply",
    ".ply_compressed": "ply",
    ".spz": "spz",
    ".sog": "sog",
    ".splat": "splat",
    ".glb": "gltf",
    ".gltf": "gltf",
}
"""Formats of scenes, by suffix."""


def scene_file(path) -> tuple[Path, str]:
    """The path of a file of a scene, and its format, one of FORMATS. Suffixes may have any case.

    Raises SceneError where the file is not there, or has another suffix.
    """
    path = Path(path)
    if path.is_dir():
        raise SceneError(f"{path}: expected a file of a scene, got a folder")
    if not path.is_file():
        raise SceneError(f"{path}: no such file")
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise SceneError(
            f"{path}: expected a .ply, .spz, .sog, .splat, .glb or .gltf file, got {path.suffix or 'no suffix'!r}"
        )
    return path, FORMATS[suffix]


def optional_import(name: str, extra: str = "cli"):
    """The module `name`.

    Raises:
        ImportError: It is missing; the message names the `extra` of this package that installs it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.split(".")[0]
        raise ImportError(f"this needs {package}: pip install analytic_rasterizer[{extra}] ({error})") from None


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


def first_line(error: BaseException) -> str:
    """Of what an error says."""
    return str(error).partition("\n")[0]
