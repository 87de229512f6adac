"""Draws docs/images/footprints_one.png and footprints_two.png: what each footprint lets a pixel see of a splat, and of
two splats in one pixel.

    python benchmarks/footprint_figure.py [--out docs/images]

All weights and shares in the pictures are computed by the library. Needs `pip install ".[analysis]"`.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch

import analytic_rasterizer as ar
from analytic_rasterizer.footprints import UNFILTERED, stated
from analytic_rasterizer.io import optional_import

NEAR, FAR, LIGHT, INK = (0.16, 0.44, 0.75), (0.93, 0.49, 0.13), (0.93, 0.93, 0.92), (0.13, 0.13, 0.16)
TEXT = "#6b7685"  # legible on white and on black
REACH = 0.74  # px: half the side of a panel, which shows one pixel and what lies around it
EXTENT = (-REACH, REACH, -REACH, REACH)
FINE = 64  # samples along a pixel's side for the truth
DISTANCE = 1000.0  # of the splats from a camera whose focal length is as large: a unit of length is a pixel
# Inches, of which a phone shows 0.57: labels have half of their points there.
WIDTH, HEIGHT = 6.6, 6.2  # of a figure
SIDE, GAP, MARGIN, TITLE = 2.0, 0.25, 0.05, 0.42  # of a panel; between panels; around them; for a name
NAME, BAR = 18, 17  # points
SHADES = 16  # of text, in the palette
IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
OPACITY = 0.98
TURN = math.radians(14)  # of the splats' long axes from the vertical
SIGMAS = 0.24, 1.1  # px, along the short and the long axis
MEANS = torch.tensor([[-0.1, 0.05], [0.36, -0.05]], dtype=torch.float64)  # of the near and the far splat, px


# Name, footprint, and what stands for the pixel.
ONE_SPLAT = [
    ("truth", "exact", "square"),
    ("point (3DGS)", "point", "dot"),
    ("box 1, mip", "box:samples=1", "window"),
    ("analytic", "analytic", "turned"),
    ("cumulant", "cumulant", "square"),
]
TWO_SPLATS = [
    ("truth", UNFILTERED, "square"),
    ("one weight", "exact", "square"),
    ("box 4", "box:samples=4", "window"),
    ("box 16", "box:samples=16", "window"),
    ("moment 4", "moment:samples=4", "moved"),
]
KEY = "dashed: pixel\ngrey: what\nstands for it\nbar: how much\nof the pixel, %\nmarks: truth"


def covariance(extra: float = 0.0) -> torch.Tensor:
    """(3,) covariance (xx, xy, yy) of both splats, px^2."""
    short, long = (sigma**2 + extra for sigma in SIGMAS)
    cos, sin = math.cos(TURN), math.sin(TURN)  # the short axis is (cos, sin)
    xx, xy, yy = short * cos**2 + long * sin**2, (short - long) * cos * sin, short * sin**2 + long * cos**2
    return torch.tensor([xx, xy, yy], dtype=torch.float64)


def matrix(covariance: torch.Tensor) -> torch.Tensor:
    xx, xy, yy = covariance.tolist()
    return torch.tensor([[xx, xy], [xy, yy]], dtype=torch.float64)


def grid(size: int = 240) -> torch.Tensor:
    """(size, size, 2) positions in a panel, px from the pixel's centre; rows go down."""
    line = (torch.arange(size, dtype=torch.float64) + 0.5) / size * 2 * REACH - REACH
    return torch.stack(torch.meshgrid(line, line, indexing="xy"), -1)


def shares(footprint: str, fine: int = 1) -> torch.Tensor:
    """(3,) how much of the pixel shows the near splat, the far one and the background, as the library blends them."""
    xx, xy, yy = covariance().tolist()
    cov3d = torch.tensor([xx, xy, 0.0, yy, 0.0, 1e-9], dtype=torch.float64).repeat(2, 1)
    depth = torch.tensor([[DISTANCE], [DISTANCE + 1e-3]], dtype=torch.float64)
    color = torch.eye(3, dtype=torch.float64)
    settings = ar.camera_settings(
        torch.eye(4, dtype=torch.float64), fine, fine, fine * DISTANCE, fine * DISTANCE, bg=color[2],
        dtype=torch.float64, footprint=footprint,
    )  # fmt: skip
    picture, _ = ar.GaussianRasterizer(settings)(
        means3D=torch.cat([MEANS, depth], 1),
        means2D=None,
        opacities=torch.full((2, 1), OPACITY, dtype=torch.float64),
        colors_precomp=color[:2],
        cov3D_precomp=cov3d,
    )
    return picture.mean((1, 2))


