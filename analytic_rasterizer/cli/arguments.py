"""What the commands share: their parser, options, types of arguments, and how they end."""

from __future__ import annotations

import argparse
import math
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import torch

from .. import _C
from ..filters import PIXEL_VARIANCE
from ..training.files import results_folder
from .launch import report

# What a user can cause: bad values and files (ValueError, TypeError, OSError), a missing extra
# (ImportError), a device out of memory or absent (RuntimeError, MemoryError), a training that
# diverges (FloatingPointError).
USER_ERRORS = (ValueError, TypeError, OSError, ImportError, RuntimeError, MemoryError, FloatingPointError)


class Parser(argparse.ArgumentParser):
    """An ArgumentParser whose errors are one line."""

    def error(self, message):
        report(f"{message} (see {self.prog} --help)")
        self.exit(2)


def run_command(parse: Callable[[], argparse.Namespace]) -> int:
    """Parses arguments, runs the command that they name, and returns its exit code.

    Args:
        parse: Returns the arguments; their `run` is called with them.

    Returns:
        0, 2 after an error that the user can correct, which is one line on stderr, or 130 when interrupted.

    Warnings are one line on stderr too, without the place in the code that Python names.
    """
    usual = warnings.formatwarning
    warnings.formatwarning = lambda message, *_, **__: f"warning: {message}\n"
    try:
        args = parse()
        args.run(args)
        return 0
    except KeyboardInterrupt:
        return 130
    except USER_ERRORS as error:
        report(_describe(error))
        return 2
    finally:
        warnings.formatwarning = usual


def _describe(error: BaseException) -> str:
    """The error in one line."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error).partition("\n")[0] or type(error).__name__


def add_scene(parser) -> None:
    """SCENE, --views, and how to render them."""
    add_files(parser)
    add_view_options(parser)
    add_machine_options(parser)


def add_files(parser) -> None:
    """SCENE and --views."""
    add = parser.add_argument
    add("scene", metavar="SCENE", help="3DGS .ply, compressed .ply, .spz, .sog or .splat")
    views = "3DGS cameras.json, Blender or nerfstudio transforms.json, or a list of {width, height, fx, fy, w2c}"
    add("--views", required=True, help=views)


def add_view_options(parser) -> None:
    """What views do not say."""
    add_size(parser)
    background = "colour behind the scene, 0 to 1 (default: black)"
    default = (0.0, 0.0, 0.0)
    parser.add_argument(
        "--background", nargs=3, type=intensity, default=default, metavar=("R", "G", "B"), help=background
    )


def add_size(parser) -> None:
    size = "image size for a views file that does not state one"
    parser.add_argument("--size", nargs=2, type=count, metavar=("W", "H"), help=size)


def add_machine_options(parser, device: str | None = "cpu") -> None:
    """Threads and the device, by default this one; None: CUDA where there is one, see `use_machine`."""
    parser.add_argument("--threads", type=count, metavar="N", help="CPU threads (default: all)")
    chosen = "(default: cuda where there is one)" if device is None else None
    parser.add_argument("--device", choices=("cpu", "cuda"), default=device, help=chosen)


def add_scale(parser, of: str = "resolution") -> None:
    """--scale, which is `of` what the views say."""
    parser.add_argument("--scale", type=positive_number, default=1.0, help=f"{of}, as a factor (default: 1)")


def use_machine(args) -> None:
    """Sets the number of threads, and a device that was left open: CUDA where there is one."""
    if args.threads is not None:
        torch.set_num_threads(args.threads)
    if args.device is None:
        args.device = "cuda" if torch.cuda.is_available() and _C.has_cuda else "cpu"
    if args.device == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: no CUDA device that this torch can use")


def writable_folder(path: str) -> Path:
    """The folder, made if it is missing; OSError before any work is done when it cannot be used."""
    folder = results_folder(path)
    try:
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError as error:  # which names the temporary file
        raise OSError(error.errno, error.strerror, str(folder)) from None


def check_writable_file(path: str) -> None:
    """Makes the file's folder if it is missing; OSError before any work is done when the file cannot be written."""
    writable_folder(Path(path).parent)
    if Path(path).is_dir():
        raise IsADirectoryError(f"{path}: expected a file for the results, got a folder")


def _number(kind, accepts, expected: str):
    """An argparse type: a number of this kind that `accepts` says is good."""

    def parse(text: str):
        try:
            value = kind(text)
        except ValueError:
            value = None
        if value is None or not accepts(value):
            raise argparse.ArgumentTypeError(f"must be {expected}, got {text}")
        return value

    return parse


def whole_numbers(text: str) -> tuple[int, ...]:
    """An argparse type: whole numbers, with commas between them."""
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be whole numbers with commas between them, got {text}") from None


positive_number = _number(float, lambda v: math.isfinite(v) and v > 0, "a positive number")
intensity = _number(float, lambda v: 0 <= v <= 1, "a number from 0 to 1")
dilation = _number(float, lambda v: PIXEL_VARIANCE <= v < math.inf, "a number from 1/12")
tolerance = _number(float, lambda v: math.isfinite(v) and v >= 0, "a number that is not negative")
density = _number(int, lambda v: v >= 8, "a whole number from 8")
count = _number(int, lambda v: v >= 1, "a positive whole number")
port = _number(int, lambda v: 0 <= v <= 65535, "a port from 0 to 65535")
