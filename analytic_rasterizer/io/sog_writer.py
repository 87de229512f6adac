"""Writing the .sog format, version 2 (see `sog`, which reads it).

Gaussians are written in Morton order, so that neighbours in a picture are neighbours in space: it takes less room.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .codebooks import codebook, nearest, palette
from .errors import optional_import
from .formats import SOG_META
from .morton import morton_order
from .sog import FIRST_MODE, OWN, PER_ROW
from .writing import write_bytes, write_safely

MOST_ENTRIES = 1 << 16  # of the palette: an index has two bytes
LOWEST_LOG_SCALE = -20.0  # smaller scales cannot be seen, and would take an entry from others
FEW = 1 << 10  # Gaussians, up to which each has an entry of its own


def write_sog(path: Path, fields: dict[str, np.ndarray], antialiased: bool | None, lines: Sequence[str]) -> None:
    """Writes a .sog, or a meta.json with its pictures beside it.

    Args:
        path: The file. If it ends in .json, the pictures are written first, each as a whole.
        fields: As from `read_sog`, float32 and finite but for scales of 0, at least one, with unit quaternions.
        antialiased: What meta.json says of it; None: nothing.
        lines: Text for its extras.

    Raises OSError, and ImportError without Pillow.
    """
    pictures, meta = encoded(fields)
    meta = {"version": 2, "asset": {"generator": OWN}} | meta
    if antialiased is not None:
        meta["antialias"] = antialiased
    if lines:
        meta["extras"] = {OWN: list(lines)}
    text = json.dumps(meta, separators=(",", ":")).encode()
    contents = {name: _webp(pixels) for name, pixels in pictures.items()}
    if path.suffix.lower() == ".json":
        for name, content in contents.items():
            write_bytes(path.with_name(name), content)
        write_bytes(path, text)
        return

    def write(temporary: Path) -> None:
        with zipfile.ZipFile(temporary, "w") as archive:  # pictures are compressed already
            for name, content in {SOG_META: text, **contents}.items():
                archive.writestr(zipfile.ZipInfo(name), content)

    write_safely(path, write)


def encoded(fields: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The pictures by their names, (height, width, 3 or 4) bytes, and what meta.json says of them."""
    order = _order(fields["means"])
    fields = {name: field[order] for name, field in fields.items()}
    count = len(order)
    width = -(-int(np.ceil(np.sqrt(count))) // 4) * 4
    height = -(-count // width)

    def picture(pixels: np.ndarray) -> np.ndarray:
        padded = np.zeros((width * height, pixels.shape[1]), np.uint8)
        padded[:count] = pixels
        return padded.reshape(height, width, -1)

    means, limits = _means(fields["means"])
    log_scales = np.maximum(fields["log_scales"], LOWEST_LOG_SCALE)
    scales, base = codebook(log_scales), codebook(fields["shs"][:, 0])
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-fields["logit_opacities"].astype(np.float64)))
    alpha = np.rint(255 * opacities).astype(np.uint8)
    pictures = {
        "means_l.webp": picture((means & 255).astype(np.uint8)),
        "means_u.webp": picture((means >> 8).astype(np.uint8)),
        "scales.webp": picture(nearest(scales, log_scales)),
        "quats.webp": picture(_quaternions(fields["rotations"])),
        "sh0.webp": picture(np.concatenate([nearest(base, fields["shs"][:, 0]), alpha], 1)),
    }
    meta = {
        "count": count,
        "means": limits | {"files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": _filled(scales), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": _filled(base), "files": ["sh0.webp"]},
    }
    if fields["shs"].shape[1] > 1:
        meta["shN"] = _add_harmonics(pictures, picture, fields["shs"][:, 1:])
    return pictures, meta


def _order(means: np.ndarray) -> np.ndarray:
    """(N,) indices along a Morton curve through a grid of 1024^3 cells."""
    low, high = means.min(0).astype(np.float64), means.max(0).astype(np.float64)
    return morton_order((means - low) / np.where(high > low, high - low, 1) * 1023, 10)


def _means(means: np.ndarray) -> tuple[np.ndarray, dict[str, list[float]]]:
    """16 bits of signed logarithms, (N, 3), and their limits."""
    wide = means.astype(np.float64)
    logs = np.sign(wide) * np.log1p(np.abs(wide))
    low, high = logs.min(0), logs.max(0)
    steps = np.rint((logs - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    return steps, {"mins": low.tolist(), "maxs": high.tolist()}


def _quaternions(rotations: np.ndarray) -> np.ndarray:
    """(N, 4) bytes: the three smaller components, and which is the largest. That is positive."""
    wide = rotations.astype(np.float64)
    largest = np.abs(wide).argmax(1)
    wide = wide * np.where(np.take_along_axis(wide, largest[:, None], 1) < 0, -1, 1)
    smaller = wide[np.arange(4) != largest[:, None]].reshape(-1, 3)
    coded = np.rint((smaller * np.sqrt(2) + 1) / 2 * 255).clip(0, 255)
    return np.concatenate([coded, FIRST_MODE + largest[:, None]], 1).astype(np.uint8)


def _add_harmonics(
    pictures: dict[str, np.ndarray], picture: Callable[[np.ndarray], np.ndarray], rest: np.ndarray
) -> dict[str, Any]:
    """Adds pictures of a palette of harmonics, and of which entry each Gaussian has; returns what meta.json says."""
    count, bands, _ = rest.shape
    size = count if count <= FEW else min(MOST_ENTRIES, 1 << (count.bit_length() - 1))
    entries, labels = palette(np.ascontiguousarray(rest.reshape(count, -1)), size)
    book = codebook(entries)
    rows = -(-len(entries) // PER_ROW)
    centroids = np.zeros((rows * PER_ROW, bands, 3), np.uint8)
    centroids[: len(entries)] = nearest(book, entries).reshape(-1, bands, 3)
    pictures["shN_centroids.webp"] = centroids.reshape(rows, PER_ROW * bands, 3)
    pictures["shN_labels.webp"] = picture(np.stack([labels & 255, labels >> 8, 0 * labels], 1).astype(np.uint8))
    return {
        "count": len(entries),
        "bands": int(np.sqrt(bands + 1)) - 1,
        "codebook": _filled(book),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }


def _filled(book: np.ndarray) -> list[float]:
    """256 numbers, of which the last may repeat."""
    return np.pad(book, (0, 256 - len(book)), mode="edge").tolist()


def _webp(pixels: np.ndarray) -> bytes:
    """A lossless picture; colours below an alpha of 0 are kept."""
    in_memory = io.BytesIO()
    optional_import("PIL.Image").fromarray(pixels).save(in_memory, "WEBP", lossless=True, exact=True)
    return in_memory.getvalue()
