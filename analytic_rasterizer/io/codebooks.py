"""Codebooks: a few values, or rows of values, of which each stands for its neighbours.

By Lloyd's algorithm (Lloyd, Least squares quantization in PCM, 1982), which is k-means.
"""

from __future__ import annotations

import math

import numpy as np

ROUNDS = 6
ROWS_AT_ONCE = 1 << 12
ENTRIES_OF_A_BRANCH = 256
SEED = 0


def codebook(values: np.ndarray, size: int = 256) -> np.ndarray:
    """At most `size` sorted numbers (float32) near finite `values` of any shape: all of them where they are so few.

    The first guess has entries in proportion to the cube root of the density, which is best for many entries (Panter
    and Dite, 1951): in a part of width w with a given share of the values, in proportion to w^(2/3).
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    different = np.unique(ordered)
    if len(different) <= size:
        return different.astype(np.float32)
    edges = ordered[np.linspace(0, len(ordered) - 1, size // 2 + 1).astype(np.int64)]
    steps = np.concatenate([[0], np.cumsum(np.diff(edges) ** (2 / 3))])
    found = np.interp((np.arange(size) + 0.5) / size * steps[-1], steps, edges)
    sums = np.concatenate([[0], np.cumsum(ordered)])
    for _ in range(3 * ROUNDS):
        borders = np.searchsorted(ordered, (found[1:] + found[:-1]) / 2)
        borders = np.concatenate([[0], borders, [len(ordered)]])
        count = np.diff(borders)
        found = np.where(count > 0, np.diff(sums[borders]) / np.maximum(count, 1), found)
    return found.astype(np.float32)


def nearest(book: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The index into a sorted codebook of at most 256 entries of what is nearest to each of the values: bytes."""
    borders = (book[1:].astype(np.float64) + book[:-1]) / 2
    return np.searchsorted(borders, values).astype(np.uint8)


def palette(rows: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """At most `size` rows near all `rows` (N, D), float32, and for each of these the index of its neighbour.

    Where there are more rows than entries: first a few branches, then in every branch as many entries as it has of the
    rows. That is a little worse than choosing among all entries at once, and takes a hundredth of the time.
    """
    if len(rows) <= size:
        return rows, np.arange(len(rows))
    random = np.random.default_rng(SEED)
    branches = max(1, min(ENTRIES_OF_A_BRANCH, math.isqrt(size)))
    _, branch = _means(rows, branches, random)
    entries = _shares(np.bincount(branch, minlength=branches), size)
    centres, labels, start = [], np.empty(len(rows), np.int64), 0
    for index in np.flatnonzero(entries):
        members = np.flatnonzero(branch == index)
        found, label = _means(rows[members], int(entries[index]), random)
        centres.append(found)
        labels[members] = start + label
        start += len(found)
    return np.concatenate(centres), labels


def _shares(counts: np.ndarray, size: int) -> np.ndarray:
    """Natural numbers of the sum `size` at most, in proportion to the counts, from 1 (0 for 0) to the count."""
    used = counts > 0
    return np.where(used, np.minimum(counts, 1 + (counts * (size - used.sum()) / counts.sum()).astype(np.int64)), 0)


def _means(points: np.ndarray, size: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """`size` centres of the points (N, D), N >= size, and the nearest one of each. An empty centre stays."""
    centres = points[random.permutation(len(points))[:size]]
    label = _nearest_rows(points, centres)
    for _ in range(ROUNDS if 1 < size < len(points) else 1):
        order = np.argsort(label, kind="stable")
        used, begin, count = np.unique(label[order], return_index=True, return_counts=True)
        centres[used] = np.add.reduceat(points[order], begin, 0, dtype=np.float64) / count[:, None]
        label = _nearest_rows(points, centres)
    return centres, label


def _nearest_rows(points: np.ndarray, centres: np.ndarray) -> np.ndarray:
    half = np.square(centres).sum(1) / 2
    parts = (points[start : start + ROWS_AT_ONCE] for start in range(0, len(points), ROWS_AT_ONCE))
    return np.concatenate([(half - part @ centres.T).argmin(1) for part in parts])
