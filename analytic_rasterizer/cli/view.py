"""`view`: a scene in the browser."""

from __future__ import annotations

import webbrowser
from pathlib import Path

from .. import io, viewer
from ..footprints import resolve_footprint
from .arguments import add_view_options, port


def add_parser(subcommands) -> None:
    parser = subcommands.add_parser(
        "view",
        help="look at a scene in the browser, with any footprint",
        description="Serve SCENE to a browser on this machine, which draws it with any of the footprints "
        + ", ".join(viewer.PAGE_FOOTPRINTS)
        + ". Nothing is sent elsewhere. Ctrl-C ends.",
    )
    parser.add_argument("scene", metavar="SCENE", help="3DGS .ply, compressed .ply or .spz")
    parser.add_argument(
        "--views",
        metavar="FILE",
        help="cameras to jump to: 3DGS cameras.json, Blender or nerfstudio transforms.json, or a list of {width, "
        "height, fx, fy, w2c}",
    )
    parser.add_argument(
        "--footprint",
        metavar="NAME[:k=v]",
        help="what the page starts with (default: what the file says it was trained with, otherwise the library's, "
        "analytic)",
    )
    parser.add_argument("--port", type=port, default=0, metavar="N", help="port to serve on (default: any free one)")
    parser.add_argument("--no-browser", action="store_true", help="print the address and open nothing")
    parser.add_argument(
        "--export", metavar="FILE.html", help="write page and scene into one file that opens anywhere, and end"
    )
    add_view_options(parser)
    parser.set_defaults(run=run)


def run(args) -> None:
    """Serves or exports the scene."""
    if args.export and Path(args.export).suffix != ".html":
        raise ValueError(f"--export must end in .html, got {args.export}")
    footprint = args.footprint
    if footprint is not None:  # raises before the scene is read
        footprint = viewer.page_footprint(resolve_footprint(footprint))
    views = None if args.views is None else io.load_views(args.views, args.size)
    scene = io.load_scene(args.scene)
    if footprint is None:
        footprint = viewer.footprint_of_file(args.scene)
    name = Path(args.scene).name
    packed = viewer.pack_scene(scene, views, name=name, footprint=footprint, background=args.background)
    if args.export:
        size = viewer.export_page(args.export, packed)
        print(f"{args.export}: {packed.meta['count']} Gaussians, {size / 1e6:.1f} MB")
        return
    del scene  # the packed scene is all that is served
    with viewer.start_server(packed, args.port) as server:
        print(f"{name}: {packed.meta['count']} Gaussians, footprint {packed.meta['footprint']}")
        print(f"{server.url}  (Ctrl-C ends)", flush=True)
        if not args.no_browser:
            webbrowser.open(server.url)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print()
