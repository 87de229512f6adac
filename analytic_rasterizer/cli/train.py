"""`train`: a scene from photographs."""

from __future__ import annotations

import argparse
import re
import sys
import time
from contextlib import nullcontext
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

from .. import io
from ..captures.loading import CHOICES
from ..captures.source import READING
from ..declared import declared
from ..distributed.ranks import Ranks
from ..footprints import DILATED, resolve_footprint
from ..reconstruction.capture import is_finished, reconstruct
from ..reconstruction.folder import check_photographs, find_photographs
from ..training import CaptureSource, PictureMemory, Run, TrainingOptions
from ..training.evaluation import COLOR_CORRECTED, about_correction, measured_in_words
from ..training.files import CHECKPOINT, SCENE, read_checkpoint
from ..training.options import DECLARATIONS, PRESETS, flag, of_other_control, preset_values, text_of
from ..training.reports import process_age
from .arguments import (
    METAVARS,
    add_machine_options,
    add_reading,
    port,
    use_expandable_segments,
    use_machine,
    whole_numbers,
)
from .launch import add_rank_options, is_launched, ranks_of

CAPTURE = "capture"  # in DIR, of photographs without cameras
TIMES_TEXT = "T is a time: a number of steps, or up to 1 a share of the training. See docs/training.md"


def add_parser(subcommands) -> None:
    parser = subcommands.add_parser(
        "train",
        help="train a scene from photographs",
        description="Train Gaussians on the pictures of SCENE, a folder of a NeRF-synthetic scene, of the multi-scale "
        "Blender set, of a COLMAP reconstruction or of a nerfstudio capture. Cameras of photographs that have none, or "
        "of a film, are found with COLMAP, in DIR/capture. Writes scene.ply, cameras.json, "
        "metrics.json, log.jsonl, options.json and checkpoint.pt to DIR. Ctrl-C or SIGTERM saves and ends; --resume "
        "goes on. Under torchrun, several processes train one scene together.",
    )
    add = parser.add_argument
    add("scene", metavar="SCENE", help="folder of pictures with cameras, or without; or a film")
    add("--out", required=True, metavar="DIR", help="folder for the results")
    add_reading(parser, "SCENE")  # what is not given is None, for --resume
    add("--points", metavar="FILE", help="start from this: a scene of any format, or a .ply of points with colours")
    preset = "options that belong together: quick, 7,000 steps; 3dgs, the recipe of 3DGS; what is given wins"
    add("--preset", choices=tuple(PRESETS), help=preset)
    add("--resume", action="store_true", help="go on from the checkpoint in DIR, with its options")
    board = "write the numbers of log.jsonl for TensorBoard too, to DIR/tensorboard; needs the extra 'tensorboard'"
    add("--tensorboard", action="store_true", help=board)
    add("--save-every", type=int, default=5000, metavar="N", help="steps between checkpoints (default: 5000; 0: none)")
    add("--no-evaluate", action="store_true", help="leave out the test at the end")
    export = "write point_cloud_mip.ply too, for viewers that do not integrate over pixels"
    add("--export", choices=("mip",), help=export)
    add(
        "--watch", action="store_true", help="show the scene in the browser while it is trained; needs the extra 'view'"
    )
    add("--port", type=port, metavar="N", help="of --watch: port to serve on (default: any free one)")
    add_machine_options(parser, device=None)
    gpu = "GiB of the GPU for pictures, those of the next steps included; the bits are the same (default: 1/4 of what "
    gpu += "is free, 1/16 with several processes)"
    add("--picture-memory-gpu", type=float, metavar="GIB", help=gpu)
    host = "GiB of memory for other pictures; the rest is decoded again and again (default: 1/2 of what is free)"
    add("--picture-memory-host", type=float, metavar="GIB", help=host)
    add_rank_options(parser)
    add_training_options(parser)
    parser.set_defaults(run=run)


