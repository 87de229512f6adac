"""Vignetting: how much darker a camera shows what is farther from its principal point.

It is measured where several photographs show a point at different radii, together with the exposures.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .. import io
from .evidence import Evidence, consistent_fit, smooth_points

POWERS = (2, 4)  # of the radius
SECTORS = 4  # left, right, above and below: what is darker there only is none of the lens
ONE_LENS = 0.05  # natural logarithm of the ratio of focal lengths, up to which photographs have one camera
REACHED = 0.95  # of the observations are at smaller radii than the outermost that is measured
LEAST_OBSERVED = 100  # observations of a camera, in each sector, whose slope is then known to a tenth of their spread


class Falloff(NamedTuple):
    """What photographs of one camera show.

    Attributes:
        photographs: Their places.
        slopes: (2,) of POWERS of the radius, in halves of the diagonal: stops of light more than in the middle.
        radius: The largest that is measured.
        stops: How much darker than the middle it is there; NaN: too little is seen.
        least: The same in the direction where it is the least.
    """

    photographs: list[int]
    slopes: Tensor
    radius: float
    stops: float
    least: float


def cameras_of(views: Sequence[io.View]) -> list[list[int]]:
    """Places of the views of each camera: those with pictures of one size, upright or not, and nearly one focal length.

    Reconstructions often have a camera for each photograph.
    """
    by_size: dict[tuple[int, ...], list[int]] = {}
    for place, view in enumerate(views):
        by_size.setdefault(tuple(sorted((view.width, view.height))), []).append(place)
    cameras = []
    for places in by_size.values():
        focal = {place: math.log(views[place].fx * views[place].fy) / 2 for place in places}
        places = sorted(places, key=lambda place: (focal[place], place))
        breaks = [i for i in range(1, len(places)) if focal[places[i]] - focal[places[i - 1]] > ONE_LENS]
        cameras += [sorted(places[a:b]) for a, b in zip([0, *breaks], [*breaks, len(places)])]
    return cameras


def falloffs_of(evidence: Evidence, views: Sequence[io.View]) -> list[Falloff]:
    """The falloff of each camera that took photographs of the evidence."""
    if evidence.position is None or not len(evidence.position):
        return []
    cameras = cameras_of(views)
    camera = torch.empty(evidence.count, dtype=torch.int64)
    for number, places in enumerate(cameras):
        camera[places] = number
    x, y = evidence.position.unbind(1)
    squares = x.square() + y.square()
    sector = torch.where(x.abs() > y.abs(), (x > 0).long(), 2 + (y > 0).long())
    of_camera, numbers = camera[evidence.photograph], torch.arange(len(squares))
    terms = squares.new_zeros(len(squares), len(cameras), len(POWERS))
    terms[numbers, of_camera] = torch.stack([squares ** (power / 2) for power in POWERS], 1)
    fit, rows = consistent_fit(evidence, smooth_points(evidence), terms.flatten(1))
    slopes = fit.slopes.mean(1).view(len(cameras), len(POWERS))
    # In sectors the square alone: of less than a picture the two powers are hard to tell apart.
    terms = squares.new_zeros(len(squares), len(cameras), SECTORS)
    terms[numbers, of_camera, sector] = squares
    in_sectors = consistent_fit(evidence, rows, terms.flatten(1))[0].slopes.mean(1).view(len(cameras), SECTORS)
    found = []
    for number, places in enumerate(cameras):
        own = rows[of_camera[rows] == number]
        radius, stops, least = 0.0, math.nan, math.nan
        if torch.bincount(sector[own], minlength=SECTORS).amin() >= LEAST_OBSERVED:
            radius = squares[own].quantile(REACHED).sqrt().item()
            stops = -sum(slope * radius**power for slope, power in zip(slopes[number].tolist(), POWERS))
            least = -in_sectors[number].max().item() * radius**2
        found.append(Falloff(places, slopes[number], radius, stops, least))
    return found
