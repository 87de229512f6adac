"""`effects` of `TrainingOptions`: what a training takes of what its capture calls for, where nobody chose otherwise."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..captures.loading import IMAGES
from ..captures.source import CaptureSource
from ..distributed.ranks import Ranks
from .corrections import Corrections
from .options import TrainingOptions, as_words
from .plan import CapturePlan, plan_capture, stops_of_photographs

LEARNED_ALONE = ("exposure", "vignetting")  # options, of what several processes cannot learn


class Settled(NamedTuple):
    """A training after a look at its capture.

    Attributes:
        options: With what was taken.
        source: The same of the arguments that say how the capture is read.
        taken: Values by the names of options: what the plan decided.
        lines: What to say of it. The first lines of a training, and none on other ranks than the first.
        notes: What to say later: that the capture could not be looked at.
        stops, falloffs: Of the photographs that were looked at, as of `CapturePlan`; falloffs where they are wanted,
            and None where nobody has looked.
    """

    options: TrainingOptions
    source: CaptureSource
    taken: Mapping[str, Any] = MappingProxyType({})
    lines: Sequence[str] = ()
    notes: Sequence[str] = ()
    stops: Mapping[Path, Tensor] = MappingProxyType({})
    falloffs: Mapping[Path, tuple[Tensor, float]] | None = None


def settle(source: CaptureSource, options: TrainingOptions, chosen: Collection[str], ranks: Ranks) -> Settled:
    """Looks at the capture, on the first rank, and takes what it calls for.

    Args:
        source, options: What differs from its default was chosen.
        chosen: Names of options that were chosen too, whatever their values.
    """
    plan = ranks.from_first(_look(source) if ranks.is_first else None)
    if isinstance(plan, str):
        told = f"{source.folder}: not looked at, --effects auto takes nothing: {plan}"
        return Settled(options, source, notes=[told])
    defaults = {field.name: field.default for kind in (options, source) for field in fields(kind)}
    values, given = plan.options, options.to_dict() | vars(source)
    kept = [name for name in values if name in chosen or given[name] != defaults[name]]
    alone = [] if ranks.world == 1 else [name for name in LEARNED_ALONE if name not in kept]
    taken = {name: value for name, value in values.items() if name not in (*kept, *alone)}
    of_source = {name: value for name, value in taken.items() if name in vars(source)}
    of_options = {name: value for name, value in taken.items() if name not in of_source}
    if "scales" in of_options:
        of_options["scale_repeats"] = ()  # as is usual for these
    begun = replace(options, **of_options)
    beginning = plan.beginning(begun.footprint, begun.scales)
    beginning = {n: v for n, v in beginning.items() if n not in chosen and given[n] == defaults[n]}
    if "first_footprint" in beginning:
        begun = replace(begun, **beginning)
    lines = []
    if ranks.is_first:
        lines = [*plan.to_lines(), f"--effects auto takes {as_words(taken) or 'nothing'}"]
        left = {name: values[name] for name in kept if given[name] != values[name]}
        if left:
            lines[-1] += f", and not {as_words(left)}: another value is given"
        refused = {name: values[name] for name in alone if name in values}
        if refused:
            lines[-1] += f", and not {as_words(refused)}, which {ranks.world} processes cannot learn: train on one"
        if "first_footprint" in beginning:
            lines.append(
                f"begins with {begun.first_footprint}, and goes on with {begun.footprint} when "
                f"{_time(begun.footprint_from)} over (--first-footprint none: does not)"
            )
    falloffs = plan.falloffs if begun.vignetting != "none" else {}
    return Settled(begun, replace(source, **of_source), taken, lines, [], plan.stops, falloffs)


def _time(time: float) -> str:
    return f"{time:.0%} is" if time <= 1 else f"{time:,.0f} steps are"


@contextmanager
def said_first(lines: Sequence[str]) -> Iterator[None]:
    """Says the lines on stderr when the block is done, before its warnings; none after an error of the block."""
    if not lines:
        yield
        return
    caught = []
    try:
        with warnings.catch_warnings(record=True) as caught:
            yield
        for line in lines:
            print(line, file=sys.stderr, flush=True)
    finally:
        for warning in caught:
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)


def measured_stops(source: CaptureSource, files: Sequence[Path], known: Mapping[Path, Tensor]) -> Tensor:
    """(files, 3) of `stops_of_photographs`; NaN where the capture cannot be looked at, as for `settle`.

    Args:
        known: Of an earlier look; photographs are read only where some are not in it.
    """
    if files and all(file in known for file in files):
        return torch.stack([known[file] for file in files])
    try:
        return stops_of_photographs(source.folder, files, source.images or IMAGES, cameras=source.cameras)
    except Exception:
        return torch.full((len(files), 3), math.nan, dtype=torch.float64)


def start_corrections(corrections: Corrections, source: CaptureSource, files: Sequence[Path], found: Settled) -> None:
    """Corrections start from what was measured, of photographs `files`; it is measured where nobody has looked."""
    if corrections.exposures is not None:
        corrections.exposures.start(measured_stops(source, files, found.stops))
    if corrections.falloffs is not None:
        measured = found.falloffs
        if measured is None:
            plan = _look(source)
            measured = {} if isinstance(plan, str) else plan.falloffs
        corrections.falloffs.start({place: measured[file] for place, file in enumerate(files) if file in measured})


def _look(source: CaptureSource) -> CapturePlan | str:
    """The plan, or why there is none: what is wrong with a capture is for its loader to say, and a look is no need."""
    try:
        return plan_capture(source.folder, source.images or IMAGES, cameras=source.cameras)
    except Exception as error:
        return str(error) or type(error).__name__
