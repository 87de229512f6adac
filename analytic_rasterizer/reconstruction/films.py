"""Photographs of a film: the sharpest picture of each interval."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from .. import io
from ..io.errors import first_line, optional_import

PER_SECOND = 2  # photographs: a walk round something shows it often enough
LEAST, MOST = 24, 240  # photographs of short and of long films
QUALITY = 95  # of JPEG


@contextmanager
def opened_film(path: Path) -> Iterator[tuple[Iterator[bytes], dict[str, Any]]]:
    """Pictures, three bytes per pixel, and what is known of all: size in px, duration in s, fps.

    Raises:
        io.SceneError: A film that cannot be read.
        ImportError: Without the extra `video`.
    """
    ffmpeg = optional_import("imageio_ffmpeg", "video")
    frames = ffmpeg.read_frames(str(path))
    try:
        try:
            known = next(frames)
        except (OSError, RuntimeError, StopIteration) as error:
            raise io.SceneError(f"{path}: expected a film, got what ffmpeg cannot read ({first_line(error)})") from None
        yield frames, known
    finally:
        frames.close()


def counts_of(known: dict[str, Any]) -> tuple[int, int]:
    """Of a film: how many pictures it has, about, and how many photographs are taken."""
    pictures = max(1, round(known["fps"] * known["duration"]))
    wanted = min(max(round(PER_SECOND * known["duration"]), LEAST), MOST)
    return pictures, min(wanted, pictures)


def about_film(path: Path) -> tuple[int, tuple[int, int], str]:
    """How many photographs are taken of a film, their size in px, and both in words. Raises as `opened_film`."""
    with opened_film(path) as (_, known):
        pictures, count = counts_of(known)
    each = f"{count} photographs, of each {known['duration'] / count:.3g} s the sharpest of {pictures / count:.3g}"
    told = f"a film of {known['duration']:.1f} s: {each} pictures"
    return count, tuple(known["size"]), told


def take_photographs(path: Path, folder: Path, progress: Callable[[int, int], None]) -> int:
    """Writes the photographs of a film to a folder, as frame_00042.jpg, the 42nd picture, and returns how many.

    Args:
        progress: Is told how many there are, and of how many.

    Raises:
        io.SceneError, ImportError: As `opened_film`.
        OSError: A photograph cannot be written.
    """
    image, taken = optional_import("PIL.Image", "cli"), 0
    with opened_film(path) as (frames, known):
        width, height = known["size"]
        pictures, count = counts_of(known)
        best: tuple[float, int, np.ndarray] | None = None

        def write() -> None:
            _, number, pixels = best
            path, picture = folder / f"frame_{number:05}.jpg", image.fromarray(pixels)
            io.write_safely(path, lambda temporary: picture.save(temporary, quality=QUALITY, subsampling=0))

        for number, data in enumerate(frames, 1):
            pixels = np.frombuffer(data, np.uint8).reshape(height, width, 3)
            if best is not None and (number - 1) * count // pictures > (best[1] - 1) * count // pictures:
                write()
                best, taken = None, taken + 1
                progress(min(taken, count), count)
            found = sharpness(pixels)
            if best is None or found > best[0]:
                best = found, number, pixels
        if best is not None:
            write()
            taken += 1
    progress(taken, taken)
    return taken


def sharpness(pixels: np.ndarray) -> float:
    """How sharp a picture (H, W, 3) uint8 is beside others of the same: the variance of its Laplacian.

    Source: Pech-Pacheco et al., Diatom autofocusing in brightfield microscopy, ICPR 2000.
    """
    grey = pixels[..., 1].astype(np.float32)
    around = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:]
    return float((around - 4 * grey[1:-1, 1:-1]).var()) if min(grey.shape) > 2 else 0.0
