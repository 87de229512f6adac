"""The command line: `python -m analytic_rasterizer COMMAND`. Without a command it says what is installed.

A command is a module with two functions: `add_parser` adds its parser to the subcommands, and `run` takes the parsed
arguments. COMMANDS lists them. A command reports what the user can correct by raising: `main` turns that into one line
on stderr and exit code 2.
"""

from __future__ import annotations

import argparse
import sys

from .. import _C, __version__
from ..footprints import ADVICE_IN_WORDS
from ..installation import about
from . import bake, convert, evaluate, inspect, pareto, render, report, train, view
from .arguments import Parser, run_command

__all__ = ["Parser", "build_parser", "main"]

COMMANDS = (train, evaluate, render, view, bake, convert, inspect, pareto, report)
# Commands that are programs of the repository now.
MOVED = {"tables": "benchmarks/paper_tables.py", "errors": "benchmarks/paper_errors.py"}


def main(argv: list[str] | None = None) -> int:
    """Runs one command and returns its exit code: 0, 2 after an error, 130 when interrupted.

    Args:
        argv: The words after the name of the program; None: those of the process.
    """
    words = sys.argv[1:] if argv is None else argv
    return run_command(lambda: _parse(words))


def _parse(words: list[str]) -> argparse.Namespace:
    """The arguments; ValueError for a command that moved, whatever its options."""
    if words and words[0] in MOVED:
        raise ValueError(f"{words[0]} has moved: in a clone of the repository, run python {MOVED[words[0]]}")
    return build_parser().parse_args(words)


def build_parser() -> Parser:
    """The parser of all commands."""
    description = "Render 3D Gaussians with pixels that integrate, not sample."
    advice = f"Footprints to take for {ADVICE_IN_WORDS}. COMMAND --help explains a command."
    parser = Parser(prog="python -m analytic_rasterizer", description=description, epilog=advice)
    parser.add_argument("--version", action="version", version=f"analytic_rasterizer {__version__}")
    parser.set_defaults(run=_say_what_is_installed)
    subcommands = parser.add_subparsers(title="commands", metavar="COMMAND")
    for command in COMMANDS:
        command.add_parser(subcommands)
    return parser


def _say_what_is_installed(_arguments: object) -> None:
    print(about(__version__, _C.BUILT_FOR, _C.has_cuda, _C.has_openmp))
    print("python -m analytic_rasterizer --help lists the commands")
