"""The .spz format (Niantic): compressed Gaussians, a flag for antialiasing, and extensions.

gsply reads and writes the Gaussians. What it leaves out is here: the flag, and two extensions, Adobe's that says the
axes, and ours that holds lines of text. An extension is a record of type, length and content, which programs that do
not know the type skip. Versions 1 to
3 are compressed by gzip as a whole and have extensions at the end; from version 4 on, the header and the extensions are
in front of the compressed parts.
"""

from __future__ import annotations

import gzip
import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .axes import MEMORY, with_axes
from .errors import SceneError, naming, optional_import, unreadable
from .with_gsply import data_of, fields_of, gsply

MAGIC = b"NGSP"
HEADER = struct.Struct("<4sIIBBBB")
SEPARATE_PARTS = 4  # the version from which on every part is compressed by itself
REST_OF_HEADER = struct.Struct("<I12x")  # of these versions
ANTIALIASED, HAS_EXTENSIONS = 1, 2  # bits of the flags
OWN_EXTENSION = 0x4152_0001  # vendor "AR", its first: lines of UTF-8, those of a .ply's comments
AXES_EXTENSION = 0xADBE_0003  # SPZ_ADOBE_coordinate_system: a place in AXES, counted from 1
# As CoordinateSystem in src/cc/splat-types.h of github.com/nianticlabs/spz has them.
AXES = tuple(x + y + z for z in "bf" for y in "du" for x in "lr") + tuple(
    x + y + z for y in "fb" for z in "du" for x in "lr"
)
MOST_TEXT = 1 << 20  # bytes of extensions that are looked at


class Header(NamedTuple):
    magic: bytes
    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    flags: int
    reserved: int

    def payload(self) -> int:
        """Bytes of the Gaussians in a file of version 2 or 3, without compression."""
        harmonics = 3 * ((self.sh_degree + 1) ** 2 - 1)
        rotation = 4 if self.version >= 3 else 3
        return self.count * (9 + 1 + 3 + 3 + rotation + harmonics)


def read_spz(path: Path) -> dict[str, np.ndarray]:
    """The parameters of an .spz of version 2 to 4, by the names of the fields of `Gaussians`.

    Raises SceneError, which names the file, for a broken one; ImportError without gsply, or for version 4 zstandard.
    """
    with path.open("rb") as file:
        if file.read(len(MAGIC)) == MAGIC:
            optional_import("zstandard")  # gsply remembers whether it was there
    read = gsply().read_spz
    with naming(path), unreadable():
        return fields_of(read(path))


def write_spz(
    temporary: Path, fields: dict[str, np.ndarray], antialiased: bool, lines: Sequence[str], axes: str
) -> None:
    """Writes an .spz of version 3.

    Args:
        temporary: The file, see `write_safely`.
        fields: As from `read_spz`, float32, with unit quaternions.
        antialiased: The flag.
        lines: Text for our extension; none leaves it out.
        axes: Those of the fields, for Adobe's.

    Raises SceneError for means that the format does not hold, OSError, and ImportError without gsply.
    """
    gsply().write_spz(temporary, data_of(fields), version=3, fractional_bits=fractional_bits(fields["means"]))
    content = bytearray(gzip.decompress(temporary.read_bytes()))
    header = Header._make(HEADER.unpack_from(content))
    flags = header.flags | (ANTIALIASED if antialiased else 0) | HAS_EXTENSIONS
    HEADER.pack_into(content, 0, *header._replace(flags=flags))
    content += struct.pack("<III", AXES_EXTENSION, 4, AXES.index(axes) + 1)
    if text := "\n".join(lines).encode():
        content += struct.pack("<II", OWN_EXTENSION, len(text)) + text
    temporary.write_bytes(gzip.compress(content, 6, mtime=0))


def fractional_bits(means: np.ndarray) -> int:
    """How many of the 24 bits of a coordinate are fractional: the usual 12, or what the largest leaves.

    gsply would move what lies further away than the bits before the point reach. Raises SceneError beyond 2^22.
    """
    largest = float(np.abs(means).max(initial=0.0))
    bits = 23 - math.frexp(largest)[1]
    if bits < 1:
        raise SceneError(f"an .spz holds means up to 2^22, got {largest:g}")
    return min(bits, 12)


def read_metadata(path: Path) -> tuple[bool, list[str], str | None]:
    """Whether the flag for antialiasing is set, the lines of our extension, and the axes that Adobe's says.

    Raises SceneError, naming the file.
    """
    with naming(path), unreadable(), path.open("rb") as raw:
        compressed = raw.read(len(MAGIC)) != MAGIC
        raw.seek(0)
        file: Any = gzip.GzipFile(fileobj=raw) if compressed else raw
        start = file.read(HEADER.size)
        if len(start) < HEADER.size or not start.startswith(MAGIC):
            raise SceneError("not an .spz: it does not begin with 'NGSP'")
        header = Header._make(HEADER.unpack(start))
        records = b""
        if header.flags & HAS_EXTENSIONS and header.version >= SEPARATE_PARTS:
            rest = file.read(REST_OF_HEADER.size).ljust(REST_OF_HEADER.size, b"\0")
            (table,) = REST_OF_HEADER.unpack(rest)  # where the table of the parts begins: behind the extensions
            records = file.read(min(max(0, table - HEADER.size - REST_OF_HEADER.size), MOST_TEXT))
        elif header.flags & HAS_EXTENSIONS:
            file.seek(HEADER.size + header.payload())
            records = file.read(MOST_TEXT)
        found = _by_type(records)
        lines = found.get(OWN_EXTENSION, b"").decode("utf-8", "replace").splitlines()
        code = int.from_bytes(found.get(AXES_EXTENSION, b"")[:4], "little")
        if 0 < code <= len(AXES):
            return bool(header.flags & ANTIALIASED), lines, AXES[code - 1]
        # Files of earlier versions have the axes of memory, or say others in a line.
        lines = with_axes(lines, MEMORY) if OWN_EXTENSION in found else lines
        return bool(header.flags & ANTIALIASED), lines, None


def _by_type(records: bytes) -> dict[int, bytes]:
    """The contents of extensions; of several of one type the first."""
    found: dict[int, bytes] = {}
    while len(records) >= 8:
        kind, length = struct.unpack_from("<II", records)
        found.setdefault(kind, records[8 : 8 + length])
        records = records[8 + length :]
    return found
