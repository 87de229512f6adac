"""`bake`: a scene that was trained with the dilation of 3DGS, for footprints that integrate over the pixel."""

from __future__ import annotations

import shlex

import torch

from .. import io
from ..filters import bake_dilation, sampling_interval
from ..footprints import DILATED, RECOMMENDED
from ..io.scenes import WRITTEN_IN_WORDS
from .arguments import (
    add_files,
    add_footprint,
    add_machine_options,
    add_scales,
    add_size,
    check_writable_file,
    dilation,
    reduction,
    use_machine,
)
from .scenes import say, sizes_in_words


def add_parser(subcommands) -> None:
    parser = subcommands.add_parser(
        "bake",
        help="make a scene that was trained with 3DGS ready for footprints that integrate over the pixel",
        description="Widen the Gaussians of SCENE, which was trained with 3DGS or with the footprint point, by the "
        "dilation that these add to every picture, and write the result to FILE. Footprints that integrate over the "
        "pixel, such as moment, then show at any distance and resolution what the training showed. VIEWS are those of "
        "the training, and must have the size of its pictures. The cameras.json of 3DGS has that of the original ones: "
        "cfg_args beside it says by what they were reduced, or else --scales does.",
    )
    add_files(parser)
    add_size(parser)
    reduced = "the training's pictures had 1/N of the size in VIEWS (default: what cfg_args or options.json says, or 1)"
    add_scales(parser, reduction, reduced)
    add = parser.add_argument
    add("--out", required=True, metavar="FILE", help=f"the scene to write: {WRITTEN_IN_WORDS}")
    add_footprint(parser, "what SCENE was trained with", "(default: what it says, else point)")
    of_training = "of the training, px^2 (default: that of the footprint, 0.3)"
    add("--dilation", type=dilation, metavar="V", help=of_training)
    add_machine_options(parser)
    parser.set_defaults(run=run)


def run(args) -> None:
    """Bakes the dilation, writes the scene, and says what changed."""
    io.written_format(args.out)  # raises
    use_machine(args)
    found = io.find_scene(args.scene)
    trained = found.training_footprint(args.footprint)
    check_is_dilated(found, trained, args.out)
    given = args.scales is not None
    views = found.load_views(args.views, args.size, trained_size=not given)
    views = [view.scaled(1 / args.scales) for view in views] if given else views
    loaded = io.load_scene(found.path)
    check_writable_file(args.out, found.path)
    scene = loaded.to(args.device)
    cameras = [view.settings(device=args.device) for view in views]
    seen = torch.zeros(scene.count, dtype=torch.bool, device=args.device)
    for camera in cameras:
        seen |= sampling_interval(scene.means, camera).isfinite()
    if not seen.any():
        raise ValueError(f"{args.views or found.cameras}: no view sees any Gaussian of {found.path}")
    say(f"trained with {trained.footprint}: {trained.reason}")
    gaussians = scene.means, scene.scales, scene.rotations, scene.opacities
    scales, opacities = bake_dilation(*gaussians, cameras, args.dilation or trained.footprint.option)
    metadata = io.SceneMetadata(footprint=RECOMMENDED, offset=found.metadata.offset, order=found.metadata.order)
    io.save_scene(args.out, scene.with_activated(scales, opacities), metadata)
    reason = f" ({found.size_reason})" if not given and found.size_reason else ""
    pictures = f"{len(views)} pictures of {sizes_in_words(views)}{reason}"
    print(f"{args.out}: {int(seen.sum())} of {scene.count} Gaussians, which are seen in {pictures}, are baked")


def check_is_dilated(found: io.FoundScene, trained: io.Choice, out: str) -> None:
    """Raises SceneError for a scene whose training added no dilation; it says how to write `out` all the same."""
    footprint = trained.footprint
    instead = f"to write it as it is: convert {shlex.quote(str(found.path))} {shlex.quote(out)}"
    if footprint.name != DILATED:
        raise io.SceneError(
            f"{found.path}: no dilation to bake: it says that pixels are to be integrated (footprint {footprint}: "
            f"{trained.reason}); {instead}; --footprint point is for a scene that was trained with 3DGS all the same"
        )
    if not io.is_dilated(footprint):
        raise io.SceneError(
            f"{found.path}: no dilation to bake: it was trained with {footprint}, without any; {instead}"
        )
