"""What a capture calls for, by its files and photographs, before anything is trained: `inspect CAPTURE`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import torch

from .. import io
from ..captures.depth import PROBLEMS
from ..captures.evidence import (
    LARGEST,
    LEAST_SEEN,
    MOST_PHOTOGRAPHS,
    Evidence,
    interval_ranges,
    sharpness_of,
    single_threaded,
    spread_out,
)
from ..captures.layouts import Capture, Photograph
from ..captures.lenses import about_folds, lens_models
from ..captures.loading import IMAGES
from ..captures.photographs import TURNED, Header
from ..captures.placement import offset_of
from ..captures.vignetting import falloffs_of
from ..footprints import FASTEST, INTEGRATING, RECOMMENDED, resolve_footprint
from .findings import NO, NOT_KNOWN, YES, Finding
from .options import as_words, value_in_words
from .survey import Survey, survey

LENS = 0.1  # px: reconstructions fit observations to 0.3 px and more
# Spreads up to which they are noise, and beyond which they are none, by whether tracks say what is visible. Projected
# points are hidden at times: with them bonsai, whose photographs look even, has 0.19 to 0.22 stops and 7%, and 0.36
# stops where every second photograph is made 0.5 stops brighter.
EXPOSURE = {True: (0.15, 0.15), False: (0.15, 0.3)}  # stops
WHITE_BALANCE = {True: (5.0, 5.0), False: (5.0, 15.0)}  # percent
VIGNETTING = 0.15  # stops: bonsai has 0.53, mouse 0.37; fox has 0.1, brighter to the left
# Halves of the diagonal to which vignetting must be measured. mouse has 0.38, and a correction brings nothing.
FAR = 0.5
MIDDLE = 0.1  # of photographs that a spread leaves out: some see few points
# Stops from the middle, from which on one photograph is odd: those of even and uneven captures have up to 0.65 (mouse),
# and in the balance of colours 0.32 (fox).
ODD_EXPOSURE, ODD_BALANCE = 1.0, 0.5
BLUR = 0.4  # octaves: sharp captures have up to 0.36 (bonsai), a blur of 1 px has 0.46 to 1
ALIASED, SEVERAL_SCALES = 1.5, 4.0  # ranges of sampling intervals
ALIASED_SHARE, SCALES_SHARE = 0.1, 0.05  # of the points: single ones are reconstructed at a wrong place
FEW = 6  # photographs that show a point: fewer leave its depth open
GRID = 17  # points along each side of a picture, where lenses are measured

SCALES = (1, 2, 4, 8)

# While shapes are being found, one sample in a pixel does as well as many: until such a share of the training where
# photographs show most points at one size, and where edges are finer than a pixel (docs/internals/training.md).
CHEAP_UNTIL, CHEAP_UNTIL_FINE = 0.9, 0.5
MOST_VARIED = 50.0  # percent of points whose sampling intervals differ, up to which it does


@dataclass(frozen=True)
class CapturePlan:
    """What a capture calls for.

    Attributes:
        capture: Its folder.
        photographs: How many it has, missing ones not among them.
        looked_at: How many of them were read.
        findings: One for each effect.
        notes: What was chosen among what the folder holds, as `Capture.notes`.
        survey: What the findings are from, for plots.
    """

    capture: str
    photographs: int
    looked_at: int
    findings: tuple[Finding, ...]
    notes: tuple[str, ...] = ()
    survey: Survey | None = field(default=None, repr=False, compare=False)

    @property
    def stops(self) -> dict[Path, torch.Tensor]:
        """By the paths of the photographs that were read: (3,) of `stops_of_photographs`."""
        return {} if self.survey is None else self.survey.stops

    @property
    def falloffs(self) -> dict[Path, tuple[torch.Tensor, float]]:
        """The same of their cameras' vignetting: slopes (2,) of `Falloff`, and the radius up to which they hold."""
        if self.survey is None:
            return {}
        items = self.survey.looked_at
        found = falloffs_of(self.survey.evidence, [item.view for item in items])
        known = [falloff for falloff in found if falloff.radius >= FAR]
        return {items[place].files[1]: (each.slopes, each.radius) for each in known for place in each.photographs}

    @property
    def options(self) -> dict[str, Any]:
        """Options of `train` that the capture calls for, and their values: {"exposure": "affine", "scales": (1, 2)}."""
        called_for = (finding.options for finding in self.findings if finding.verdict == YES)
        return {name: value for options in called_for for name, value in options.items()}

    def beginning(self, footprint: str, scales: Sequence[int]) -> dict[str, Any]:
        """Options of `train` for a cheaper footprint at the beginning of a training for `footprint` at such scales."""
        if resolve_footprint(footprint).name not in INTEGRATING or footprint == FASTEST:
            return {}
        found = {finding.effect: finding for finding in self.findings}
        share, alpha = found["sampling"].number, found["alpha"].verdict == YES
        if not alpha and (share is None or share > MOST_VARIED):
            return {}
        fine = alpha or len(scales) > 1  # edges finer than a pixel
        return {"first_footprint": FASTEST, "footprint_from": CHEAP_UNTIL_FINE if fine else CHEAP_UNTIL}

    def to_lines(self) -> list[str]:
        """A line of what was looked at, then one for each finding: the first lines of `train`."""
        looked = f"looked at {self.looked_at} of {self.photographs} photographs, at up to {LARGEST} px"
        return [f"{self.capture}: {looked}", *(finding.to_text() for finding in self.findings)]

    def to_text(self) -> str:
        """`to_lines`, and the options."""
        lines, wanted = self.to_lines(), as_words(self.options) or "nothing special"
        beginning = self.beginning(RECOMMENDED, self.options.get("scales", (1,)))
        if beginning:
            lines.append(f"training may begin with: {as_words(beginning)}")
        return "\n".join([*lines, f"calls for: {wanted}"])

    def to_json(self) -> dict[str, Any]:
        """Everything that can be compared, as JSON holds it; options in words."""
        values = {each.name: getattr(self, each.name) for each in fields(self) if each.compare}
        values["findings"] = [finding.to_json() for finding in self.findings]
        return values | {"options": {name: value_in_words(value) for name, value in self.options.items()}}


