"""A resolution target made of Gaussians, rendered with seven footprints and compared with the truth.

    python examples/demo.py --out DIR

`make_target()` draws, with 3D Gaussians, what is hard to sample: rings and spokes that grow finer, strokes of text,
needles, a bush of leaves in many layers, and translucent blobs over a fabric. `run()` renders it at four resolutions,
measures each footprint against a supersampled reference, and draws a sheet that shows all of it.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import NamedTuple

import torch

from analytic_rasterizer import render_stages
from analytic_rasterizer.analysis.reference import UNFILTERED, image_errors, refine, supersampled
from analytic_rasterizer.analysis.tables import format_table
from analytic_rasterizer.cli import arguments
from analytic_rasterizer.gaussians import Gaussians
from analytic_rasterizer.io import (
    SceneMetadata,
    View,
    optional_import,
    save_image,
    save_scene,
    save_views,
    to_image,
    write_text,
)

CANVAS = (384, 256)  # the target is drawn in these units; also the default size of the picture
FOCAL = 460.0  # canvas units
PAPER = (0.97, 0.96, 0.93)
REDUCTIONS = (1, 2, 4, 8)
COLUMNS = {  # footprint: its title on the sheet
    "point": "point",
    "mip": "mip",
    "analytic": "analytic",
    "cumulant": "cumulant",
    "box:samples=1": "box, 1 sample",
    "box:samples=4": "box, 4 samples",
    "moment:samples=4": "moment, 4 samples",
}

INK = (0.09, 0.11, 0.17)
RED = (0.86, 0.10, 0.12)


# ------------------------------------------------------------------------------------- target


class Brush:
    """Places Gaussians by their picture: canvas units, x right, y down, depth in world units."""

    def __init__(self):
        self.parts = []

    def stamp(self, x, y, along, across, angle, depth, color, opacity):
        """Flat Gaussians facing the camera. Numbers or (n,) tensors; color (3,) or (n, 3).

        `along` and `across` are standard deviations; `angle` [rad] turns x towards y.
        """
        columns = [torch.as_tensor(v, dtype=torch.float64) for v in (x, y, along, across, angle)]
        columns += [torch.as_tensor(v, dtype=torch.float64) for v in (depth, opacity)]
        columns = torch.stack(torch.broadcast_tensors(*columns), -1).reshape(-1, 7)
        color = torch.as_tensor(color, dtype=torch.float64).expand(len(columns), 3)
        self.parts.append(torch.cat([columns, color], 1))

    def line(self, points, width, depth, color, opacity=0.95):
        """A stroke of overlapping Gaussians along points (n, 2), about `width` across."""
        points = torch.as_tensor(points, dtype=torch.float64)
        steps = points.diff(dim=0)
        for start, step, length in zip(points, steps, steps.norm(dim=1).tolist()):
            count = max(1, round(1.6 * length / width))
            at = start + (torch.arange(count)[:, None] + 0.5) / count * step
            angle = math.atan2(step[1], step[0])
            along = 0.75 * length / count
            self.stamp(at[:, 0], at[:, 1], along, width / 3, angle, depth, color, opacity)

    def scene(self) -> Gaussians:
        """The Gaussians that project to these stamps under `make_target`'s view."""
        x, y, along, across, angle, depth, opacity = torch.cat(self.parts)[:, :7].unbind(1)
        color = torch.cat(self.parts)[:, 7:]
        unit = depth / FOCAL  # world units that a canvas unit spans at this depth
        centre = [(x - CANVAS[0] / 2) * unit, (y - CANVAS[1] / 2) * unit, depth]
        zero = torch.zeros_like(angle)
        fields = (
            torch.stack(centre, 1),
            torch.stack([along * unit, across * unit, 1e-3 * across * unit], 1),
            torch.stack([(angle / 2).cos(), zero, zero, (angle / 2).sin()], 1),
            opacity[:, None],
            ((color - 0.5) / math.sqrt(1 / (4 * math.pi)))[:, None],
        )
        return Gaussians.from_activated(*(field.float().contiguous() for field in fields))


