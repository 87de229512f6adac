"""How measurements are written: tables, and figures in which a footprint always has the same colour and marker."""

from __future__ import annotations

import csv
import math
from io import StringIO
from pathlib import Path

from ..footprints import FOOTPRINTS, resolve_footprint
from ..io import optional_import, write_safely, write_text

PALETTE = (  # colours and markers, of the footprints in the order of the registry
    ("#7a7f87", "o"),
    ("#e08214", "s"),
    ("#c2255c", "D"),
    ("#2b8a3e", "^"),
    ("#1c7ed6", "v"),
    ("#0c8599", "p"),
    ("#e599b8", "d"),
    ("#000000", "*"),
    ("#7048e8", "P"),
    ("#495057", "h"),
)


def line_style(place: int) -> dict:
    """Keywords of matplotlib for a line, by its place among those of a figure: color, marker and linestyle."""
    color, marker = PALETTE[place % len(PALETTE)]
    return {"color": color, "marker": marker, "linestyle": "-"}


def style(footprint: str) -> dict:
    """The same for a footprint with its options.

    More samples are darker; options other than the defaults are darker and dashed.
    """
    spec = resolve_footprint(footprint)
    samples = dict(spec.options).get("samples")
    found = line_style(FOOTPRINTS.index(spec.name))
    is_default = samples is not None or spec == resolve_footprint(spec.name)
    shade = math.log2(samples) / 4 - 0.5 if samples else 0.0 if is_default else 0.5
    return found | {"color": _shade(found["color"], shade), "linestyle": "-" if is_default else "--"}


def _shade(color: str, darker: float) -> str:
    """The colour "#rrggbb" mixed with black, or with white where `darker` (-1 to 1) is negative."""
    target = 0 if darker > 0 else 255
    return "#" + bytes(round(c + abs(darker) * (target - c)) for c in bytes.fromhex(color[1:])).hex()


def new_figure(width: float, height: float, columns: int = 1, rows: int = 1, **options):
    """(figure, axes): a matplotlib figure of this size [in] without global state, and its axes as a 2D array."""
    figure = optional_import("matplotlib.figure", "analysis").Figure((width, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for ax in axes.flat:
        ax.grid(True, which="major", color="#e3e6ea", linewidth=0.8)
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)
    return figure, axes


def label_log_axis(axis) -> None:
    """Labels a logarithmic axis between powers of ten too, so that it has labels however short it is."""
    ticker = optional_import("matplotlib.ticker", "analysis")
    low, high = axis.get_view_interval()
    subs = (1, 2, 5) if high / low >= 12 else (1, 1.2, 1.5, 2, 3, 5, 7)
    axis.set_major_locator(ticker.LogLocator(subs=subs))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(ticker.NullFormatter())


def add_titles(figure, axes, title: str, xlabel: str = "") -> None:
    """Logarithmic x axes with labels, the title, and the legend of the last axes at the right."""
    for ax in axes.flat:
        ax.set_xscale("log")
        label_log_axis(ax.xaxis)
    for ax in axes[-1]:
        ax.set_xlabel(xlabel or ax.get_xlabel())
    handles, labels = axes[-1, -1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", frameon=False, fontsize=9)
    figure.suptitle(title, fontsize=11)


def save_figure(figure, out: Path, name: str) -> None:
    """Writes DIR/NAME.png and DIR/NAME.svg, the same bytes for the same plot."""
    with optional_import("matplotlib", "analysis").rc_context({"svg.hashsalt": name}):
        write_safely(out / f"{name}.png", lambda temporary: figure.savefig(temporary, dpi=140))
        write_safely(out / f"{name}.svg", lambda temporary: figure.savefig(temporary, metadata={"Date": None}))


def save_csv(path: Path, rows: list[dict]) -> None:
    """Writes rows with the keys of the first as header; None is left empty."""
    text = StringIO()
    writer = csv.DictWriter(text, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def format_table(header: list[str], rows: list[list]) -> str:
    """Columns of text: the first aligned left, the others right; floats with 4 digits, "-" for None."""
    cells = [header, *map(_texts, rows)]
    widths = [max(map(len, column)) for column in zip(*cells)]
    aligned = "  ".join(f"{{:{'>' if i else '<'}{width}}}" for i, width in enumerate(widths))
    return "\n".join(aligned.format(*row).rstrip() for row in cells)


def markdown_table(header: list[str], rows: list[list]) -> str:
    """The same as Markdown."""
    return "\n".join(f"| {' | '.join(line)} |" for line in (header, ["---"] * len(header), *map(_texts, rows)))


def _texts(row: list) -> list[str]:
    return ["-" if cell is None else f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in row]
