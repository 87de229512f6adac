"""`bake`: a scene that was trained with the dilation of 3DGS, for footprints that integrate over the pixel."""

from __future__ import annotations

from pathlib import Path

from .. import io
from ..filters import DILATION, bake_dilation
from ..training.files import write_scene
from .arguments import add_machine_options, check_writable_file, count, positive_number, use_machine


def add_parser(subcommands) -> None:
    parser = subcommands.add_parser(
        "bake",
        help="make a scene that was trained with 3DGS ready for footprints that integrate over the pixel",
        description="Widen the Gaussians of SCENE, which was trained with 3DGS or with the footprint point, by the "
        "dilation that these add to every picture, and write the result to FILE. Footprints that integrate over the "
        "pixel, such as moment, then show what the training showed, at any distance and resolution.",
    )
    add = parser.add_argument
    add("scene", metavar="SCENE", help="3DGS .ply, compressed .ply or .spz")
    views = "file of the views that the scene was trained from: 3DGS cameras.json, or Blender or nerfstudio "
    add("--views", required=True, help=f"{views}transforms.json, or a list of {{width, height, fx, fy, w2c}}")
    add("--out", required=True, metavar="FILE", help="the scene to write, a .ply")
    size = "image size for a views file that does not state one"
    add("--size", nargs=2, type=count, metavar=("W", "H"), help=size)
    add(
        "--dilation",
        type=positive_number,
        default=DILATION,
        metavar="V",
        help="of the training, px^2 (default: %(default)s)",
    )
    add_machine_options(parser)
    parser.set_defaults(run=run)


def run(args) -> None:
    """Bakes the dilation, writes the scene, and says what changed."""
    out = Path(args.out)
    if out.suffix != ".ply" or out.stem.endswith(".compressed"):
        raise ValueError(f"--out must be the name of a .ply, not a compressed one, got {args.out}")
    use_machine(args)
    views = io.load_views(args.views, args.size)
    check_writable_file(args.out)
    scene = io.load_scene(args.scene).to(args.device)
    cameras = [view.settings(device=args.device) for view in views]
    scales, opacities = bake_dilation(
        scene.means, scene.scales, scene.rotations, scene.opacities, cameras, args.dilation
    )
    widened = int((scales > scene.scales).any(1).sum())
    write_scene(out, scene._replace(scales=scales, opacities=opacities), "moment")
    print(f"{args.out}: {widened} of {len(scales)} Gaussians widened, for {len(cameras)} views")