def make_target() -> tuple[Gaussians, View]:
    """The target and the view that frames it at CANVAS size, always the same."""
    random = torch.Generator().manual_seed(7)
    brush = Brush()
    _rings(brush, centre=(67, 72), radius=58)
    _fabric(brush, centre=(192, 72), radius=54)
    _star(brush, centre=(317, 72), radius=50)
    _text(brush, top=150)
    _leaves(brush, random, centre=(245, 196), radius=46)
    _needles(brush, random, left=300, top=150)
    view = View("target", *CANVAS, FOCAL, FOCAL, torch.eye(4, dtype=torch.float64))
    return brush.scene(), view


def _rings(brush: Brush, centre, radius) -> None:
    """Concentric rings, their period falling from 13 to 4 units outwards."""
    r = 4.0
    while r < radius:
        period = 13 - 9 * r / radius
        angle = torch.linspace(0, 2 * math.pi, max(16, round(2.2 * r)), dtype=torch.float64)
        circle = torch.stack([angle.cos(), angle.sin()], 1) * r + torch.tensor(centre)
        brush.line(circle, period / 2, depth=4.0, color=INK)
        r += period


def _star(brush: Brush, centre, radius, spokes=24) -> None:
    """A Siemens star. Behind each dark spoke lies a red one that it hides exactly."""
    angle = torch.arange(spokes, dtype=torch.float64)[:, None] * (2 * math.pi / spokes)
    r = 3 * 1.07 ** torch.arange(math.log(radius / 3) / math.log(1.07), dtype=torch.float64)
    x, y = centre[0] + r * angle.cos(), centre[1] + r * angle.sin()
    for depth, color in ((4.0, INK), (4.5, RED)):
        across = r * math.pi / spokes / 2.5
        brush.stamp(x, y, 0.05 * r, across, angle, depth, color, 0.98)


def _fabric(brush: Brush, centre, radius) -> None:
    """A weave of two thread colours behind three translucent blobs."""
    for depth, slant, color in ((5.0, 0.35, (0.13, 0.42, 0.55)), (5.2, 1.92, (0.80, 0.52, 0.14))):
        along = torch.tensor([math.cos(slant), math.sin(slant)])
        normal = torch.tensor([-along[1], along[0]])
        for offset in torch.arange(-radius, radius + 0.1, 4.5).tolist():
            half = math.sqrt(max(radius**2 - offset**2, 0.0))
            middle = torch.tensor(centre) + offset * normal
            if half > 2:
                brush.line(torch.stack([middle - half * along, middle + half * along]), 2.5, depth, color)
    for turn, depth, color in (
        (-0.5, 3.0, (0.93, 0.25, 0.45)),
        (1.6, 3.2, (0.16, 0.62, 0.93)),
        (3.7, 3.4, (0.98, 0.80, 0.18)),
    ):
        x, y = centre[0] + 21 * math.cos(turn), centre[1] + 21 * math.sin(turn)
        brush.stamp(x, y, 15, 15, 0.0, depth, color, 0.75)


def _text(brush: Brush, top) -> None:
    """An eye chart: the same words at falling size."""
    y = top
    for text, height in (
        ("ANALYTIC", 26),
        ("SPLATTING", 18),
        ("ANALYTIC SPLATTING", 11),
        ("ANALYTIC SPLATTING", 8),
    ):
        x = 10.0
        for letter in text:
            for stroke in LETTERS.get(letter, ()):
                points = torch.tensor(stroke, dtype=torch.float64) * (height / 6)
                brush.line(points + torch.tensor([x, y]), height / 7, depth=4.0, color=INK)
            x += height * 0.86
        y += height * 1.45


LETTERS = {  # strokes on a grid 4 wide and 6 high, y down
    "A": [[(0, 6), (2, 0), (4, 6)], [(0.8, 4), (3.2, 4)]],
    "C": [[(4, 1), (3, 0), (1, 0), (0, 1), (0, 5), (1, 6), (3, 6), (4, 5)]],
    "G": [[(4, 1), (3, 0), (1, 0), (0, 1), (0, 5), (1, 6), (3, 6), (4, 5), (4, 3.3), (2.4, 3.3)]],
    "I": [[(2, 0), (2, 6)]],
    "L": [[(0, 0), (0, 6), (3.6, 6)]],
    "N": [[(0, 6), (0, 0), (4, 6), (4, 0)]],
    "P": [[(0, 6), (0, 0), (3, 0), (4, 1), (4, 2), (3, 3), (0, 3)]],
    "S": [
        [
            (4, 1),
            (3, 0),
            (1, 0),
            (0, 1),
            (0, 2),
            (1, 3),
            (3, 3),
            (4, 4),
            (4, 5),
            (3, 6),
            (1, 6),
            (0, 5),
        ]
    ],
    "T": [[(0, 0), (4, 0)], [(2, 0), (2, 6)]],
    "Y": [[(0, 0), (2, 3), (4, 0)], [(2, 3), (2, 6)]],
}