def moved_nodes() -> tuple[torch.Tensor, torch.Tensor]:
    """(4, 2) positions of the samples of `moment` before and after the near splat, px.

    Source: docs/internals/numerics.md, "Moving nodes".
    """
    rest = torch.tensor([[x, y] for y in (-0.25, 0.25) for x in (-0.25, 0.25)], dtype=torch.float64)
    variance = stated(ar.resolve_footprint("moment:samples=4"))["variance"]
    narrow, wide = (matrix(covariance(extra)) for extra in (0.0, variance))
    peak = OPACITY * (torch.det(narrow) / torch.det(wide)).sqrt()
    moved, left, seen, places = rest, torch.ones(4, dtype=torch.float64), [], []
    for mean in MEANS:
        step = (moved - mean) @ torch.linalg.inv(wide)
        alpha = peak * torch.exp(-(step * (moved - mean)).sum(1) / 2)
        seen.append((alpha * left).mean())
        left = left * (1 - alpha)
        shift = moved - rest + variance * (alpha / (1 - alpha))[:, None] * step
        moved = rest + shift.clamp(-0.25, 0.25)
        places.append(moved)
    torch.testing.assert_close(torch.stack([*seen, left.mean()]), shares("moment:samples=4"), rtol=0, atol=1e-6)
    return rest, places[0]


def splat_picture(count: int, footprint: str = UNFILTERED) -> torch.Tensor:
    """(H, W, 3) the first splats in their colours on white, the near one over the far one."""
    color = torch.ones(3, dtype=torch.float64)
    for mean, own in reversed(list(zip(MEANS, (NEAR, FAR)))[:count]):
        weight = 0.9 * ar.footprint_weight(grid() - mean, covariance(), footprint)[..., None]
        color = color * (1 - weight) + weight * torch.tensor(own, dtype=torch.float64)
    return color


def draw_pixel(axes, kind: str, footprint: str) -> None:
    """What stands for the pixel, in ink."""
    half = 0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    style = {"color": INK, "linewidth": 2.2}
    axes.plot(*half.T, color=INK, linewidth=1.0, linestyle=(0, (2, 2)))
    if kind == "square":
        axes.plot(*half.T, **style)
        axes.fill(*half.T, color=INK, alpha=0.12, linewidth=0)
    elif kind == "turned":
        cos, sin = math.cos(TURN), math.sin(TURN)
        turned = half @ np.array([[cos, sin], [-sin, cos]])
        axes.plot(*turned.T, **style)
        axes.fill(*turned.T, color=INK, alpha=0.12, linewidth=0)
    elif kind == "dot":
        axes.plot(0, 0, "o", color=INK, markersize=8)
    elif kind == "window":  # the weight of a speck at every position is the weight that the pixel has there
        speck = torch.tensor([1e-6, 0.0, 1e-6], dtype=torch.float64)
        window = ar.footprint_weight(-grid(), speck, footprint).numpy()
        window = window / window.max()
        axes.contourf(window, levels=[0.135, 0.607, 2], colors=[INK], alpha=0.16, extent=EXTENT, origin="lower")
        axes.contourf(window, levels=[0.607, 2], colors=[INK], alpha=0.3, extent=EXTENT, origin="lower")
        axes.contour(window, levels=[0.607], colors=[INK], linewidths=1.6, extent=EXTENT, origin="lower")
    else:
        rest, moved = (nodes.numpy() for nodes in moved_nodes())
        axes.plot([-0.5, 0.5], [0, 0], [0, 0], [-0.5, 0.5], color=INK, linewidth=1.0, linestyle=(0, (2, 2)))
        radius = stated(ar.resolve_footprint(footprint))["variance"] ** 0.5
        angle = np.linspace(0, 2 * math.pi, 60)
        circle = radius * np.stack([np.cos(angle), np.sin(angle)], 1)
        for start, end in zip(rest, moved):
            axes.fill(*(end + circle).T, color=INK, alpha=0.3, linewidth=0)
            axes.plot(*(end + circle).T, color=INK, linewidth=1.6)
            axes.plot(*(start + circle).T, color=INK, linewidth=0.9, linestyle=":")
            axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": INK, "shrinkA": 0, "shrinkB": 0})


