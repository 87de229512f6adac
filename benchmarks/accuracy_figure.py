"""Draws what tables of the documents say: errors of weights, and errors of pictures beside their time.

    python benchmarks/accuracy_figure.py [--out docs/images]

errors_weight.png shows "The weight" of docs/accuracy.md. accuracy_time.png shows "The picture" of docs/accuracy.md and
"On an H100" of docs/performance.md. So the figures are as new as the tables. To measure your own scene:
`python -m analytic_rasterizer pareto`. Needs Matplotlib.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from analytic_rasterizer.io import optional_import

DOCS = Path(__file__).resolve().parents[1] / "docs"
SCENES = (("plaza 1/1", "plaza hd", "plaza, 1920x1080"), ("plaza 1/8", "plaza lo", "plaza, 240x135"))
INK, GRID, ONE, SEVERAL = "#6b7685", "#6b768540", "#d97900", "#3e82f7"  # legible on white and on black
WIDTH, HEIGHT = 6, 8.4  # inches
LINES = ("point", "mip", "analytic", "cumulant", "box/moment, 1", "box, 4", "box, 16", "moment, 4", "moment, 16")
FLOOR = 1e-7  # of the errors that are shown


def table(page: Path, heading: str) -> dict[str, dict[str, str]]:
    """The first table under a heading: {name of the row: {name of the column: text}}."""
    section = page.read_text().split(f"\n## {heading}\n")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    columns, _, *body = rows
    return {plain(row[0]): dict(zip(columns[1:], row[1:])) for row in body if len(row) == len(columns)}


def plain(name: str) -> str:
    """`box`, 4 samples and `box`, 4 are one name."""
    return re.sub(r"[`*]| \(.*\)| samples?$", "", name.replace("samples**", "samples").replace("sample**", "sample"))


def points(psnr_column: str, time_column: str) -> list[tuple[str, float, float]]:
    """Name, forward time in ms, and PSNR in dB of what both tables have."""
    psnr, times = table(DOCS / "accuracy.md", "The picture"), table(DOCS / "performance.md", "On an H100")
    both = [name for name in psnr if name in times]
    forward = {name: float(times[name][time_column].strip("*").split("/")[0]) for name in both}
    return [(name, forward[name], float(psnr[name][psnr_column])) for name in both]


def style():
    """Matplotlib's pyplot, with colours that can be read on white and on black."""
    plt = optional_import("matplotlib.pyplot", "analysis")
    plt.rcParams.update({"text.color": INK, "axes.labelcolor": INK, "axes.edgecolor": INK, "font.size": 13})
    plt.rcParams.update({"xtick.color": INK, "ytick.color": INK, "grid.color": GRID, "axes.facecolor": "none"})
    return plt


def draw_time(plt, out: Path) -> None:
    figure, axes = plt.subplots(len(SCENES), 1, figsize=(WIDTH, HEIGHT))
    for axis, (psnr_column, time_column, title) in zip(axes, SCENES):
        shown = points(psnr_column, time_column)
        psnr_of = {name: psnr for name, _, psnr in shown}
        # Labels that others would cover: points down.
        down = {"analytic": 5, "box, 1": 20, min("box, 4", "moment, 1", key=psnr_of.get): 15}
        for name, time, psnr in shown:
            several = name.startswith("moment") or name in ("box, 4", "box, 16")
            axis.plot(time, psnr, "o", color=SEVERAL if several else ONE, markersize=8)
            if name not in ("mip", "cumulant"):  # which lie on box, 1
                text = {"box, 1": "box 1, mip, cumulant"}.get(name, name.replace(", ", " "))
                axis.annotate(text, (time, psnr), (7, -down.get(name, -5)), textcoords="offset points")
        left, right = min(t for _, t, _ in shown), max(t for _, t, _ in shown)
        axis.set_xlim(left - 0.05 * (right - left), right + 0.25 * (right - left))
        axis.set_ylim(top=max(psnr_of.values()) + 6)
        axis.set(title=title, ylabel="PSNR against the truth, dB", xlabel="forward, ms on an H100")
        axis.grid(True)
    figure.tight_layout()
    figure.savefig(out, dpi=100, transparent=True)


def draw_weights(plt, out: Path) -> None:
    rows = table(DOCS / "accuracy.md", "The weight")
    figure, axis = plt.subplots(figsize=(WIDTH, 0.9 * WIDTH))
    for i, name in enumerate(LINES):
        sizes = [column for column in rows[name] if re.fullmatch(r"[\d.]+ px", column)]
        errors = [max(float(rows[name][size]), FLOOR) for size in sizes]
        marker = "osD^v<>PX"[i]
        axis.loglog([float(size.split()[0]) for size in sizes], errors, "-" + marker, label=name.replace(", ", " "))
    axis.set(xlabel="smaller standard deviation of the splat, px", ylabel="largest error of the weight")
    axis.set_ylim(bottom=FLOOR / 2)
    axis.grid(True)
    axis.legend(fontsize=11, framealpha=0)
    figure.tight_layout()
    figure.savefig(out, dpi=100, transparent=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=DOCS / "images", metavar="DIR")
    out = parser.parse_args().out
    plt = style()
    draw_time(plt, out / "accuracy_time.png")
    draw_weights(plt, out / "errors_weight.png")


if __name__ == "__main__":
    main()
