"""Axes of files: where x, y and z point, as three letters such as "rub".

x points to the right or left (r, l), y up or down (u, d), z forward or back (f, b). In memory scenes are RDF, as 3DGS
and COLMAP have them: right, down, forward. Programs of other axes negate coordinates. Words and letters are those of
the documents of .spz (github.com/nianticlabs/spz).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product

import numpy as np

from .turning import Z_UP_TO_Y_UP, placed

OWN_LINE = ["analytic_rasterizer", "axes"]  # the first words of the line that names the axes of a file
AXES = tuple(map("".join, product("rl", "du", "fb")))
Z_UP = tuple(map("".join, product("rl", "fb", "du")))  # of files that are read, not of those that are written
MEMORY = "rdf"
OF_FORMATS = {"spz": "rub", "gltf": "luf", "glb": "luf", "usd": "rub"}
"""Axes of formats that are not RDF, as other programs write and read them.

An .spz is RUB by its documents, where it does not say its axes: Scaniverse and LichtFeld write it so. The documents of
glTF say y-up, and that models face +z. Scenes are turned to LUF by splat-transform (PlayCanvas), by the documents of
.spz, and by the extension that stores an .spz in a glTF (Cesium). Viewers (Babylon, PlayCanvas, three.js, Cesium)
place them as any glTF. A USD is y-up, and its cameras look along -z.
"""
WRITTEN = OF_FORMATS | {"spz": MEMORY}
"""Axes that this package writes. An .spz says its axes; SuperSplat, splat-transform from 3 on, and Spark do not look,
and take its numbers as those of a .ply."""


def axes_of_format(kind: str) -> str:
    """The axes of a format's files that do not say theirs."""
    return OF_FORMATS.get(kind, MEMORY)


def axes_written(kind: str) -> str:
    """The axes of files that this package writes, where the user asks for none."""
    return WRITTEN.get(kind, MEMORY)


def checked_axes(axes: str) -> str:
    """The letters in lower case. Raises ValueError for others."""
    if not isinstance(axes, str) or axes.lower() not in AXES:
        raise ValueError(f"axes must be three letters, r or l, d or u, f or b, such as rdf or rub, got {axes!r}")
    return axes.lower()


def axes_in(lines: Sequence[str]) -> str | None:
    """The axes that lines of a file name; None where they name none that we know."""
    words = (line.split() for line in lines)
    return next((word[2] for word in words if word[:2] == OWN_LINE and len(word) == 3 and word[2] in AXES), None)


def with_axes(lines: Sequence[str], axes: str) -> list[str]:
    """The lines with one that names `axes`, where none names any."""
    return list(lines) if axes_in(lines) else [" ".join([*OWN_LINE, axes]), *lines]


def flipped(fields: dict[str, np.ndarray], axes: str) -> dict[str, np.ndarray]:
    """Gaussians of other axes as RDF, and of RDF as others: both negate the same coordinates.

    Args:
        fields: Parameters by the names of the fields of `Gaussians`. Harmonics may have any degree.
        axes: One of AXES; of a file also one of Z_UP, whose Gaussians are turned.
    """
    if axes == MEMORY:
        return fields
    if axes[1] in "fb":
        fields, axes = placed(fields, Z_UP_TO_Y_UP), axes[0] + axes[2] + "bf"["fb".index(axes[1])]
    signs = np.array([1 if letter == own else -1 for letter, own in zip(axes, MEMORY)], np.float32)
    # A rotation R becomes S R S. Its axis turns with S, and where S is a mirror the angle changes its sign.
    quaternion = np.array([1, *(signs * signs.prod())], np.float32)
    return fields | {
        "means": fields["means"] * signs,
        "rotations": fields["rotations"] * quaternion,
        "shs": fields["shs"] * _signs_of_harmonics(signs, fields["shs"].shape[1])[:, None],
    }


def _signs_of_harmonics(signs: np.ndarray, bands: int) -> np.ndarray:
    """(bands,) factors: every harmonic of 3DGS is an even or odd function of each coordinate.

    The harmonic of degree l and order m is sin(|m| phi) for m < 0, else cos(m phi), times a function of z that is odd
    if l + m is. Its sine is odd in y; in x the sine is odd for even m, and the cosine for odd m.
    """
    x, y, z = signs
    found = [
        z ** (degree + order) * (y * x ** (order + 1) if order < 0 else x**order)
        for degree in range(math.isqrt(bands))
        for order in range(-degree, degree + 1)
    ]
    return np.array(found, np.float32)
