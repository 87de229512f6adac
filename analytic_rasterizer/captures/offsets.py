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
ROUNDS = 5  # of medians in turn; where photographs overlap, the first three do nearly all
# Added to the diagonal, of its mean: photographs without common points are known up to a constant each.
DAMPING = 1e-9


class Fit(NamedTuple):
    """Of C values for each observation.

    Attributes:
        offsets: (count, C) what the photographs add, with the median 0; NaN for those without observations.
        slopes: (K, C) by which the terms are multiplied.
        deviations: (O, C) what is left of the values.
    """

    offsets: Tensor
    slopes: Tensor
    deviations: Tensor


def offsets_of(values: Tensor, photograph: Tensor, point: Tensor, count: int, terms: Tensor | None = None) -> Fit:
    """Offsets of `count` photographs from values (O, C) of points (O,) in photographs (O,), in float64.

    The sum of pseudo-Huber losses of the deviations is minimal. It is convex, so there is one solution: least squares
    with weights that follow from the deviations, until nothing moves. Levels of points are eliminated.

    Args:
        terms: (O, K) what else an observation may have, each times a slope; None: nothing.
    """
    _, point = point.unique(return_inverse=True)
    terms = values[:, :0] if terms is None else terms
    weights = values.new_ones(len(values))
    unknowns, deviations = values.new_zeros(count + terms.shape[1], values.shape[1]), values
    for _ in range(MOST_SOLUTIONS if len(values) else 0):
        before = unknowns
        unknowns, deviations = _weighted(values, photograph, point, weights, count, terms)
        if (unknowns - before).abs().max() < CONVERGED:
            break
        weights = (1 + deviations.square().mean(1) / SCALE**2).rsqrt()
    offsets, slopes = unknowns.split([count, terms.shape[1]])
    seen = torch.bincount(photograph, minlength=count) > 0
    offsets = torch.where(seen[:, None], offsets, math.nan)
    return Fit(offsets - offsets.nanmedian(0).values, slopes, deviations)


def _weighted(
    values: Tensor, photograph: Tensor, point: Tensor, weights: Tensor, count: int, terms: Tensor
) -> tuple[Tensor, Tensor]:
    """Offsets with slopes, and deviations, that are the least in the mean square, where observations have weights (O,).

    Their normal equations, less what the levels of the points have of them.
    """
    points, unknowns = int(point.max()) + 1, count + terms.shape[1]
    weighted, weighted_terms = weights[:, None] * values, weights[:, None] * terms
    of_photographs = values.new_zeros(count).index_add_(0, photograph, weights)
    crossed = values.new_zeros(count, terms.shape[1]).index_add_(0, photograph, weighted_terms)
    matrix = values.new_zeros(unknowns, unknowns)
    matrix[:count, :count] = torch.diag(of_photographs)
    matrix[:count, count:], matrix[count:, :count] = crossed, crossed.T
    matrix[count:, count:] = weighted_terms.T @ terms
    right = torch.cat([values.new_zeros(count, values.shape[1]), weighted_terms.T @ values])
    right.index_add_(0, photograph, weighted)
    # By point: weights of each unknown, and mean values.
    shared = values.new_zeros(points, unknowns)
    shared.view(-1).index_add_(0, point * unknowns + photograph, weights)
    shared[:, count:].index_add_(0, point, weighted_terms)
    of_points = values.new_zeros(points, 1).index_add_(0, point, weights[:, None])
    means = values.new_zeros(points, values.shape[1]).index_add_(0, point, weighted) / of_points
    matrix -= shared.T @ (shared / of_points)
    right -= shared.T @ means
    matrix.diagonal().add_(DAMPING * of_photographs.mean())
    found = torch.linalg.solve(matrix, right)
    levels = means - shared @ found / of_points
    return found, values - found[:count][photograph] - terms @ found[count:] - levels[point]


def medians_in_turn(values: Tensor, photograph: Tensor, point: Tensor, count: int) -> Fit:
    """The same without terms, by a few rounds of medians over points and over photographs."""
    _, point = point.unique(return_inverse=True)
    offsets, levels = values.new_zeros(count, values.shape[1]), values[:0]
    for _ in range(ROUNDS if len(values) else 0):
        levels = _medians(values - offsets[photograph], point, int(point.max()) + 1)
        offsets = _medians(values - levels[point], photograph, count)
        offsets = offsets - offsets.nanmedian(0).values
    if not len(values):
        offsets = torch.full_like(offsets, math.nan)
    return Fit(offsets, values[:0], values - offsets[photograph] - levels[point])


def _medians(values: Tensor, group: Tensor, count: int) -> Tensor:
    return torch.stack([medians_of(channel, group, count) for channel in values.unbind(1)], 1)


def medians_of(values: Tensor, group: Tensor, count: int) -> Tensor:
    """(count,): the median of the values (O,) of each group (O,); NaN for groups without any."""
    order = values.argsort(stable=True)
    order = order[group[order].argsort(stable=True)]
    sizes = torch.bincount(group, minlength=count)
    first = sizes.cumsum(0) - sizes
    medians = values.new_full((count,), math.nan)
    there = sizes > 0
    low, high = ((first + half)[there] for half in ((sizes - 1) // 2, sizes // 2))
    medians[there] = (values[order[low]] + values[order[high]]) / 2
    return medians
