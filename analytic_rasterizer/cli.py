"""The command line: `python -m analytic_rasterizer COMMAND`.

A command is one function that adds its parser to the subcommands and sets `run`, a function of the
parsed arguments, as its default; COMMANDS lists them. A command reports what the user can mend by
raising: `main` turns that into one line on stderr and exit code 2.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from pathlib import Path

import torch

from . import __version__, accuracy, demo, errors, io, pareto
from .footprints import FOOTPRINTS
from .planner import inspect_scene
from .rasterizer import render_stages
from .report import format_table

STAGES = ("project", "bin", "blend")
PLOTS = (".png", ".svg", ".pdf")
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
    _add_view_options(parser)
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


def add_pareto(subcommands) -> None:
    parser = subcommands.add_parser(
        "pareto",
        help="measure accuracy against time of every footprint on a trained scene",
        description="Render SCENE with every footprint and with supersampling at several scales, compare with the "
        "converged integral of the image over every pixel, time them, and write DIR/pareto_SCALE.png and .svg, "
        "pareto.md and pareto.json. On the CPU times are ratios, of the fastest of interleaved rounds. Errors are of "
        "colours in 0 to 1, not clamped. ~ marks a PSNR that the reference does not resolve; F and B under front mark "
        "methods that no other beats, forward and with backward.",
    )
    parser.add_argument("scene", metavar="SCENE", help="3DGS .ply, compressed .ply or .spz")
    parser.add_argument("--views", required=True, help="file of views, as for render")
    parser.add_argument("--out", default="pareto", metavar="DIR", help="folder for the results (default: %(default)s)")
    parser.add_argument(
        "--scales",
        nargs="+",
        type=_count,
        default=[1, 2, 4, 8],
        metavar="N",
        help="1/N of the views' size; a remainder is cut off (default: 1 2 4 8)",
    )
    parser.add_argument(
        "--footprints",
        nargs="+",
        metavar="NAME[:k=v,..][@N]",
        help="methods; @N renders N x N times the pixels and averages (default: {})".format(
            " ".join(method.name for method in pareto.default_methods())
        ),
    )
    parser.add_argument("--limit-views", type=_count, metavar="N", help="only the first N views")
    parser.add_argument(
        "--crop",
        nargs=2,
        type=_count,
        metavar=("W", "H"),
        help="only the middle W x H pixels of the picture, at every scale (default: all of it)",
    )
    parser.add_argument("--rounds", type=_count, metavar="N", help="timed rounds (default: 5, with CUDA 20)")
    parser.add_argument(
        "--cpu-time",
        action="store_true",
        help="count CPU seconds instead of the wall clock's: on a shared machine, with --threads 1",
    )
    parser.add_argument(
        "--max-density",
        type=_density,
        metavar="N",
        help=f"samples of the reference along a pixel's side, at most (default: {accuracy.MAX_DENSITY})",
    )
    _add_view_options(parser)
    _add_machine_options(parser)
    parser.set_defaults(run=run_pareto)


def run_pareto(args) -> None:
    """Runs the measurement and prints a table for every scale."""
    _use_machine(args)
    methods = None if args.footprints is None else [pareto.parse_method(text) for text in args.footprints]
    views = io.load_views(args.views, args.size)[: args.limit_views]
    out = _writable_folder(args.out)
    scene = io.load_scene(args.scene).to(args.device)
    results = pareto.run(
        out,
        scene,
        views,
        args.scales,
        methods,
        crop=args.crop and tuple(args.crop),
        background=tuple(args.background),
        rounds=args.rounds,
        max_density=args.max_density,
        cpu_time=args.cpu_time,
        name=Path(args.scene).stem,
    )
    print(f"{results['gaussians']} Gaussians of SH degree {results['sh_degree']}, {results['machine']}")
    for at_scale in results["scales"]:
        title, *notes = pareto.describe(results, at_scale)
        print(f"\n{title}\n{format_table(*pareto.to_table(results, at_scale))}")
        print("\n".join(notes))
    print(f"\nsee {out / 'pareto.md'} and the plots beside it")


def add_errors(subcommands) -> None:
    parser = subcommands.add_parser(
        "errors",
        help="measure the error of every footprint's weight and gradients",
        description="The paper's error analysis: the logistic window against erf, the turned pixel against Monte Carlo "
        "and the exact integral, and both errors of every footprint from 0.02 to 20 px. Writes plots (.png, .svg), "
        ".csv files and summary.md to DIR, and prints the summary.",
    )
    parser.add_argument("--out", required=True, metavar="DIR", help="folder for the results")
    parser.add_argument(
        "--samples",
        type=_count,
        default=errors.SAMPLES,
        metavar="N",
        help="splats of each standard deviation (default: %(default)s)",
    )
    parser.add_argument(
        "--monte-carlo",
        type=_count,
        default=errors.MONTE_CARLO,
        metavar="N",
        help="samples in a pixel (default: %(default)s, as in the paper)",
    )
    parser.add_argument("--threads", type=_count, metavar="N", help="CPU threads (default: all)")
    parser.set_defaults(run=run_errors, device="cpu")


def run_errors(args) -> None:
    """Runs the analysis and prints its summary."""
    _use_machine(args)
    out = _writable_folder(args.out)
    print(errors.run(out, args.samples, args.monte_carlo)["summary"])
    print(f"see the plots and tables in {out}")


def add_inspect(subcommands) -> None:
    parser = subcommands.add_parser(
        "inspect",
        help="say which effects and which footprint a scene calls for, and what they cost",
        description="Render SCENE from the views of VIEWS with every effect that it may call for and with a few "
        "footprints, and recommend the cheapest that stays within the tolerance of everything switched on. Prints "
        "what each effect changes and costs, and what the views show.",
    )
    parser.add_argument("scene", metavar="SCENE", help="3DGS .ply, compressed .ply or .spz")
    parser.add_argument("--views", required=True, help="file of views, as for render")
    parser.add_argument(
        "--tolerance",
        type=_tolerance,
        default=1 / 255,
        metavar="T",
        help="root mean square over a view, in units of colour, 0 to 1 (default: 1/255)",
    )
    parser.add_argument("--training-views", metavar="F", help="file of the views that the scene was trained from")
    parser.add_argument("--scale", type=_positive, default=1.0, help="resolution, as a factor (default: 1)")
    parser.add_argument(
        "--max-views",
        type=_count,
        default=8,
        metavar="N",
        help="look at no more than N views, evenly spread over the file (default: %(default)s)",
    )
    parser.add_argument("--json", metavar="FILE", help="write the findings as JSON; - prints them instead of the text")
    parser.add_argument(
        "--picture",
        metavar="FILE",
        help="plot what the views show, as .png, .svg or .pdf: sizes of splats, and samples per tile",
    )
    _add_view_options(parser)
    _add_machine_options(parser)
    parser.set_defaults(run=run_inspect)


def run_inspect(args) -> None:
    """Inspects the scene and prints the report."""
    if args.picture:  # now rather than after everything is rendered
        io.optional_import("matplotlib.figure", "analysis")
        if Path(args.picture).suffix not in PLOTS:
            raise ValueError(f"--picture must end in {', '.join(PLOTS[:-1])} or {PLOTS[-1]}, got {args.picture}")
    _use_machine(args)
    views = io.load_views(args.views, args.size)
    count = min(len(views), args.max_views)
    views = [views[i * len(views) // count] for i in range(count)]
    training = None if args.training_views is None else io.load_views(args.training_views, args.size)
    for path in (args.json, args.picture):
        if path not in (None, "-"):
            _writable_folder(Path(path).parent)
    scene = io.load_scene(args.scene).to(args.device)
    found = inspect_scene(scene, views, args.tolerance, training, scale=args.scale, background=tuple(args.background))
    if args.picture:
        found.save_picture(args.picture)
    if args.json:
        text = json.dumps(found.to_json(), indent=1, allow_nan=False) + "\n"
        if args.json == "-":
            print(text, end="")
            return
        Path(args.json).write_text(text, encoding="utf-8")
    print(found.to_text())


COMMANDS = (add_render, add_demo, add_errors, add_pareto, add_inspect)


# ------------------------------------------------------------------ shared by commands


def _add_view_options(parser) -> None:
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
_tolerance = _number(float, lambda v: math.isfinite(v) and v >= 0, "a number that is not negative")
_density = _number(int, lambda v: v >= 8, "a whole number from 8")
_count = _number(int, lambda v: v >= 1, "a positive whole number")


def _describe(error: BaseException) -> str:
    """The error in one line."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error).partition("\n")[0] or type(error).__name__
