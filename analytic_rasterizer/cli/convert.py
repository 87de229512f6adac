"""`convert`: a scene in another format, turned, cut and thinned out."""

from __future__ import annotations

from dataclasses import replace

import torch

from .. import io
from ..gaussians import Gaussians
from ..io.axes import AXES, axes_of_format, axes_written
from ..io.metadata import axes_said
from ..io.scenes import WRITTEN_IN_WORDS
from ..render.effects import MAX_SH_DEGREE
from .arguments import add_scene_file, box, check_writable_file, fraction


def add_parser(subcommands) -> None:
    parser = subcommands.add_parser(
        "convert",
        help="write a scene in another format",
        description="Read SCENE and write it as OUT, whose suffix says the format. Footprint and background of SCENE "
        "go along where the format has room for them.",
    )
    add_scene_file(parser)
    add = parser.add_argument
    add("out", metavar="OUT", help=f"the file to write: {WRITTEN_IN_WORDS}")
    three = "three letters: r or l (right, left) for x, d or u (down, up) for y, f or b (forward, back) for z"
    usual = "luf for glTF, rub for OpenUSD"
    wanted = f"axes of OUT, {three} (default: {usual}, else rdf)"
    add("--axes", type=str.lower, choices=AXES, metavar="XYZ", help=wanted)
    said = f"axes of SCENE, as of --axes (default: those it says, else rub for .spz, {usual}, else rdf)"
    add("--scene-axes", type=str.lower, choices=AXES, metavar="XYZ", help=said)
    degrees = range(MAX_SH_DEGREE + 1)
    add("--sh-degree", type=int, choices=degrees, metavar="N", help="leave out harmonics of higher degrees")
    kept = "keep Gaussians whose centre is in the box, in coordinates with y down (axes rdf)"
    add("--crop", type=box, metavar="X0,Y0,Z0,X1,Y1,Z1", help=kept)
    add("--min-opacity", type=fraction, metavar="A", help="keep Gaussians of at least this opacity, 0 to 1")
    parser.set_defaults(run=run)


def run(args) -> None:
    """Writes the scene, and says what is in the file."""
    kind = io.written_format(args.out)  # raises
    found = io.find_scene(args.scene)
    if found.path.suffix.lower() == ".spz" and not (args.scene_axes or axes_said(found.path, "spz")):
        print(f"{found.path}: says no axes: read as {axes_of_format('spz')}; --scene-axes rdf if SuperSplat wrote it")
    scene = io.load_scene(found.path, axes=args.scene_axes)
    kept = scene.rows(chosen(scene, args.crop, args.min_opacity))
    if not kept.count:
        raise ValueError(f"{found.path}: none of {scene.count} Gaussians is left by --crop and --min-opacity")
    if args.sh_degree is not None and args.sh_degree < kept.sh_degree:
        kept = kept.with_sh_degree(args.sh_degree)
    metadata = metadata_of(found)
    check_writable_file(args.out, found.path)
    io.save_scene(args.out, kept, metadata, axes=args.axes)
    axes = args.axes or axes_written(kind)
    footprint = f", footprint {metadata.footprint}" if metadata.footprint else ""
    count = f"{kept.count} of {scene.count} Gaussians" if kept.count < scene.count else f"{scene.count} Gaussians"
    degree = 0 if kind == "splat" else kept.sh_degree
    print(f"{args.out}: {count}, harmonics of degree {degree}, axes {axes}{footprint}")


def chosen(scene: Gaussians, corners: tuple[float, ...] | None, opacity: float | None) -> torch.Tensor:
    """(N,) bool: Gaussians with their centre in the box, and of at least this opacity.

    Args:
        scene: N Gaussians.
        corners: x0, y0, z0, x1, y1, z1; None: anywhere.
        opacity: 0 to 1; None: any.
    """
    kept = torch.ones(scene.count, dtype=torch.bool)
    if corners is not None:
        low, high = torch.tensor(corners, dtype=torch.float32).reshape(2, 3)
        kept &= ((scene.means >= low) & (scene.means <= high)).all(1)
    if opacity is not None:
        kept &= scene.opacities[:, 0] >= opacity
    return kept


def metadata_of(found: io.FoundScene) -> io.SceneMetadata:
    """What the file says, and what lies around it and will not lie around the new one."""
    metadata, trained = found.metadata, found.trained_with
    if metadata.footprint is None and not metadata.antialiased and trained is not None:
        metadata = replace(metadata, footprint=str(trained.footprint))
    if metadata.background is None and found.background is not None:
        metadata = replace(metadata, background=found.background[0])
    return metadata
