"""The compressed .ply (PlayCanvas). 256 Gaussians at a time share limits, and have 8 to 11 bits a number between them.

gsply packs and unpacks the bits. It expects certain elements in a certain order and does not check the order. So the
elements of the file are found first, and gsply is given a file of only these, in its order.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from . import ply
from .errors import SceneError, naming, unreadable
from .with_gsply import data_of, fields_of, gsply

PER_CHUNK = 256
PLAIN = "xyz"  # of vertices that are not packed, whatever chunks the file has
AXES, CHANNELS = "xyz", "rgb"
LIMITS = [f"{end}_{of}{axis}" for of in ("", "scale_") for end in ("min", "max") for axis in AXES]
COLOR_LIMITS = [f"{end}_{channel}" for end in ("min", "max") for channel in CHANNELS]  # 0 and 1 in earlier files
PACKED = [f"packed_{name}" for name in ("position", "rotation", "scale", "color")]
LOWEST_LOG_SCALE = -20.0  # of a file: smaller scales cannot be seen, and would widen the limits of their neighbours


def is_compressed(header: ply.Header) -> bool:
    """Whether a .ply with this header is compressed."""
    vertices = header.element("vertex")
    return header.element("chunk") is not None and vertices is not None and not set(PLAIN) <= set(vertices.names)


def read_compressed(path: Path) -> dict[str, np.ndarray]:
    """The parameters of a compressed .ply, by the names of the fields of `Gaussians`.

    Raises SceneError, which names the file, for a broken one; ImportError without gsply.
    """
    read = gsply().decompress_from_bytes
    _, elements = ply.read_rows(path, ["chunk", "vertex", "sh"])
    with naming(path):
        content = _canonical(elements)
        with unreadable():
            data = read(content)
    return fields_of(data)


def _canonical(elements: dict[str, ply.Rows]) -> bytes:
    """The file as gsply expects it: these elements in this order, with nothing else."""
    chunks, vertices = elements["chunk"], elements["vertex"]
    if len(chunks) * PER_CHUNK < len(vertices):
        raise SceneError(f"expected a chunk for every {PER_CHUNK} of {len(vertices)} vertices, got {len(chunks)}")
    limits = chunks.columns(LIMITS, "<f4")
    if set(COLOR_LIMITS) & set(chunks.names):
        colors = chunks.columns(COLOR_LIMITS, "<f4")
    else:
        colors = np.tile(np.array([0, 0, 0, 1, 1, 1], "<f4"), (len(chunks), 1))
    parts = [
        ("chunk", "float", [*LIMITS, *COLOR_LIMITS], np.concatenate([limits, colors], 1)),
        ("vertex", "uint", PACKED, vertices.columns(PACKED, "<u4")),
    ]
    if "sh" in elements:
        names = [f"f_rest_{i}" for i in range(len(elements["sh"].names))]
        stored = elements["sh"].columns(names)
        if len(stored) != len(vertices) or stored.dtype != np.uint8:
            raise SceneError(f"expected harmonics of {len(vertices)} vertices in bytes, got {len(stored)}")
        parts.append(("sh", "uchar", names, stored))
    header, rows = ["ply", "format binary_little_endian 1.0"], b""
    for name, kind, columns, values in parts:
        header += [f"element {name} {len(values)}", *(f"property {kind} {column}" for column in columns)]
        rows += values.tobytes()
    return "\n".join([*header, "end_header", ""]).encode() + rows


def to_compressed(fields: dict[str, np.ndarray], comments: Sequence[str]) -> bytes:
    """The content of a compressed .ply.

    Args:
        fields: As from `read_compressed`, float32 and finite but for scales of 0, with unit quaternions.
        comments: Lines for its header.

    Raises ImportError without gsply.
    """
    data = data_of(fields | {"log_scales": fields["log_scales"].clip(LOWEST_LOG_SCALE)})
    return ply.with_comments(gsply().compress_to_bytes(data), comments)
