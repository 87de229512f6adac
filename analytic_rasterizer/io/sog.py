"""The .sog format (PlayCanvas): a ZIP archive, or a folder, of lossless pictures and of a meta.json about them.

Pixel i of a picture belongs to Gaussian i. Its bytes choose numbers from a codebook, or in files of the first version
lie between two limits. Harmonics beyond degree 0 are rows of a palette. The format is described at
developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from .errors import SceneError, naming, optional_import, unreadable
from .formats import SOG_META

OWN = "analytic_rasterizer"  # the key of its extras that holds lines, those of a .ply's comments
FIRST_MODE = 252  # of a quaternion's fourth byte, which names the largest component
PER_ROW = 64  # entries of the palette in a row of its picture
LARGEST_DEGREE = 3


def read_sog(path: Path) -> dict[str, np.ndarray]:
    """The parameters of a .sog or meta.json of version 1 or 2, by the names of the fields of `Gaussians`.

    Opacities are kept off 0 and 1 by 1e-6, where their logit is infinite.

    Raises SceneError, which names the file, for a broken one; ImportError without Pillow.
    """
    optional_import("PIL.Image")
    with naming(path), unreadable(), _opened(path) as read:
        return _Reader(read).fields()


def read_metadata(path: Path) -> tuple[bool | None, list[str]]:
    """Whether the file says that pixels are to be integrated, None where it says nothing, and our lines in it.

    Raises SceneError, which names the file.
    """
    with naming(path), unreadable(), _opened(path) as read:
        meta = _meta(read)
    extras = meta.get("extras")
    lines = extras.get(OWN) if isinstance(extras, dict) else None
    lines = [line for line in lines if isinstance(line, str)] if isinstance(lines, list) else []
    if "model" in meta:
        return meta["model"] == "antialiased", lines
    found = meta.get("antialias")  # of earlier files
    return found if isinstance(found, bool) else None, lines


@contextmanager
def _opened(path: Path) -> Iterator[Callable[[str], bytes]]:
    """What reads a member by its name, from an archive or from the folder of a meta.json."""
    if path.suffix.lower() != ".json":
        with zipfile.ZipFile(path) as archive:
            yield archive.read
        return

    def read(name: str) -> bytes:
        if Path(name).name != name:
            raise SceneError(f"expected the name of a file beside it, got {name!r}")
        return (path if name == SOG_META else path.with_name(name)).read_bytes()

    yield read


def _meta(read: Callable[[str], bytes]) -> dict[str, Any]:
    meta = json.loads(read(SOG_META))
    if not isinstance(meta, dict):
        raise SceneError(f"meta.json must hold an object, got {type(meta).__name__}")
    return meta


class _Reader:
    """An open file. Whatever it lacks raises KeyError, IndexError or another error of Python."""

    def __init__(self, read: Callable[[str], bytes]):
        self.read, self.meta = read, _meta(read)
        version = self.meta.get("version", 1)
        if version not in (1, 2):
            raise SceneError(f"expected version 1 or 2, got {version}")
        self.has_codebooks = version == 2
        self.count = self.meta["count"] if self.has_codebooks else self.meta["means"]["shape"][0]
        if not isinstance(self.count, int) or self.count < 0:
            raise SceneError(f"expected a number of Gaussians, got {self.count!r}")

    def fields(self) -> dict[str, np.ndarray]:
        color = self.pixels("sh0")
        base = self.numbers("sh0", color[:, :3], slice(0, 3))
        if self.has_codebooks:
            opacities = (color[:, 3:] / 255).clip(1e-6, 1 - 1e-6)
            logits = np.log(opacities / (1 - opacities))
        else:
            logits = self.numbers("sh0", color[:, 3:], slice(3, 4))
        return {
            "means": self.means(),
            "log_scales": self.numbers("scales", self.pixels("scales")[:, :3], slice(0, 3)),
            "rotations": self.rotations(),
            "logit_opacities": logits,
            "shs": np.concatenate([base[:, None], self.harmonics()], 1),
        }

    def picture(self, name: str, number: int = 0) -> np.ndarray:
        """A picture of a property, (height, width, 4) bytes."""
        content = self.read(self.meta[name]["files"][number])
        with optional_import("PIL.Image").open(BytesIO(content)) as opened:
            return np.asarray(opened.convert("RGBA"))

    def pixels(self, name: str, number: int = 0) -> np.ndarray:
        """The pixels of the Gaussians, (count, 4) bytes."""
        found = self.picture(name, number).reshape(-1, 4)
        if len(found) < self.count:
            raise SceneError(f"expected pictures of at least {self.count} pixels, got {len(found)} of {name}")
        return found[: self.count]

    def numbers(self, name: str, coded: np.ndarray, channels: slice) -> np.ndarray:
        """What the bytes (..., channels) of a property stand for."""
        entry = self.meta[name]
        if self.has_codebooks:
            return np.array(entry["codebook"], np.float32)[coded]
        low, high = (np.array(entry[limit], np.float64) for limit in ("mins", "maxs"))
        if low.ndim:  # one for each channel
            low, high = low[channels], high[channels]
        return low + coded / 255 * (high - low)

    def means(self) -> np.ndarray:
        """Positions: 16 bits of the signed logarithm of 1 + |x|, between limits."""
        low_bytes, high_bytes = (self.pixels("means", i)[:, :3].astype(np.float64) for i in (0, 1))
        low, high = (np.array(self.meta["means"][limit], np.float64) for limit in ("mins", "maxs"))
        logs = low + (256 * high_bytes + low_bytes) / 65535 * (high - low)
        return np.sign(logs) * np.expm1(np.abs(logs))

    def rotations(self) -> np.ndarray:
        """Unit quaternions from their three smaller components; the identity where none is named."""
        pixels = self.pixels("quats")
        smaller = (pixels[:, :3] / 255 * 2 - 1) / np.sqrt(2)
        largest = np.sqrt((1 - (smaller**2).sum(1)).clip(0))
        found = np.tile(np.array([1.0, 0.0, 0.0, 0.0]), (self.count, 1))
        for i in range(4):
            named = pixels[:, 3] == FIRST_MODE + i
            found[named] = np.insert(smaller[named], i, largest[named], 1)
        return found

    def harmonics(self) -> np.ndarray:
        """Coefficients beyond degree 0, (count, coefficients, 3)."""
        entry = self.meta.get("shN")
        if not entry:
            return np.zeros((self.count, 0, 3))
        palette = self.picture("shN")[:, :, :3]
        coefficients = palette.shape[1] // PER_ROW
        degree = [(degree + 1) ** 2 - 1 for degree in range(LARGEST_DEGREE + 1)].index(coefficients)
        if entry.get("bands", degree) != degree:
            raise SceneError(f"expected a palette of degree {entry['bands']}, got {degree}")
        palette = palette[:, : PER_ROW * coefficients].reshape(-1, coefficients, 3)
        labels = self.pixels("shN", 1)[:, :2].astype(np.int64)
        return self.numbers("shN", palette[labels[:, 0] + 256 * labels[:, 1]], slice(0, 3))
