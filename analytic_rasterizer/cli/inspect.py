"""`inspect`: which effects and which footprint a scene calls for, and what a capture calls for before training."""

from __future__ import annotations

import argparse
import json
import shlex
from dataclasses import asdict
from pathlib import Path

import torch

from .. import io
from ..analysis.baking import bake_gain
from ..analysis.memory import check_sizes
from ..analysis.planner import inspect_scene, steps_of
from ..analysis.plots import check_plot, save_plots
from ..captures.evidence import MOST_PHOTOGRAPHS
from ..captures.loading import IMAGES, is_capture
from ..io.appearance import holds_scene
from ..reconstruction.folder import Photographs, find_photographs, is_film
from ..reconstruction.forecast import forecast
from ..reconstruction.process import is_installed, missing_library
from ..training.plan import plan_capture
from ..training.report import plots_of_capture
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

MOST_VIEWS = 8
TOLERANCE = 1 / 255
# Options that captures do not have, and their defaults.
OF_SCENES = dict.fromkeys(("views", "footprint", "training_views", "size", "background"))
OF_SCENES |= {"scales": 1.0, "tolerance": TOLERANCE}


def add_parser(subcommands) -> None:
    parser = subcommands.add_parser(
        "inspect",
        help="say which effects and which footprint a scene calls for, and what they cost; or what a capture calls for",
        description="Render SCENE from the views of VIEWS with every effect that it may call for and with a few "
        "footprints, and name the cheapest that stay within the tolerance of everything switched on. Prints what each "
        "effect changes and costs, and what the views show. A scene that was trained with 3DGS, or with the "
        "footprint point, is baked in memory first, and what that gains is printed. Of a folder of photographs with "
        "cameras it says, before any training, what lenses, exposures, blur, masks and the like they have, and which "
        "options of train act on them. Of photographs without cameras, or a film, it says what train would do to find "
        "them.",
    )
    add_scene(parser)
    add_footprint(parser, "what SCENE was trained with", "(default: what it says, else point)")
    add_scales(parser, reduction, "of the views: 2 is half the size (default: 1)", 1.0)
    add = parser.add_argument
    rms = "root mean square over a view, in units of colour, 0 to 1 (default: 1/255)"
    add("--tolerance", type=tolerance, default=TOLERANCE, metavar="T", help=rms)
    add("--training-views", metavar="FILE", help="views that the scene was trained from, for the 3D filter")
    views = "look at no more than N views, evenly spread over the file "
    views += f"(default: {MOST_VIEWS}, of a capture {MOST_PHOTOGRAPHS})"
    add("--max-views", type=count, metavar="N", help=views)
    add("--images", metavar="NAME", help=f"of a capture: folder of the photographs (default: {IMAGES})")
    add("--cameras", metavar="NAME", help="of a capture: file or folder to read the cameras from (default: found)")
    add("--json", metavar="FILE", help="write the findings as JSON; - prints them instead of the text")
    plot = "draw what the views show, as .png, .svg or .pdf: sizes of splats; of a capture exposures, sampling, masks"
    add("--plot", metavar="FILE", help=plot)
    add("--picture", dest="plot", metavar="FILE", help=argparse.SUPPRESS)  # its former name
    parser.set_defaults(run=run)


