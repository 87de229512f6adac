"""Points with colours, from a .ply: where a training may begin."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from . import ply
from .compressed import is_compressed
from .errors import SceneError, naming
from .formats import FORMATS

AXES, COLORS = ("x", "y", "z"), ("red", "green", "blue")


def load_points(path, strict: bool = False) -> tuple[Tensor, Tensor]:
    """The vertices of any .ply, on the CPU.

    Vertices whose position or colour is not a number, or infinite, are left out, and a warning counts them.

    Args:
        path: A .ply with vertices that have x, y and z, whatever their types, and whatever else it holds.
        strict: Refuse a file with such vertices.

    Returns:
        Positions (P, 3) float64, as far from zero as geographic coordinates are, and colours (P, 3) float32 in [0, 1]:
        those of red, green and blue (see `read_colors`), grey where there are none.

    Raises:
        SceneError: The file is no complete .ply with such vertices, or colours are out of their range, or no vertex is
            finite. The message names the file.
        OSError: The file cannot be read.
    """
    path = Path(path)
    _, elements = ply.read_rows(path, ["vertex"])
    with naming(path):
        if "vertex" not in elements:
            raise SceneError("expected vertices, but the .ply has none")
        rows = elements["vertex"]
        if any(rows.names.count(axis) != 1 for axis in AXES):
            raise SceneError(f"expected vertices with x, y and z, each once, got {', '.join(rows.names) or 'nothing'}")
        points = rows.columns(AXES, np.float64)
        finite = np.isfinite(points).all(1)
        bad = len(points) - int(finite.sum())
        if bad and (strict or bad == len(points)):
            raise SceneError(f"expected {len(points)} finite points, got {len(points) - bad}")
        colors = np.full(points.shape, 0.5, np.float32)
        if has_colors(rows):
            colors = read_colors(rows)
            known = np.isfinite(colors).all(1)
            if not known.all() and (strict or not (finite & known).any()):
                raise SceneError("expected colours from 0 to 255, got nan")
            finite &= known
    left_out = len(points) - int(finite.sum())
    if left_out:
        warnings.warn(
            f"{path}: {left_out} of {len(points)} points are left out: their numbers are not finite", stacklevel=2
        )
    return torch.from_numpy(points[finite]), torch.from_numpy(colors[finite])


def has_colors(rows: ply.Rows) -> bool:
    """Whether vertices have red, green and blue."""
    return set(COLORS) <= set(rows.names)


def read_colors(rows: ply.Rows) -> np.ndarray:
    """Colours (rows, 3) float32 in [0, 1] of red, green and blue, NaN where one is not a finite number.

    Full intensity is 65535 in colours of type ushort, 1 in fractions none of which is larger than 1, and else 255.
    Raises SceneError for colours out of that range.
    """
    stored = rows.columns(COLORS)
    finite = np.isfinite(stored).all(1) if stored.dtype.kind == "f" else np.ones(len(stored), bool)
    good = stored[finite]
    fractions = stored.dtype.kind == "f" and not (good > 1).any()
    whole = 65535 if stored.dtype == np.uint16 else 1 if fractions else 255
    if ((good < 0) | (good > whole)).any():
        raise SceneError(f"expected colours from 0 to 255, got {good.min()} to {good.max()}")
    colors = np.full(stored.shape, np.nan, np.float32)
    colors[finite] = good.astype(np.float32) / np.float32(whole)
    return colors


def is_scene(path) -> bool:
    """Whether the file `path` holds Gaussians rather than points: by the properties of a .ply, else by the suffix.

    Raises:
        SceneError: A .ply that is none.
        OSError: It cannot be read.
    """
    path = Path(path)
    if FORMATS.get(path.suffix.lower(), "ply") != "ply":
        return True
    header = ply.read_header(path)
    vertices = header.element("vertex")
    names = set(vertices.names) if vertices else set()
    return names >= SCALES_AND_MORE or is_compressed(header)


SCALES_AND_MORE = {"opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))}