@single_threaded()
def plan_capture(
    folder,
    images: str = IMAGES,
    *,
    cameras: str | None = None,
    most: int = MOST_PHOTOGRAPHS,
) -> CapturePlan:
    """Looks at a capture: its cameras, its points, the headers of all pictures, and the pixels of some.

    Args:
        folder, images, cameras: As of `load_capture`.
        most: Pictures that are read, evenly spread over the capture. Their longer side is reduced to at most LARGEST
            px.

    Raises:
        io.SceneError: As `load_capture`, but for pictures and masks that are missing or cannot be read, and lenses.
        OSError: A file that cannot be read.
        ValueError: `most` is not positive.
    """
    if most < 1:
        raise ValueError(f"most must be at least 1, got {most}")
    folder = Path(folder)
    found = survey(folder, images, cameras, most)
    findings = (
        _lens(found.items),
        *_colors(found),
        _vignetting(found),
        *_intervals(found.evidence, found.kept),
        _depth(found),
        _blur(found.evidence, found.looked_at),
        _masks(found.capture, found.items, found.evidence),
        _alpha(found.evidence, found.looked_at),
        *_files([(item, found.headers[item.files[1]]) for item in found.items]),
        _missing(found.capture, folder),
        _outlying(found.items, found.outliers),
        _far([item.view for item in found.kept], found.points),
    )
    notes = found.capture.notes
    return CapturePlan(str(folder), len(found.items), len(found.looked_at), findings, notes, found)


@single_threaded()
def stops_of_photographs(
    folder, files: Sequence[Path], images: str = IMAGES, *, cameras: str | None = None
) -> torch.Tensor:
    """(files, 3) float64: how much brighter than the others these photographs are in red, green and blue, in stops.

    NaN where it is not known.

    Args:
        folder, images, cameras: As of `load_capture`.
        files: Paths of photographs (`Photograph.files[1]`), all of which are read.

    Raises:
        io.SceneError, OSError: As `plan_capture`.
    """
    found = survey(Path(folder), images, cameras, len(files), set(files))
    unknown = torch.full((3,), math.nan, dtype=torch.float64)
    return torch.stack([found.stops.get(file, unknown) for file in files])


def _unknown(effect: str, unit: str, reason: str) -> Finding:
    return Finding(effect, None, unit, NOT_KNOWN, reason)


def _names(items: Sequence[Photograph]) -> tuple[str, ...]:
    return tuple(item.files[1].name for item in items)


