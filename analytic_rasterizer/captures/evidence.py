"""What the photographs of a capture show of the same points: colours, sharpness, and sampling intervals.

Photographs are compared at the points that they share. What is measured of a point in a photograph is the sum of what
the point has and of what the photograph adds; `offsets_of` separates the two.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from .. import io
from .layouts import Photograph
from .offsets import Fit, medians_in_turn, medians_of, offsets_of
from .photographs import broken_files, read_file, read_mask

MOST_PHOTOGRAPHS, LARGEST = 100, 1024  # what is looked at: pictures, and px of their longer side
MOST_POINTS, MOST_HIDING = 8192, 200_000  # points that are looked at, and points behind which they may be hidden
READERS = 8  # threads, each of which holds a whole picture for a moment
LEAST_SEEN = 3  # photographs that see a point: of two nobody knows which is the odd one
LEAST_COMMON = 20  # points that a photograph shares with others: its median is then right to a third of their spread
LEAST_AROUND = 40  # photographs of an object, whose nine numbers of what is usual are then known

# A point is visible where it is about as near as the nearest point in a cell.
CELL = 8  # px
DEPTH_TOLERANCE = 1.03  # of the nearest depth

WINDOW = 5  # px, whose mean colour is that of a point, so that half a pixel of a wrong position does not count
SMOOTH = 0.15  # largest deviation of colours in the window, of their mean. More than that moves with the position
DARKEST, BRIGHTEST = 10 / 255, 245 / 255  # of colours that are measured: others are noise, or clipped
# Stops: the largest median deviation of a point over photographs (otherwise it shines, or is not there), and the
# largest deviation of a single observation.
CONSISTENT, OUTLYING = 0.25, 1.0
BAND_WINDOW = 9  # px, over which frequencies are averaged
LEAST_TEXTURE = 2 / 255  # amplitude of the octave below the finest: in less the finest is noise


class Evidence(NamedTuple):
    """What photographs show of points, with one row for each of O observations.

    Attributes:
        count: How many photographs there are.
        points: How many points there are.
        photograph, point: (O,) int64, which.
        color: (O, 3) float64, mean stored colours around the point, in [0, 1].
        roughness: (O,) float64, deviation of the colours around it, of their mean.
        bands: (O, 2) float64, mean squares of the finest octave of frequencies and of the next.
        nearest, farthest: (points,) float64, the smallest and the largest size of a pixel of the picture at the point,
            world units, over the photographs that can see it.
        seen: (points,) int64, how many photographs can see it.
        transparent: (count,) bool, whether a picture has pixels that are not opaque.
        light: (count, 3) float64, mean light of the opaque pixels; NaN where there are none, or there are points.
        counted: (count,) float64, the share of a picture that its mask lets count.
        position: (O, 2) float64, right and down from the principal point, in halves of the diagonal.
    """

    count: int
    points: int
    photograph: Tensor
    point: Tensor
    color: Tensor
    roughness: Tensor
    bands: Tensor
    nearest: Tensor
    farthest: Tensor
    seen: Tensor
    transparent: Tensor
    light: Tensor
    counted: Tensor | None = None
    position: Tensor | None = None


class BrokenPictures(io.SceneError):
    """Files of pictures or masks cannot be read, `files`."""

    def __init__(self, errors: dict[Path, io.SceneError]):
        super().__init__(next(iter(errors.values())).message)
        self.files = errors.keys()


def spread_out(items: Sequence, most: int) -> list:
    """At most `most` of the items, evenly over their order."""
    count = min(len(items), most)
    return [items[i * len(items) // count] for i in range(count)]


@contextmanager
def single_threaded() -> Iterator[None]:
    """No operator of torch uses several threads within, in threads that start there either: teams of threads wait for
    each other wherever processors are busy, as they are while pictures are read."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def gather(items: Sequence[Photograph], points: Tensor | None, tracks: dict[str, Tensor]) -> Evidence:
    """Reads the photographs, a few at a time, and looks at the points in them.

    Args:
        items: The photographs, all of which are read.
        points: (P, 3) float64, in the frame of the views; None where there are none.
        tracks: Rows of the points that a photograph observes, by the names of views; empty: a test of depths says it.

    Raises BrokenPictures for files that cannot be read, and io.SceneError for a mask of another shape than its picture.
    """
    points = torch.zeros(0, 3, dtype=torch.float64) if points is None else points.double()
    step = max(-(-len(points) // MOST_HIDING), 1)
    points, tracks = points[::step], {name: rows[rows % step == 0] // step for name, rows in tracks.items()}
    chosen = torch.zeros(len(points), dtype=torch.bool)
    candidates = torch.arange(len(points))
    if tracks:
        rows = torch.cat([tracks[item.view.name] for item in items if item.view.name in tracks] or [candidates[:0]])
        candidates = (torch.bincount(rows, minlength=len(points)) >= LEAST_SEEN).nonzero()[:, 0]
    if len(candidates):
        chosen[candidates[:: -(-len(candidates) // MOST_POINTS)]] = True

    def look(item: Photograph) -> _Look | io.SceneError:
        try:
            return _look(item, points, chosen, tracks)
        except io.SceneError as error:
            return error

    with ThreadPoolExecutor(READERS) as pool:
        looks = list(pool.map(look, items))
    errors = [(item, found) for item, found in zip(items, looks) if isinstance(found, io.SceneError)]
    if errors:
        broken = broken_files(path for item, _ in errors for path in (item.files[1], item.mask) if path is not None)
        raise BrokenPictures(broken) if broken else errors[0][1]
    observed = [look.observed for look in looks]
    nearest, farthest = points.new_full((len(points),), math.inf), points.new_zeros(len(points))
    seen = torch.zeros(len(points), dtype=torch.int64)
    for look in looks:
        nearest[look.visible] = torch.minimum(nearest[look.visible], look.intervals)
        farthest[look.visible] = torch.maximum(farthest[look.visible], look.intervals)
        seen[look.visible] += 1
    return Evidence(
        count=len(items),
        points=len(points),
        photograph=torch.arange(len(items)).repeat_interleave(torch.tensor([len(rows) for rows in observed])),
        point=torch.cat(observed),
        color=torch.cat([look.sampled[:, :3] for look in looks]),
        roughness=torch.cat([look.sampled[:, 3] for look in looks]),
        bands=torch.cat([look.sampled[:, 4:6] for look in looks]),
        nearest=nearest,
        farthest=farthest,
        seen=seen,
        transparent=torch.tensor([look.transparent for look in looks]),
        light=torch.stack([look.light for look in looks]),
        counted=torch.tensor([look.counted for look in looks], dtype=torch.float64),
        position=torch.cat([look.sampled[:, 7:] for look in looks]),
    )


class _Look(NamedTuple):
    """At the points in one photograph."""

    transparent: bool
    visible: Tensor  # (V,) the points that it can see
    intervals: Tensor  # (V,) sizes of a pixel there
    observed: Tensor  # (O,) the points whose pixels are measured
    sampled: Tensor  # (O, 9) of `_sampled`, and `Evidence.position`
    light: Tensor  # (3,) mean of the opaque pixels, without points
    counted: float  # share of the picture that its mask lets count


def _look(item: Photograph, points: Tensor, chosen: Tensor, tracks: dict[str, Tensor]) -> _Look:
    rgba = read_file(item.files[1], LARGEST).rgba
    transparent = bool((rgba[:, :, 3] < 255).any())
    none = torch.zeros(0, dtype=torch.int64)
    planes = rgba.permute(2, 0, 1)[None].float() / 255
    counted = 1.0
    if item.mask is not None:  # what does not count is not looked at
        mask = read_mask(item.mask, rgba.shape[1], rgba.shape[0]).float() / 255
        counted = mask.mean().item()
        planes[0, 3] *= mask
    reduction = -(-max(rgba.shape[:2]) // LARGEST)
    planes = functional.avg_pool2d(planes, reduction) if reduction > 1 else planes
    if not len(points):
        light = _linear(planes[0, :3, planes[0, 3] == 1].double()).mean(1)
        return _Look(transparent, none, points[:, 0], none, points.new_zeros(0, 9), light, counted)
    height, width = planes.shape[2:]
    view = item.view.resized(width, height)
    in_camera = points @ view.w2c[:3, :3].double().T + view.w2c[:3, 3].double()
    pixels = view.pixels_of(in_camera)
    inside = ((pixels >= 0) & (pixels < pixels.new_tensor([width, height]))).all(1)
    depth = view.depths_of(in_camera)
    visible = inside.nonzero()[:, 0]
    visible = visible[in_front(pixels[visible], depth[visible], width, height) & chosen[visible]]
    observed = visible
    if tracks:
        observed = tracks.get(view.name, none)
        observed = observed[(inside & chosen)[observed]]
    position = (pixels[observed] - pixels.new_tensor(view.middle)) / math.hypot(width / 2, height / 2)
    sampled = torch.cat([_sampled(planes, pixels[observed]), position], 1)
    opaque = sampled[:, 6] == 1
    intervals = depth[visible] / math.sqrt(view.fx * view.fy)
    unknown = points.new_full((3,), math.nan)
    return _Look(transparent, visible, intervals, observed[opaque], sampled[opaque], unknown, counted)


def in_front(pixels: Tensor, depth: Tensor, width: int, height: int, size: float = CELL) -> Tensor:
    """(N,) bool: whether a point is about as near as the nearest in its cell of a picture of this size. Cells are of
    `size` px."""
    columns, rows = int(width / size) + 1, int(height / size) + 1
    column, row = (pixels / size).long().unbind(1)
    cell = row * columns + column
    nearest = depth.new_full((rows * columns,), math.inf).scatter_reduce(0, cell, depth, "amin")
    return depth <= DEPTH_TOLERANCE * nearest[cell]


def _sampled(planes: Tensor, pixels: Tensor) -> Tensor:
    """(N, 7) float64 at pixels (N, 2) of planes (1, 4, H, W): columns of `Evidence` from `color` to `bands`, and
    whether all around is opaque."""
    colors = _around(planes[:, :3], pixels, WINDOW)
    mean = colors.mean(2)
    variance = (colors - mean[:, :, None]).square().mean((1, 2))
    roughness = variance.sqrt() / mean.mean(1).clamp_min(DARKEST)
    grey = planes[:, :3].mean(1, keepdim=True)
    # Binomial filters of variance 1 and 4 px^2.
    fine = _blurred(grey)
    coarse = _blurred(_blurred(_blurred(fine)))
    bands = _around(torch.cat([grey - fine, fine - coarse], 1), pixels, BAND_WINDOW).square().mean(2)
    opaque = _around(planes[:, 3:], pixels, BAND_WINDOW).amin(2) == 1
    return torch.cat([mean, roughness[:, None], bands, opaque], 1)


def _around(planes: Tensor, pixels: Tensor, window: int) -> Tensor:
    """(N, C, window^2) float64: planes (1, C, H, W) in squares about pixels (N, 2), continued beyond the border."""
    height, width = planes.shape[2:]
    steps = torch.arange(window) - window // 2
    column, row = pixels.long().unbind(1)
    rows = (row[:, None, None] + steps[:, None]).clamp(0, height - 1)
    columns = (column[:, None, None] + steps).clamp(0, width - 1)
    return planes[0].flatten(1)[:, (rows * width + columns).flatten(1)].transpose(0, 1).double()


def _blurred(planes: Tensor) -> Tensor:
    """Planes (N, C, H, W) after a binomial filter of variance 1 px^2, continued beyond the border."""
    for dim, padding in ((2, (0, 0, 2, 2)), (3, (2, 2, 0, 0))):
        length, padded = planes.shape[dim], functional.pad(planes, padding, mode="replicate")
        planes = sum(weight / 16 * padded.narrow(dim, i, length) for i, weight in enumerate((1, 4, 6, 4, 1)))
    return planes


# ------------------------------------------------------------------------------------ measures


def stops_of(evidence: Evidence, tracked: bool = True) -> Tensor:
    """(count, 3): how much brighter each photograph is in red, green and blue than the others at the same points, in
    powers of two of linear light; NaN for photographs that share too few points with others.

    Args:
        tracked: Whether tracks say what is visible. Otherwise some points are hidden, and photographs that overlap
            little would carry the error on from one to the next: medians in turn are taken, which hardly move then.
    """
    return consistent_fit(evidence, smooth_points(evidence), tracked=tracked)[0].offsets


def smooth_points(evidence: Evidence) -> Tensor:
    """The observations (O',) whose colours can be compared."""
    color = evidence.color
    good = ((color > DARKEST) & (color < BRIGHTEST)).all(1) & (evidence.roughness < SMOOTH)
    return good.nonzero()[:, 0]


def consistent_fit(
    evidence: Evidence, rows: Tensor, terms: Tensor | None = None, tracked: bool = True
) -> tuple[Fit, Tensor]:
    """The fit of light, in powers of two, of those observations `rows` whose points have one colour; and which they
    are, (O',).

    Args:
        terms: (O, K) of all observations, as of `offsets_of`; where tracks say what is visible.
        tracked: As of `stops_of`.
    """
    for strictness in (0.5, 1, None):  # the first offsets are those with hidden and shining points
        rows = rows[_shared(evidence.photograph[rows], evidence.point[rows], evidence)]
        point = evidence.point[rows]
        given = None if terms is None else terms[rows]
        logs = _linear(evidence.color[rows]).log2()
        photograph = evidence.photograph[rows]
        if tracked:
            fit = offsets_of(logs, photograph, point, evidence.count, given)
        else:
            fit = medians_in_turn(logs, photograph, point, evidence.count)
        if strictness is not None:
            deviations = strictness * fit.deviations.abs().amax(1)
            kept = medians_of(deviations, point, evidence.points)[point] < CONSISTENT
            rows = rows[kept & (deviations < OUTLYING)]
    return fit, rows


def object_stops(evidence: Evidence, axes: Tensor) -> Tensor:
    """(count, 3): how much brighter than from its direction is usual each photograph shows a cut-out object, in powers
    of two of mean light. What is usual is a polynomial of the direction, which lights from all sides make smooth.

    NaN where that is not known: where there are few photographs, or some that are opaque everywhere.

    Args:
        axes: (count, 3), directions in which the cameras look, of length 1.
    """
    logs = evidence.light.log2()
    known = logs.isfinite().all(1) & evidence.transparent
    if known.sum() < LEAST_AROUND or not known.all():
        return torch.full_like(logs, math.nan)
    x, y, z = axes.double().unbind(1)
    terms = torch.stack([torch.ones_like(x), x, y, z, x * x, y * y, x * y, y * z, z * x], 1)
    return logs - terms @ torch.linalg.pinv(terms) @ logs


def sharpness_of(evidence: Evidence) -> Tensor:
    """(count,): the share of the finest octave of frequencies of each photograph over that of the others at the same
    points, in powers of two; NaN for photographs that share too few points with others."""
    textured = evidence.bands[:, 1] > LEAST_TEXTURE**2
    photograph, point = evidence.photograph[textured], evidence.point[textured]
    finest, next_finest = evidence.bands[textured].unbind(1)
    shares = 0.5 * (finest / next_finest).clamp_min(1e-6).log2()
    kept = _shared(photograph, point, evidence)
    return offsets_of(shares[kept, None], photograph[kept], point[kept], evidence.count).offsets[:, 0]


def interval_ranges(evidence: Evidence) -> Tensor:
    """(N,): the largest over the smallest sampling interval of every point that several photographs can see."""
    return (evidence.farthest / evidence.nearest)[evidence.seen >= LEAST_SEEN]


def _shared(photograph: Tensor, point: Tensor, evidence: Evidence) -> Tensor:
    """(O,) bool: observations of points in enough photographs, by photographs with enough such points."""
    kept = torch.ones_like(point, dtype=torch.bool)
    for _ in range(2):  # the second time without points of photographs that have too few
        seen = torch.bincount(point[kept], minlength=evidence.points)
        kept = kept & (seen[point] >= LEAST_SEEN)
        common = torch.bincount(photograph[kept], minlength=evidence.count)
        kept = kept & (common[photograph] >= LEAST_COMMON)
    return kept


def _linear(stored: Tensor) -> Tensor:
    """Light of stored values, by the curve of sRGB."""
    return torch.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)
