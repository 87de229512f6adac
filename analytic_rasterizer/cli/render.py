"""`render`: a scene from the views of a file or along a path, as pictures or as a film."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from .. import io, render_stages
from ..analysis import tables
from ..analysis.memory import check_sizes
from ..cameras import path as camera_path
from ..cameras.focus import focus
from ..cameras.up import level_up
from ..footprints import FOOTPRINTS, Footprint, resolve_footprint
from ..gaussians import Gaussians
from ..render.effects import Effects
from ..render.order import CENTER
from ..render.outputs import normalized
from ..render.rasterizer import GaussianRasterizer
from ..viewer.packing import extent
from .arguments import (
    LARGER,
    add_footprint,
    add_order,
    add_scales,
    add_scene,
    check_writable_file,
    count,
    positive_number,
    reductions,
    use_machine,
    writable_folder,
)
from .scenes import order_in_words, say, settle_views, sizes_in_words

STAGES = ("project", "list_tiles", "blend")
FILM = ".mp4"
OTHER_FILES = (".png", ".jpg", ".jpeg", ".gif", ".mov", ".avi", ".mkv", ".webm", ".npy")
PATHS = ("orbit", "views")
FRAMES, FPS = 120, 30.0
COVERED = 0.5  # alpha up to which a pixel has no depth: that of mist would be noise


def add_parser(subcommands) -> None:
    parser = subcommands.add_parser(
        "render",
        help="render a scene from the views of a file or along a path, as pictures or as a film",
        description="Render SCENE from every view of VIEWS into DIR/NAME.png, and say what each stage cost; or along a "
        f"path, as pictures or as a film. Footprints: {', '.join(FOOTPRINTS)}; options follow a colon: box:samples=4, "
        "point:dilation=0.",
    )
    add_scene(parser)
    add_scales(parser, reductions, "reductions: 2 is half the size; several go to DIR/scale_N (default: 1)", (1.0,))
    add = parser.add_argument
    add("--out", required=True, metavar="OUT", help="folder for the pictures, or FILE.mp4 for a film (extra 'video')")
    add_footprint(parser)
    add_order(parser)
    samples = "of --footprint: samples of a pixel, 1, 4 or 16 of box and moment"
    add("--samples", type=int, metavar="N", help=samples)
    path = "orbit: a circle around the scene; views: a smooth path through the views, in their order"
    add("--path", choices=PATHS, help=path)
    add("--frames", type=count, metavar="N", help=f"pictures along --path (default: {FRAMES})")
    add("--fps", type=positive_number, metavar="X", help=f"pictures of a film per second (default: {FPS:g})")
    add("--alpha", action="store_true", help="write pictures with alpha and without a background")
    depth = "write DIR/depth/NAME.npy too, world units, 0 where less than half is covered; and .png to look at"
    add("--depth", action="store_true", help=depth)
    parser.set_defaults(run=run)


def run(args) -> None:
    """Renders every view, saves it, and prints what each one cost."""
    given = check_options(args)
    film = Path(args.out).suffix.lower() == FILM
    io.optional_import("tqdm")
    io.optional_import(*(("imageio_ffmpeg", "video") if film else ("PIL.Image",)))  # raises before anything is rendered
    use_machine(args)
    found = io.find_scene(args.scene)
    choice = found.choose_footprint(given)
    order = found.choose_order(choice.footprint, args.order)
    if args.alpha:
        args.background = io.BLACK  # whose picture is that without a background
    views, said = settle_views(args, found)
    check_sizes((view.scaled(1 / scale) for view in views for scale in args.scales), args.device, LARGER)
    if film:
        check_writable_file(args.out)
    else:
        writable_folder(args.out)
    scene = io.load_scene(found.path).to(args.device)
    if args.path is not None:
        views = path_of(args, scene, views)
    said += [f"footprint {choice.footprint}: {choice.reason}", *order_in_words(order)]
    say(*said, size_in_words(views, args.scales))
    renderer = Renderer(scene, choice.footprint, args.background, args.device, order.order)
    if film:
        save_film(args, renderer, [view.scaled(1 / args.scales[0]) for view in views])
        return
    rows = []
    for scale in args.scales:
        folder = Path(args.out) / f"scale_{scale:g}" if len(args.scales) > 1 else Path(args.out)
        pictures = Pictures(writable_folder(folder), args.alpha, args.depth)
        scaled = [view.scaled(1 / scale) for view in views]
        of_scale = []
        for view, color, row in renderer.pictures(scaled):
            pictures.write(view.name, color, renderer.outputs(view) if args.alpha or args.depth else None)
            of_scale.append(row)
        rows += of_scale if args.path is None else []
        rows.append(mean_of(of_scale))
    header = ["view", "size", "Gaussians", "visible", "pairs"]
    print(tables.format_table([*header, *(f"{stage} [s]" for stage in STAGES), "total [s]"], rows))


def size_in_words(views: list[io.View], scales: tuple[float, ...]) -> str:
    """Such as "pictures of 17x30, 1/4 of the 67x120 of the views"."""
    made = ", ".join(sizes_in_words([view.scaled(1 / scale) for view in views]) for scale in scales)
    if tuple(scales) == (1,):
        return f"pictures of {made}"
    parts = ", ".join(f"1/{scale:g}" if scale >= 1 else f"{1 / scale:g} times" for scale in scales)
    return f"pictures of {made}: {parts} of the {sizes_in_words(views)} of the views"


def check_options(args) -> Footprint | None:
    """The footprint that is given. Raises ValueError for options that do not go together."""
    suffix = Path(args.out).suffix.lower()
    if suffix in OTHER_FILES:
        raise ValueError(f"--out must be a folder, or a film that ends in {FILM}, got {args.out}")
    if args.path is None and args.frames is not None:
        raise ValueError("--frames is the number of pictures along a path: give --path orbit or --path views")
    if suffix != FILM and args.fps is not None:
        raise ValueError(f"--fps is for a film: give --out FILE{FILM}")
    if suffix == FILM:
        wrong = [name for name in ("alpha", "depth") if getattr(args, name)]
        if wrong:
            raise ValueError(f"--{wrong[0]} is for pictures: give --out DIR, got {args.out}")
        if len(args.scales) > 1:
            raise ValueError(f"a film has one size: give one number to --scales, got {len(args.scales)}")
    if args.alpha and args.background is not None:
        raise ValueError("--alpha leaves the background out: give --background or --alpha")
    if args.samples is not None and args.footprint is None:
        raise ValueError("--samples is an option of a footprint, which --footprint names: --footprint box --samples 4")
    options = {} if args.samples is None else {"samples": args.samples}
    return None if args.footprint is None else resolve_footprint(args.footprint, **options)


def path_of(args, scene: Gaussians, views: list[io.View]) -> list[io.View]:
    """The frames of --path."""
    frames = FRAMES if args.frames is None else args.frames
    if args.path == "views":
        return camera_path.through(views, frames)
    center = focus(views)
    if center is None:
        center, _ = extent(scene.to("cpu"))
    return camera_path.orbit(views, center, level_up(views), frames)


class Renderer:
    """Renders views of a scene with one footprint, in one order."""

    def __init__(self, scene: Gaussians, footprint: Footprint, background, device: str, order: str = CENTER):
        self.scene, self.footprint, self.background, self.device = scene, footprint, background, device
        self.effects = Effects(order=order)
        self.gaussians = scene.arguments()

    def settings(self, view: io.View, **outputs):
        degree, effects = self.scene.sh_degree, replace(self.effects, **outputs)
        return view.settings(1, self.background, degree, self.footprint, device=self.device, effects=effects)

    def pictures(self, views: list[io.View]) -> Iterator[tuple[io.View, torch.Tensor, list]]:
        """Each view, its colours (3, H, W), and its row of the table."""
        with io.optional_import("tqdm").tqdm(views, desc="render", unit="view", disable=None) as progress:
            for view in progress:
                stages = render_stages(self.settings(view), **self.gaussians)
                seconds = [stages.seconds[stage] for stage in STAGES]
                counts = [self.scene.count, len(stages.ids), len(stages.pairs)]
                yield view, stages.color, [view.name, f"{view.width}x{view.height}", *counts, *seconds, sum(seconds)]

    @torch.no_grad()
    def outputs(self, view: io.View):
        """The `Outputs` alpha and depth of a view."""
        settings = self.settings(view, alpha=True, depth=True)
        return GaussianRasterizer(settings)(means2D=None, **self.gaussians)[2]


class Pictures:
    """Writes pictures to a folder, with alpha and depth where they are asked for."""

    def __init__(self, folder: Path, alpha: bool, depth: bool):
        self.folder, self.alpha = folder, alpha
        self.depth_folder = writable_folder(folder / "depth") if depth else None
        self.nearest: float | None = None  # of the first picture that shows something: white in all of them

    def write(self, name: str, color: torch.Tensor, outputs) -> None:
        if self.alpha:  # colours in PNG files are not multiplied by alpha
            color = torch.cat([normalized(color, outputs.alpha), outputs.alpha])
        io.save_image(self.folder / f"{name}.png", color)
        if self.depth_folder is not None:
            self._save_depth(name, normalized(outputs.depth, outputs.alpha, COVERED)[0])

    def _save_depth(self, name: str, depth: torch.Tensor) -> None:
        stored = depth.cpu().numpy()
        io.write_safely(self.depth_folder / f"{name}.npy", lambda temporary: np.save(temporary, stored))
        seen = depth > 0
        if self.nearest is None and seen.any():
            self.nearest = depth[seen].min().item()
        closeness = torch.where(seen, (self.nearest or 0) / torch.where(seen, depth, 1), 0)
        io.save_image(self.depth_folder / f"{name}.png", closeness.expand(3, -1, -1))


def save_film(args, renderer: Renderer, views: list[io.View]) -> None:
    """Writes a film, and says how long it is."""
    sizes = {(view.width, view.height) for view in views}
    if len(sizes) > 1:
        raise ValueError("a film has one size, and the views have several: give --path views, or --out DIR")
    fps = FPS if args.fps is None else args.fps
    colors = (color for _, color, _ in renderer.pictures(views))
    io.save_video(args.out, colors, *sizes, fps)
    print(f"{args.out}: {len(views)} pictures of {sizes_in_words(views)}, {len(views) / fps:.1f} s")


def mean_of(rows: list[list]) -> list:
    """The last row of the table."""
    mean = [sum(column) / len(rows) for column in list(zip(*rows))[2:]]
    return ["mean", "", *(round(value) for value in mean[:3]), *mean[3:]]
