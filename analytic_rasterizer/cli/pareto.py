"""`pareto`: accuracy against time of every footprint."""

from __future__ import annotations

from .. import io
from ..analysis import pareto, tables
from ..analysis.memory import check_sizes
from ..analysis.reference import MAX_DENSITY
from .arguments import LARGER, add_scales, add_scene, count, density, use_machine, whole_reductions, writable_folder
from .scenes import say, settle_views

VIEWS = 4  # of those that were found beside the scene: a cameras.json may have hundreds


def add_parser(subcommands) -> None:
    parser = subcommands.add_parser(
        "pareto",
        help="measure accuracy against time of every footprint on a trained scene",
        description="Render SCENE with every footprint and with supersampling at several scales, compare with the "
        "converged integral of the image over every pixel, time them, and write DIR/pareto_SCALE.png and .svg, "
        "pareto.md and pareto.json. On the CPU times are ratios, of the fastest of interleaved rounds. Errors are of "
        "colours in 0 to 1, not clamped. ~ marks a PSNR that the reference does not resolve; F and B under front mark "
        "methods that no other beats, forward and with backward.",
    )
    add_scene(parser)
    add = parser.add_argument
    add("--out", default="pareto", metavar="DIR", help="folder for the results (default: %(default)s)")
    scales = "reductions of the views: 2 is half the size, a remainder is cut off (default: 1,2,4,8)"
    add_scales(parser, whole_reductions, scales, (1, 2, 4, 8))
    names = " ".join(method.name for method in pareto.default_methods())
    methods = f"methods; @N renders N x N times the pixels and averages (default: {names})"
    add("--footprints", nargs="+", metavar="NAME[:k=v,..][@N]", help=methods)
    limit = f"only the first N views (default: all of --views, and {VIEWS} spread over those found beside SCENE)"
    add("--limit-views", type=count, metavar="N", help=limit)
    crop = "only the middle W x H pixels of the picture, at every scale (default: all of it)"
    add("--crop", nargs=2, type=count, metavar=("W", "H"), help=crop)
    add("--rounds", type=count, metavar="N", help="timed rounds (default: 5, with CUDA 20)")
    cpu_time = "count CPU seconds instead of the wall clock's: on a shared machine, with --threads 1"
    add("--cpu-time", action="store_true", help=cpu_time)
    at_most = f"samples of the reference along a pixel's side, at most (default: {MAX_DENSITY})"
    add("--max-density", type=density, metavar="N", help=at_most)
    parser.set_defaults(run=run)


def run(args) -> None:
    """Runs the measurement and prints a table for every scale."""
    use_machine(args)
    methods = None if args.footprints is None else [pareto.parse_method(text) for text in args.footprints]
    found = io.find_scene(args.scene)
    views, said = settle_views(args, found)
    if args.limit_views is None and args.views is None and len(views) > VIEWS:
        views = [views[i * len(views) // VIEWS] for i in range(VIEWS)]
        said.append(f"{VIEWS} of the views are measured (--limit-views)")
    views = views[: args.limit_views]
    pareto.check_given(views, args.scales, methods)
    check_sizes((view.framed(scale, args.crop) for view in views for scale in args.scales), args.device, LARGER)
    out = writable_folder(args.out)
    if found.is_dilated:
        trained = found.training_footprint()
        said.append(
            f"trained with {trained.footprint}: {trained.reason}; errors are those against the integral of the "
            f"Gaussians as they are, which its training did not show: measure what bake makes of it"
        )
    scene = io.load_scene(found.path).to(args.device)
    say(*said)
    results = pareto.run(
        out,
        scene,
        views,
        args.scales,
        methods,
        crop=args.crop,
        background=args.background,
        rounds=args.rounds,
        max_density=args.max_density,
        cpu_time=args.cpu_time,
        name=found.path.stem,
    )
    print(f"{results['gaussians']} Gaussians of SH degree {results['sh_degree']}, {results['machine']}")
    for at_scale in results["scales"]:
        title, *notes = pareto.describe(results, at_scale)
        print(f"\n{title}\n{tables.format_table(*pareto.to_table(results, at_scale))}")
        print("\n".join(notes))
    print(f"\nsee {out / 'pareto.md'} and the plots beside it")
