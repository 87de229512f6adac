"""`report`: one page about a training."""

from __future__ import annotations

from pathlib import Path

from ..analysis.plots import SUFFIXES, check_plot, save_plots
from ..training.report import plots_of_training, write_report
from .arguments import check_writable_file

PAGES = (".html", ".htm")


def add_parser(subcommands) -> None:
    parser = subcommands.add_parser(
        "report",
        help="write a page about a training: how it went, how good it is, what its capture calls for",
        description="Write a page about DIR, which `train` wrote: curves of the training, the test by scale, the worst "
        "views, pictures if `evaluate` drew some, what the capture calls for, and the options. The page is one file "
        "that needs nothing else. With --out FILE.png, .svg or .pdf only the curves and the test are drawn.",
    )
    add = parser.add_argument
    add("folder", metavar="DIR", help="folder that `train` wrote")
    add("--out", metavar="FILE", help="page, or picture (default: DIR/report.html)")
    add("--no-capture", action="store_true", help="leave out the look at the photographs")
    parser.set_defaults(run=run)


def run(args) -> None:
    """Writes the page or the picture and says where."""
    out = Path(args.out or Path(args.folder) / "report.html")
    is_page = out.suffix.lower() in PAGES
    if not is_page and out.suffix.lower() not in SUFFIXES:
        raise ValueError(f"--out must end in .html, {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}, got {out}")
    check_plot("page.svg" if is_page else out, "--out")
    if args.out is not None:
        check_writable_file(args.out)
    if is_page:
        write_report(args.folder, out, not args.no_capture)
    else:
        save_plots(out, plots_of_training(Path(args.folder)))
    print(out)