def _leaves(brush: Brush, random, centre, radius) -> None:
    """A bush of small opaque leaves, each at its own depth."""
    count = 1300
    r = radius * torch.rand(count, generator=random).sqrt()
    angle = 2 * math.pi * torch.rand(count, generator=random)
    depth = 3.5 + torch.rand(count, generator=random)
    shade = torch.rand(count, 1, generator=random)
    green, straw = torch.tensor([0.10, 0.33, 0.16]), torch.tensor([0.62, 0.74, 0.22])
    brush.stamp(
        centre[0] + r * angle.cos(),
        centre[1] + r * angle.sin(),
        1.7,
        0.6,
        math.pi * torch.rand(count, generator=random),
        depth,
        green + shade * (straw - green),
        0.95,
    )


def _needles(brush: Brush, random, left, top) -> None:
    """Needles of 2 units, in two crossing sweeps at different depths."""
    for sweep, (depth, color) in enumerate(((3.6, (0.55, 0.16, 0.42)), (4.2, (0.93, 0.55, 0.16)))):
        for i in range(22):
            bend = torch.linspace(0, 1, 9)
            x = left + 78 * bend
            y = top + 92 * (i / 21 * (1 - 0.8 * bend) + sweep * 0.8 * bend + 0.02 * torch.rand(1, generator=random))
            brush.line(torch.stack([x, y], 1), 2.0, depth, color)


# ---------------------------------------------------------------------------------- measuring

REPEATS = 30  # renders of which the fastest is reported


class Picture(NamedTuple):
    """One footprint at one reduction, and how far it is from the reference (colours in 0 to 1)."""

    footprint: str
    reduction: int
    color: torch.Tensor  # (3, H, W) float32
    seconds: float  # project + bin + blend
    psnr: float  # dB
    rmse: float
    max: float  # largest error of any channel of any pixel


def run(out, size: tuple[int, int] = CANVAS, device="cpu") -> dict:
    """Renders and measures the target at `size` and its reductions; writes everything to `out`.

    Writes contact_sheet.png, every picture, results.json, and the target itself as target.ply with
    views.json. Returns what results.json holds. `out` must exist. Raises ValueError for a size that
    is not a positive multiple of 8.
    """
    if any(length < 8 or length % max(REDUCTIONS) for length in size):
        raise ValueError(f"size must be positive multiples of 8, got {size[0]} x {size[1]}")
    out = Path(out)
    scene, view = make_target()
    save_scene(out / "target.ply", scene, SceneMetadata(footprint="moment", background=PAPER))
    zoom = size[0] / view.width  # pixels are square whatever the size
    view = View(view.name, *size, FOCAL * zoom, FOCAL * zoom, view.w2c)
    save_views(out / "views.json", [view])
    scene = scene.to(device)

    work = len(COLUMNS) * len(REDUCTIONS)
    with optional_import("tqdm").tqdm(total=work, desc="footprints", disable=None) as bar:
        renders = {}
        for reduction in REDUCTIONS:
            for footprint in COLUMNS:
                renders[footprint, reduction] = _render(scene, view, 1 / reduction, footprint)
                bar.update()
    truth, density, residual = _converged_reference(scene, view, renders)
    pictures = [
        Picture(footprint, reduction, color, seconds, *_errors(color, truth[reduction]))
        for (footprint, reduction), (color, seconds) in renders.items()
    ]

    for picture in pictures:
        name = picture.footprint.replace(":samples=", "")
        save_image(out / f"{name}_{picture.reduction}.png", picture.color)
    for reduction, color in truth.items():
        save_image(out / f"reference_{reduction}.png", color)
    results = {
        "size": list(size),
        "gaussians": len(scene.means),
        "device": str(device),
        "threads": torch.get_num_threads(),
        "reference": {
            "footprint": UNFILTERED,
            "samples_per_pixel": {str(r): (density * r) ** 2 for r in REDUCTIONS},
            "residual_rmse": {str(r): value for r, value in residual.items()},
        },
        "pictures": [
            {key: value for key, value in picture._asdict().items() if key != "color"} for picture in pictures
        ],
    }
    write_text(out / "results.json", json.dumps(results, indent=1) + "\n")
    save_image(out / "contact_sheet.png", draw_sheet(pictures, truth, results), optimize=True)
    return results


