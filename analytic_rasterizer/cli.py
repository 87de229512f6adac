"""The command line: `python -m analytic_rasterizer COMMAND`.

A command is one function that adds its parser to the subcommands and sets `run`, a function of the
parsed arguments, as its default; COMMANDS lists them. A command reports what the user can mend by
raising: `main` turns that into one line on stderr and exit code 2.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from pathlib import Path

import torch

from . import __version__, demo, io
from .footprints import FOOTPRINTS
from .rasterizer import render_stages

STAGES = ("project", "bin", "blend")
PROGRAM = "python -m analytic_rasterizer"
# What a user can cause: bad values and files (ValueError, TypeError, OSError), a missing extra
# (ImportError), a device out of memory or absent (RuntimeError, MemoryError).
MENDABLE = (ValueError, TypeError, OSError, ImportError, RuntimeError, MemoryError)


def main(argv: list[str] | None = None) -> int:
    """Runs one command and returns its exit code: 0, 2 after an error, 130 when interrupted."""
    try:
        args = build_parser().parse_args(argv)
        args.run(args)
        return 0
    except KeyboardInterrupt:
        return 130
    except MENDABLE as error:
        print(f"error: {_describe(error)}", file=sys.stderr)
        return 2


class Parser(argparse.ArgumentParser):
    """An ArgumentParser whose errors are one line."""

    def error(self, message):
        self.exit(2, f"error: {message} (see {self.prog} --help)\n")


def build_parser() -> Parser:
    parser = Parser(prog=PROGRAM, description="Render 3D Gaussians with pixels that integrate, not sample.")
    parser.add_argument("--version", action="version", version=f"analytic_rasterizer {__version__}")
    subcommands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for add_command in COMMANDS:
        add_command(subcommands)
    return parser


# ----------------------------------------------------------------------------------- commands


def add_render(subcommands) -> None:
    parser = subcommands.add_parser(
        "render",
        help="render a scene from the views of a file, as PNG",
        description="Render SCENE from every view of VIEWS into DIR/NAME.png, and say what each "
        "stage cost. Footprints: "
        + ", ".join(FOOTPRINTS)
        + "; options follow a colon: box:samples=4, point:dilation=0.",
    )
    parser.add_argument("scene", metavar="SCENE", help="3DGS .ply, compressed .ply or .spz")
    parser.add_argument(
        "--views",
        required=True,
        help="3DGS cameras.json, Blender or nerfstudio transforms.json, or a list of {width, height, fx, fy, w2c}",
    )
    parser.add_argument("--out", required=True, metavar="DIR", help="folder for the pictures")
    parser.add_argument(
        "--footprint",
        metavar="NAME[:k=v,..]",
        help="how a pixel sees a splat (default: the library's, analytic)",
    )
    parser.add_argument("--samples", type=int, help="samples of the box footprint: 1, 2, 4, 8, 16")
    parser.add_argument("--scale", type=_positive, default=1.0, help="resolution, as a factor (default: 1)")
    parser.add_argument(
        "--background",
        nargs=3,
        type=_intensity,
        default=(0.0, 0.0, 0.0),
        metavar=("R", "G", "B"),
        help="colour behind the scene, 0 to 1 (default: black)",
    )
    parser.add_argument(
        "--size",
        nargs=2,
        type=_count,
        metavar=("W", "H"),
        help="image size for a views file that does not state one",
    )
    _add_machine_options(parser)
    parser.set_defaults(run=render)


def render(args) -> None:
    """Renders every view, saves it, and prints what each one cost."""
    tqdm = io.optional_import("tqdm").tqdm
    io.optional_import("PIL.Image")  # now rather than after the first render
    _use_machine(args)
    views = io.load_views(args.views, args.size)
    out = _writable_folder(args.out)
    scene = io.load_scene(args.scene).to(args.device)
    options = {} if args.samples is None else {"samples": args.samples}
    rows = []
    with tqdm(views, desc="render", unit="view", disable=None) as progress:
        for view in progress:
            settings = view.settings(
                args.scale,
                args.background,
                scene.sh_degree,
                args.footprint,
                device=args.device,
                **options,
            )
            stages = render_stages(settings, **scene.arguments())
            io.to_image(stages.color).save(out / f"{view.name}.png")
            seconds = [stages.seconds[stage] for stage in STAGES]
            counts = [len(scene.means), len(stages.ids), len(stages.pairs)]
            size = f"{settings.image_width}x{settings.image_height}"
            rows.append([view.name, size, *counts, *seconds, sum(seconds)])
    mean = [sum(column) / len(rows) for column in list(zip(*rows))[2:]]
    rows.append(["mean", "", *(round(value) for value in mean[:3]), *mean[3:]])
    header = ["view", "size", "Gaussians", "visible", "pairs"]
    print(format_table([*header, *(f"{stage} [s]" for stage in STAGES), "total [s]"], rows))


def add_demo(subcommands) -> None:
    parser = subcommands.add_parser(
        "demo",
        help="render a built-in resolution target with every footprint and measure the errors",
        description="Render a resolution target made of Gaussians with every footprint at four "
        "resolutions, compare with a supersampled reference, and write DIR/contact_sheet.png, "
        "the pictures, results.json, and the target itself as target.ply with views.json.",
    )
    parser.add_argument("--out", required=True, metavar="DIR", help="folder for the results")
    parser.add_argument(
        "--size",
        nargs=2,
        type=_count,
        default=demo.CANVAS,
        metavar=("W", "H"),
        help="of the full picture, multiples of 8 (default: {} {})".format(*demo.CANVAS),
    )
    _add_machine_options(parser)
    parser.set_defaults(run=run_demo)


def run_demo(args) -> None:
    """Runs the demo and prints its table of errors and times."""
    _use_machine(args)
    out = _writable_folder(args.out)
    results = demo.run(out, tuple(args.size), args.device)
    rows = [
        [
            f"1/{picture['reduction']}",
            picture["footprint"],
            f"{picture['psnr']:.2f}",
            picture["rmse"],
            picture["max"],
            picture["seconds"],
        ]
        for picture in results["pictures"]
    ]
    print(format_table(["scale", "footprint", "PSNR [dB]", "RMSE", "max", "time [s]"], rows))
    reference = results["reference"]
    print(
        "reference: {footprint}, {samples} samples per pixel at full size; RMSE against a quarter "
        "of the samples: {residual}".format(
            footprint=reference["footprint"],
            samples=reference["samples_per_pixel"]["1"],
            residual=", ".join(f"{v:.1e} (1/{k})" for k, v in reference["residual_rmse"].items()),
        )
    )
    print(f"see {out / 'contact_sheet.png'}")


COMMANDS = (add_render, add_demo)


# ------------------------------------------------------------------ shared by commands


def format_table(header: list[str], rows: list[list]) -> str:
    """Columns of text: the first left-aligned, the others right-aligned; floats to 4 digits."""
    cells = [header] + [[f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in row] for row in rows]
    widths = [max(len(row[i]) for row in cells) for i in range(len(header))]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if i else cell.ljust(width) for i, (cell, width) in enumerate(zip(row, widths))
        ).rstrip()
        for row in cells
    )


def _add_machine_options(parser) -> None:
    parser.add_argument("--threads", type=_count, metavar="N", help="CPU threads (default: all)")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")


def _use_machine(args) -> None:
    if args.threads is not None:
        torch.set_num_threads(args.threads)
    if args.device == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: no CUDA device that this torch can use")


def _writable_folder(path: str) -> Path:
    """The folder, made if it is missing; OSError before any work is done when it cannot be used."""
    folder = Path(path)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):
        return folder


def _number(kind, accepts, expected: str):
    """An argparse type: a number of this kind that `accepts` says is good."""

    def parse(text: str):
        try:
            value = kind(text)
        except ValueError:
            value = None
        if value is None or not accepts(value):
            raise argparse.ArgumentTypeError(f"must be {expected}, got {text}")
        return value

    return parse


_positive = _number(float, lambda v: math.isfinite(v) and v > 0, "a positive number")
_intensity = _number(float, lambda v: 0 <= v <= 1, "a number from 0 to 1")
_count = _number(int, lambda v: v >= 1, "a positive whole number")


def _describe(error: BaseException) -> str:
    """The error in one line."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error).partition("\n")[0] or type(error).__name__
