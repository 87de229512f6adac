"""`errors`: the error of every footprint's weight."""

from __future__ import annotations

from ..analysis import errors
from .arguments import count, use_machine, writable_folder


def add_parser(subcommands) -> None:
    parser = subcommands.add_parser(
        "errors",
        help="measure the error of every footprint's weight and gradients",
        description="The paper's error analysis: the logistic window against erf, the turned pixel against Monte Carlo "
        "and the exact integral, and both errors of every footprint from 0.02 to 20 px. Writes plots (.png, .svg), "
        ".csv files and summary.md to DIR, and prints the summary.",
    )
    add = parser.add_argument
    add("--out", required=True, metavar="DIR", help="folder for the results")
    samples = "splats of each standard deviation (default: %(default)s)"
    add("--samples", type=count, default=errors.SAMPLES, metavar="N", help=samples)
    monte_carlo = "samples in a pixel (default: %(default)s, as in the paper)"
    add("--monte-carlo", type=count, default=errors.MONTE_CARLO, metavar="N", help=monte_carlo)
    add("--threads", type=count, metavar="N", help="CPU threads (default: all)")
    parser.set_defaults(run=run, device="cpu")


def run(args) -> None:
    """Runs the analysis and prints its summary."""
    use_machine(args)
    out = writable_folder(args.out)
    print(errors.run(out, args.samples, args.monte_carlo)["summary"])
    print(f"see the plots and tables in {out}")