def add_training_options(parser) -> None:
    """The options of `TrainingOptions`, as they are declared."""
    rest = parser.add_argument_group("fine tuning", TIMES_TEXT)
    for field in fields(TrainingOptions):
        said = declared(DECLARATIONS[field.name][1])
        default = shown_default(field.default)
        text = as_help(text_of(field.name)) + (f" (default: {default})" if default else "")
        kind = type(field.default)
        # What is not given is absent, so that a checkpoint's options are only compared with what is.
        how = {"default": argparse.SUPPRESS, "help": text}
        if kind is bool:
            how |= {"action": "store_true"}
        else:
            how |= {"type": whole_numbers if kind is tuple else kind, "metavar": said.metavar or METAVARS[kind]}
        (parser if said.main else rest).add_argument(flag(field.name), **how)


def as_help(text: str) -> str:
    """The text of an option as `--help` shows it, with other options as the command line spells them."""
    text = re.sub("`([^`]+)`", lambda match: flag(match[1]) if match[1] in DECLARATIONS else match[1], text)
    return text[:1].lower() + text[1:].rstrip(".").replace("%", "%%")


def shown_default(value) -> str:
    """A default as `--help` shows it, which is not at all where there is nothing to show."""
    if isinstance(value, tuple):
        return ",".join(map(str, value))
    if isinstance(value, bool):
        return ""
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def run(args) -> None:
    """Trains, writes the results, and prints what the test views say. Raises KeyboardInterrupt if interrupted."""
    use_expandable_segments()
    use_machine(args)
    with ranks_of(args) as ranks:
        complete = run_on(ranks, args)
    if not complete:  # all ranks have agreed on that, and ended their group like any other
        raise KeyboardInterrupt


def run_on(ranks: Ranks, args) -> bool:
    """`run`, on every rank. Returns whether the training came to its end."""
    if args.port is not None and not args.watch:
        raise ValueError("--port is for --watch")
    if args.watch and is_launched():
        raise ValueError("--watch is for one process, got torchrun")
    if args.watch:
        io.optional_import("viser", "view")  # raises before the pictures are read
    asked = _asked_for(args)
    age = process_age()  # most of it is the import of torch
    began = time.perf_counter()
    reading = {name: getattr(args, name) for name in READING}
    scene = capture_of(args, ranks)
    if scene != args.scene:
        reading["images"] = None  # which said where the photographs are
    seconds = time.perf_counter() - began
    training = Run(
        CaptureSource(scene, **reading, points=args.points),
        args.out,
        asked.options,
        device=args.device,
        save_every=args.save_every,
        resume=args.resume,
        **asked.length,
        memory=PictureMemory(args.picture_memory_gpu, args.picture_memory_host),
        tensorboard=args.tensorboard,
        chosen=asked.chosen,
        ranks=ranks,
    )
    if age is not None:
        training.phases = {"start": age, **({"cameras": seconds} if scene != args.scene else {}), **training.phases}
    for note in training.notes if ranks.is_first else ():
        print(note, file=sys.stderr)
    limit, found = training.options.gaussian_limit, training.points_found
    if found is not None and found > limit and ranks.is_first:
        print(f"starts from {limit:,} of {found:,} points, drawn at random (--max-gaussians)", file=sys.stderr)
    with training.start_viewer(args.port or 0) if args.watch else nullcontext() as viewer:
        if viewer is not None:
            print(f"watch at {viewer.url}", flush=True)
        complete = training.train(viewer)
        finish(training, complete, args)
    return complete


class Asked(NamedTuple):
    """What the command line says of the training."""

    options: TrainingOptions
    length: dict[str, Any]  # of a training that is resumed: another length
    chosen: list[str]  # names of the arguments that were given