def run(args) -> None:
    """Inspects the scene, or the capture, and prints the report."""
    photographs = _photographs(args)
    if photographs is not None:
        _inspect_photographs(args, photographs)
        return
    if args.plot:  # raises before anything is looked at
        check_plot(args.plot)
        check_writable_file(args.plot)
    if _is_capture(args):
        _inspect_capture(args)
        return
    for name in ("images", "cameras"):
        if getattr(args, name) is not None:
            raise ValueError(f"--{name} is for captures, and {args.scene} is none")
    io.optional_import("tqdm")
    use_machine(args)
    found = io.find_scene(args.scene)
    trained = found.training_footprint(args.footprint)
    training = None if args.training_views is None else found.load_views(args.training_views, args.size)
    all_views, said = settle_views(args, found)
    limit = min(len(all_views), args.max_views or MOST_VIEWS)
    views = [all_views[i * len(all_views) // limit] for i in range(limit)]
    check_sizes((view.scaled(1 / args.scales) for view in views), args.device, LARGER)
    if args.json not in (None, "-"):
        check_writable_file(args.json)
    scene = io.load_scene(found.path).to(args.device)
    say(*said, f"trained with {trained.footprint}: {trained.reason}")
    gain, is_dilated = None, io.is_dilated(trained.footprint)
    with io.optional_import("tqdm").tqdm(total=steps_of(views) + is_dilated * len(views), disable=None) as bar:

        def progress(what):
            bar.set_description(what, refresh=False)
            bar.update()

        if is_dilated:
            known = training or (found.load_views(size=args.size) if found.cameras is not None else all_views)
            scene, gain = bake_gain(scene, views, known, trained.footprint, args.background, progress)
        options = {"scale": 1 / args.scales, "background": args.background, "progress": progress}
        report = inspect_scene(scene, views, args.tolerance, training, **options)
    if args.plot:
        report.save_picture(args.plot)
    if args.json:
        data = {"trained_with": str(trained.footprint), **report.to_json(), "bake": gain and asdict(gain)}
        if _write_json(args.json, data):
            return
    if gain is not None:
        print(f"{gain.to_text()}\n\nwhat follows is for the baked scene: bake {shlex.quote(args.scene)} --out FILE\n")
    print(report.to_text())


def _photographs(args) -> Photographs | None:
    """SCENE, where it is photographs without cameras, or a film."""
    path = Path(args.scene)
    if args.cameras is not None or not (is_film(path) or path.is_dir()) or (path.is_dir() and holds_scene(path)):
        return None
    return find_photographs(path, args.images)


def _inspect_photographs(args, photographs: Photographs) -> None:
    """Says how train would find the cameras."""
    _check_no_options_of_scenes(args, "photographs without cameras")
    if args.plot:
        raise ValueError(f"--plot is for scenes and captures, and {args.scene} has no cameras")
    if args.threads is not None:
        torch.set_num_threads(args.threads)
    found = forecast(photographs, torch.get_num_threads())
    if _write_json(args.json, found.to_json()):
        return
    print("\n".join(found.lines))
    print("train SCENE --out DIR finds the cameras" if is_installed() else missing_library(photographs.source))


def _check_no_options_of_scenes(args, kind: str) -> None:
    given = [name for name, default in OF_SCENES.items() if getattr(args, name) != default]
    if given:
        raise ValueError(f"--{given[0].replace('_', '-')} is for scenes, and {args.scene} is {kind}")


def _write_json(path: str | None, content: dict) -> bool:
    """Writes the content where --json says, and returns whether this is stdout."""
    if path is None:
        return False
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"
    if path == "-":
        print(text, end="")
        return True
    io.write_text(path, text)
    return False


def _is_capture(args) -> bool:
    """Whether SCENE is a folder of photographs, and not one of a trained scene."""
    folder = Path(args.scene)
    if not folder.is_dir() or holds_scene(folder):
        return False
    return args.cameras is not None or args.images is not None or is_capture(folder)


def _inspect_capture(args) -> None:
    """Says what a capture calls for."""
    _check_no_options_of_scenes(args, "a capture")
    if args.threads is not None:
        torch.set_num_threads(args.threads)
    if args.json not in (None, "-"):
        check_writable_file(args.json)
    most = args.max_views or MOST_PHOTOGRAPHS
    plan = plan_capture(args.scene, args.images or IMAGES, cameras=args.cameras, most=most)
    say(*plan.notes)
    if args.plot:
        save_plots(args.plot, plots_of_capture(plan))
    if not _write_json(args.json, plan.to_json()):
        print(plan.to_text())
