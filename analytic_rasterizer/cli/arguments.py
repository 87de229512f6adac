"""What the commands share: their parser, options, types of arguments, and how they end."""

from __future__ import annotations

import argparse
import difflib
import math
import os
import re
import sys
import tempfile
import warnings
from collections.abc import Callable, Collection
from io import StringIO
from pathlib import Path

import torch

from .. import _C
from ..captures.loading import CHOICES, IMAGES, TEST_PERIOD
from ..checks import did_you_mean
from ..filters import PIXEL_VARIANCE
from ..io.errors import SceneError, SceneWarning
from ..io.images import BACKGROUNDS
from ..render.order import ORDERS
from ..training.files import check_results_folder, results_folder
from .launch import report

# What a user can cause: bad values and files (ValueError, TypeError, OSError), a missing extra
# (ImportError), a device out of memory or absent (RuntimeError, MemoryError), a training that
# diverges (FloatingPointError).
USER_ERRORS = (ValueError, TypeError, OSError, ImportError, RuntimeError, MemoryError, FloatingPointError)
VIEWS = "3DGS cameras.json, Blender or nerfstudio transforms.json, or a list of {width, height, fx, fy, w2c}"
LARGER = "larger numbers in --scales make them smaller"
ALLOCATOR_VARIABLES = ("PYTORCH_ALLOC_CONF", "PYTORCH_CUDA_ALLOC_CONF", "PYTORCH_HIP_ALLOC_CONF")
KNOWN_OPTIONS = "known_options"  # of parsed arguments: what messages may advise
MOST_NAMES = 3  # that may have been meant
OF_OTHERS = {  # what other trainers call an option
    **dict.fromkeys(("--steps", "--max-steps", "--max_steps", "--num-iterations"), "--iterations"),
    **dict.fromkeys(("--model_path", "--model-path", "--result-dir", "--result_dir"), "--out"),
    **dict.fromkeys(("--resolution", "--data-factor", "--data_factor", "--downscale"), "--scales"),
    **dict.fromkeys(("--cap-max", "--cap_max", "--num-gaussians"), "--max-gaussians"),
}
METAVARS = {int: "N", float: "X", str: "NAME", tuple: "N,N,.."}
"""What `--help` shows for a value, by its type."""


class Parser(argparse.ArgumentParser):
    """An ArgumentParser whose errors are one line, and which takes the numbers of a colour as three arguments, too.

    A list of numbers may begin with a negative one, which ArgumentParser takes for an option.

    It takes no option by a part of its name: programs that call a command would break with the next option that begins
    so. The error for an unknown name says which is near.

    Args:
        others: As of ArgumentParser, but for `allow_abbrev`.
    """

    def __init__(self, **others):
        super().__init__(allow_abbrev=False, **others)

    def parse_known_args(self, args=None, namespace=None):
        """As of ArgumentParser, with `--background R G B` in `args` as one argument; for `namespace` see there.

        Options that do not exist are an error.
        """
        args = _with_joined_lists(_with_joined_colors(sys.argv[1:] if args is None else args))
        unknown = self._unknown_options(args)
        if unknown:  # before what argparse says of an option that is required, and here has another name
            near = dict.fromkeys(name for option in unknown for name in self._near_options(option))
            self.error(f"unrecognized arguments: {' '.join(unknown)}{did_you_mean(near)}")
        parsed, rest = super().parse_known_args(args, namespace)
        if not hasattr(parsed, KNOWN_OPTIONS):  # a command's, which has its own parser, are there already
            setattr(parsed, KNOWN_OPTIONS, frozenset(self._option_string_actions))
        return parsed, rest

    def _unknown_options(self, args: list[str]) -> list[str]:
        """The names among the arguments that no option of this parser has; those after a command are the command's."""
        unknown = []
        for text in args:
            is_option = re.match(r"--?[A-Za-z][^ ]*$", text) is not None and not _is_float(text)
            if text == "--" or (self._subparsers is not None and not is_option):
                break
            name = text.partition("=")[0]
            if is_option and name not in self._option_string_actions:
                unknown.append(name)
        return unknown

    def _near_options(self, name: str) -> list[str]:
        """The options that a name may stand for: what others call by it, those that begin with it, or else the most
        similar one."""
        actions = [action for action in self._actions if action.help != argparse.SUPPRESS]
        options = [option for action in actions for option in action.option_strings]
        begun = [option for option in options if option == OF_OTHERS.get(name) or option.startswith(name)]
        return begun[:MOST_NAMES] or difflib.get_close_matches(name, options, 1)

    def _check_value(self, action, value):
        """As of ArgumentParser; the error names the choice that is near, of commands as well."""
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            error.message += did_you_mean(difflib.get_close_matches(str(value), map(str, action.choices), 1))
            raise

    def error(self, message):
        """Prints `message` as one line, and ends the process with the exit code 2."""
        if re.fullmatch(r"unrecognized arguments:( [\d.]+)+", message):
            message += "; lists have commas and no spaces: 1,2,4"
        report(f"{message} (see {self.prog} --help)")
        self.exit(2)