def _asked_for(args) -> Asked:
    """What is asked for. Raises ValueError for what does not go together, or with the checkpoint to go on from."""
    given = {field.name: getattr(args, field.name) for field in fields(TrainingOptions) if hasattr(args, field.name)}
    if given.get("seconds") and "iterations" in given:
        raise ValueError("--seconds is instead of --iterations: leave out one of them")
    checkpoint = Path(args.out) / CHECKPOINT
    chosen = [*given, *(name for name in ("images", "test_every") if getattr(args, name) is not None)]
    # Mapped: of a large file little is needed here.
    stored = TrainingOptions.from_dict(read_checkpoint(checkpoint, mapped=True)["options"]) if args.resume else None
    length = {name: given[name] for name in ("iterations", "seconds") if stored is not None and name in given}
    if args.preset is not None:
        # Without --scales, a preset is for those of the checkpoint.
        given.setdefault("scales", (stored or TrainingOptions).scales)
        given = preset_values(args.preset, given["scales"]) | given
    usual = {} if stored is None else {"density": stored.density}  # by which it is known what an option means
    options = TrainingOptions(**(usual | given))
    if stored is not None:
        asked = {name: getattr(options, name) for name in given}
        asked |= {name: given[name] for name in chosen if of_other_control(name, options.density)}
        differing = [name for name in asked if name not in length and asked[name] != getattr(stored, name)]
        if differing:
            named = ", ".join(map(flag, differing))
            raise ValueError(f"{named}: a resumed training keeps the options of its checkpoint")
    elif checkpoint.exists():
        raise ValueError(f"{checkpoint} exists: go on with --resume, or choose another --out")
    if args.export and resolve_footprint((stored or options).footprint).name == DILATED:
        raise ValueError("--export mip is for footprints that integrate over pixels, got point")
    if args.points and not Path(args.points).exists():  # known before the pictures are read
        raise ValueError(f"--points {args.points}: no such file")
    return Asked(options, length, chosen)


def capture_of(args, ranks: Ranks) -> str | Path:
    """The folder of SCENE's cameras: SCENE itself, or what is made of photographs that have none."""
    of_scene = args.cameras is not None and (Path(args.scene) / args.cameras).exists()
    photographs = None if of_scene else find_photographs(args.scene, args.images)
    if photographs is None:
        return args.scene
    check_photographs(photographs, Path(args.out))
    folder = Path(args.out) / CAPTURE
    if ranks.world > 1 and not is_finished(args.scene, folder, args.images):
        raise ValueError(f"{args.scene}: one process finds the cameras, got {ranks.world}: train without torchrun once")
    choices = {name: getattr(args, name) or CHOICES[name][0] for name in ("masks", "missing")}
    folder, notes = reconstruct(args.scene, folder, args.images, **choices)
    for note in notes if ranks.is_first else ():
        print(note, file=sys.stderr, flush=True)
    return folder


def finish(training: Run, complete: bool, args) -> None:
    """Says what was written, and tests it if the training came to its end."""
    say = print if training.ranks.is_first else lambda line: None
    if not complete:
        say(f"stopped after {training.progress.step} steps and saved; go on with --resume")
        return
    say(f"{Path(args.out) / SCENE}: {training.count()} Gaussians")
    if training.trainer.dropped:
        say(f"{training.trainer.dropped:,} Gaussians were taken away because their numbers had left float32")
    counting = training.trainer.counting
    if counting is not None and counting.pruned:
        say(f"{counting.pruned:,} Gaussians were taken away because masks leave out all that they show")
    if args.export:
        say(f"{training.export_mip()}: for viewers that do not integrate over pixels")
    if not args.no_evaluate:
        metrics = training.evaluate()
        say(f"{metrics['steps']} steps in {metrics['seconds']:.1f} s, {metrics['ms_per_step']:.2f} ms each")
        tested, options = metrics.get("test", {}), training.options
        vary, vignetted = options.exposure != "none", options.vignetting != "none"
        for scale, values in tested.items():
            say(test_line(scale, values, vary or vignetted))
        if tested:
            say(about_correction(vary, vignetted))
    if training.ranks.is_first:
        print(", ".join(f"{name} {seconds:.1f} s" for name, seconds in training.phases.items()), file=sys.stderr)


def test_line(scale: str, values: dict, vary: bool) -> str:
    """What the test pictures of a scale say, or all scales ("mean"). The corrected number is first where
    photographs `vary`."""
    name = "mean over scales" if scale == "mean" else f"1/{scale}, {measured_in_words(values)}"
    corrected = f"after the best affine colour of each picture: PSNR {values[COLOR_CORRECTED]:.2f} dB"
    plain = f"PSNR {values['psnr']:.2f} dB, SSIM {values['ssim']:.4f}"
    return f"test, {name}: " + (f"{corrected}; as rendered: {plain}" if vary else f"{plain}; {corrected}")
