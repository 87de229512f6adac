"""What finding the cameras of photographs takes, before it is done: `inspect PHOTOGRAPHS`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from ..training.reports import duration
from .films import about_film
from .folder import Photographs, Shot, sizes_in_words
from .pairs import matching_in_words, pairs_of

LARGEST = 1600  # px of the longer side, to which pictures are reduced for their features
FEATURES = 4096  # of a picture, at most: the time of a pair grows with their square
# Camera models of COLMAP, by the photographs of a camera: fewer do not determine the four numbers of a lens.
FEW, OF_FEW, OF_MANY = 20, "SIMPLE_RADIAL", "OPENCV"
# Seconds of one thread of a Xeon: of a megapixel, of a pair, and of placing photographs, by the square of their number.
OF_MEGAPIXEL, OF_PAIR, OF_PLACING = 1.0, 0.05, 0.005


def groups_of(shots: Sequence[Shot]) -> list[tuple[str, list[Shot]]]:
    """The photographs of each camera, with its model: a camera has one size and one focal length."""
    groups: dict[tuple, list[Shot]] = {}
    for shot in shots:
        groups.setdefault(shot.camera, []).append(shot)
    return [(OF_FEW if len(group) < FEW else OF_MANY, group) for group in groups.values()]


@dataclass(frozen=True)
class Forecast:
    """What will be done.

    Attributes:
        photographs: How many; of a film, how many will be taken.
        cameras: Photographs by camera model, for each camera: ["OPENCV: 39"].
        pairs: Of photographs that are compared.
        seconds: About how long it takes.
        lines: All of it, in words.
    """

    photographs: int
    cameras: tuple[str, ...]
    pairs: int
    seconds: float
    lines: tuple[str, ...] = field(repr=False)

    def to_json(self) -> dict[str, Any]:
        """Everything, as JSON holds it."""
        return dict(vars(self))


def forecast(found: Photographs, threads: int) -> Forecast:
    """Looks at the headers of the photographs, or of a film.

    Args:
        found: The photographs.
        threads: That COLMAP will have.

    Raises:
        io.SceneError: A file that cannot be read.
        ImportError: Without the extra `video`, of a film.
    """
    lines = []
    if found.is_film:
        count, size, said = about_film(found.source)
        lines.append(said)
        shots = [Shot(f"{k}", (*size, "", "", None, None)) for k in range(count)]
    else:
        shots = found.shots()
    groups = groups_of(shots)
    pairs = len(pairs_of([shot.name for shot in shots], [shot.position for shot in shots]))
    seconds = (
        sum(OF_MEGAPIXEL * _megapixels(shot.size) for shot in shots) + OF_PAIR * pairs + OF_PLACING * len(shots) ** 2
    ) / threads
    cameras = tuple(f"{model}: {len(group)}" for model, group in groups)
    masks = sum(found.mask(name) is not None for name in found.names)
    located = sum(shot.position is not None for shot in shots)
    lines += [
        f"{len(shots)} photographs without cameras, {sizes_in_words(shots)}",
        f"cameras, one for each size and focal length: {len(groups)} ({', '.join(cameras)})",
        f"masks: {masks or 'none'}",
        f"matching: {matching_in_words(len(shots), located)}, {pairs:,} pairs",
        f"COLMAP takes about {duration(seconds)} on {threads} threads",
    ]
    return Forecast(len(shots), cameras, pairs, seconds, tuple(f"{found.source}: {line}" for line in lines))


def _megapixels(size: tuple[int, int]) -> float:
    """Of a picture as its features are looked for."""
    width, height = size
    return width * height * min(1, LARGEST / max(size)) ** 2 / 1e6
