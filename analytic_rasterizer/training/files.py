"""What a training writes, by `io.write_safely`: a full disk never costs the file that was there."""

from __future__ import annotations

import errno
import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from .. import io
from ..gaussians import Gaussians
from ..io.trained import CAMERAS, OPTIONS, SCENE  # noqa: F401  (the names by which commands find them)
from ..io.views import write_cameras  # noqa: F401
from ..io.writing import as_json, write_json, write_safely, write_text  # noqa: F401

CHECKPOINT = "checkpoint.pt"
MIP_SCENE = "point_cloud_mip.ply"
EXPOSURES = "exposures.json"  # as of 3DGS: 3x4 by the name of a photograph
VIGNETTING = "vignetting.json"  # of `Falloffs`
METRICS, LOG = "metrics.json", "log.jsonl"
EVALUATION = "evaluation"  # the folder of pictures, and the name of the .json
CHECKPOINT_FORMAT = 3


def results_folder(path) -> Path:
    """The folder `path`, made if it is missing. Raises NotADirectoryError for a file, OSError if it cannot be made."""
    folder = Path(path)
    if folder.is_file():
        raise NotADirectoryError(f"{folder}: expected a folder for the results, got a file")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:  # which may name a folder above
        raise OSError(
            error.errno, f"the folder for the results cannot be made ({error.strerror})", str(folder)
        ) from None
    return folder


def check_results_folder(path) -> None:
    """Raises what `results_folder` and the first file in it will, as far as can be known without making anything."""
    if str(path) == "":  # of a variable of the shell that is not set, mostly
        raise ValueError("expected the name of a folder for the results, got ''; this folder is '.'")
    folder = Path(path)
    there = next(above for above in (folder, *folder.absolute().parents) if os.path.lexists(above))
    if not there.is_dir():
        raise NotADirectoryError(f"{there}: expected a folder for the results, got a file")
    if not os.access(there, os.W_OK | os.X_OK):
        said = "the folder for the results cannot be written to (Permission denied, or read-only)"
        raise PermissionError(errno.EACCES, said, str(there))


def write_log(path: Path, entries: list[dict]) -> None:
    """One JSON object per line, with null as in `write_json`. Raises OSError."""
    write_text(path, "".join(map(_line, entries)))


def _line(entry: dict) -> str:
    return json.dumps(as_json(entry), allow_nan=False) + "\n"


class Log:
    """log.jsonl, which grows while a training runs.

    Args:
        entries: What there is already. The list may grow; it is written anew where a line could not be added.
    """

    def __init__(self, path: Path, entries: list[dict]):
        self.path, self.entries, self.complete = path, entries, False

    def begin(self) -> None:
        """Writes the entries, and nothing of an earlier file. Raises OSError."""
        write_log(self.path, self.entries)
        self.complete = True

    def add(self, entry: dict) -> None:
        """Adds a line for the last entry. The system has it then, whatever happens to this process.

        Raises OSError, once, if that cannot be done; the file is complete again as soon as it can.
        """
        if self.complete:
            try:
                with self.path.open("a", encoding="utf-8") as file:
                    file.write(_line(entry))
            except OSError:
                self.complete = False
                raise
        else:
            with suppress(OSError):
                self.begin()


def write_scene(
    path: Path,
    scene: Gaussians,
    footprint: str,
    offset: tuple[float, float, float] | None = None,
    order: str | None = None,
) -> None:
    """The scene in a file that says for which footprint and order it is, and what positions are relative to, see
    `View`."""
    io.save_scene(path, scene, io.SceneMetadata(footprint=footprint, offset=offset, order=order))


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    write_safely(path, lambda temporary: torch.save({"format": CHECKPOINT_FORMAT, **state}, temporary))


def read_checkpoint(path: Path, device: str | torch.device = "cpu", mapped: bool = False) -> dict[str, Any]:
    """What `write_checkpoint` wrote. Raises io.SceneError for a file that is missing or something else.

    Args:
        mapped: Leave tensors in the file until they are read, for who needs a part of them; on the CPU.
    """
    if not path.is_file():
        raise io.SceneError(f"{path}: no such file; there is no training to resume")
    try:
        state = torch.load(path, map_location=device, weights_only=True, mmap=mapped)
    except Exception as error:  # torch.load raises a different type for every way in which a file can be broken
        raise io.SceneError(f"{path}: not a checkpoint, or cut short ({type(error).__name__})") from None
    if not isinstance(state, dict) or state.get("format") != CHECKPOINT_FORMAT:
        found = state.get("format") if isinstance(state, dict) else type(state).__name__
        raise io.SceneError(f"{path}: expected a checkpoint of format {CHECKPOINT_FORMAT}, got {found}")
    return state
