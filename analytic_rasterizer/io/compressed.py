"""The compressed .ply (PlayCanvas). 256 Gaussians at a time share limits, and have 8 to 11 bits a number between them.

The format is PlayCanvas's (developer.playcanvas.com, "Compressed PLY format"). gsply packs the bits. They are unpacked
here: gsply compiles for seconds first, and takes elements for what it expects at their place.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..gaussians import SH_C0
from . import ply
from .errors import SceneError, naming
from .formats import check_harmonics
from .with_gsply import data_of, gsply

PER_CHUNK = 256
PLAIN = "xyz"  # of vertices that are not packed, whatever chunks the file has
AXES, CHANNELS = "xyz", "rgb"
LIMITS = [f"{end}_{of}{axis}" for of in ("", "scale_") for end in ("min", "max") for axis in AXES]
COLOR_LIMITS = [f"{end}_{channel}" for end in ("min", "max") for channel in CHANNELS]  # 0 and 1 in earlier files
PACKED = [f"packed_{name}" for name in ("position", "rotation", "scale", "color")]
LOWEST_LOG_SCALE = -20.0  # of a file: smaller scales cannot be seen, and would widen the limits of their neighbours
LARGEST_LOGIT = 10.0  # of opacities in bytes, of which 0 and 255 stand for more than 0 and 1


def is_compressed(header: ply.Header) -> bool:
    """Whether a .ply with this header is compressed."""
    vertices = header.element("vertex")
    return header.element("chunk") is not None and vertices is not None and not set(PLAIN) <= set(vertices.names)


def read_compressed(path: Path) -> dict[str, np.ndarray]:
    """The parameters of a compressed .ply, by the names of the fields of `Gaussians`.

    Raises SceneError, which names the file, for a broken one.
    """
    _, elements = ply.read_rows(path, ["chunk", "vertex", "sh"])
    with naming(path):
        chunks, vertices = elements["chunk"], elements["vertex"]
        count = len(vertices)
        if len(chunks) * PER_CHUNK < count:
            raise SceneError(f"expected a chunk for every {PER_CHUNK} of {count} vertices, got {len(chunks)}")
        limits = chunks.columns(LIMITS, np.float32)
        position, rotation, scale, color = vertices.columns(PACKED, np.uint32).T
        colors = np.tile(np.float32([0, 0, 0, 1, 1, 1]), (len(chunks), 1))
        if set(COLOR_LIMITS) & set(chunks.names):
            colors = chunks.columns(COLOR_LIMITS, np.float32)
        rest = _harmonics(elements.get("sh"), count)
    shares = _shares(color, (8, 8, 8, 8))
    shs = np.empty((count, 1 + rest.shape[1], 3), np.float32)
    shs[:, 0] = (_between(shares[:, :3], colors) - 0.5) / SH_C0
    shs[:, 1:] = (rest - np.float32(127.5)) / 32
    with np.errstate(divide="ignore"):
        logits = -np.log(1 / shares[:, 3:] - 1)
    return {
        "means": _between(_shares(position, (11, 10, 11)), limits[:, :6]),
        "log_scales": _between(_shares(scale, (11, 10, 11)), limits[:, 6:]),
        "rotations": _rotations(rotation),
        "logit_opacities": logits.clip(-LARGEST_LOGIT, LARGEST_LOGIT),
        "shs": shs,
    }


def _harmonics(rows: ply.Rows | None, count: int) -> np.ndarray:
    """(count, bands, 3) uint8 of harmonics beyond the base colour. Raises SceneError."""
    if rows is None:
        return np.empty((count, 0, 3), np.uint8)
    stored = rows.columns([f"f_rest_{i}" for i in range(len(rows.names))])
    if len(stored) != count or stored.dtype != np.uint8:
        raise SceneError(f"expected harmonics of {count} vertices in bytes, got {len(stored)}")
    check_harmonics(stored.shape[1])
    # All bands of red come first, then those of green, then those of blue.
    return stored.reshape(count, 3, stored.shape[1] // 3).transpose(0, 2, 1)


def _shares(packed: np.ndarray, bits: Sequence[int]) -> np.ndarray:
    """(N, len(bits)) float32: numbers of so many bits, the highest first, over the largest of their kind."""
    shift, shares = sum(bits), np.empty((len(packed), len(bits)), np.float32)
    for i, width in enumerate(bits):
        shift, largest = shift - width, (1 << width) - 1
        shares[:, i] = (packed >> np.uint32(shift)) & np.uint32(largest)
        shares[:, i] /= largest
    return shares


def _between(shares: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Shares (N, 3) of the way between the limits of their chunks, lowest x, y, z before highest."""
    chunk = np.arange(len(shares)) // PER_CHUNK
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite then is left out
        return limits[chunk, :3] + shares * (limits[:, 3:] - limits[:, :3])[chunk]


def _rotations(packed: np.ndarray) -> np.ndarray:
    """(N, 4) w, x, y, z: 2 bits say which is the largest, 10 each are the others from -1/sqrt(2) to 1/sqrt(2)."""
    others = (_shares(packed, (10, 10, 10)) - np.float32(0.5)) * np.float32(2**0.5)
    largest = np.sqrt((1 - (others**2).sum(1, keepdims=True)).clip(0))
    which = packed >> np.uint32(30)
    rotations = np.empty((len(packed), 4), np.float32)
    for place in range(4):
        rows = which == place
        rotations[rows] = np.insert(others[rows], [place], largest[rows], 1)
    return rotations


def to_compressed(fields: dict[str, np.ndarray], comments: Sequence[str]) -> bytes:
    """The content of a compressed .ply.

    Args:
        fields: As from `read_compressed`, float32 and finite but for scales of 0, with unit quaternions.
        comments: Lines for its header.

    Raises ImportError without gsply.
    """
    data = data_of(fields | {"log_scales": fields["log_scales"].clip(LOWEST_LOG_SCALE)})
    return ply.with_comments(gsply().compress_to_bytes(data), comments)
