"""The table of docs/performance.md: footprints and peers, forward / forward + backward, on several scenes.

    python benchmarks/table.py "plant hd=plant.ply,plant_hd.json" "plant lo=plant.ply,plant_lo.json" ...
                               [--footprints NAME ...] [--against gsplat,module:NAME ...] [--queued]
                               [--device cuda] [--json FILE]

Every column is LABEL=SCENE,VIEWS. Within a column all rows are measured in turn, as `speed.py --against` does, which
also says what is timed and what NAME may be; milliseconds, medians of the rounds, means of the views. Printed is
Markdown, and below it how far the pictures of peers are from ours. The SH of a scene are padded to degree 3 with zeros,
as trainers hold them.
"""

from __future__ import annotations

import argparse

from common import add_measuring, parse, save_json
from scene_files import load_scene
from speed import add_against_and_queued, measure_scene

from analytic_rasterizer import io
from analytic_rasterizer.analysis.tables import markdown_table
from analytic_rasterizer.analysis.timing import describe_machine

FOOTPRINTS = ["box:samples=1", "mip", "point", "cumulant", "analytic"]
FOOTPRINTS += [f"box:samples={samples}" for samples in (4, 16)]
FOOTPRINTS += [f"moment:samples={cells}" for cells in (1, 4, 16)]
SH_DEGREE = 3


def main() -> None:
    args = parse_arguments()
    columns = {}
    for label, (scene_file, views_file) in args.columns.items():
        scene, views = load_scene(scene_file).with_sh_degree(SH_DEGREE).to(args.device), io.load_views(views_file)
        columns[label], _ = measure_scene(args, scene, views)
    print(f"{describe_machine(args.device)}; forward / forward + backward, ms\n")
    print(format_columns(columns))
    for label, results in columns.items():
        for name, result in results.items():
            if "difference" in result:
                print(f"{label}, {name}: mean absolute difference from our picture {result['difference']:.2g}")
    save_json(args, {"results": columns})


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("columns", nargs="+", type=_column, metavar="LABEL=SCENE,VIEWS")
    parser.add_argument("--footprints", nargs="+", default=FOOTPRINTS, metavar="NAME[:k=v]")
    add_against_and_queued(parser)
    add_measuring(parser)
    args = parse(parser)
    args.columns = dict(args.columns)
    return args


def _column(text: str) -> tuple[str, tuple[str, str]]:
    label, equals, files = text.partition("=")
    scene, comma, views = files.partition(",")
    if not (equals and comma):
        raise argparse.ArgumentTypeError(f"must be LABEL=SCENE,VIEWS, got {text}")
    return label, (scene, views)


def format_columns(columns: dict[str, dict[str, dict]]) -> str:
    """A row per footprint and peer, a column per label."""
    rows = []
    for name in next(iter(columns.values())):
        cells = [[1e3 * results[name][key] for key in ("forward", "forward_backward")] for results in columns.values()]
        rows.append([name, *(" / ".join(f"{ms:.3g}" for ms in cell) for cell in cells)])
    return markdown_table(["forward / forward + backward, ms", *columns], rows)


if __name__ == "__main__":
    main()
