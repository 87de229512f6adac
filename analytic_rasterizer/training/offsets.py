"""What photographs add to what they show of the same points: one robust fit of both.

A measured value is what the point has plus what the photograph adds. Both are found together, so that the answer does
not depend on how far photographs overlap: around a ring of which each photograph shares points with its neighbours
alone, medians over points and over photographs in turn hardly move.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

SCALE = 0.05  # deviation from which on a value counts less; of logarithms of colours, half of all deviate by more
CONVERGED = 1e-3  # change of a number from one solution to the next
MOST_SOLUTIONS = 50  # 20 are enough in all captures that were measured
# Added to the diagonal, of its mean: photographs without common points are known up to a constant each.
DAMPING = 1e-9


class Fit(NamedTuple):
    """Of C values for each observation.

    Attributes:
        offsets: (count, C) what the photographs add, with the median 0; NaN for those without observations.
        deviations: (O, C) what is left of the values.
    """

    offsets: Tensor
    deviations: Tensor


def offsets_of(values: Tensor, photograph: Tensor, point: Tensor, count: int) -> Fit:
    """Offsets of `count` photographs from values (O, C) of points (O,) in photographs (O,), in float64.

    The sum of pseudo-Huber losses of the deviations is minimal. It is convex, so there is one solution: least squares
    with weights that follow from the deviations, until nothing moves. Levels of points are eliminated.
    """
    _, point = point.unique(return_inverse=True)
    weights = values.new_ones(len(values))
    offsets, deviations = values.new_zeros(count, values.shape[1]), values
    for _ in range(MOST_SOLUTIONS if len(values) else 0):
        before = offsets
        offsets, deviations = _weighted(values, photograph, point, weights, count)
        if (offsets - before).abs().max() < CONVERGED:
            break
        weights = (1 + deviations.square().mean(1) / SCALE**2).rsqrt()
    seen = torch.bincount(photograph, minlength=count) > 0
    offsets = torch.where(seen[:, None], offsets, math.nan)
    return Fit(offsets - offsets.nanmedian(0).values, deviations)


def _weighted(values: Tensor, photograph: Tensor, point: Tensor, weights: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Offsets and deviations that are the least in the mean square, where observations have weights (O,)."""
    points, weighted = int(point.max()) + 1, weights[:, None] * values
    of_points = values.new_zeros(points).index_add_(0, point, weights)
    shared = values.new_zeros(points * count).index_add_(0, point * count + photograph, weights).view(points, count)
    means = values.new_zeros(points, values.shape[1]).index_add_(0, point, weighted) / of_points[:, None]
    of_photographs = shared.sum(0)
    matrix = torch.diag(of_photographs + DAMPING * of_photographs.mean()) - shared.T @ (shared / of_points[:, None])
    right = values.new_zeros(count, values.shape[1]).index_add_(0, photograph, weighted) - shared.T @ means
    offsets = torch.linalg.solve(matrix, right)
    levels = means - shared @ offsets / of_points[:, None]
    return offsets, values - offsets[photograph] - levels[point]