def draw_bar(axes, parts: list[float], truth: list[float]) -> None:
    """How much of the pixel shows each splat and the background; ticks are where the truth ends."""
    ends, true = np.cumsum([0.0, *parts]), np.cumsum([0.0, *truth])
    for i, (part, color) in enumerate(zip(parts, (NEAR, FAR))):
        axes.barh(0, part, left=ends[i], height=1, color=color)
        middle = (max(ends[i], true[i]) + min(ends[i + 1], true[i + 1])) / 2  # where no mark is
        axes.text(middle, 0, f"{100 * part:.0f}", color="white", ha="center", va="center", fontsize=BAR,
                  fontweight="bold")  # fmt: skip
        axes.plot([true[i + 1]] * 2, [-0.5, 0.5], color=INK, linewidth=2.4)
    axes.barh(0, 1 - ends[-1], left=ends[-1], height=1, color=LIGHT, zorder=0)
    axes.set(xlim=(-0.01, 1.01), ylim=(-0.8, 0.8))
    axes.axis("off")


def draw(path, panels: list[tuple], count: int) -> None:
    """Writes the figure of the first `count` splats, three panels in a row and the key after the last."""
    figure = optional_import("matplotlib.figure", "analysis").Figure(figsize=(WIDTH, HEIGHT), facecolor="none")
    FigureCanvas = optional_import("matplotlib.backends.backend_agg", "analysis").FigureCanvasAgg
    canvas = FigureCanvas(figure)

    def at(x, y, width, height):
        """Axes with a corner at x, y and a size, inches from the upper left of the figure."""
        return figure.add_axes((x / WIDTH, 1 - (y + height) / HEIGHT, width / WIDTH, height / HEIGHT))

    def write(x, y, text, size, **style):
        figure.text(x / WIDTH, 1 - y / HEIGHT, text, fontsize=size, va="top", color=TEXT, **style)

    truth = None
    for number, (name, footprint, kind) in enumerate(panels):
        x, y = MARGIN + (SIDE + GAP) * (number % 3), MARGIN + (HEIGHT / 2) * (number // 3)
        write(x, y, name, NAME, fontweight="bold")
        if count == 1:
            parts = [ar.footprint_weight(-MEANS[0], covariance(), footprint).item()]
        else:
            parts = shares(footprint, FINE if footprint == UNFILTERED else 1)[:2].tolist()
        truth = truth or parts
        axes = at(x, y + TITLE, SIDE, SIDE)
        shown = "point" if footprint == "point" else UNFILTERED
        axes.imshow(splat_picture(count, shown).numpy(), extent=EXTENT, origin="lower", interpolation="bilinear")
        draw_pixel(axes, kind, footprint)
        axes.set(xlim=EXTENT[:2], ylim=EXTENT[2:][::-1], xticks=[], yticks=[])
        for spine in axes.spines.values():
            spine.set(color="0.75")
        draw_bar(at(x, y + TITLE + SIDE + 0.05, SIDE, 0.4), parts, truth)
    x, y = MARGIN + 2 * (SIDE + GAP), MARGIN + HEIGHT / 2
    write(x, y + TITLE, KEY, NAME, linespacing=1.25)
    canvas.draw()
    save(canvas.buffer_rgba(), path)


def save(rgba, path) -> None:
    """Writes a picture with a palette, which makes the file small. What is not opaque is text, in SHADES of alpha."""
    Image = optional_import("PIL.Image")
    pixels = np.asarray(rgba)
    alpha, colors = pixels[..., 3], 256 - SHADES
    palette = Image.fromarray(pixels[..., :3].copy()).quantize(colors, kmeans=2)
    shade = colors + np.round(alpha / 255 * (SHADES - 1))
    written = Image.fromarray(np.where(alpha == 255, np.asarray(palette), shade).astype(np.uint8), "P")
    text = [int(TEXT[i : i + 2], 16) for i in (1, 3, 5)]
    written.putpalette((palette.getpalette() + [0] * 3 * colors)[: 3 * colors] + text * SHADES)
    alphas = [255] * colors + [round(255 * i / (SHADES - 1)) for i in range(SHADES)]
    written.save(path, optimize=True, transparency=bytes(alphas))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=IMAGES, metavar="DIR")
    out = parser.parse_args().out
    draw(out / "footprints_one.png", ONE_SPLAT, 1)
    draw(out / "footprints_two.png", TWO_SPLATS, 2)


if __name__ == "__main__":
    main()
