"""How measurements are written: tables, and plots in which a footprint always looks the same."""

from __future__ import annotations

import csv
from pathlib import Path

from .footprints import BOX_SAMPLES, resolve_footprint
from .io import optional_import

COLORS = {
    "point": "#7a7f87",
    "mip": "#e08214",
    "analytic": "#c2255c",
    "cumulant": "#2b8a3e",
    "box": "#1c7ed6",
    "erf": "#e599b8",
    "exact": "#000000",
    "adaptive": "#7048e8",
}
OTHER = "#8d6e4b"  # a footprint that is not listed
BOX_COLORS = dict(zip(BOX_SAMPLES, ("#8cc4f5", "#4f9fe6", "#1c7ed6", "#1259a0", "#0a3566")))
MARKERS = {"point": "o", "mip": "s", "analytic": "D", "cumulant": "^", "erf": "d", "exact": "*", "adaptive": "P"}


def style(footprint: str) -> dict:
    """Color, marker and linestyle of a footprint with its options, as matplotlib's keywords."""
    spec = resolve_footprint(footprint)
    options = dict(spec.options)
    color = BOX_COLORS[options["samples"]] if spec.name == "box" else COLORS.get(spec.name, OTHER)
    plain = resolve_footprint(spec.name).options == spec.options or spec.name == "box"
    marker = MARKERS.get(spec.name, "v" if spec.name == "box" else "h")
    return {"color": color, "marker": marker, "linestyle": "-" if plain else "--"}


def new_figure(width: float, height: float, columns: int = 1, rows: int = 1, **options):
    """(figure, axes): a matplotlib figure of this size [in] without global state, and its axes as a 2D array."""
    figure = optional_import("matplotlib.figure", "analysis").Figure((width, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for ax in axes.flat:
        ax.grid(True, which="major", color="#e3e6ea", linewidth=0.8)
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)
    return figure, axes


def plain_log_ticks(ax) -> None:
    """A logarithmic x axis with plain numbers: 1, 2, 5, 10, ..., and more of them in a narrow range."""
    ticker = optional_import("matplotlib.ticker", "analysis")
    low, high = ax.get_xlim()
    low = max(low, ax.dataLim.x0 * 0.9)
    ax.set_xscale("log")
    subs = (1, 1.5, 2, 3, 5, 7) if high / low < 12 else (1, 2, 5)
    subs = (1, 1.2, 1.4, 1.6, 1.8, 2, 2.5, 3, 4, 5, 6, 7, 8, 9) if high / low < 3 else subs
    ax.xaxis.set_major_locator(ticker.LogLocator(subs=subs))
    ax.xaxis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    ax.xaxis.set_minor_formatter(ticker.NullFormatter())


def save_figure(figure, out: Path, name: str) -> None:
    """Writes DIR/NAME.png and DIR/NAME.svg, the same bytes for the same plot."""
    rc_context = optional_import("matplotlib", "analysis").rc_context
    with rc_context({"svg.hashsalt": name}):
        figure.savefig(out / f"{name}.png", dpi=140)
        figure.savefig(out / f"{name}.svg", metadata={"Date": None})


def save_csv(path: Path, rows: list[dict]) -> None:
    """Writes rows with the keys of the first as header; None is left empty."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def format_table(header: list[str], rows: list[list]) -> str:
    """Columns of text: the first left-aligned, the others right-aligned; floats to 4 digits."""
    cells = [header] + [[format_cell(cell) for cell in row] for row in rows]
    widths = [max(len(row[i]) for row in cells) for i in range(len(header))]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if i else cell.ljust(width) for i, (cell, width) in enumerate(zip(row, widths))
        ).rstrip()
        for row in cells
    )


def markdown_table(header: list[str], rows: list[list]) -> str:
    """The same as Markdown."""
    lines = [header, ["---"] * len(header)] + [[format_cell(cell) for cell in row] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def format_cell(cell) -> str:
    """Text of a cell: floats to 4 digits, "-" where there is nothing."""
    if cell is None:
        return "-"
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell)