def _with_joined_colors(args: list[str]) -> list[str]:
    """--background R G B as --background=R,G,B."""
    joined = list(args)
    for i in reversed([i for i, text in enumerate(joined) if text == "--background"]):
        numbers = joined[i + 1 : i + 4]
        if len(numbers) == 3 and all(_is_number(text) for text in numbers):
            joined[i : i + 4] = [f"--background={','.join(numbers)}"]
    return joined


def _with_joined_lists(args: list[str]) -> list[str]:
    """--crop -1,0,1 as --crop=-1,0,1."""
    joined = list(args)
    for i in reversed(range(1, len(joined))):
        is_list = re.match(r"-[\d.]", joined[i]) is not None and "," in joined[i]
        if is_list and re.fullmatch(r"--[a-z-]+", joined[i - 1]):
            joined[i - 1 : i + 1] = [f"{joined[i - 1]}={joined[i]}"]
    return joined


def _is_float(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _is_number(text: str) -> bool:
    return _is_float(text) and math.isfinite(float(text))


def run_command(parse: Callable[[], argparse.Namespace]) -> int:
    """Parses arguments, runs the command that they name, and returns its exit code.

    Args:
        parse: Returns the arguments; their `run` is called with them.

    Returns:
        0, 2 after an error that the user can correct, which is one line on stderr, or 130 when interrupted.

    Warnings are one line on stderr too, without the place in the code that Python names.
    """
    if sys.stderr is None:  # closed, as for a service: without a place, print takes stdout, and libraries fail
        sys.stderr = StringIO()
    usual, options = warnings.formatwarning, frozenset()
    warnings.formatwarning = lambda message, *_, **__: f"warning: {_told(message, options)}\n"
    try:
        args = parse()
        options = getattr(args, KNOWN_OPTIONS, options)
        args.run(args)
        return 0
    except KeyboardInterrupt:
        return 130
    except USER_ERRORS as error:
        report(_describe(error, options))
        return 2
    finally:
        warnings.formatwarning = usual


def _told(said: object, options: Collection[str]) -> str:
    """The text of an error or a warning, with the advice that a command with these options can follow."""
    return said.told(options) if isinstance(said, (SceneError, SceneWarning)) else str(said)


def _describe(error: BaseException, options: Collection[str]) -> str:
    """The error in one line, for a command with these options."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return _told(error, options).partition("\n")[0] or type(error).__name__


def add_scene(parser) -> None:
    """SCENE, --views, and how to render them."""
    add_files(parser)
    add_view_options(parser)
    add_machine_options(parser)


def add_scene_file(parser) -> None:
    """SCENE."""
    formats = ".ply, compressed .ply, .spz, .sog, its meta.json, .splat, .glb, .gltf, .usd"
    scene = f"file of a scene ({formats}), or a folder: of `train`, or a model of 3DGS"
    parser.add_argument("scene", metavar="SCENE", help=scene)


def add_files(parser, purpose: str = "file of views") -> None:
    """SCENE and --views."""
    add_scene_file(parser)
    views = f"{purpose}: {VIEWS} (default: cameras.json beside SCENE, or of the model of 3DGS)"
    parser.add_argument("--views", metavar="FILE", help=views)


def add_footprint(
    parser,
    text: str = "how a pixel sees a splat",
    default: str = "(default: ANALYTIC_RASTERIZER_FOOTPRINT, else what SCENE was trained with)",
) -> None:
    """--footprint, and where it comes from otherwise."""
    parser.add_argument("--footprint", metavar="NAME[:k=v,..]", help=f"{text} {default}")


def add_order(parser) -> None:
    """--order, and where it comes from otherwise."""
    text = "order of splats: center, by the depth of their centres; ray or ray:32, along the rays of pixels"
    parser.add_argument("--order", choices=ORDERS, help=f"{text} (default: that of the training, else {ORDERS[0]})")


def add_reading(parser, folder: str, training: str = "") -> None:
    """How a capture is read, see `training.load_capture`. What is not given is None.

    Args:
        folder: What the help calls the capture.
        training: What comes before the usual, in the help of defaults.
    """
    add = parser.add_argument
    images = f"folder in {folder} of a reconstruction's photographs (default: {training}{IMAGES})"
    add("--images", metavar="NAME", help=images)
    test_every = f"where {folder} does not say: keep every N-th photograph for the test; 0: none"
    add("--test-every", type=int, metavar="N", help=f"{test_every} (default: {training}{TEST_PERIOD})")
    cameras = f"file or folder in {folder} to read the cameras from, such as transforms.json or sparse/1"
    add("--cameras", metavar="NAME", help=f"{cameras} (default: {training}found)")
    choices = {
        "lens": "photographs with a lens are rendered with it, resampled to pinholes, or an error",
        "missing": "pictures, masks and depth maps that cannot be read are an error, or left out: without its picture "
        "a camera too",
        "masks": "black pixels of masks do not count, or masks are ignored",
        "alpha": "a background is seen through transparent pixels, or they do not count",
    }
    for name, text in choices.items():
        add(f"--{name}", choices=CHOICES[name], help=f"{text} (default: {training}{CHOICES[name][0]})")


def add_view_options(parser) -> None:
    """What views do not say."""
    add_size(parser)
    background = "colour behind the scene: black, white, or three numbers from 0 to 1 (default: that of the training)"
    parser.add_argument("--background", type=color, metavar="COLOR", help=background)


def add_size(parser) -> None:
    size = "image size for a views file that does not state one"
    parser.add_argument("--size", nargs=2, type=count, metavar=("W", "H"), help=size)


def add_machine_options(parser, device: str | None = None) -> None:
    """Threads and the device; by default CUDA where there is one, see `use_machine`."""
    parser.add_argument("--threads", type=count, metavar="N", help="CPU threads (default: all)")
    chosen = f"(default: {device or 'cuda where there is one'})"
    parser.add_argument("--device", choices=("cpu", "cuda"), default=device, help=chosen)


def add_scales(parser, kind: Callable, text: str, default: tuple | None = None) -> None:
    """--scales, which says reductions in every command: 2 is half the size.

    Args:
        kind: A type of arguments: `reductions`, `whole_reductions` or `reduction`.
        text: The help.
        default: In place of None.
    """
    several = "N" if kind is reduction else "N,N,.."
    parser.add_argument("--scales", type=kind, default=default, metavar=several, help=text)
    # It had another meaning than --scales: whoever gives it has to think again.
    parser.add_argument("--scale", type=_former_scale, help=argparse.SUPPRESS)


def _former_scale(text: str):
    raise argparse.ArgumentTypeError(f"use --scales, which takes reductions: 2 is half the size; got {text}")


def use_machine(args) -> None:
    """Sets the number of threads, and a device that was left open: CUDA where there is one."""
    if args.threads is not None:
        torch.set_num_threads(args.threads)
    if args.device is None:
        args.device = "cuda" if torch.cuda.is_available() and _C.has_cuda else "cpu"
    if args.device == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: no CUDA device that this torch can use")


def use_expandable_segments() -> None:
    """Tells torch's CUDA allocator to map memory page by page, unless the user has told it anything by a variable.

    Buffers of frames have many sizes, for each of which it would reserve a block of its own. Does nothing where CUDA is
    in use already. torch 2.9 knows the newer name, and ignores it.
    """
    if any(name in os.environ for name in ALLOCATOR_VARIABLES) or torch.cuda.is_initialized():
        return
    if sys.platform == "linux":  # elsewhere torch warns that it cannot
        version = tuple(int(number) for number in torch.__version__.split(".")[:2])
        os.environ[ALLOCATOR_VARIABLES[version < (2, 10)]] = "expandable_segments:True"


def writable_folder(path: str) -> Path:
    """The folder, made if it is missing; OSError before any work is done when it cannot be used."""
    check_results_folder(path)
    folder = results_folder(path)
    try:
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError as error:  # which names the temporary file
        said = f"the folder for the results cannot be written to ({error.strerror})"
        raise OSError(error.errno, said, str(folder)) from None


def check_writable_file(path: str, scene: Path | None = None) -> None:
    """Makes the file's folder if it is missing; OSError before any work is done when the file cannot be written.

    `scene` is the file that is read, which stays as it is: ValueError where it is the same.
    """
    if scene is not None and os.path.exists(path) and os.path.samefile(path, scene):
        raise ValueError(f"{path}: expected another file than the scene, which is not overwritten")
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


def _numbers(kind, accepts, expected: str):
    """An argparse type: a tuple of such numbers, which have commas between them."""

    def parse(text: str) -> tuple:
        try:
            values = tuple(kind(part) for part in text.split(","))
        except ValueError:
            values = ()
        if not values or not all(map(accepts, values)):
            raise argparse.ArgumentTypeError(f"must be {expected} with commas between them, got {text}")
        return values

    return parse


def color(text: str) -> tuple[float, float, float]:
    """An argparse type: a colour by its name, or as R,G,B."""
    if text in BACKGROUNDS:
        return BACKGROUNDS[text]
    parts = text.split(",")
    if len(parts) != 3 or not all(_is_number(part) and 0 <= float(part) <= 1 for part in parts):
        expected = f"{', '.join(BACKGROUNDS)} or three numbers from 0 to 1, as R,G,B"
        raise argparse.ArgumentTypeError(f"must be {expected}, got {text}")
    return tuple(map(float, parts))


def box(text: str) -> tuple[float, ...]:
    """An argparse type: x0,y0,z0,x1,y1,z1 with x0 <= x1 and so on; inf and -inf leave a side open."""
    parts = text.split(",")
    numbers = tuple(map(float, parts)) if all(map(_is_float, parts)) else ()
    if len(numbers) != 6 or not all(low <= high for low, high in zip(numbers[:3], numbers[3:])):
        raise argparse.ArgumentTypeError(f"must be x0,y0,z0,x1,y1,z1, the lower corner first, got {text}")
    return numbers


def _is_reduction(value: float) -> bool:
    return math.isfinite(value) and value > 0


whole_numbers = _numbers(int, lambda v: True, "whole numbers")
whole_reductions = _numbers(int, lambda v: v >= 1, "reductions, positive whole numbers (2 is half the size),")
reductions = _numbers(float, _is_reduction, "reductions, positive numbers (2 is half the size),")
reduction = _number(float, _is_reduction, "a reduction, a positive number (2 is half the size)")
positive_number = _number(float, lambda v: math.isfinite(v) and v > 0, "a positive number")
dilation = _number(float, lambda v: PIXEL_VARIANCE <= v < math.inf, "a number from 1/12")
fraction = _number(float, lambda v: 0 <= v <= 1, "a number from 0 to 1")
tolerance = _number(float, lambda v: math.isfinite(v) and v >= 0, "a number that is not negative")
density = _number(int, lambda v: v >= 8, "a whole number from 8")
count = _number(int, lambda v: v >= 1, "a positive whole number")
whole_number = _number(int, lambda v: v >= 0, "a whole number that is not negative")
port = _number(int, lambda v: 0 <= v <= 65535, "a port from 0 to 65535")