def _render(scene: Gaussians, view: View, scale: float, footprint: str):
    """(color on the CPU, seconds of the fastest of REPEATS renders)."""
    settings = view.settings(scale, PAPER, 0, footprint, device=scene.means.device)
    runs = [render_stages(settings, **scene.arguments()) for _ in range(REPEATS)]
    return runs[0].color.cpu(), min(sum(stages.seconds.values()) for stages in runs)


def _errors(color: torch.Tensor, truth: torch.Tensor) -> tuple[float, float, float]:
    """(PSNR, RMSE, largest error)."""
    errors = image_errors(color, truth)
    return errors["psnr"], errors["rmse"], errors["max"]


def _converged_reference(scene: Gaussians, view: View, renders: dict):
    """({reduction: reference}, density, {reduction: RMSE against half the density})."""
    refined = refine(
        lambda density: _reduced(supersampled(scene, view, density, background=PAPER)),
        lambda truth: {r: min(_errors(renders[name, r][0], truth[r])[1] for name in COLUMNS) for r in REDUCTIONS},
    )
    return refined.pictures, refined.density, refined.residuals[refined.density]


def _reduced(color: torch.Tensor) -> dict[int, torch.Tensor]:
    """The picture at every reduction: a pixel of 1/n is the mean of the n x n that it covers."""
    return {n: torch.nn.functional.avg_pool2d(color[None], n)[0].cpu() for n in REDUCTIONS}


# -------------------------------------------------------------------------------------- sheet

ERROR_SPAN = 0.15  # error [0 to 1] at which the error maps saturate
ERROR_RAMP = ((1.0, 1.0, 1.0), (1.0, 0.80, 0.35), (0.88, 0.25, 0.16), (0.25, 0.02, 0.12))
SHEET, TEXT, MUTED, BEST = "#ffffff", "#1c2330", "#6b7280", "#0b7a3e"


