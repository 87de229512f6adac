"""The folder that the program of 3DGS writes a model to, and cfg_args in it, which says how the model was trained."""

from __future__ import annotations

import ast
import math
import re
import warnings
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ..cameras.camera import View

CFG_ARGS = "cfg_args"
LARGEST = 1 << 16  # bytes of cfg_args; that of 3DGS has a few hundred
ITERATION = re.compile(r"iteration_(\d+)")
DIVISORS = (1, 2, 4, 8)  # values of `resolution` that divide; other positive ones are a width in px
USUAL_WIDTH = 1600  # px, which resolution -1 limits pictures to
MOST_REDUCED = 16  # images_N with a larger N is a name, and no reduction


@dataclass(frozen=True)
class CfgArgs:
    """What cfg_args says. None where it says nothing, or nothing that makes sense.

    Attributes:
        white_background: Whether the model was trained on white, otherwise on black.
        resolution: 1, 2, 4 or 8 divides the pictures; another positive number is their width in px; -1 limits it to
            1600 px.
        images: Folder of the photographs in the capture. images_4 has them at a quarter of the size.
        source_path: The capture.
        eval: Whether pictures were kept for the test.
        kernel_size: Of Mip-Splatting and its kin alone: variance of the 2D filter, px^2.
    """

    white_background: bool | None = None
    resolution: float | None = None
    images: str | None = None
    source_path: str | None = None
    eval: bool | None = None
    kernel_size: float | None = None

    @property
    def images_reduction(self) -> int:
        """N of a folder images_N, otherwise 1."""
        named = re.fullmatch(r"images_(\d{1,2})", Path(self.images or "").name)
        reduction = int(named[1]) if named else 1
        return reduction if 1 <= reduction <= MOST_REDUCED else 1

    def trained_size(self, width: int, height: int) -> tuple[int, int]:
        """(width, height) of the training's picture, px, of a photograph that cameras.json gives this size."""
        reduction = self.images_reduction
        width, height = (math.floor(length / reduction + 0.5) for length in (width, height))
        if self.resolution in DIVISORS:
            width, height = (round(length / self.resolution) for length in (width, height))
        elif self.resolution is not None:
            wanted = min(width, USUAL_WIDTH) if self.resolution == -1 else self.resolution
            width, height = (int(length / (width / wanted)) for length in (width, height))
        return max(1, width), max(1, height)

    def trained_view(self, view: View) -> View:
        """The view with pixels as large as those of the training, over the same field of view."""
        return view.resized(*self.trained_size(view.width, view.height))

    @property
    def size_in_words(self) -> str:
        """What makes pictures smaller than the photographs, such as "images images_4"; "" where nothing is said."""
        said = [f"images {self.images}"] if self.images_reduction > 1 else []
        said += [f"resolution {self.resolution:g}"] if self.resolution is not None else []
        return ", ".join(said)


def read_cfg_args(path) -> CfgArgs:
    """Reads the text of an argparse.Namespace of literals. Nothing of it is evaluated.

    Warns where the file is something else, and of values that this package needs and that are of the wrong kind: these
    are ignored.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST + 1)
        if len(content) > LARGEST:
            raise ValueError(f"more than {LARGEST} bytes")
        text = content.decode("utf-8-sig").strip()
        call = ast.parse(text, mode="eval").body
        if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Namespace"):
            raise ValueError("no Namespace")
        said = {keyword.arg: keyword.value for keyword in call.keywords}
    # The parser raises the last two for text that is nested too deeply.
    except (OSError, SyntaxError, ValueError, MemoryError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or str(error).partition("\n")[0] or type(error).__name__
        warnings.warn(f"{path}: ignored, it is not what 3DGS writes ({reason[:80]})", stacklevel=2)
        return CfgArgs()
    found: dict[str, Any] = {}
    for name in (field.name for field in fields(CfgArgs)):
        node = said.get(name)
        value = _literal(node)
        if value is not None and _fits(name, value):
            found[name] = value
        elif node is not None and not (isinstance(node, ast.Constant) and node.value is None):
            shown = " ".join((ast.get_source_segment(text, node) or "").split())[:40]
            warnings.warn(f"{path}: {name} is ignored, got {shown}", stacklevel=2)
    return CfgArgs(**found)


def _literal(node: ast.expr | None) -> Any:
    """A number, a text or a truth value, None for anything else."""
    negative = isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub)
    value = getattr(node.operand if negative else node, "value", None)
    if negative:
        return -value if type(value) in (int, float) else None
    return value if type(value) in (bool, int, float, str) else None


def _fits(name: str, value: Any) -> bool:
    if name in ("resolution", "kernel_size"):
        if not isinstance(value, (int, float)) or isinstance(value, bool):
            return False
        # A larger kernel_size is the width of a window, of a program that blurs.
        return 0 <= value <= 1 if name == "kernel_size" else value == -1 or 0 < value <= 2**20
    return isinstance(value, str if name in ("images", "source_path") else bool)


def model_root(file: Path) -> Path | None:
    """The folder of the model that a file MODEL/point_cloud/iteration_N/NAME belongs to, or None.

    Where the path does not look so, that of the file that it leads to may: through "..", or a symbolic link.
    """
    for path in (file.absolute(), file.resolve()):
        folder = path.parent
        if ITERATION.fullmatch(folder.name) and folder.parent.name == "point_cloud":
            return folder.parent.parent
    return None


def latest_ply(folder: Path) -> Path | None:
    """The point_cloud.ply of the last iteration in the folder of a model, in its folder point_cloud, or in the folder
    of an iteration; None where there is none."""
    if (folder / "point_cloud.ply").is_file():
        return folder / "point_cloud.ply"
    found = {}
    for base in (folder / "point_cloud", folder):
        for path in base.glob("iteration_*/point_cloud.ply"):
            if (named := ITERATION.fullmatch(path.parent.name)) and path.is_file():
                found.setdefault(int(named[1]), path)
        if found:
            return found[max(found)]
    return None
