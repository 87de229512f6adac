"""`render`: a scene from the views of a file, as PNG."""

from __future__ import annotations

from .. import io, render_stages
from ..analysis import tables
from ..footprints import FOOTPRINTS
from .arguments import add_scale, add_scene, use_machine, writable_folder

STAGES = ("project", "list_tiles", "blend")


def add_parser(subcommands) -> None:
    parser = subcommands.add_parser(
        "render",
        help="render a scene from the views of a file, as PNG",
        description="Render SCENE from every view of VIEWS into DIR/NAME.png, and say what each stage cost. "
        f"Footprints: {', '.join(FOOTPRINTS)}; options follow a colon: box:samples=4, point:dilation=0.",
    )
    add_scene(parser)
    add_scale(parser)
    add = parser.add_argument
    add("--out", required=True, metavar="DIR", help="folder for the pictures")
    footprint = "how a pixel sees a splat (default: the library's, analytic)"
    add("--footprint", metavar="NAME[:k=v,..]", help=footprint)
    samples = "of --footprint: samples of a pixel, 1, 2, 4, 8 or 16 of box, 1, 4, 9 or 16 of moment"
    add("--samples", type=int, metavar="N", help=samples)
    parser.set_defaults(run=run)


def run(args) -> None:
    """Renders every view, saves it, and prints what each one cost."""
    if args.samples is not None and args.footprint is None:
        raise ValueError("--samples is an option of a footprint, which --footprint names: --footprint box --samples 4")
    tqdm = io.optional_import("tqdm").tqdm
    io.optional_import("PIL.Image")  # raises before anything is rendered
    use_machine(args)
    views = io.load_views(args.views, args.size)
    out = writable_folder(args.out)
    scene = io.load_scene(args.scene).to(args.device)
    options = {} if args.samples is None else {"samples": args.samples}
    rows = []
    with tqdm(views, desc="render", unit="view", disable=None) as progress:
        for view in progress:
            settings = view.settings(
                args.scale, args.background, scene.sh_degree, args.footprint, device=args.device, **options
            )
            stages = render_stages(settings, **scene.arguments())
            io.save_image(out / f"{view.name}.png", stages.color)
            seconds = [stages.seconds[stage] for stage in STAGES]
            counts = [len(scene.means), len(stages.ids), len(stages.pairs)]
            size = f"{settings.image_width}x{settings.image_height}"
            rows.append([view.name, size, *counts, *seconds, sum(seconds)])
    mean = [sum(column) / len(rows) for column in list(zip(*rows))[2:]]
    rows.append(["mean", "", *(round(value) for value in mean[:3]), *mean[3:]])
    header = ["view", "size", "Gaussians", "visible", "pairs"]
    print(tables.format_table([*header, *(f"{stage} [s]" for stage in STAGES), "total [s]"], rows))
