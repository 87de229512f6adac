"""`inspect`: which effects and which footprint a scene calls for."""

from __future__ import annotations

import json
from pathlib import Path

from .. import io
from ..analysis.planner import inspect_scene
from .arguments import add_scale, add_scene, check_writable_file, count, tolerance, use_machine


def add_parser(subcommands) -> None:
    parser = subcommands.add_parser(
        "inspect",
        help="say which effects and which footprint a scene calls for, and what they cost",
        description="Render SCENE from the views of VIEWS with every effect that it may call for and with a few "
        "footprints, and recommend the cheapest that stays within the tolerance of everything switched on. Prints "
        "what each effect changes and costs, and what the views show.",
    )
    add_scene(parser)
    add_scale(parser)
    add = parser.add_argument
    rms = "root mean square over a view, in units of colour, 0 to 1 (default: 1/255)"
    add("--tolerance", type=tolerance, default=1 / 255, metavar="T", help=rms)
    add("--training-views", metavar="F", help="file of the views that the scene was trained from")
    views = "look at no more than N views, evenly spread over the file (default: %(default)s)"
    add("--max-views", type=count, default=8, metavar="N", help=views)
    add("--json", metavar="FILE", help="write the findings as JSON; - prints them instead of the text")
    picture = "plot what the views show, as .png, .svg or .pdf: sizes of splats, and samples per tile"
    add("--picture", metavar="FILE", help=picture)
    parser.set_defaults(run=run)


def run(args) -> None:
    """Inspects the scene and prints the report."""
    if args.picture:  # raises before anything is rendered
        io.optional_import("matplotlib.figure", "analysis")
        if Path(args.picture).suffix.lower() not in (".png", ".svg", ".pdf"):
            raise ValueError(f"--picture must end in .png, .svg or .pdf, got {args.picture}")
    use_machine(args)
    views = io.load_views(args.views, args.size)
    limit = min(len(views), args.max_views)
    views = [views[i * len(views) // limit] for i in range(limit)]
    training = None if args.training_views is None else io.load_views(args.training_views, args.size)
    for path in (args.json, args.picture):
        if path not in (None, "-"):
            check_writable_file(path)
    scene = io.load_scene(args.scene).to(args.device)
    found = inspect_scene(scene, views, args.tolerance, training, scale=args.scale, background=args.background)
    if args.picture:
        found.save_picture(args.picture)
    if args.json:
        text = json.dumps(found.to_json(), indent=1, allow_nan=False) + "\n"
        if args.json == "-":
            print(text, end="")
            return
        io.write_text(args.json, text)
    print(found.to_text())
