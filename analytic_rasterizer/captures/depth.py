"""What is known of the depths in the photographs of a capture: points, and maps that are fitted to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import torch
from torch import Tensor

from .. import io
from .depth_files import PARAMETERS, DepthFile, read_depth
from .evidence import in_front
from .layouts import Photograph

READERS = 8  # threads
LEAST_POINTS = 20  # in a map, that a scale and a shift are fitted to
PAIRS, MOST_COMPARED, ROUNDS = 256, 1024, 3  # of the fit: lines, points that tell the best of them, and refinements
USUAL = 1.4826  # deviations of a normal distribution, of a median difference
FLAT = 0.02  # relative spread of raw inverse depths, up to which there is no telling a shift from a scale
# Median differences of a map from the points, relative to their depths, beyond which it is wrong: always, and where
# they are more than half of the spread of the depths themselves.
APART, UNLIKE, UNLIKE_SHARE = 0.25, 0.03, 0.5
NEAREST = 1000.0  # of a median depth over a depth, which float16 holds
IN_CELL = 8  # points that a cell of a picture has on average, in which far ones are taken for hidden


class SeenPoints(NamedTuple):
    """Points that a photograph shows.

    Attributes:
        pixels: (N, 2) float64, where, px of the view.
        inverse: (N,) float64, their inverse depths, 1 / world units.
    """

    pixels: Tensor
    inverse: Tensor


class DepthMap(NamedTuple):
    """A depth map with its scale.

    Attributes:
        file: Of it, with the `scale` and the `shift` that hold.
        reference: A median depth, world units, in which inverse depths are stored.
    """

    file: DepthFile
    reference: float


class Measured(NamedTuple):
    """What became of the depth map of a photograph.

    Attributes:
        map: The map; None: it cannot be used.
        problem: Why it cannot, one of PROBLEMS; "" where it can, or there is none.
        about: More of that, for messages.
        difference: The median difference of its depths from those of the points, relative; None: not known.
        fitted: Whether scale and shift are fitted to the points.
    """

    map: DepthMap | None
    problem: str = ""
    about: str = ""
    difference: float | None = None
    fitted: bool = False


MISSING, BROKEN, EMPTY = "are missing", "cannot be used", "hold no depth anywhere"
UNSCALED, WRONG = "have no scale", "do not fit the points"
PROBLEMS = (MISSING, BROKEN, EMPTY, UNSCALED, WRONG)
OF_FILES = PROBLEMS[:3]  # those of the files alone, whatever the points are


def seen_points(view: io.View, points: Tensor, rows: Tensor | None) -> SeenPoints:
    """The points that a photograph shows.

    Args:
        points: (P, 3), in the frame of the view.
        rows: Those that it observes, (O,) int64; None: nobody knows, so those that no nearer point may hide.
    """
    points = points.double() if rows is None else points[rows].double()
    in_camera = points @ view.w2c[:3, :3].double().T + view.w2c[:3, 3].double()
    pixels, depth = view.pixels_of(in_camera), view.depths_of(in_camera)
    size = pixels.new_tensor([view.width, view.height])
    shown = ((pixels >= 0) & (pixels < size)).all(1) & (depth > 0)
    pixels, depth = pixels[shown], depth[shown]
    if rows is None and len(depth):
        cell = (view.width * view.height * IN_CELL / len(depth)) ** 0.5
        front = in_front(pixels, depth, view.width, view.height, cell)
        pixels, depth = pixels[front], depth[front]
    return SeenPoints(pixels, depth.reciprocal())


def points_in(views: Sequence[io.View], points: Tensor | None, tracks: Mapping[str, Tensor]) -> list[SeenPoints]:
    """What each view shows of the points (P, 3) of its capture; `tracks` as `colmap.load_tracks` has them."""
    points, none = torch.zeros(0, 3) if points is None else points, torch.zeros(0, dtype=torch.int64)
    return [seen_points(view, points, tracks.get(view.name, none) if tracks else None) for view in views]


def measure_maps(
    items: Sequence[Photograph],
    points: Tensor | None,
    tracks: Mapping[str, Tensor],
    unit: float | None = None,
    fit: bool = True,
) -> list[Measured]:
    """Reads the depth maps of photographs, and finds what depths they mean.

    Args:
        items: The photographs.
        points, tracks: As of `points_in`.
        unit: World units of 1 in maps of depths; None: as usual there.
        fit: Whether scale and shift of each map are fitted to the points that its photograph shows, where these are
            enough; otherwise those of the files hold.
    """

    def measure(item: Photograph) -> Measured:
        file = item.depth
        if file is None:
            return Measured(None)
        if unit is not None and not file.is_inverse:
            file = file._replace(scale=1 / unit)
        absent = [path for path in (file.path, file.confidence) if path is not None and not path.is_file()]
        if absent:
            return Measured(None, MISSING, str(absent[0]))
        try:
            return _measured(file, item.view, points_in([item.view], points, tracks)[0], fit)
        except io.SceneError as error:
            return Measured(None, BROKEN, error.message)

    with ThreadPoolExecutor(READERS) as pool:
        return list(pool.map(measure, items))


def _measured(file: DepthFile, view: io.View, seen: SeenPoints, fit: bool) -> Measured:
    """Of a map that is there. Raises io.SceneError."""
    raw, shares = read_depth(file, view)
    if not (raw * shares).any():
        return Measured(None, EMPTY, str(file.path))
    height, width = raw.shape
    column, row = (seen.pixels * seen.pixels.new_tensor([width / view.width, height / view.height])).long().unbind(1)
    place = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    known = shares.flatten()[place] > 0
    at_points, inverse = raw.flatten()[place][known].double(), seen.inverse[known]
    enough = len(inverse) >= LEAST_POINTS
    found = fitted_scale(at_points, inverse) if fit and enough else None
    if fit and enough and found is None:
        return Measured(None, WRONG, f"{file.path}: far where they are near")
    if found is not None:
        file = file._replace(scale=found[0], shift=found[1])
    if file.scale is None:
        about = f"{file.path}: expected its scale in {PARAMETERS}"
        about += f", or {LEAST_POINTS} points in it, got {len(inverse)}" if fit else " (--depth-fit none)"
        return Measured(None, UNSCALED, about)
    difference = None
    if enough:
        difference = ((file.scale * at_points + file.shift - inverse).abs() / inverse).median().item()
        spread = ((inverse - inverse.median()).abs() / inverse).median().item()
        if not difference <= min(APART, max(UNLIKE, UNLIKE_SHARE * spread)):
            return Measured(None, WRONG, f"{file.path}: by {difference:.0%}", difference, found is not None)
    depths = file.scale * raw[shares > 0].double() + file.shift
    if not (depths > 0).any():
        return Measured(None, EMPTY, str(file.path))
    reference = 1 / depths[depths > 0].median().item()
    return Measured(DepthMap(file, reference), difference=difference, fitted=found is not None)


def depth_planes(found: DepthMap, view: io.View) -> Tensor:
    """(2, h, w) float32 of a map of a view: inverse depths times its reference and the share of the pixel that counts,
    and this share. Raises io.SceneError as `read_depth`."""
    raw, shares = read_depth(found.file, view)
    inverse = (found.file.scale * raw + found.file.shift).clamp_min(0) * found.reference
    inverse = inverse.clamp_max(NEAREST)
    return torch.stack([inverse * shares, shares])


def fitted_scale(raw: Tensor, inverse: Tensor) -> tuple[float, float] | None:
    """Scale and shift that bring raw inverse depths (N,) near to `inverse` (N,): most of them, whatever the others are.

    The least median of differences over lines through pairs of points, drawn always alike; then least squares among
    points that differ by no more than is usual there. None where no positive scale is near.
    """
    middle = raw.median()
    if (raw - middle).abs().median() <= FLAT * middle.abs():
        scale = (inverse / raw).median().item() if middle != 0 else 0.0
        return (scale, 0.0) if scale > 0 else None
    generator = torch.Generator().manual_seed(0)
    first, second = torch.randint(len(raw), (2, PAIRS), generator=generator)
    some = torch.randperm(len(raw), generator=generator)[:MOST_COMPARED]
    scales = (inverse[first] - inverse[second]) / (raw[first] - raw[second])
    scales = scales[scales.isfinite() & (scales > 0)]
    if not len(scales):
        return None
    # The best shift of a scale is nearly the median of what is left.
    shifts = (inverse[some] - scales[:, None] * raw[some]).median(1).values
    left = (scales[:, None] * raw[some] + shifts[:, None] - inverse[some]).abs().median(1).values
    best = left.argmin()
    scale, shift = scales[best], shifts[best]
    for _ in range(ROUNDS):
        differences = (scale * raw + shift - inverse).abs()
        near = differences <= 3 * USUAL * differences.median()
        x, y = raw[near], inverse[near]
        across = x - x.mean()
        if not across.square().sum() > 0:
            break
        scale = (across * y).sum() / across.square().sum()
        shift = y.mean() - scale * x.mean()
    return (scale.item(), shift.item()) if scale > 0 else None