def draw_sheet(pictures: list[Picture], truth: dict, results: dict):
    """A Pillow image: a row for each reduction, a column for each footprint, the reference last.

    Every picture is shown at the size of the full one, without smoothing, over its error map.
    """
    image, draw_module, font_module = (optional_import(f"PIL.{name}") for name in ("Image", "ImageDraw", "ImageFont"))
    width, height = results["size"]
    unit = width / 24  # lengths below are in these, so that the sheet scales with its pictures
    gap, label, notes = round(unit), round(6 * unit), height // 2
    top = round(9.5 * unit)
    step_x, step_y = width + gap, height + notes + 2 * gap
    sheet = image.new(
        "RGB",
        (gap + label + (len(COLUMNS) + 1) * step_x, top + len(truth) * step_y + round(1.5 * gap)),
        SHEET,
    )
    draw = draw_module.Draw(sheet)

    def write(x, y, text, size=2.0, fill=TEXT, anchor="la", bold=False):
        font = font_module.load_default(size=max(1, size * unit))
        draw.text((x, y), text, fill, font, anchor, stroke_width=0.03 * unit * size * bold)

    def paste(color, x, y, size):
        sheet.paste(to_image(color).resize(size, image.Resampling.NEAREST), (x, y))

    right = sheet.width - gap
    title = "One scene at four resolutions, as each footprint renders it"
    write(gap, 4 * unit, title, 3.2, anchor="ls", bold=True)
    threads = "" if results["device"] != "cpu" else f" on the CPU (threads: {results['threads']})"
    notes_on = f"below each picture: its error map, its PSNR against the reference, its time{threads}"
    write(right - width - 9 * unit, 4 * unit, notes_on, 1.8, MUTED, "rs")
    ramp = ERROR_SPAN * torch.linspace(0, 1, 256).expand(3, 1, 256)
    paste(_error_colors(ramp, 0), right - width, gap, (width, round(1.6 * unit)))
    write(right - width, 4.4 * unit, "no error", 1.6, MUTED, "ls")
    write(right, 4.4 * unit, f"{ERROR_SPAN} or more", 1.6, MUTED, "rs")
    for i, title in enumerate([*COLUMNS.values(), "reference"]):
        x = gap + label + i * step_x
        write(x + width / 2, top - gap, title, 2.6, anchor="ms", bold=True)

    by_cell = {(picture.footprint, picture.reduction): picture for picture in pictures}
    for row, (reduction, reference) in enumerate(truth.items()):
        y = top + row * step_y
        pixels = f"{width // reduction} x {height // reduction}"
        write(gap, y, "full" if reduction == 1 else f"1/{reduction}", 3.0, bold=True)
        write(gap, y + 4 * unit, pixels, 1.3, MUTED)
        best = max(by_cell[name, reduction].psnr for name in COLUMNS)
        for column, name in enumerate(COLUMNS):
            x = gap + label + column * step_x
            picture = by_cell[name, reduction]
            paste(picture.color, x, y, (width, height))
            below, half = y + height + gap // 2, (width // 2, height // 2)
            error = (picture.color - reference).abs().float()
            paste(_error_colors(error, 1 if reduction == 1 else 0), x, below, half)
            draw.rectangle((x, below, x + half[0] - 1, below + half[1] - 1), outline="#d1d5db")
            x += half[0] + gap // 2
            is_best = picture.psnr == best
            color = BEST if is_best else TEXT
            write(x, below, f"{picture.psnr:.1f} dB", 2.6, color, bold=is_best)
            write(x, below + 3.4 * unit, f"{1000 * picture.seconds:.1f} ms", 1.9, MUTED)
        x = gap + label + len(COLUMNS) * step_x
        paste(reference, x, y, (width, height))
        side = math.isqrt(results["reference"]["samples_per_pixel"][str(reduction)])
        write(x, y + height + gap // 2, f"{side} x {side} points per pixel", 1.7, MUTED)
    return sheet


def _error_colors(error: torch.Tensor, halvings: int) -> torch.Tensor:
    """Colours (3, h, w) of |error| (3, H, W), the mean over channels, on ERROR_RAMP."""
    error = torch.nn.functional.avg_pool2d(error.mean(0)[None, None], 2**halvings)[0, 0]
    place = (error / ERROR_SPAN).clamp(0, 1) * (len(ERROR_RAMP) - 1)
    below = place.floor().clamp(max=len(ERROR_RAMP) - 2).long()
    ramp = torch.tensor(ERROR_RAMP)
    share = (place - below)[..., None]
    return (ramp[below] * (1 - share) + ramp[below + 1] * share).permute(2, 0, 1)


# -------------------------------------------------------------------------------- the command


def main(argv: list[str] | None = None) -> int:
    """Returns the exit code: 0, 2 after an error, 130 when interrupted."""
    return arguments.run_command(lambda: parse_arguments(argv))


def parse_arguments(argv: list[str] | None):
    parser = arguments.Parser(
        description="Render a resolution target made of Gaussians with seven footprints at four resolutions, compare "
        "with a supersampled reference, and write DIR/contact_sheet.png, the pictures, results.json, and the target "
        "itself as target.ply with views.json."
    )
    parser.add_argument("--out", required=True, metavar="DIR", help="folder for the results")
    size_help = "of the full picture, multiples of 8 (default: {} {})".format(*CANVAS)
    parser.add_argument("--size", nargs=2, type=arguments.count, default=CANVAS, metavar=("W", "H"), help=size_help)
    arguments.add_machine_options(parser)
    parser.set_defaults(run=run_demo)
    return parser.parse_args(argv)


def run_demo(args) -> None:
    """Runs the demo and prints its table of errors and times."""
    arguments.use_machine(args)
    out = arguments.writable_folder(args.out)
    results = run(out, tuple(args.size), args.device)
    rows = [
        [f"1/{p['reduction']}", p["footprint"], f"{p['psnr']:.2f}", p["rmse"], p["max"], p["seconds"]]
        for p in results["pictures"]
    ]
    print(format_table(["scale", "footprint", "PSNR [dB]", "RMSE", "max", "time [s]"], rows))
    reference = results["reference"]
    residual = ", ".join(f"{value:.1e} (1/{scale})" for scale, value in reference["residual_rmse"].items())
    print(
        f"reference: {reference['footprint']}, {reference['samples_per_pixel']['1']} samples per pixel at full size; "
        f"RMSE against a quarter of the samples: {residual}"
    )
    print(f"see {out / 'contact_sheet.png'}")


if __name__ == "__main__":
    sys.exit(main())
