"""`bake`: a scene that was trained with the dilation of 3DGS, for footprints that integrate over the pixel."""

from __future__ import annotations

import torch

from .. import io
from ..filters import DILATION, bake_dilation, sampling_interval
from ..training.files import write_scene
from .arguments import (
    add_files,
    add_machine_options,
    add_scale,
    add_size,
    check_writable_file,
    dilation,
    use_machine,
)


def add_parser(subcommands) -> None:
    parser = subcommands.add_parser(
        "bake",
        help="make a scene that was trained with 3DGS ready for footprints that integrate over the pixel",
        description="Widen the Gaussians of SCENE, which was trained with 3DGS or with the footprint point, by the "
        "dilation that these add to every picture, and write the result to FILE. Footprints that integrate over the "
        "pixel, such as moment, then show at any distance and resolution what the training showed. VIEWS are those of "
        "the training, and must have the size of its pictures. The cameras.json of 3DGS has that of the original ones: "
        "after a training with -r 4 or --images images_4, give --scale 0.25.",
    )
    add_files(parser)
    add_size(parser)
    add_scale(parser, "size of the training's pictures beside what VIEWS says")
    add = parser.add_argument
    add("--out", required=True, metavar="FILE", help="the scene to write: .ply, .compressed.ply, .spz or .splat")
    of_training = "of the training, px^2 (default: %(default)s)"
    add("--dilation", type=dilation, default=DILATION, metavar="V", help=of_training)
    add_machine_options(parser)
    parser.set_defaults(run=run)


def run(args) -> None:
    """Bakes the dilation, writes the scene, and says what changed."""
    io.written_format(args.out)  # raises
    use_machine(args)
    views = [view.scaled(args.scale) for view in io.load_views(args.views, args.size)]
    loaded = io.load_scene(args.scene)
    if io.read_metadata(args.scene).antialiased:
        raise io.SceneError(f"{args.scene}: no dilation to bake: it says that pixels are to be integrated")
    check_writable_file(args.out)
    scene = loaded.to(args.device)
    cameras = [view.settings(device=args.device) for view in views]
    seen = torch.zeros(len(scene.means), dtype=torch.bool, device=args.device)
    for camera in cameras:
        seen |= sampling_interval(scene.means, camera).isfinite()
    if not seen.any():
        raise ValueError(f"{args.views}: no view sees any Gaussian of {args.scene}")
    scales, opacities = bake_dilation(
        scene.means, scene.scales, scene.rotations, scene.opacities, cameras, args.dilation
    )
    write_scene(args.out, scene.with_activated(scales, opacities), "moment")
    sizes = sorted({(view.width, view.height) for view in views})
    pictures = f"{len(views)} pictures of " + " to ".join(f"{w}x{h}" for w, h in dict.fromkeys((sizes[0], sizes[-1])))
    print(f"{args.out}: {int(seen.sum())} of {len(scales)} Gaussians, which are seen in {pictures}, are baked")
