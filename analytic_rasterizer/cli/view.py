"""`view`: a scene in the browser."""

from __future__ import annotations

import webbrowser
from pathlib import Path

from .. import io, viewer
from ..footprints import resolve_footprint
from ..render.order import CENTER
from .arguments import (
    add_files,
    add_footprint,
    add_machine_options,
    add_order,
    add_view_options,
    check_writable_file,
    port,
    use_expandable_segments,
    use_machine,
)
from .photographs import find_photographs
from .scenes import order_in_words, say, settle_views


def add_parser(subcommands) -> None:
    parser = subcommands.add_parser(
        "view",
        help="look at a scene in the browser, with any footprint",
        description="Serve SCENE to a browser on this machine, which draws it with any of the footprints "
        + ", ".join(viewer.PAGE_FOOTPRINTS)
        + ". With --server this machine renders every frame, with any footprint that the library has. Nothing is sent "
        "elsewhere. Ctrl-C ends.",
    )
    add_files(parser, "cameras to jump to")
    add_footprint(parser, "what the page starts with")
    add_order(parser)
    parser.add_argument("--port", type=port, metavar="N", help="port to serve on (default: any free one)")
    parser.add_argument("--no-browser", action="store_true", help="print the address and open nothing")
    parser.add_argument(
        "--export", metavar="FILE.html", help="write page and scene into one file that opens anywhere, and end"
    )
    parser.add_argument(
        "--exact", action="store_true", help="export all numbers as they are, in a file several times as large"
    )
    parser.add_argument(
        "--compact", action="store_true", help="half of the memory: harmonics of 8 bits, for browsers with WebGPU only"
    )
    parser.add_argument(
        "--server",
        action="store_true",
        help="render every frame here, by the library's own kernels, and not in the browser; needs the extra 'view'",
    )
    add_view_options(parser)
    add_machine_options(parser)
    parser.set_defaults(run=run)


def run(args) -> None:
    """Serves or exports the scene."""
    use_expandable_segments()
    if args.server:
        run_live(args)
        return
    if args.threads is not None or args.device is not None:
        raise ValueError("--device and --threads are for --server: otherwise the browser draws")
    if args.order not in (None, CENTER):
        raise ValueError(f"--order {args.order} is for --server: the browser draws in the order of {CENTER}")
    if args.export is not None and Path(args.export).suffix.lower() != ".html":
        raise ValueError(f"--export must end in .html, got {args.export}")
    if args.export is not None:
        check_writable_file(args.export)
    if args.export is not None and args.port is not None:
        raise ValueError("--port is for serving: --export writes a file and ends")
    if args.exact and args.export is None:
        raise ValueError("--exact is for --export: what is served is not rounded")
    if args.footprint is not None:  # raises before the scene is read
        try:
            viewer.page_footprint(resolve_footprint(args.footprint))
        except viewer.PageFootprintError as error:
            raise ValueError(f"{error}; with --server every footprint can be shown") from None
    asked_background = args.background
    found = io.find_scene(args.scene)
    views, said = settle_views(args, found, required=False)
    packed, chosen = pack(args, found, views, args.background)
    said.append(chosen)
    if args.export is not None:
        size = viewer.export_page(args.export, packed, exact=args.exact)
        say(*said)
        print(f"{args.export}: {packed.meta['count']} Gaussians, {size / 1e6:.1f} MB")
        return
    photographs, told = find_photographs(found, views)

    def opens(path: Path):
        """A file that is dropped on the page."""
        dropped = io.find_scene(path)
        background = asked_background or (dropped.background or (io.BLACK,))[0]
        return pack(args, dropped, [], background)[0]

    with viewer.start_server(packed, args.port or 0, photographs, opens) as server:
        say(*said, *told)
        announce(args, packed.meta["count"], packed.meta["footprint"], server.url)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print()


def pack(args, found: io.FoundScene, views: list[io.View], background) -> tuple[viewer.PackedScene, str]:
    """What the page needs of a scene, and a line that says with which footprint it begins."""
    choice = found.choose_footprint(args.footprint)
    footprint, reason = viewer.nearest_page_footprint(choice.footprint), choice.reason
    if footprint != choice.footprint:
        reason = f"the page cannot draw {choice.footprint} ({reason}), and this is near; --server shows it"
    options = {"footprint": footprint, "background": background, "name": found.path.name, "compact": args.compact}
    if found.metadata.order not in (None, CENTER):
        reason += f"; {found.path.name} was trained in order {found.metadata.order}, which --server shows"
    return viewer.pack_scene(io.load_scene(found.path), views, **options), f"footprint {footprint}: {reason}"


def run_live(args) -> None:
    """Renders for browsers until interrupted."""
    if args.export is not None:
        raise ValueError("--export writes the page that needs no server: leave out --server")
    if args.exact:
        raise ValueError("--exact is for the page that --export writes: leave out --server")
    if args.compact:
        raise ValueError("--compact is for the memory of the browser: leave out --server")
    given = None if args.footprint is None else resolve_footprint(args.footprint)  # raises before the scene is read
    found = io.find_scene(args.scene)
    choice = found.choose_footprint(given)
    order = found.choose_order(choice.footprint, args.order)
    use_machine(args)
    io.optional_import("viser", "view")  # raises before the scene is read
    views, said = settle_views(args, found, required=False)
    scene = io.load_scene(found.path)
    options = {"views": views, "footprint": choice.footprint, "background": args.background, "order": order.order}
    with viewer.LiveViewer(args.port or 0, name=found.path.name, **options) as live:
        live.update(scene.to(args.device), copy=False)
        say(*said, f"footprint {choice.footprint}: {choice.reason}", *order_in_words(order))
        announce(args, len(scene.means), live.footprint, live.url)
        try:
            live.wait()
        except KeyboardInterrupt:
            print()


def announce(args, count: int, footprint: str, url: str) -> None:
    """Says what is served where, and opens it."""
    print(f"{Path(args.scene).name}: {count} Gaussians, footprint {footprint}")
    print(f"{url}  (Ctrl-C ends)", flush=True)
    if not args.no_browser:
        webbrowser.open(url)
