"""The paper's error analysis: the error of every footprint's weight and gradients.

    python benchmarks/paper_errors.py --out errors

Writes plots, CSV files and summary.md to the folder. docs/accuracy.md has results.
"""

from __future__ import annotations

import argparse
import sys

from paper import errors

from analytic_rasterizer.cli.arguments import Parser, count, run_command, use_machine, writable_folder


def main(argv: list[str] | None = None) -> int:
    """Runs the analysis; returns the exit code, 2 after an error that the user can correct."""
    return run_command(lambda: make_parser().parse_args(argv))


def make_parser() -> argparse.ArgumentParser:
    """The parser of this program."""
    parser = Parser(
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
    return parser


def run(args) -> None:
    """Runs the analysis and prints its summary."""
    use_machine(args)
    out = writable_folder(args.out)
    print(errors.run(out, args.samples, args.monte_carlo)["summary"])
    print(f"see the plots and tables in {out}")


if __name__ == "__main__":
    sys.exit(main())
