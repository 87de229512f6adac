"""The depths that a step compares its pictures with, by the option `depth`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .. import io
from ..captures import colmap
from ..captures.depth import (
    OF_FILES,
    PROBLEMS,
    UNSCALED,
    WRONG,
    DepthMap,
    Measured,
    SeenPoints,
    measure_maps,
    points_in,
)
from ..captures.layouts import Capture
from ..captures.pictures import Pictures
from .options import TrainingOptions

MARGIN = 0.02  # of an inverse median depth: smaller differences count by their square, for pixels are as wide as that


class DepthTarget(NamedTuple):
    """What the inverse depths of a picture are to be.

    Attributes:
        inverse: (H, W) float32, 1 / world units.
        shares: (H, W) float32, how much each pixel counts, 0 where nothing is known.
        reference: A median depth of the picture, world units.
        total: The sum of all shares, without a mask.
    """

    inverse: Tensor
    shares: Tensor
    reference: float
    total: float

    def arguments(self, weight: float) -> dict[str, Tensor | float]:
        """By the names of the op: `weight` times the mean difference of inverse depths, times the reference."""
        return {
            "depth_target": self.inverse,
            "depth_shares": self.shares,
            "depth_weight": weight * self.reference / self.total,
            "depth_margin": MARGIN / self.reference,
        }


Targets = Callable[[int, int], "DepthTarget | None"]
"""The target of a picture by its scale and view; None where nothing is known."""


class PointTargets:
    """Of the points that photographs show. Points of one pixel count together.

    Args:
        pictures: Of the training.
        seen: For every view of theirs.
        device: Of the pictures.
    """

    def __init__(self, pictures: Pictures, seen: Sequence[SeenPoints], device: torch.device):
        self._pictures, self._kept = pictures, {}
        for scale, settings in pictures.settings.items():
            for view, (of_view, points) in enumerate(zip(settings, seen)):
                if not len(points.inverse):
                    continue
                height, width = of_view.image_height, of_view.image_width
                column, row = (points.pixels / scale).long().unbind(1)
                place = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
                pixels, which, counts = place.unique(return_inverse=True, return_counts=True)
                sums = points.inverse.new_zeros(len(pixels)).index_add_(0, which, points.inverse)
                values = torch.stack([sums / counts, counts.double()]).to(device, torch.float32)
                reference = 1 / points.inverse.median().item()
                self._kept[scale, view] = (height, width), pixels.to(device), values, reference, len(points.inverse)

    def __call__(self, scale: int, view: int) -> DepthTarget | None:
        if (scale, view) not in self._kept:
            return None
        size, pixels, values, reference, total = self._kept[scale, view]
        inverse, shares = values.new_zeros(2, size[0] * size[1]).index_copy_(1, pixels, values).view(2, *size)
        mask = self._pictures.mask(scale, view)
        return DepthTarget(inverse, shares if mask is None else shares * mask, reference, total)


class MapTargets:
    """Of depth maps, which are among the pictures."""

    def __init__(self, pictures: Pictures, maps: Sequence[DepthMap | None]):
        self._pictures, self._maps = pictures, maps

    def __call__(self, scale: int, view: int) -> DepthTarget | None:
        found, total = self._maps[view], self._pictures.depth_sums[scale][view]
        if found is None or not total:
            return None
        inverse, shares = self._pictures.depth(scale, view)
        return DepthTarget(inverse / found.reference, shares, found.reference, total)


class Depths(NamedTuple):
    """What a capture has of the depths that a training is told to take.

    Attributes:
        maps: Of the photographs to train with, for `load_pictures`; None: maps are not asked for.
        points: (P, 3) of the capture, and `tracks` as of `points_in`; None: points are not asked for.
        notes: Sentences for the user.
    """

    maps: list[DepthMap | None] | None = None
    points: Tensor | None = None
    tracks: dict[str, Tensor] | None = None
    notes: tuple[str, ...] = ()

    def targets(self, pictures: Pictures, device: torch.device) -> Targets | None:
        """For a `Trainer` of these pictures, which were loaded with the maps."""
        if self.maps is not None:
            return MapTargets(pictures, self.maps)
        if self.points is None:
            return None
        return PointTargets(pictures, points_in(pictures.views, self.points, self.tracks), device)


def depths_of(options: TrainingOptions, capture: Capture, skip_missing: bool = False) -> Depths:
    """What `options.depth` asks for.

    Args:
        capture: In the frame of the training.
        skip_missing: Whether maps that are not there, cannot be read or hold no depth are left out; otherwise they are
            an error.

    Raises:
        io.SceneError: There is none of it, or none that can be used; says what was found, and what to do.
    """
    if options.depth == "none":
        return Depths()
    points = None if capture.points is None else capture.points[0]
    from_colmap = points is not None and capture.source is not None and capture.source.is_dir()
    tracks = colmap.load_tracks(capture.source) if from_colmap else {}
    if options.depth == "maps":
        return _maps_of(options, capture, points, tracks, skip_missing)
    if points is None:
        raise io.SceneError(
            f"{capture.source}: the capture has no points, whose depths --depth points compares",
            "--depth maps takes depth maps beside the photographs",
            "--depth none does without",
        )
    how = "that tracks of the reconstruction name" if tracks else "that no nearer point hides"
    return Depths(points=points, tracks=tracks, notes=(f"depths are those of the points {how}, in each photograph",))


def _maps_of(
    options: TrainingOptions,
    capture: Capture,
    points: Tensor | None,
    tracks: dict[str, Tensor],
    skip_missing: bool,
) -> Depths:
    items, where = capture.train, capture.source
    if not any(item.depth for item in items):
        raise io.SceneError(
            f"{where}: none of {len(items)} photographs has a depth map: expected depths/NAME.png beside the folder of "
            "the photographs (inverse depths, with depth_params.json beside the cameras), or depth_file_path in the "
            "frames of transforms.json",
            "--depth points takes the points of the reconstruction",
            "--depth none does without",
        )
    if any(item.undistort and item.depth for item in items):
        raise io.SceneError(f"{where}: depth maps cannot be undistorted", "leave out --lens undistort")
    found = measure_maps(items, points, tracks, options.depth_unit, options.depth_fit == "auto")
    given, usable = sum(item.depth is not None for item in items), [one for one in found if one.map is not None]
    reasons = [
        f"{len(bad)} {problem}, the first is {bad[0]}" for problem in PROBLEMS if (bad := _about(found, problem))
    ]
    counted = f"{where}: of {given} depth maps {'; '.join(reasons)}"
    if any(_about(found, problem) for problem in OF_FILES) and not skip_missing:
        raise io.SceneError(counted, "--missing skip leaves them out")
    if not usable:
        raise io.SceneError(counted, *_advice(found, options), "--depth none does without")
    notes = [f"{len(usable)} of {len(items)} photographs have a depth map{_fit_in_words(usable)}"]
    if reasons:
        notes.append(f"of {given} depth maps {given - len(usable)} are left out: {'; '.join(reasons)}")
    return Depths([one.map for one in found], notes=tuple(notes))


def _about(found: Sequence[Measured], problem: str) -> list[str]:
    return [one.about for one in found if one.problem == problem]


def _fit_in_words(usable: Sequence[Measured]) -> str:
    """How the scales of maps were found, and how well they fit."""
    fitted = sum(one.fitted for one in usable)
    text = f"; the scales of {fitted} are fitted to the points" if fitted else ""
    known = sorted(one.difference for one in usable if one.difference is not None)
    return f"{text}, from which maps differ by {known[len(known) // 2]:.1%}" if known else text


def _advice(found: Sequence[Measured], options: TrainingOptions) -> list[str]:
    """What may help where no map can be used."""
    problems, advice = {one.problem for one in found}, []
    if UNSCALED in problems:
        advice.append("depth_params.json beside the cameras, or points, give maps of inverse depths a scale")
    if WRONG in problems and options.depth_fit == "none":
        advice.append("--depth-fit auto fits scales to the points")
        advice.append("--depth-unit is what 1 means in maps of depths, in world units")
    return advice
