"""What people would rather look at than read: a training, a test and a capture as figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from io import StringIO
from itertools import pairwise
from pathlib import Path
from typing import Any

from ..io import optional_import, write_safely
from . import tables

SUFFIXES = (".png", ".svg", ".pdf")
WIDTH, HEIGHT, COLUMNS = 4.6, 3.1, 3  # in, of one plot; plots in a row
WORST = 8  # views
NAMED, LONGEST = 12, 14  # photographs along an axis, of more only some are named; characters of a name
INK = "#010203"  # in figures for pages, where it becomes the colour of the text

Draw = Callable[[Any], None]  # on axes


def check_plot(path, option: str = "--plot") -> None:
    """Raises ValueError for a file that is no plot, ImportError without matplotlib; before anything is measured."""
    if Path(path).suffix.lower() not in SUFFIXES:
        raise ValueError(f"{option} must end in {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}, got {path}")
    optional_import("matplotlib.figure", "analysis")


def save_plots(path, plots: Sequence[Draw]) -> None:
    """Writes plots beside each other, as .png, .svg or .pdf.

    Raises:
        ImportError: There is no matplotlib.
        OSError: The file cannot be written.
        ValueError: Another suffix, or no plots.
    """
    check_plot(path, "the file of a plot")
    if not plots:
        raise ValueError("there is nothing to plot")
    figure = _drawn(plots)
    kind = Path(path).suffix[1:].lower()
    write_safely(path, lambda temporary: figure.savefig(temporary, dpi=140, format=kind))


def to_svg(plot: Draw) -> str:
    """A plot as an <svg> for a page, which gives it the colours of its text and of its background."""
    names = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")
    colors = dict.fromkeys(names, INK) | {"svg.fonttype": "none", "svg.hashsalt": "report", "font.family": "sans-serif"}
    with optional_import("matplotlib", "analysis").rc_context(colors):
        figure, in_memory = _drawn([plot]), StringIO()
        figure.savefig(in_memory, format="svg", transparent=True, metadata={"Date": None})
    svg = in_memory.getvalue()
    return svg[svg.index("<svg") :].replace(INK, "currentColor")


def _drawn(plots: Sequence[Draw]):
    columns = min(len(plots), COLUMNS)
    rows = -(-len(plots) // columns)
    figure, axes = tables.new_figure(WIDTH * columns, HEIGHT * rows, columns, rows)
    for ax in axes.flat[len(plots) :]:
        ax.remove()
    for ax, draw in zip(axes.flat, plots):
        draw(ax)
    return figure


def log_plots(history: Sequence[Mapping[str, Any]]) -> list[Draw]:
    """PSNR, loss and number of Gaussians by step.

    Args:
        history: Entries of log.jsonl: {"step", "psnr" or None, "loss", "gaussians"}, and "footprint", that of the
            step, where it changes.
    """
    changes = [one["step"] for one, later in pairwise(history) if one.get("footprint") != later.get("footprint")]

    def plot(name: str, title: str, log: bool = False) -> Draw:
        def draw(ax):
            known = [(entry["step"], entry[name]) for entry in history if entry[name] is not None]
            ax.plot(*zip(*known), ".-", linewidth=1.4, markersize=3, color=tables.PALETTE[4][0])
            for step in changes:
                ax.axvline(step, color="gray", linewidth=0.9, linestyle=":")
            if log and all(value > 0 for _, value in known):
                ax.set_yscale("log")
            ax.set(xlabel="step" + (" (dotted: another footprint from there on)" if changes else ""), title=title)

        return draw

    wanted = (
        ("psnr", "PSNR of a training picture [dB]", False),
        ("loss", "loss", True),
        ("gaussians", "Gaussians", False),
    )
    return [plot(*each) for each in wanted if any(entry.get(each[0]) is not None for entry in history)]


def evaluation_plots(results: Mapping[str, Mapping[str, Any]], names: Sequence[str] | None = None) -> list[Draw]:
    """PSNR by scale of every footprint, and the worst views of the first one.

    Args:
        results: By footprint, of `training.evaluate`.
        names: Of the views; None: their numbers.
    """

    def by_scale(ax):
        for place, (footprint, measured) in enumerate(results.items()):
            scales = [scale for scale in measured if scale != "mean"]
            values = [measured[scale]["psnr"] for scale in scales]
            ax.plot([f"1/{scale}" for scale in scales], values, label=footprint, **tables.line_style(4 + place))
        ax.set(xlabel="size of the pictures", title="PSNR of the test [dB]")
        ax.legend(frameon=False, fontsize=8)

    first = next(iter(results.values()))
    finest = next(scale for scale in first if scale != "mean")
    values = {place: view["psnr"] for place, view in enumerate(first[finest]["views"])}
    known = sorted((value, place) for place, value in values.items() if value is not None and math.isfinite(value))

    def worst(ax):
        shown = known[:WORST][::-1]
        labels = [_short(names[place]) if names else f"view {place}" for _, place in shown]
        ax.barh(range(len(shown)), [value for value, _ in shown], color=tables.PALETTE[1][0])
        ax.set_yticks(range(len(shown)), labels, fontsize=8)
        low = min(value for value, _ in shown)
        ax.set_xlim(left=max(0, math.floor(low - 2)))
        ax.set(xlabel="PSNR [dB]", title=f"worst of {len(known)} test views, 1/{finest}")

    return [by_scale, *([worst] if known else [])]


def capture_plots(
    stops: Mapping[str, Sequence[float]], ranges: Sequence[float], counted: Mapping[str, float]
) -> list[Draw]:
    """Exposures by photograph, ranges of sampling intervals, and shares that masks let count.

    Args:
        stops: By photograph, how much brighter it is in red, green and blue, in powers of two; NaN: not known.
        ranges: Of every point, the largest over the smallest size of a pixel there.
        counted: By photograph, the share of the picture that counts.
    """

    def exposures(ax):
        for channel, color in enumerate(("#c2255c", "#2b8a3e", "#1c7ed6")):
            ax.plot([value[channel] for value in stops.values()], ".-", color=color, linewidth=0.8, markersize=4)
        _name_photographs(ax, list(stops))
        ax.set(title="brightness, against other photographs [stops]")

    def sampling(ax):
        edges = [2 ** (i / 4) for i in range(21)]
        ax.hist([min(value, edges[-1]) for value in ranges], edges, color=tables.PALETTE[4][0])
        ax.set_xscale("log", base=2)
        ax.xaxis.set_major_formatter("{x:g}")
        ax.set(xlabel="farthest over nearest photograph", title="points, by range of sampling")

    def masks(ax):
        ax.bar(range(len(counted)), [100 * share for share in counted.values()], color=tables.PALETTE[4][0])
        _name_photographs(ax, list(counted))
        ax.set(ylim=(0, 100), title="of the picture counts [%]")

    known = any(math.isfinite(value) for of_photograph in stops.values() for value in of_photograph)
    masked = any(share < 1 for share in counted.values())
    return [draw for draw, shown in ((exposures, known), (sampling, len(ranges)), (masks, masked)) if shown]


def _name_photographs(ax, names: list[str]) -> None:
    places = range(0, len(names), -(-len(names) // NAMED))
    ax.set_xticks(places, [_short(names[place]) for place in places], rotation=60, ha="right", fontsize=7)


def _short(name: str) -> str:
    """The end of a long name, in which photographs differ."""
    return name if len(name) <= LONGEST else f"…{name[1 - LONGEST :]}"
