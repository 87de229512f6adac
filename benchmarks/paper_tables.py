"""The tables of the paper, trained and tested by this package.

    python benchmarks/paper_tables.py
    python benchmarks/paper_tables.py blender-mtmt --data nerf_synthetic --out results --rows analytic moment

The first line lists the tables, the second trains and tests two rows of one. docs/tables.md describes them.
"""

from __future__ import annotations

import argparse
import sys

from paper import PUBLISHED, TABLES, Table, run_table, text

from analytic_rasterizer import io
from analytic_rasterizer.cli.arguments import Parser, add_machine_options, count, run_command, use_machine
from analytic_rasterizer.training import load_lpips
from analytic_rasterizer.training.options import PRESETS


def main(argv: list[str] | None = None) -> int:
    """Runs what is asked for; returns the exit code: 0, 2 after an error, 130 when interrupted."""
    return run_command(lambda: make_parser().parse_args(argv))


def make_parser() -> argparse.ArgumentParser:
    """The parser of this program."""
    parser = Parser(
        description="Train and test all that a table of the paper shows, and print our rows beside the paper's. "
        "Nothing is downloaded; scenes that are not in FOLDER are skipped. What is complete is not done again: the "
        "same command goes on after an interruption. Writes NAME.md, NAME.json and the trainings to DIR. Without "
        "NAME, lists the tables.",
    )
    add = parser.add_argument
    add("name", nargs="?", choices=tuple(TABLES), metavar="NAME", help="of a table; without one, they are listed")
    add("--data", metavar="FOLDER", help="folder with the scenes")
    add("--out", metavar="DIR", help="folder for the results")
    add("--scenes", nargs="+", default=(), metavar="NAME", help="(default: all that are there)")
    add("--rows", nargs="+", default=(), metavar="NAME", help="(default: all)")
    add("--iterations", type=count, metavar="N", help="steps of every training (default: 30000)")
    add("--preset", choices=tuple(PRESETS), default="3dgs", help="as of `train`; the paper's is 3dgs, the default")
    add("--seed", type=int, metavar="N", help="of everything that is drawn (default: 0)")
    add("--no-lpips", action="store_true", help="leave out LPIPS")
    add_machine_options(parser)
    parser.set_defaults(run=run)
    return parser


def run(args) -> None:
    """Lists the tables, or trains, tests and prints one."""
    if args.name is None:
        print("\n\n".join(describe(table) for table in TABLES.values()))
        return
    missing = [text for name, text in (("data", "--data FOLDER"), ("out", "--out DIR")) if getattr(args, name) is None]
    if missing:
        raise ValueError(f"{args.name} needs {' and '.join(missing)}")
    use_machine(args)
    lpips = None
    if not args.no_lpips:
        try:
            lpips = load_lpips("vgg", args.device, like_3dgs=True)
        except (ImportError, io.SceneError) as error:
            print(f"LPIPS is left out: {error}", file=sys.stderr)
    given = {name: getattr(args, name) for name in ("iterations", "seed") if getattr(args, name) is not None}
    results = run_table(
        TABLES[args.name],
        args.data,
        args.out,
        scenes=args.scenes,
        rows=args.rows,
        device=args.device,
        preset=args.preset,
        lpips=lpips,
        say=lambda line: print(line, file=sys.stderr, flush=True),
        **given,
    )
    print(text(results))


def describe(table: Table) -> str:
    """A table and its protocol, for the list."""
    published = PUBLISHED.get(table.name)
    scenes: dict[int, list[str]] = {}
    for scene, reduction in table.data.scenes.items():
        scenes.setdefault(reduction, []).append(scene)
    tested = f"{table.enlarged} times the full size" if table.enlarged > 1 else _sizes(table.scales)
    lines = [
        f"{table.name} ({'paper, ' + published.source if published else 'ours only'}): {table.title}",
        *(f"full size {_fraction(reduction)}: {', '.join(names)}" for reduction, names in scenes.items()),
        f"trains at {_sizes(table.options['scales'])}, tests at {tested}, on "
        + (f"the test views ({table.data.views})" if table.data.views else "every eighth photograph"),
        f"rows: {', '.join(row.name for row in table.rows)}",
    ]
    return "\n    ".join(lines)


def _sizes(scales: tuple[int, ...]) -> str:
    return "the full size" if scales == (1,) else f"{', '.join(map(_fraction, scales))} of the full size"


def _fraction(scale: int) -> str:
    return "1" if scale == 1 else f"1/{scale}"


if __name__ == "__main__":
    sys.exit(main())
