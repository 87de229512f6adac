"""`inspect`: which effects and which footprint a scene calls for."""

from __future__ import annotations

import json
import shlex
from dataclasses import asdict
from pathlib import Path

from .. import io
from ..analysis.baking import bake_gain
from ..analysis.memory import check_sizes
from ..analysis.planner import inspect_scene
from .arguments import (
    LARGER,
    add_footprint,
    add_scales,
    add_scene,
    check_writable_file,
    count,
    reduction,
    tolerance,
    use_machine,
)
from .scenes import say, settle_views


def add_parser(subcommands) -> None:
    parser = subcommands.add_parser(
        "inspect",
        help="say which effects and which footprint a scene calls for, and what they cost",
        description="Render SCENE from the views of VIEWS with every effect that it may call for and with a few "
        "footprints, and name the cheapest that stay within the tolerance of everything switched on. Prints what each "
        "effect changes and costs, and what the views show. A scene that was trained with 3DGS, or with the "
        "footprint point, is baked in memory first, and what that gains is printed.",
    )
    add_scene(parser)
    add_footprint(parser, "what SCENE was trained with", "(default: what it says, else point)")
    add_scales(parser, reduction, "of the views: 2 is half the size (default: 1)", 1.0)
    add = parser.add_argument
    rms = "root mean square over a view, in units of colour, 0 to 1 (default: 1/255)"
    add("--tolerance", type=tolerance, default=1 / 255, metavar="T", help=rms)
    add("--training-views", metavar="FILE", help="views that the scene was trained from, for the 3D filter")
    views = "look at no more than N views, evenly spread over the file (default: %(default)s)"
    add("--max-views", type=count, default=8, metavar="N", help=views)
    add("--json", metavar="FILE", help="write the findings as JSON; - prints them instead of the text")
    picture = "plot what the views show, as .png, .svg or .pdf: sizes of splats"
    add("--picture", metavar="FILE", help=picture)
    parser.set_defaults(run=run)


def run(args) -> None:
    """Inspects the scene and prints the report."""
    if args.picture:  # raises before anything is rendered
        io.optional_import("matplotlib.figure", "analysis")
        if Path(args.picture).suffix.lower() not in (".png", ".svg", ".pdf"):
            raise ValueError(f"--picture must end in .png, .svg or .pdf, got {args.picture}")
    use_machine(args)
    found = io.find_scene(args.scene)
    trained = found.training_footprint(args.footprint)
    training = None if args.training_views is None else found.load_views(args.training_views, args.size)
    all_views, said = settle_views(args, found)
    limit = min(len(all_views), args.max_views)
    views = [all_views[i * len(all_views) // limit] for i in range(limit)]
    check_sizes((view.scaled(1 / args.scales) for view in views), args.device, LARGER)
    for path in (args.json, args.picture):
        if path not in (None, "-"):
            check_writable_file(path)
    scene = io.load_scene(found.path).to(args.device)
    say(*said, f"trained with {trained.footprint}: {trained.reason}")
    gain = None
    if io.is_dilated(trained.footprint):
        known = training or (found.load_views(size=args.size) if found.cameras is not None else all_views)
        scene, gain = bake_gain(scene, views, known, trained.footprint, args.background)
    report = inspect_scene(scene, views, args.tolerance, training, scale=1 / args.scales, background=args.background)
    if args.picture:
        report.save_picture(args.picture)
    if args.json:
        data = {"trained_with": str(trained.footprint), **report.to_json(), "bake": gain and asdict(gain)}
        text = json.dumps(data, indent=1, allow_nan=False) + "\n"
        if args.json == "-":
            print(text, end="")
            return
        io.write_text(args.json, text)
    if gain is not None:
        print(f"{gain.to_text()}\n\nwhat follows is for the baked scene: bake {shlex.quote(args.scene)} --out FILE\n")
    print(report.to_text())
