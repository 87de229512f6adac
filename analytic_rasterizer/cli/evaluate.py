"""`evaluate`: how good a trained scene is, with one footprint or several."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from .. import io
from ..analysis.tables import format_table
from ..distributed.ranks import Ranks, even_counts
from ..footprints import resolve_footprint
from ..gaussians import Gaussians
from ..training import TrainingOptions, evaluate, load_capture, load_lpips, load_pictures, save_pictures
from ..training.evaluation import LPIPS_WEIGHTS, MEASURES
from ..training.files import OPTIONS, SCENE, write_json
from ..training.options import check_scales
from ..training.run import capture_arguments
from ..training.trainer import background_of
from .arguments import add_machine_options, count, use_machine, whole_numbers, writable_folder
from .launch import add_rank_options, ranks_of

HEADINGS = {"psnr": ("PSNR", "{:.2f}"), "ssim": ("SSIM", "{:.4f}"), "lpips": ("LPIPS", "{:.4f}")}


def add_parser(subcommands) -> None:
    parser = subcommands.add_parser(
        "evaluate",
        help="measure a trained scene: PSNR, SSIM and LPIPS per scale",
        description="Compare the scene in DIR, which `train` wrote, with the test pictures of its capture, at one or "
        "more scales and with one or more footprints. Writes evaluation.json and pictures of truth, rendering and four "
        "times their difference to DIR/evaluation, and prints a table.",
    )
    add = parser.add_argument
    add("out", metavar="DIR", help="results of `train`")
    add("--data", metavar="SCENE", help="folder of the capture (default: the one that was trained with)")
    add("--footprint", nargs="+", dest="footprints", metavar="NAME[:k=v]", help="(default: that of the training)")
    add("--scales", type=whole_numbers, metavar="1,2,..", help="reductions to test at (default: those trained at)")
    supersampling = "render pictures so many times larger and average them (default: as in the training)"
    add("--supersampling", type=count, metavar="N", help=supersampling)
    add("--lpips", choices=(*LPIPS_WEIGHTS, "none"), default="vgg", help="network of LPIPS (default: vgg)")
    add("--pictures", type=int, default=2, metavar="N", help="views to draw per footprint and scale (default: 2)")
    add_machine_options(parser, device=None)
    add_rank_options(parser)
    parser.set_defaults(run=run)


def run(args) -> None:
    """Measures, writes the results, and prints the table."""
    use_machine(args)
    with ranks_of(args) as ranks:
        run_on(ranks, args)


def run_on(ranks: Ranks, args) -> None:
    """`run`, on every rank."""
    folder = Path(args.out)
    try:
        described = json.loads((folder / OPTIONS).read_text(encoding="utf-8"))
        source, options = described["source"], TrainingOptions.from_dict(described["options"])
        place, arguments = args.data or source["scene"], capture_arguments({"offset": None} | source)
    except (ValueError, KeyError, TypeError) as error:
        raise io.SceneError(f"{folder / OPTIONS}: not what `train` writes ({error})") from None
    scales = tuple(dict.fromkeys(args.scales or options.scales))
    check_scales(scales)  # raises before the capture is read
    footprints = [str(resolve_footprint(name)) for name in args.footprints or [options.footprint]]
    capture = load_capture(place, **arguments)
    if not capture.test:
        raise io.SceneError(f"{place}: there are no test pictures")
    scene = part_of(io.load_scene(folder / SCENE), ranks).to(args.device)
    background = background_of(options, capture.background) or capture.background
    pictures = load_pictures(
        capture.test, scales, background, args.device, options.downsampling, on_host=ranks.world > 1
    )
    for note in capture.notes if ranks.is_first else ():
        print(note, file=sys.stderr)
    lpips = None
    if args.lpips != "none":
        try:
            lpips = load_lpips(args.lpips, args.device)
        except (ImportError, io.SceneError) as error:
            if ranks.is_first:
                print(f"LPIPS is left out: {error}", file=sys.stderr)
    out = writable_folder(folder / "evaluation")
    results = {}
    common = {"supersampling": args.supersampling or options.supersampling, "ranks": ranks}
    for footprint in footprints:
        results[footprint] = evaluate(scene, pictures, footprint, lpips, **common)
        if args.pictures > 0:
            save_pictures(out, scene, pictures, footprint, args.pictures, **common)
    if ranks.is_first:
        views = [view.name for view in pictures.views]
        resampled = sum(item.lens is not None for item in capture.test)
        written = {"views": views, "resampled": resampled, "supersampling": common["supersampling"], "results": results}
        write_json(folder / "evaluation.json", written)
        print(format_results(results, scales))


def part_of(scene: Gaussians, ranks: Ranks) -> Gaussians:
    """The Gaussians of this rank."""
    return scene.rows(ranks.part_of(even_counts(scene.count, ranks.world)))


def format_results(results: dict[str, dict], scales: tuple[int, ...]) -> str:
    """A row per footprint and measure, with a column per scale and one for the mean."""
    rows = []
    for footprint, measured in results.items():
        for measure in (m for m in MEASURES if m in measured["mean"]):
            heading, layout = HEADINGS[measure]
            values = [measured[key][measure] for key in (*map(str, scales), "mean")]
            rows.append([footprint, heading, *(layout.format(value) for value in values)])
    return format_table(["footprint", "", *(f"1/{scale}" for scale in scales), "mean"], rows)