# ------------------------------------------------------------------------------------ geometry


def displacement_of(view: io.View) -> float:
    """How far from where a pinhole would show it a lens shows something, px: the most inside the picture.

    Infinite where the picture shows what is 90 degrees or more from the axis. 0 without a lens.
    """
    if view.lens is None:
        return 0.0
    x, y = (torch.linspace(0, size, GRID, dtype=torch.float64) for size in (view.width, view.height))
    pixels = torch.cartesian_prod(x, y)
    rays = view.rays_of(pixels)
    shown = rays.isfinite().all(1)
    rays, pixels = rays[shown], pixels[shown]
    if (rays[:, 2] <= 0).any():
        return math.inf
    moved = pixels - replace(view, lens=None).pixels_of(rays)
    return moved.norm(dim=1).max().item() if len(rays) else 0.0


def _lens(items: list[Photograph]) -> Finding:
    with_lens = [item for item in items if item.view.lens is not None]
    if not with_lens:
        return Finding("lens", 0.0, "px", NO, "from a pinhole: no camera has a lens")
    distinct = {(v.lens, v.width, v.height, v.fx, v.fy, v.middle): v for v in (item.view for item in with_lens)}
    keep = {"lens": "keep"}
    largest = max(displacement_of(view) for view in spread_out(list(distinct.values()), MOST_PHOTOGRAPHS))
    which = f"{len(with_lens)} of {len(items)} photographs have a lens ({lens_models(with_lens)})"
    which = "; ".join([which, *about_folds(with_lens)])
    if math.isinf(largest):
        reason = f"{which}, and show more than a half space, which no pinhole does"
        return Finding("lens", None, "px", YES, reason, keep)
    needed = largest > LENS
    reason = f"is the largest displacement from a pinhole; {which}"
    return Finding("lens", largest, "px", YES if needed else NO, reason, keep if needed else {})


def _intervals(evidence: Evidence, items: list[Photograph]) -> tuple[Finding, Finding]:
    """Whether the range of sampling intervals calls for integration over pixels, and for several scales."""
    unit, ranges = "% of points", interval_ranges(evidence)

    def finding(effect: str, limit: float, least: float, median: str, options: dict[str, Any], advice: str) -> Finding:
        if not len(ranges):
            return _unknown(effect, unit, _why_unknown(evidence))
        share = (ranges > limit).double().mean().item()
        needed = share >= least
        reason = f"have sampling intervals that differ by more than {limit:g}{median}{advice if needed else ''}"
        return Finding(effect, 100 * share, unit, YES if needed else NO, reason, options if needed else {})

    median = f" (median {ranges.median():.2f})" if len(ranges) else ""
    advice = ": integrate over pixels, as the default footprint does"
    sampling = finding("sampling", ALIASED, ALIASED_SHARE, median, {}, advice)
    stored = tuple(sorted({scale for item in items for scale in item.files}))
    if len(stored) > 1:
        reason = "of each picture are in the capture"
        return sampling, Finding("scales", len(stored), "sizes", YES, reason, {"scales": stored})
    return sampling, finding("scales", SEVERAL_SCALES, SCALES_SHARE, "", {"scales": SCALES}, "")


