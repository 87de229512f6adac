"""`view`: a scene in the browser."""

from __future__ import annotations

import webbrowser
from pathlib import Path

from .. import io, viewer
from ..footprints import resolve_footprint
from ..gaussians import Gaussians
from .arguments import add_machine_options, add_view_options, port, use_machine


def add_parser(subcommands) -> None:
    parser = subcommands.add_parser(
        "view",
        help="look at a scene in the browser, with any footprint",
        description="Serve SCENE to a browser on this machine, which draws it with any of the footprints "
        + ", ".join(viewer.PAGE_FOOTPRINTS)
        + ". With --server this machine renders every frame, with any footprint that the library has. Nothing is sent "
        "elsewhere. Ctrl-C ends.",
    )
    parser.add_argument("scene", metavar="SCENE", help="3DGS .ply, compressed .ply, .spz, .sog or .splat")
    parser.add_argument(
        "--views",
        metavar="FILE",
        help="cameras to jump to: 3DGS cameras.json, Blender or nerfstudio transforms.json, or a list of {width, "
        "height, fx, fy, w2c}",
    )
    parser.add_argument(
        "--footprint",
        metavar="NAME[:k=v]",
        help="what the page starts with (default: mip, if the file says that it was trained with an antialiasing "
        "filter, otherwise the library's, analytic)",
    )
    parser.add_argument("--port", type=port, metavar="N", help="port to serve on (default: any free one)")
    parser.add_argument("--no-browser", action="store_true", help="print the address and open nothing")
    parser.add_argument(
        "--export", metavar="FILE.html", help="write page and scene into one file that opens anywhere, and end"
    )
    parser.add_argument(
        "--server",
        action="store_true",
        help="render every frame here, by the library's own kernels, and not in the browser; needs the extra 'view'",
    )
    add_view_options(parser)
    add_machine_options(parser)
    parser.set_defaults(run=run, device=None)  # so that a device that is given is known


def run(args) -> None:
    """Serves or exports the scene."""
    if args.server:
        run_live(args)
        return
    if args.threads is not None or args.device is not None:
        raise ValueError("--device and --threads are for --server: otherwise the browser draws")
    if args.export and Path(args.export).suffix.lower() != ".html":
        raise ValueError(f"--export must end in .html, got {args.export}")
    if args.export and args.port is not None:
        raise ValueError("--port is for serving: --export writes a file and ends")
    footprint = args.footprint
    if footprint is not None:  # raises before the scene is read
        footprint = viewer.page_footprint(resolve_footprint(footprint))
    scene, views = read(args)
    if footprint is None:
        footprint = viewer.footprint_of_file(args.scene)
    name = Path(args.scene).name
    packed = viewer.pack_scene(scene, views, name=name, footprint=footprint, background=args.background)
    if args.export:
        size = viewer.export_page(args.export, packed)
        print(f"{args.export}: {packed.meta['count']} Gaussians, {size / 1e6:.1f} MB")
        return
    del scene  # the packed scene is all that is served
    with viewer.start_server(packed, args.port or 0) as server:
        announce(args, packed.meta["count"], packed.meta["footprint"], server.url)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print()


def run_live(args) -> None:
    """Renders for browsers until interrupted."""
    if args.export:
        raise ValueError("--export writes the page that needs no server: leave out --server")
    footprint = None if args.footprint is None else resolve_footprint(args.footprint)
    args.device = args.device or "cpu"
    use_machine(args)
    io.optional_import("viser", "view")  # raises before the scene is read
    scene, views = read(args)
    footprint = footprint or viewer.footprint_of_file(args.scene)
    name = Path(args.scene).name
    options = {"views": views, "footprint": footprint, "background": args.background, "name": name}
    with viewer.LiveViewer(args.port or 0, **options) as live:
        live.update(scene.to(args.device), copy=False)
        announce(args, len(scene.means), live.footprint, live.url)
        try:
            live.wait()
        except KeyboardInterrupt:
            print()


def read(args) -> tuple[Gaussians, list[io.View] | None]:
    """The scene and the views that the arguments name."""
    views = None if args.views is None else io.load_views(args.views, args.size)
    return io.load_scene(args.scene), views


def announce(args, count: int, footprint: str, url: str) -> None:
    """Says what is served where, and opens it."""
    print(f"{Path(args.scene).name}: {count} Gaussians, footprint {footprint}")
    print(f"{url}  (Ctrl-C ends)", flush=True)
    if not args.no_browser:
        webbrowser.open(url)
