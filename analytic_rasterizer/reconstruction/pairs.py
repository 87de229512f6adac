"""Which photographs are compared: all with all, or neighbours by name and by position."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import combinations

import numpy as np

MOST_EXHAUSTIVE = 80  # photographs: 3,160 pairs
NEXT = 10  # by name; and those that are 16, 32, .. further on
NEAREST = 20  # by position
SPREAD = 40  # photographs all of which are compared with each other: where a walk comes back to its beginning
EARTH_RADIUS = 6_371_000.0  # m


def in_order(names: Sequence[str]) -> list[str]:
    """The names in the order of their numbers: img2 comes before img10."""
    return sorted(names, key=_key)


def _key(name: str) -> list[tuple[bool, int, str]]:
    parts = [part for part in re.split(r"(\d+)", name) if part]
    return [(False, int(part), "") if part.isdecimal() else (True, 0, part) for part in parts]


def pairs_of(names: Sequence[str], positions: Sequence[tuple[float, float, float] | None]) -> list[tuple[str, str]]:
    """The pairs of photographs to compare, each once.

    Args:
        names: Of the files.
        positions: Latitude and longitude in degrees and height in m, of each; None: not known.
    """
    if len(names) <= MOST_EXHAUSTIVE:
        return list(combinations(in_order(names), 2))
    place = {name: k for k, name in enumerate(in_order(names))}
    count, chosen = len(names), set()
    steps = [*range(1, NEXT + 1), *(2**k for k in range(4, count.bit_length()))]
    for step in steps:
        chosen.update((first, first + step) for first in range(count - step))
    chosen.update(combinations((k * count // SPREAD for k in range(SPREAD)), 2))
    known = [(place[name], position) for name, position in zip(names, positions) if position is not None]
    chosen.update(_near([number for number, _ in known], [position for _, position in known]))
    ordered = in_order(names)
    return [(ordered[first], ordered[second]) for first, second in sorted(chosen)]


def _near(numbers: Sequence[int], positions: Sequence[tuple[float, float, float]]) -> set[tuple[int, int]]:
    """Pairs of numbers whose positions are near: of each, the NEAREST others."""
    if len(numbers) < 2:
        return set()
    latitude, longitude, height = np.array(positions, dtype=np.float64).T
    angle = np.radians(np.stack([latitude, longitude]))
    # A plane through the middle of the photographs: they are within a few kilometres of each other.
    across = EARTH_RADIUS * np.stack([angle[0], angle[1] * np.cos(angle[0].mean())])
    metres = np.stack([*across, height], 1)
    found = set()
    for k, own in enumerate(metres):
        order = np.argsort(((metres - own) ** 2).sum(1), kind="stable")
        found |= {tuple(sorted((numbers[k], numbers[other]))) for other in order[: NEAREST + 1] if other != k}
    return found


def matching_in_words(count: int, located: int) -> str:
    """How so many photographs are compared, of which `located` have a position."""
    if count <= MOST_EXHAUSTIVE:
        return "each with each"
    return "neighbours by name" + (f", and by position of {located} with one" if located > 1 else "")