def _depth(found: Survey) -> Finding:
    """Whether measured depths are called for: where few photographs show most points."""
    count, shown_by = sum(item.depth is not None for item in found.items), found.shown_by
    parts = [f"in {len(found.items)} photographs"]
    differences = sorted(measured.difference for measured in found.maps if measured.difference is not None)
    if differences:
        middle = differences[len(differences) // 2]
        parts.append(f"after the best scale and shift they differ from the points by {middle:.1%}")
    for problem in PROBLEMS:
        bad = [measured.about for measured in found.maps if measured.problem == problem]
        parts += [f"{len(bad)} {problem}, the first is {bad[0]}"] if bad else []
    if shown_by is None:
        return Finding("depth", count, "maps", NOT_KNOWN, "; ".join([*parts, _why_unknown(found.evidence)]))
    parts.append(f"the median point is in {shown_by:.0f} photographs")
    few = shown_by <= FEW
    if few:
        parts.append(f"train --depth {'maps' if differences else 'points'} takes what is known of depths")
    return Finding("depth", count, "maps", YES if few else NO, "; ".join(parts))


def _outlying(items: list[Photograph], outliers: dict[int, float]) -> Finding:
    effect, unit = "outlying cameras", "photographs"
    if len(items) < 3:
        return _unknown(effect, unit, "fewer than 3 photographs")
    reason = "have a camera far from all others" + (", and are left out" if outliers else "")
    found = _names([items[place] for place in outliers])
    return Finding(effect, len(outliers), unit, YES if outliers else NO, reason, photographs=found)


def _far(views: list[io.View], points: torch.Tensor | None) -> Finding:
    offset = offset_of(views, points)
    distance = 0.0 if offset is None else math.hypot(*offset)
    reason = "to take off" if offset is None else "from zero, which are taken off, and written to the files"
    return Finding("far from zero", distance, "world units", NO if offset is None else YES, reason)


# ------------------------------------------------------------------------------------ pixels


def _why_unknown(evidence: Evidence) -> str:
    if not evidence.points:
        return "the capture has no points"
    return f"too few points are in {LEAST_SEEN} photographs that were looked at"


def _colors(survey: Survey) -> tuple[Finding, Finding]:
    units = {"exposure": "stops", "white balance": "%"}
    evidence, tracked, stops = survey.evidence, survey.tracked, torch.stack(list(survey.stops.values()))
    how, source = "at the same points", "tracks" if tracked else "projected points"
    if not evidence.points:
        how, source = "of what is usual from their direction, which hides a slow drift", "mean light of an object"
    known = stops.isfinite().all(1)
    count = int(known.sum())
    if count < LEAST_SEEN:
        reason = _why_unknown(evidence) if not evidence.points else "too few smooth points are seen several times"
        return tuple(_unknown(effect, unit, reason) for effect, unit in units.items())
    stops, items = stops[known], [item for item, is_known in zip(survey.looked_at, known.tolist()) if is_known]
    exposures = stops.mean(1, keepdim=True)
    offsets = {"exposure": exposures, "white balance": stops - exposures}
    limits = {"exposure": (*EXPOSURE[tracked], ODD_EXPOSURE), "white balance": (*WHITE_BALANCE[tracked], ODD_BALANCE)}
    found = []
    for effect, of_channels in offsets.items():
        noise, least, odd = limits[effect]
        number = _in_unit(_spread(of_channels).max().item(), effect)
        far = (of_channels - of_channels.median(0).values).abs().amax(1)
        names = _names([item for item, distance in zip(items, far.tolist()) if distance > odd])
        verdict = YES if number > least or names else NO if number <= noise else NOT_KNOWN
        reason = f"to either side of the middle, {how} ({count} photographs, {source})"
        if names:
            farthest = _in_unit(far.max().item(), effect)
            reason += f"; {len(names)} by up to {farthest:.3g} {units[effect]}"
        if verdict == NOT_KNOWN:
            reason += (
                f"; without {'tracks this may be hidden points' if evidence.points else 'points this may be gloss'}"
            )
        options = {"exposure": "affine"} if verdict == YES else {}
        found.append(Finding(effect, number, units[effect], verdict, reason, options, names))
    return tuple(found)


def _vignetting(survey: Survey) -> Finding:
    """The camera with the largest falloff; the verdict is that of all directions from the middle."""
    effect, unit = "vignetting", "stops"
    views = [item.view for item in survey.looked_at]
    falloffs = [falloff for falloff in falloffs_of(survey.evidence, views) if not math.isnan(falloff.stops)]
    if not falloffs:
        reason = "too few smooth points are seen several times" if survey.evidence.points else None
        return _unknown(effect, unit, reason or _why_unknown(survey.evidence))
    worst = max(falloffs, key=lambda falloff: falloff.stops)
    reason = f"darker than in the middle, at {worst.radius:.0%} of the way to the corners"
    reason += f" ({len(worst.photographs)} photographs of one camera)"
    if worst.stops <= VIGNETTING:
        return Finding(effect, worst.stops, unit, NO, reason)
    verdict = YES
    if worst.least <= worst.stops / 2:
        verdict, reason = NOT_KNOWN, f"{reason}; not in all directions, in one {worst.least:.2g}"
    elif worst.radius < FAR:
        verdict, reason = NOT_KNOWN, f"{reason}; too few points are farther out"
    elif not survey.tracked:
        verdict, reason = NOT_KNOWN, f"{reason}; without tracks this may be hidden points"
    return Finding(effect, worst.stops, unit, verdict, reason, {"vignetting": "polynomial"} if verdict == YES else {})


def _in_unit(stops: float, effect: str) -> float:
    return stops if effect == "exposure" else 100 * (2**stops - 1)


def _spread(offsets: torch.Tensor) -> torch.Tensor:
    """Half the range of columns, without the outer tenth of the rows."""
    low, high = torch.quantile(offsets, offsets.new_tensor([MIDDLE / 2, 1 - MIDDLE / 2]), dim=0)
    return (high - low) / 2


def _blur(evidence: Evidence, items: list[Photograph]) -> Finding:
    effect, unit = "blur", "photographs"
    sharpness = sharpness_of(evidence)
    known = int(sharpness.isfinite().sum())
    if known < LEAST_SEEN:
        reason = "too few textured points are seen several times" if evidence.points else _why_unknown(evidence)
        return _unknown(effect, unit, reason)
    blurred = [place for place in sharpness.argsort().tolist() if sharpness[place] < -BLUR]
    least = 2 ** sharpness[sharpness.isfinite()].min().item()
    reason = f"of {known} have less of the finest details than others at the same points, down to {least:.0%}"
    names = _names([items[place] for place in blurred])
    return Finding(effect, len(blurred), unit, YES if blurred else NO, reason, photographs=names)


def _alpha(evidence: Evidence, items: list[Photograph]) -> Finding:
    found = [item for item, transparent in zip(items, evidence.transparent.tolist()) if transparent]
    reason = f"of {len(items)} looked at are transparent somewhere" + (
        ": the background shows through" if found else ""
    )
    return Finding("alpha", len(found), "photographs", YES if found else NO, reason)


# ------------------------------------------------------------------------------------ files


def _masks(capture: Capture, items: list[Photograph], evidence: Evidence) -> Finding:
    masked = sum(item.mask is not None for item in items)
    verdict, options = (YES, {"masks": "auto"}) if masked else (NO, {})
    reason = f"of {len(items)} have a mask"
    if masked:
        reason += f"; of the pixels that were looked at they leave out {1 - evidence.counted.mean().item():.1%}"
        if not evidence.counted.any():
            reason += ", so that train has nothing to learn from; --masks none ignores them"
            options = {}
    if capture.ignored_masks:
        about = f" ({capture.about_masks})"
        reason += f"; {capture.ignored_masks} files of masks belong to no convention, and are ignored{about}"
    if capture.missing_masks:
        reason += f"; {len(capture.missing_masks)} masks are not there or cannot be read"
    return Finding("masks", masked, "photographs", verdict, reason, options)


def _missing(capture: Capture, folder: Path) -> Finding:
    paths = (*capture.missing, *capture.missing_masks)
    names = tuple(str(path.relative_to(folder) if path.is_relative_to(folder) else path) for path in paths)
    verdict, options = (YES, {"missing": "skip"}) if names else (NO, {})
    reason = "are not there" if not any(path.is_file() for path in paths) else "are not there, or cannot be read"
    return Finding("missing pictures", len(names), "files", verdict, reason, options, names)


def _files(pairs: list[tuple[Photograph, Header]]) -> tuple[Finding, Finding]:
    """Turns that EXIF asks for, and pictures that do not have the shape of their camera's."""
    turned = [item for item, header in pairs if header.orientation in TURNED]
    open_ones = sum(not header.tells_orientation(item.view) for item, header in pairs)
    reason = "are to be turned by EXIF, and used as stored"
    if turned:
        reason += f"; the sizes of {open_ones} do not tell whether that fits the camera"
    verdict = YES if turned else NO
    turns = Finding("EXIF turns", len(turned), "photographs", verdict, reason, photographs=_names(turned))
    wrong = [item for item, header in pairs if not header.fits(item.view)]
    quarter = sum(header.fits_turned(item.view) for item, header in pairs if not header.fits(item.view))
    reason = "do not have the proportions of their camera"
    if wrong:
        cut = sum(header.is_cut(item.view) for item, header in pairs)
        reason += (
            f"; {quarter} do after a quarter turn, which train refuses; it takes {cut} for cut about the principal "
            "point, and stretches the camera of the others"
        )
    verdict = YES if wrong else NO
    return turns, Finding("wrong sizes", len(wrong), "photographs", verdict, reason, photographs=_names(wrong))
